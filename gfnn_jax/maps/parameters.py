"""What a map depends on beside the state, by name: parameters of the system and the time of a
periodic drive, and where they were sampled.

The time moves on with the steps. It is counted from the step's number, t₀ + n dt reduced by whole
periods without rounding, so that a rollout of any length does not lose the drive's phase.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import numpy as np

from gfnn_jax.arrays import as_row, namespace
from gfnn_jax.phase_space import TIME

_EDGE = 1e-9  # of the range: what a printed number may miss its end by
# Of a period: a part of it that no pair has seen and that is longer is not known. Harmonics of up
# to the fourth are learned, which vary over an eighth.
_UNSEEN = 1 / 8
_HALF_DIGITS = 2.0**27 + 1  # splits a float64 in two halves, whose products are exact (Veltkamp)


@partial(
    jax.tree_util.register_dataclass,
    data_fields=("low", "high", "period"),
    meta_fields=("names",),
)
@dataclasses.dataclass(frozen=True, eq=False)
class Parameters:
    """names (k,) in their order; low, high (k,): the smallest and largest values of the data.
    period: of a drive, whose time t is then the last name; the data saw it from low to high, at
    most a period later."""

    names: tuple[str, ...]
    low: Any
    high: Any
    period: Any = None

    @property
    def bounds(self) -> tuple[Any, Any]:
        """(k,) each: low and high, and what a printed number may miss them by."""
        edge = _EDGE * (self.high - self.low)
        return self.low - edge, self.high + edge

    def contains(self, args):
        """Whether the values args (..., k) lie where data were: (...). NumPy or JAX."""
        xp = namespace(args)
        low, high = (as_row(a, args) for a in self.bounds)
        if self.period is not None:
            turns = xp.floor((args[..., -1:] - low[..., -1:]) / self.period)
            args = xp.concatenate([args[..., :-1], args[..., -1:] - turns * self.period], axis=-1)
        return xp.all((args >= low) & (args <= high), axis=-1)

    def after(self, args, steps, dt):
        """args (..., k) that many steps (...) of dt later: the time goes on, reduced by whole
        periods. NumPy or JAX."""
        if self.period is None:
            return args
        xp = namespace(args, steps)
        steps = xp.asarray(steps, dtype=args.dtype)
        # The product of a whole number below 2^27 with either half of dt has no more than 53 bits.
        wide = _HALF_DIGITS * dt
        upper = wide - (wide - dt)
        time = xp.fmod(steps * upper, self.period) + steps * (dt - upper)
        time = xp.fmod(args[..., -1] + time, self.period)
        still = xp.broadcast_to(args[..., :-1], (*time.shape, args.shape[-1] - 1))
        return xp.concatenate([still, time[..., None]], axis=-1)


def sampled(
    names: tuple[str, ...], args: np.ndarray, dt: Any = 0.0, period: float | None = None
) -> Parameters:
    """Those of the data's values args (N, k); of a drive its time is that from a pair's state to
    its image, dt later, a number or (N,)."""
    low, high = args.min(axis=0), args.max(axis=0)
    if period is not None:
        low[-1], high[-1] = _seen(args[:, -1], np.broadcast_to(dt, len(args)), period)
    return Parameters(names, low, high, period)


def _seen(t0: np.ndarray, dt: np.ndarray, period: float) -> tuple[float, float]:
    """From when to when the intervals (t0, t0 + dt) (N,) see a drive: all but the longest part of
    its period that none does."""
    begin = np.mod(t0, period)
    order = np.argsort(begin)
    begin, end = begin[order], np.maximum.accumulate((begin + dt)[order])
    # What reaches into the next period has seen its first part.
    gaps = np.append(begin[1:], begin[0] + period) - np.maximum(end, end[-1] - period)
    longest = int(np.argmax(gaps))
    if gaps[longest] <= _UNSEEN * period:
        return 0.0, period
    first = begin[(longest + 1) % len(begin)]
    return float(first), float(first + period - gaps[longest])


def as_args(parameters: Parameters | None, given: Any, shape: tuple, dtype, t0: Any = None) -> Any:
    """What steps of states of this shape, (2d,) or (B, 2d), take: (k,) or (B, k), or None.

    given: name -> a number or (B,), or an array of the names' order; of one parameter also a
    number or (B,). t0: the time of a drive, a number or (B,), where it is not among them. Raises
    ValueError, in one line, where it is not what the map was learned with.
    """
    if t0 is not None:
        given = _with_time(parameters, given, t0)
    if parameters is None:
        if given is not None:
            raise ValueError("expected no params: the map was learned without")
        return None
    names = parameters.names
    wanted = ", ".join(names)
    if given is None and parameters.period is not None:
        own = f"params {', '.join(names[:-1])} and " if len(names) > 1 else ""
        raise ValueError(f"expected {own}t0, the time of the drive that the map was learned with")
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


def _with_time(parameters: Parameters | None, given: Any, t0: Any) -> dict[str, Any]:
    """The params by name, the time of the drive among them."""
    if parameters is None or parameters.period is None:
        raise ValueError("expected no t0: the map was learned without a drive")
    others = parameters.names[:-1]
    if given is None:
        given = {}
    elif not isinstance(given, Mapping):
        given = given if hasattr(given, "ndim") else np.asarray(given)
        given = given[..., None] if len(others) == 1 and given.shape[-1:] != (1,) else given
        if given.ndim not in (1, 2) or given.shape[-1] != len(others):
            raise ValueError(
                f"expected params {', '.join(others) or 'none'} beside t0, got {given.shape}"
            )
        given = {name: given[..., i] for i, name in enumerate(others)}
    return {**given, TIME: t0}


def _numbers(values: Any, dtype) -> Any:
    if isinstance(values, jax.Array):
        return values if values.dtype == dtype else values.astype(dtype)
    try:
        return np.asarray(values, dtype)
    except (TypeError, ValueError):
        raise ValueError(f"expected numbers as params, got {values!r}") from None
