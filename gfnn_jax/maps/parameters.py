"""Arguments of a map beside the state: parameters of the system, the time of a periodic drive.

They have names, and ranges in which they were sampled. The time advances with the steps. It is
counted from the step's number: t₀ + n dt, reduced by whole periods without rounding, so that a
rollout of any length keeps the drive's phase.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from gfnn_jax.arrays import as_numbers, as_row, namespace, pytree
from gfnn_jax.phase_space import TIME


class _Options:
    """Ranges of parameters, and gaps in a period."""

    edge: float = 1e-9  # tolerance at the ends of a range, relative to it, for printed numbers
    # A part of a period that no pair covers and that is longer than this, relative to the period,
    # lies outside the data. Harmonics of up to the fourth are learned, which vary over an eighth.
    largest_gap: float = 1 / 8


_HALF_DIGITS = 2.0**27 + 1  # splits a float64 in two halves, whose products are exact (Veltkamp)


@pytree("names")
class Parameters:
    """Names, ranges and period of the arguments of a map.

    names: (k,) in their order. low, high: (k,) the smallest and largest values in the data. period:
    that of a drive, whose time t is then the last name; the data cover it from low to high, at most
    a period later.
    """

    names: tuple[str, ...]
    low: Any
    high: Any
    period: Any = None

    @property
    def bounds(self) -> tuple[Any, Any]:
        """Lower and upper bounds (k,), with a tolerance for numbers that were printed."""
        edge = _Options.edge * (self.high - self.low)
        return self.low - edge, self.high + edge

    def contains(self, args):
        """Return whether the values args (..., k) lie in the ranges of the data: (...).

        NumPy or JAX.
        """
        xp = namespace(args)
        low, high = (as_row(a, args) for a in self.bounds)
        if self.period is not None:
            turns = xp.floor((args[..., -1:] - low[..., -1:]) / self.period)
            args = xp.concatenate([args[..., :-1], args[..., -1:] - turns * self.period], axis=-1)
        return xp.all((args >= low) & (args <= high), axis=-1)

    def after(self, args, steps, dt):
        """Advance args (..., k) by a number of steps (...) of dt. NumPy or JAX.

        The time advances and is reduced by whole periods; the other values stay.
        """
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
    """Make the parameters of the data's values args (N, k).

    With ``period``, the last of the args is the time of a drive at each pair's state. A pair covers
    the time to its image, dt later, a number or (N,).
    """
    low, high = args.min(axis=0), args.max(axis=0)
    if period is not None:
        low[-1], high[-1] = _covered(args[:, -1], np.broadcast_to(dt, len(args)), period)
    return Parameters(names, low, high, period)


def _covered(t0: np.ndarray, dt: np.ndarray, period: float) -> tuple[float, float]:
    """Begin and end of the part of a period that the intervals (t0, t0 + dt) (N,) cover.

    It is the period without the longest gap between the intervals.
    """
    begin = np.mod(t0, period)
    order = np.argsort(begin)
    begin, end = begin[order], np.maximum.accumulate((begin + dt)[order])
    # An interval that reaches into the next period covers the first part of this one.
    gaps = np.append(begin[1:], begin[0] + period) - np.maximum(end, end[-1] - period)
    longest = int(np.argmax(gaps))
    if gaps[longest] <= _Options.largest_gap * period:
        return 0.0, period
    first = begin[(longest + 1) % len(begin)]
    return float(first), float(first + period - gaps[longest])


def as_args(parameters: Parameters | None, given: Any, shape: tuple, dtype, t0: Any = None) -> Any:
    """Convert a user's parameters to args (k,) or (B, k) for states (2d,) or (B, 2d), or None.

    given: name -> a number or (B,), or an array in the order of the names; for a single parameter
    also a number or (B,). t0: the time of a drive, a number or (B,), where it is not in ``given``.
    Raises ValueError, in one line, where they are not the parameters that the map was learned with.
    """
    if t0 is not None:
        given = _with_time(parameters, given, t0)
    if parameters is None:
        if given is not None:
            raise ValueError("expected no params: the map was learned without parameters")
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
        values: Any = [as_numbers(given[name], dtype, "params") for name in names]
        xp = namespace(*values)
        args = xp.stack(xp.broadcast_arrays(*values), axis=-1)
    else:
        args = as_numbers(given, dtype, "params")
        if len(names) == 1 and (args.ndim == 0 or args.shape == shape[:-1] != (1,)):
            args = args[..., None]
    if args.shape not in ((len(names),), (*shape[:-1], len(names))):
        of = f"({len(names)},)" + (f" or ({shape[0]}, {len(names)})" if len(shape) == 2 else "")
        raise ValueError(f"expected params {wanted} of shape {of}, got {args.shape}")
    return args


def _with_time(parameters: Parameters | None, given: Any, t0: Any) -> dict[str, Any]:
    """Return the params by name, including the time of the drive."""
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
                f"expected params {', '.join(others) or 'none'} beside t0, got an array of shape "
                f"{given.shape}"
            )
        given = {name: given[..., i] for i, name in enumerate(others)}
    return {**given, TIME: t0}
