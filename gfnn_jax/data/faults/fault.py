"""A mistake in a recording, as its user is told."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any


@dataclasses.dataclass(frozen=True)
class Fault:
    """kind: a word or two. message: what was found. remedy: what mends it. options: those of
    `gfnn_jax.read` that do, if any. wrong: whether a fit must not begin."""

    kind: str
    message: str
    remedy: str
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    wrong: bool = True

    def __str__(self) -> str:
        return f"{self.message}: {self.remedy}"
