"""Pairs that differ in more than their states: in the time between them, in parameters, in the
time of a drive.

A Hamiltonian serves any dt and, as a function of the parameters too, any system of the family. A
generating function is that of one map; in the midpoint chart it may be a function of dt as well.
"""

import dataclasses
from typing import Any

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.errors import FitError, InputError
from gfnn_jax.families.expressions import check_names
from gfnn_jax.phase_space import TIME, Pairs, sizes


class _Options:
    """Times and parameters that count as one."""

    same: float = 1e-9  # of its size: a parameter, or a dt, that varies by less does not
    printed: float = 1e-5  # of dt: what printed times may differ by
    nearly_all: float = 0.9  # of the pairs


_OF_DT = ("auto", "polynomial")  # families of an S of dt


def check_varied(pairs: Pairs) -> None:
    """Raises FitError, in one line, for a dt of each pair or args that cannot be used."""
    args = pairs.args or {}
    if (TIME in args) != (pairs.period is not None):
        came = "t0 without a period" if TIME in args else "a period without t0"
        raise FitError(f"expected t0, the time of a drive, together with its period; got {came}")
    if pairs.period is not None and not (
        np.ndim(pairs.period) == 0
        and np.asarray(pairs.period).dtype.kind in "fiu"
        and 0 < float(pairs.period) < np.inf
    ):
        wanted = "a number that is finite and above 0 as the drive's period"
        raise FitError(f"expected {wanted}, got {pairs.period!r}")
    try:
        check_names(pairs.dim, tuple(name for name in args if name != TIME))
    except InputError as error:
        raise FitError(str(error)) from error
    columns = {"dt": np.asarray(pairs.dt)} if np.ndim(pairs.dt) else {}
    for name, values in {**columns, **args}.items():
        if np.asarray(values).dtype.kind not in "fiu":
            raise FitError(f"expected {name} of real numbers, got {np.asarray(values).dtype}")
        bad = ~np.isfinite(values) | (values <= 0 if name == "dt" else False)
        if bad.any():
            what = "finite time steps above 0" if name == "dt" else f"finite values of {name}"
            row = int(np.argmax(bad))
            got = f"{int(bad.sum())} of {len(bad)} that are not"
            raise FitError(f"expected {what}, got {got}, the first is {values[row]} in row {row}")


def as_varied(
    pairs: Pairs, *, learn: str, family: Any, chart: str, base: Any, structure: Any = None
) -> tuple[Pairs, str, list[str]]:
    """Return the pairs as they vary, what is learned of them, and messages for the user.

    The options are those of a fit; a family is a name or a user's object. A dt that is the same in
    all is one number; so is one that is the same in nearly all, and the others, those across a gap,
    are left out unless only H is asked for. A parameter that is the same in all is left out; so is
    the time of a drive, with a message. Of pairs of different dt H is learned, or S of dt and w in
    the midpoint chart; of pairs that differ in dt and in parameters, or of sites, H alone. Raises
    FitError where anything else is asked for.
    """
    pairs, messages = without_constants(pairs)
    if np.ndim(pairs.dt) and learn != "hamiltonian":
        usual = np.median(pairs.dt)
        rows = np.flatnonzero(np.abs(pairs.dt - usual) <= _Options.printed * usual)
        if len(rows) >= _Options.nearly_all * len(pairs):
            messages.append(
                f"{len(pairs) - len(rows)} of {len(pairs)} pairs are not dt = {usual:g} apart: "
                "they are left out (--learn hamiltonian uses them)"
            )
            pairs = pairs.take(rows)
            pairs = dataclasses.replace(pairs, dt=float(np.mean(pairs.dt)))
    differs = "dt" if np.ndim(pairs.dt) else "parameters" if pairs.args else None
    if differs is None:
        return pairs, learn, messages
    families = ("auto",) if pairs.period is not None else ("auto", "polynomial")
    if differs == "parameters" and family in families and base is None:
        return pairs, "map" if (family, chart) != ("auto", "auto") else learn, messages
    of_dt = differs == "dt" and not pairs.args and structure is None and learn != "hamiltonian"
    if of_dt and base is None and family in _OF_DT and chart in ("auto", "midpoint"):
        return pairs, learn, messages
    asked = {"learn": learn, "family": family, "chart": chart}
    came = [f"{name}={value!r}" for name, value in asked.items() if value != "auto"]
    came += ["a base"] if base is not None else []
    if differs == "parameters":
        what, expected = "parameters", f"family {' or '.join(map(repr, families))} and no base"
    elif of_dt:
        what = "dt"
        expected = "family 'auto' or 'polynomial', chart 'auto' or 'midpoint' and no base"
    else:
        what = "dt and in parameters" if pairs.args else "dt"
        expected = "learn='hamiltonian', and no family, chart or base"
    if came and came != ["learn='hamiltonian'"]:
        got = ", ".join(came)
        raise FitError(f"the pairs differ in their {what}: expected {expected}, got {got}")
    return pairs, "hamiltonian", messages


def without_constants(pairs: Pairs) -> tuple[Pairs, list[str]]:
    """The pairs without a dt, parameters or a phase of a drive that are the same in all, and
    messages."""
    dt = np.asarray(pairs.dt)
    one = float(np.mean(dt)) if dt.ndim and np.ptp(dt) <= _Options.same * np.mean(dt) else pairs.dt
    args = {name: np.asarray(v, np.float64) for name, v in (pairs.args or {}).items()}
    still = [name for name, v in args.items() if np.ptp(v) <= _Options.same * np.abs(v).max()]
    period, own_time = pairs.period, []
    if period is not None:
        args[TIME] = np.mod(args[TIME], period)
        still = [name for name in still if name != TIME]
        apart = np.mod(args[TIME] - args[TIME][0] + 0.5 * period, period) - 0.5 * period
        if not np.ndim(one) and np.ptp(apart) <= _Options.same * period:
            own_time = [_one_phase(args.pop(TIME)[0], one, period)]
            period = None
    kept = {name: v for name, v in args.items() if name not in still}
    messages = [
        f"the parameter {name} is {args[name][0]:g} in all pairs: it is left out, for its effect "
        "is not known"
        for name in still
    ]
    varied = dataclasses.replace(pairs, dt=one, args=kept or None, t0=None, period=period)
    return varied, own_time + messages


def _one_phase(t0: float, dt: float, period: float) -> str:
    message = f"all pairs begin at the phase t = {t0:g} of the drive: the map from there is learned"
    turns = dt / period
    if abs(turns - round(turns)) <= _Options.same * max(turns, 1.0) and round(turns) > 0:
        return (
            f"{message}, that of {round(turns)} whole period{'s' * (round(turns) > 1)} of the drive"
        )
    return (
        f"{message}. A second step begins at another phase, for dt = {dt:g} is no whole number of "
        "periods: do not iterate this map. Sample pairs at several phases (t0)"
    )


def given_by(data: Dataset) -> np.ndarray | None:
    """Args and dt that a pair's move depends on beside its state, (N, k) of unit sizes; None for
    nothing."""
    if not data.varied:
        return None
    columns = [] if data.own_dt is None else [data.own_dt]
    columns += [] if data.args is None else list(data.args.T)
    given = np.column_stack(columns)
    return given / sizes(given)
