"""Mistakes in a recording that its own data show: columns against each other, times, sensors.

Each check yields faults, one line each: what was found, and what mends it. A fault is *wrong* where
the recording cannot be learned from as it is read; the others are notes.
"""

import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from gfnn_jax.data.columns import SECONDS
from gfnn_jax.data.traits import (
    Traits,
    accelerations,
    fitted,
    functions,
    held_out,
    in_words,
    missed,
    scaled,
    turning_points,
)
from gfnn_jax.errors import advised, as_typed
from gfnn_jax.signals.derivatives import Relation, difference
from gfnn_jax.signals.steps import drift
from gfnn_jax.signals.wrong_values import TURN

WRONG = (
    *("constant", "repeated", "order", "time unit", "no derivative", "degrees", "sign", "factor"),
    *("wrapped", "interpolated jump", "drifting clock", "different systems", "circle"),
    "first order",
)
PROPOSED = ("kind", "let go", "caught", "rounded times", "roles")


class _Options:
    """Thresholds of the checks, chosen on recordings of test systems with and without mistakes
    (`benchmarks/random_recordings.py`, tests of mistakes)."""

    wide: float = 0.75 * np.pi  # rad: step of an angle that may as well be one the other way round
    swing: float = 2 * TURN  # beyond which the unit of an angle that swings is doubted
    drift: float = 5e-3  # relative change of the step over a run
    derivative: float = 0.8  # of a velocity's variance, that the position's derivative explains
    better: float = 0.25  # score by which other pairs of columns are better than the declared ones
    near: float = 0.1  # relative, to a factor like 180/π or 1000
    off: float = 0.2  # logarithm of a factor that no filter makes
    filtered: float = 0.03  # deviation of a factor from 1 that is reported
    late: float = 0.4  # steps of lag that are reported
    most_runs: int = 40  # that are compared as different systems, of so many windows each
    fewest_windows: int = 40
    # A run moves by another law where the common fit misses its accelerations by so many times its
    # own residual, and by this part of their spread.
    worse: float = 6.0
    missed: float = 0.04
    drives: float = 0.9  # of what is missed without a column, that is missed with it as an input


@dataclasses.dataclass(frozen=True)
class Fault:
    """A mistake in a recording.

    kind: one of WRONG, with which a fit must not begin, one of PROPOSED, whose options the command
    to type has too, or of a note. message: what was found. advice: what mends it, "" for nothing to
    do. options: those of `gfnn_jax.read` that do, if any; typed behind advice that ends in a colon.
    """

    kind: str
    message: str
    advice: str = ""
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def wrong(self) -> bool:
        """True where a fit must not begin."""
        return self.kind in WRONG

    @property
    def remedy(self) -> str:
        """Remedy, with the options to type."""
        return advised(self.advice, self.options)

    def __str__(self) -> str:
        return f"{self.message}. {self.remedy}" if self.remedy else self.message


def faults(traits: Traits) -> Iterator[Fault]:
    """All mistakes that are found, in the order of the checks."""
    return (fault for check in _CHECKS for fault in check(traits))


# Columns that a sensor did not measure, or measured badly.


def _constant(traits: Traits) -> Iterator[Fault]:
    recording = traits.recording
    for role in ("positions", "velocities", "momenta", "inputs"):
        for name in getattr(recording, role):
            low, high = traits.range(name)
            if low == high:
                shown = f"{low / recording.factors[name]:g} {recording.unit(name)}".rstrip()
                found = f"{name} is {shown} in all rows"
                kind = "constant input" if role == "inputs" else "constant"
                yield Fault(kind, found, f"Leave it out of --{role}")


def _repeated(traits: Traits) -> Iterator[Fault]:
    for one, other in itertools.combinations(traits.recording.columns, 2):
        low, high = traits.range(one)
        same = np.array_equal(traits.columns[one], traits.columns[other], equal_nan=True)
        if low < high and same:
            found = f"{one} and {other} are equal in all rows"
            yield Fault("repeated", found, f"Leave {other} out")


def _missing(traits: Traits) -> Iterator[Fault]:
    recording = traits.recording
    for name in recording.columns:
        of_runs = zip(recording.runs, traits.by_run(name), strict=True)
        gone = [run for run, x in of_runs if not np.isfinite(x).any()]
        cells = int(np.sum(~np.isfinite(traits.columns[name])))
        if gone:
            yield Fault("missing column", f"{name} has no values in run {', '.join(gone[:8])}")
        elif cells and name not in recording.events:
            rows = "1 row, which is" if cells == 1 else f"{cells} rows, which are"
            yield Fault("missing", f"{name} has no value in {rows} not used for it")


def _wrong_values(traits: Traits) -> Iterator[Fault]:
    """Sensors at their limit, or that repeat one value while the motion goes on, and samples far
    from where those around them lead."""
    told = [in_words(traits.recording, name, of) for name, of in traits.wrong.items()]
    for kind in ("clipped", "stuck", "outliers"):
        yield from (Fault(kind, one[kind], "Left out of a fit") for one in told if kind in one)


# Velocities that are not the derivatives of their positions.


def _related(traits: Traits) -> Iterator[Fault]:
    """The pairs of position and velocity: columns in another order, or factors that mend one."""
    recording = traits.recording
    still = {name for name in recording.columns if np.ptp(traits.range(name)) == 0}
    excluded = still | recording.explained  # what a sensor shows is fitted with the law
    pairs = zip(recording.positions, recording.velocities, strict=False)
    declared = [p for p in pairs if not excluded & set(p) and not _leaps(traits, p[0])]
    known = {pair: r for pair in declared if (r := traits.relation(*pair)) is not None}
    if not known or len(known) < len(declared):
        return
    other = _other_order(traits, declared)
    if other is not None:
        positions, velocities = zip(*other, strict=True)
        finding = ", ".join(f"{v} is the derivative of {x}" for x, v in other)
        yield Fault(
            "order",
            f"the columns are in another order than their names say: {finding}",
            "Name them in that order:",
            {"positions": positions, "velocities": velocities},
        )
        return
    unit = _time_unit(recording.time_unit, [relation.factor for relation in known.values()])
    if unit is not None:
        finding = ", ".join(f"{v} is {r.factor:.4g} × d{x}/dt" for (x, v), r in known.items())
        yield Fault("time unit", finding, f"The times are in {unit}:", {"time_unit": unit})
        return
    for (x, v), relation in known.items():
        yield from _of_pair(traits, x, v, relation)


def _leaps(traits: Traits, x: str) -> bool:
    """Return whether a column that jumps by turns has not been lifted, so that it has no
    derivative."""
    found = _jumps(traits, x)
    return found is not None and not (x in traits.recording.angles and found[0] < 10)


def _other_order(traits: Traits, declared: list[tuple[str, str]]) -> list[tuple[str, str]] | None:
    """The pairs of the same columns that fit much better than the declared ones, or None."""
    if not 1 <= len(declared) <= 3:
        return None
    names = [name for pair in declared for name in pair]
    related = {pair: traits.relation(*pair) for pair in itertools.permutations(names, 2)}
    scores = {pair: 0.0 if r is None else r.likeness for pair, r in related.items()}
    orders = itertools.permutations(names)
    pairings = (list(zip(order[::2], order[1::2], strict=True)) for order in orders)
    best = max(pairings, key=lambda pairs: sum(scores[pair] for pair in pairs))
    gain = sum(scores[pair] for pair in best) - sum(scores[pair] for pair in declared)
    good = gain > _Options.better and all(scores[pair] > 0.9 for pair in best)
    turned = (r for pair in declared if (r := related[pair]) is not None)
    if all(abs(r.factor + 1) < _Options.near and r.explained > 0.9 for r in turned):
        return None  # velocities of the wrong sign: of an oscillator x is that of v, too
    if not good or set(best) == set(declared):
        return None
    return sorted(best, key=lambda pair: names.index(pair[0]))


def _time_unit(unit: str, factors: list[float]) -> str | None:
    """The unit of time that makes all velocities derivatives, if factors are a power of 1000."""
    power = np.round(np.log10(np.abs(factors)) / 3) * 3
    near = np.abs(np.array(factors) / 10.0**power - 1) < _Options.near
    if not near.all() or len(set(power)) > 1 or power[0] == 0:
        return None
    second = SECONDS[unit] / 10.0 ** power[0]
    return next((name for name, s in SECONDS.items() if np.isclose(s, second)), None)


def _of_pair(traits: Traits, x: str, v: str, relation: Relation) -> Iterator[Fault]:
    factor, degree, near = relation.factor, 180 / np.pi, _Options.near
    alone = {"positions": traits.recording.positions}
    without = f"or ignore {v}:{as_typed(alone)}"
    finding = f"{v} is {factor:.4g} × d{x}/dt"
    if relation.explained < _Options.derivative:
        part = f"{100 * relation.explained:.0f} % of its variance"
        finding = f"{v} is not the derivative of {x}: d{x}/dt explains {part}"
        remedy = f"Name {v} as an input ({as_typed({'inputs': (v,)}).strip()}), {without}"
        if _drives(traits, v):
            alone["inputs"] = (*traits.recording.inputs, v)
        yield Fault("no derivative", finding, remedy, alone)
    elif abs(factor * degree - 1) < near:
        yield Fault("degrees", finding, f"The unit of {x} is degrees:", {"degrees": (x,)})
    elif abs(factor / degree - 1) < near:
        remedy = f"The unit of {v} is degrees per second:"
        yield Fault("degrees", finding, remedy, {"degrees": (v,)})
    elif abs(factor + 1) < near:
        yield Fault("sign", finding, f"Change the sign of {v} in the file, {without}", alone)
    elif factor < 0 or abs(np.log(factor)) > _Options.off:
        scale = as_typed({"scale": (v,)}).strip()
        remedy = f"Check its unit, fit its scale ({scale}), {without}"
        yield Fault("factor", finding, remedy, alone)
    else:
        yield from _derived(traits, x, v, relation)


def _drives(traits: Traits, name: str) -> bool:
    """Return whether accelerations follow a column as they follow an input."""
    recording = traits.recording
    angles = [n in recording.angles for n in recording.positions]
    beside = accelerations(traits, (*recording.inputs, name))
    if beside is None:
        return False
    without = dataclasses.replace(beside, u=beside.u[:-1])
    ratio = beside.held_out(angles) / np.maximum(without.held_out(angles), 1e-300)
    return bool(np.any(ratio < _Options.drives))


def _derived(traits: Traits, x: str, v: str, relation: Relation) -> Iterator[Fault]:
    """Notes about a velocity that was made of the position."""
    alone, without = {"positions": traits.recording.positions}, f"To ignore {v}:"
    kind = difference(traits.times, traits.columns[x], traits.columns[v])
    if kind is not None:
        found = f"{v} is the {kind} difference of {x} and adds no information"
        yield Fault("difference", found, without, alone)
        return
    error = max(5 * relation.factor_error, _Options.filtered)
    late = max(5 * relation.lag_error, _Options.late * traits.step)
    if abs(relation.factor - 1) > error or abs(relation.lag) > late:
        shown = f"{relation.factor:.3g} × d{x}/dt with a lag of {1e3 * relation.lag:.2g} ms"
        yield Fault("filtered", f"{v} looks filtered: it is {shown}", without, alone)


# Angles in other units, wrapped angles, and jumps that interpolation has cut.


def _jumps(traits: Traits, name: str) -> tuple[float, int] | None:
    """(2π or 360, how often) where a column that was not lifted jumps by a turn, and else moves by
    much less; None where it does not."""
    raw = traits.raw(name)
    steps = _steps(raw)
    for turn in (TURN, 360.0):
        near = np.abs(steps - turn) < 0.1 * turn
        others = np.sum((steps > 0.3 * turn) & ~near)
        small = len(steps) > 0 and np.quantile(steps, 0.9) < 0.2 * turn
        if near.sum() > 2 * others and small and np.ptp(np.concatenate(raw)) < 1.1 * turn:
            return turn, int(near.sum())
    return None


def _steps(runs: list[np.ndarray]) -> np.ndarray:
    return np.abs(np.concatenate([np.diff(x) for x in runs]))


def _angles(traits: Traits) -> list[str]:
    """Positions that are angles; a coordinate that no column shows directly is none of them."""
    return [name for name in traits.recording.positions if name in traits.recording.angles]


def _units_of_angles(traits: Traits) -> Iterator[Fault]:
    """Angles whose jumps, or whose swings, are too wide for radians."""
    recording = traits.recording
    for name in _angles(traits):
        if recording.factors[name] != 1 or name in recording.explained:
            continue
        option, raw = {"degrees": (name,)}, traits.raw(name)
        jump, swing = _jumps(traits, name), _swing(raw)
        wide = swing > _Options.swing and np.ptp(np.concatenate(raw)) < 720
        if jump is not None and jump[0] == 360:
            found = f"{name} jumps by 360 ({jump[1]} times)"
            yield Fault("degrees", found, "Its unit is degrees:", option)
        elif wide and not _settled(traits, name):
            found = f"{name} swings by {swing:.3g}, degrees or {swing / TURN:.0f} turns in radians"
            radians = as_typed({"angles": recording.angles})
            remedy = f"If degrees:{as_typed(option)}. If radians:{radians}"
            yield Fault("degrees", found, remedy, option)


def _settled(traits: Traits, name: str) -> bool:
    """Return whether a velocity, or the file's unit, has told the unit of this angle already."""
    recording = traits.recording
    place = recording.positions.index(name)
    unit = recording.units.get(name, "")
    return place < len(recording.velocities) or unit.startswith("rad") or recording.angles_given


def _swing(runs: list[np.ndarray]) -> float:
    """The median way between turning points, the ends of runs among them; 0 where nothing turns."""
    ways = [np.empty(0)]
    for x in runs:
        found = turning_points(x, 0.05 * np.ptp(x)) if len(x) and np.ptp(x) > 0 else []
        ways.append(np.abs(np.diff(x[[0, *found, -1]] if len(found) else [])))
    every = np.concatenate(ways)
    return float(np.median(every)) if len(every) else 0.0


def _wraps(traits: Traits) -> Iterator[Fault]:
    """Positions that jump by a turn and were not called angles."""
    for name in traits.recording.positions:
        jump = None if name in traits.recording.angles else _jumps(traits, name)
        if jump is not None:
            option = "degrees" if jump[0] == 360 else "angles"
            found = f"{name} jumps by {jump[0]:.3g} ({jump[1]} times)"
            yield Fault("wrapped", found, "Name it as an angle:", {option: (name,)})


def _interpolated_jumps(traits: Traits) -> Iterator[Fault]:
    """Wrapped angles that were interpolated across their jump: a few steps make a whole turn."""
    for name in _angles(traits):
        count = sum(_cuts(x) for x in traits.raw(name))
        if count:
            jump = "1 jump by a turn takes" if count == 1 else f"{count} jumps by a turn take"
            found = f"{name} was resampled across its wraps: {jump} several samples"
            yield Fault("interpolated jump", found, "Unwrap it first, or resample sine and cosine")


def _cuts(x: np.ndarray) -> int:
    """Jumps of one turn that are spread over 2 to 6 steps."""
    if len(x) < 16 or np.ptp(x) > 1.02 * TURN:
        return 0
    steps = np.diff(x)
    usual = np.median(np.abs(np.angle(np.exp(1j * steps))))
    small = max(6 * usual, 1e-3 * TURN)
    if small > 0.12 * TURN:  # a coarse motion makes such steps by itself
        return 0
    found = np.zeros(len(steps), bool)
    for count in range(2, 7):
        windows = np.lib.stride_tricks.sliding_window_view(steps, count)
        way = windows.sum(axis=1)
        same = np.all(windows > small, axis=1) | np.all(windows < -small, axis=1)
        whole = np.abs(windows).max(axis=1) < 0.93 * TURN
        turn = np.abs(np.abs(way) - TURN) < count * small
        found[: len(way)] |= same & whole & turn
    return int(found.sum())


def _coarse(traits: Traits) -> Iterator[Fault]:
    """Angles whose steps are so wide that their lift is a guess."""
    for name in _angles(traits):
        raw = traits.raw(name)
        steps = _steps(raw)
        wide = int(np.sum(np.abs(np.angle(np.exp(1j * steps))) > _Options.wide))
        is_lift = np.ptp(np.concatenate(raw)) > 1.02 * TURN
        if wide > max(3, 0.01 * len(steps)) and not is_lift:
            found = f"{name} moves by more than 135° in {wide} steps, in an ambiguous direction"
            yield Fault("coarse", found, "Sample faster, or give the unwrapped angle")


# Times in several units, clocks that drift, and runs that do not belong together.


def _time_units(traits: Traits) -> Iterator[Fault]:
    """Runs whose steps are a thousandfold those of the others."""
    for run, t in zip(traits.recording.runs, traits.times, strict=True):
        step = float(np.median(np.diff(t))) if len(t) > 2 else traits.step
        power = np.log10(step / traits.step) / 3
        if abs(power) > 0.9 and abs(power - round(power)) < 0.02:
            found = f"the steps of run {run} are {step:g} s, those of others {traits.step:g} s"
            yield Fault("time unit", found, "Give its times in the unit of the others")


def _drifting(traits: Traits) -> Iterator[Fault]:
    drifts = {run: drift(t) for run, t in zip(traits.recording.runs, traits.times, strict=True)}
    run = max(drifts, key=lambda name: abs(drifts[name]))
    events = traits.recording.events  # whose times are what is measured
    if abs(drifts[run]) > _Options.drift and not events:
        found = f"the time step drifts by {100 * drifts[run]:.2g} % along run {run}"
        remedy = "If the samples are even and the clock drifts, give even steps: --dt"
        yield Fault("drifting clock", found, f"{remedy} {traits.step:g}")


def _systems(traits: Traits) -> Iterator[Fault]:
    runs = _of_other_systems(traits)
    if runs:
        found = f"runs {', '.join(runs[:8])} do not follow the law of the others"
        remedy = "Check their units and signs, name what differs (--parameters), or fit them apart"
        yield Fault("different systems", found, remedy)


def _of_other_systems(traits: Traits) -> list[str]:
    """Names of runs that move by another law than the rest does; none where that cannot be told.

    Accelerations by local polynomials are fitted with functions that small mechanical systems have:
    once for all runs together, and for each run by itself, where one half of its windows is fitted
    and the other judged. Runs of one system lose nothing by being fitted together. Where the
    functions do not describe the runs one by one, nothing can be told."""
    recording, dim = traits.recording, traits.recording.dim
    varied = any(np.ptp(traits.range(name)) > 0 for name in recording.parameters)
    if len(recording.runs) < 2 or not recording.positions or dim > 3 or varied:
        return []
    known = accelerations(traits, recording.inputs)
    if known is None:
        return []
    angles = [n in recording.angles for n in recording.positions]
    table = scaled(functions(known.q, known.v, angles, known.u))
    target, run = known.a.T, known.run
    fewest, most = _Options.fewest_windows, _Options.most_runs
    runs = [r for r in range(len(recording.runs)) if np.sum(run == r) >= fewest][:most]
    if len(runs) < 2:
        return []
    rows = [np.flatnonzero(run == r) for r in runs]
    least = _Options.missed * target.std(axis=0)
    own = np.array([held_out(table[k], target[k]) for k in rows])
    if np.any(own > least):
        return []
    together = np.concatenate(rows)
    common = fitted(table[together], target[together])
    shared = np.array([missed(table[k], target[k], common) for k in rows])
    apart = np.any((shared > _Options.worse * own) & (shared > least), axis=1)
    return [recording.runs[r] for r, is_apart in zip(runs, apart, strict=True) if is_apart]


_CHECKS = (
    *(_constant, _repeated, _related, _units_of_angles, _wraps, _interpolated_jumps),
    *(_time_units, _drifting, _systems, _missing, _wrong_values, _coarse),
    lambda traits: (Fault("reading", note) for note in traits.recording.notes),
)
