"""Families of the generating function S(params, w)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from jax.tree_util import Partial, all_leaves


def as_pytree(scalar: Callable) -> Any:
    """A scalar that can be passed to compiled code: a family as it is, a function wrapped."""
    return Partial(scalar) if callable(scalar) and all_leaves((scalar,)) else scalar
