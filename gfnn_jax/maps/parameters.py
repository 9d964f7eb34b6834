"""The parameters of the systems that a map was learned from: their names, and where they were
sampled."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import numpy as np

from gfnn_jax.arrays import as_row, namespace

_EDGE = 1e-9  # of the range: what a printed number may miss its end by


@partial(
    jax.tree_util.register_dataclass, data_fields=("low", "high"), meta_fields=("names",)
)  # fmt: skip
@dataclasses.dataclass(frozen=True, eq=False)
class Parameters:
    """names (k,) in their order; low, high (k,): the smallest and largest values of the data."""

    names: tuple[str, ...]
    low: Any
    high: Any

    def contains(self, args):
        """Whether the values args (..., k) lie where data were: (...). NumPy or JAX."""
        edge = _EDGE * (self.high - self.low)
        low, high = (as_row(a, args) for a in (self.low - edge, self.high + edge))
        return namespace(args).all((args >= low) & (args <= high), axis=-1)


def sampled(names: tuple[str, ...], args: np.ndarray) -> Parameters:
    """Those of the data's values args (N, k)."""
    return Parameters(names, args.min(axis=0), args.max(axis=0))


def as_args(parameters: Parameters | None, given: Any, shape: tuple[int, ...], dtype) -> Any:
    """What steps of states of this shape, (2d,) or (B, 2d), take: (k,) or (B, k), or None.

    given: name -> a number or (B,), or an array of the names' order; of one parameter also a
    number or (B,). Raises ValueError, in one line, where it is not what the map was learned with.
    """
    if parameters is None:
        if given is not None:
            raise ValueError("expected no params: the map was learned without")
        return None
    names = parameters.names
    wanted = ", ".join(names)
    if given is None:
        raise ValueError(f"expected params {wanted}, which the map was learned with; got none")
    if isinstance(given, Mapping):
        if set(given) != set(names):
            raise ValueError(f"expected params {wanted}; got {', '.join(map(str, given)) or '{}'}")
        values: Any = [_numbers(given[name], dtype) for name in names]
        xp = namespace(*values)
        args = xp.stack(xp.broadcast_arrays(*values), axis=-1)
    else:
        args = _numbers(given, dtype)
        if len(names) == 1 and (args.ndim == 0 or args.shape == shape[:-1] != (1,)):
            args = args[..., None]
    if args.shape not in ((len(names),), (*shape[:-1], len(names))):
        of = f"({len(names)},)" + (f" or ({shape[0]}, {len(names)})" if len(shape) == 2 else "")
        raise ValueError(f"expected params {wanted} of shape {of}, got {args.shape}")
    return args


def _numbers(values: Any, dtype) -> Any:
    if isinstance(values, jax.Array):
        return values if values.dtype == dtype else values.astype(dtype)
    try:
        return np.asarray(values, dtype)
    except (TypeError, ValueError):
        raise ValueError(f"expected numbers as params, got {values!r}") from None
