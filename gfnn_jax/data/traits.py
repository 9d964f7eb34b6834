"""The traits of a recording's columns that both its summary and the search for mistakes need."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np

from gfnn_jax.data.recording import Recording, lift
from gfnn_jax.signals.derivatives import Derivatives, Relation, derivatives, window
from gfnn_jax.signals.local_polynomials import local_fits
from gfnn_jax.signals.noise import Noise, noise, resolution
from gfnn_jax.signals.steps import median_step
from gfnn_jax.signals.wrong_values import TURN, WrongValues, clipped, wrong_at_jumps, wrong_values


class _Options:
    """Windows of accelerations, fits of these, and which rows and columns count."""

    narrowest: int = 9  # samples of a window
    degree: int = 5  # of its polynomial
    block: int = 8  # windows fitted or judged together
    ridge: float = 1e-8  # of the fits, relative to columns of unit size
    ignored: int = 8  # columns without a role that are looked at, at most
    whole_turn: float = 0.95  # of a turn, within which a wrapped angle has extremes of its own
    gone: float = 0.5  # of the rows; where more lack a position, columns take turns: all rows count


@dataclasses.dataclass(frozen=True)
class Traits:
    """Traits of a recording's columns, from their samples.

    times: (n_r,) of each run. columns: name -> (T,), the runs one after another, angles lifted.
    wrong: stretches of wrong values, of positions and sensors by name. seen: (K,) rows in which
    none of these is missing, and sound: (K',) those in which none is wrong either; noise and local
    are of them. noise, resolution: by name. local: local polynomials of the columns named in
    ``moving``. step: the median one, in s.
    """

    recording: Recording
    times: list[np.ndarray]
    columns: dict[str, np.ndarray]
    wrong: dict[str, tuple[WrongValues, ...]]
    seen: np.ndarray
    sound: np.ndarray
    noise: dict[str, Noise]
    resolution: dict[str, float | None]
    moving: tuple[str, ...]
    local: Derivatives | None
    step: float

    def relation(self, of: str, name: str) -> Relation | None:
        """Column ``name`` against the derivative of column ``of``; None where nothing tells."""
        if self.local is None or not {of, name} <= set(self.moving):
            return None
        return self.local.relation(self.moving.index(of), self.moving.index(name))

    def range(self, name: str) -> tuple[float, float]:
        """The smallest and the largest value of a column, NaN where it has none."""
        known = self.columns[name][np.isfinite(self.columns[name])]
        return (float(known.min()), float(known.max())) if len(known) else (np.nan, np.nan)

    def raw(self, name: str) -> list[np.ndarray]:
        """A column as it came, in radians, without what is missing or wrong, run by run."""
        recording = self.recording
        if wrong := [stretch.rows for stretch in self.wrong.get(name, ())]:
            recording = recording.without({name: np.concatenate(wrong)})
        return [x[np.isfinite(x)] for x in recording.each(recording.values, name)]

    def by_run(self, name: str) -> list[np.ndarray]:
        """A column of `columns`, (n_r,) of each run."""
        return np.split(self.columns[name], np.cumsum([len(t) for t in self.times])[:-1])


def traits(recording: Recording) -> Traits:
    """The traits of a recording, in seconds for a million rows."""
    ignored = [name for name in recording.ignored if name in recording.factors][: _Options.ignored]
    names = [*recording.columns, *ignored]
    times = [recording.times(run) for run in recording.runs]
    columns = {n: np.concatenate(recording.each(recording.unwrapped, n)) for n in names}
    steps = {n: _resolution(recording, n) for n in names}
    shown = (*recording.positions, *recording.sensors)
    wrong = wrong_values_of(recording)
    gone = np.zeros(len(recording), bool)
    for name in shown:
        gone |= ~np.isfinite(columns[name])
    seen = _rows(gone)
    for stretch in (stretch for of in wrong.values() for stretch in of):
        gone[stretch.rows] = True
    sound = _rows(gone)
    sound_times = of_rows(times, sound)
    noises = {}
    inputs = np.stack([columns[n][sound] for n in recording.inputs]) if recording.inputs else None
    driven = [n for n in names if n not in (*recording.inputs, *recording.parameters)]
    for group, by in ((driven, inputs), (recording.inputs, None)):
        if group:
            found = noise(sound_times, np.stack([columns[n][sound] for n in group]), by)
            noises |= dict(zip(group, found, strict=True))
    moving, local = tuple(driven), None
    if moving:
        sigmas = [noises[n].sigma for n in moving]
        table = np.stack([columns[n][sound] for n in moving])
        size = window([noises[n] for n in recording.positions])
        local = derivatives(sound_times, table, size, sigmas)
    step = median_step(times)
    return Traits(recording, times, columns, wrong, seen, sound, noises, steps, moving, local, step)


def of_rows(times: list[np.ndarray], rows: np.ndarray) -> list[np.ndarray]:
    """The times of some rows, of each run, the runs one after another."""
    ends = np.cumsum([len(t) for t in times])[:-1]
    return np.split(np.concatenate(times)[rows], np.searchsorted(rows, ends))


def _rows(gone: np.ndarray) -> np.ndarray:
    """The rows that are not gone, or all where most are."""
    return np.flatnonzero(~gone) if gone.mean() <= _Options.gone else np.arange(len(gone))


def wrong_values_of(recording: Recording) -> dict[str, tuple[WrongValues, ...]]:
    """The wrong values of each position, velocity, sensor and input, by name."""
    times = [recording.times(run) for run in recording.runs]
    found = {}
    limited = {n: _clipped(recording, n) for n in (*recording.positions, *recording.velocities)}
    limited = {name: stretches for name, stretches in limited.items() if stretches}
    rows = {n: np.concatenate([one.rows for one in of]) for n, of in limited.items()}
    recording = recording.without(rows)
    for name in (*recording.positions, *recording.sensors):
        parts, smallest = recording.each(recording.unwrapped, name), _resolution(recording, name)
        found[name] = wrong_values(times, parts, smallest)
        if name in recording.angles:  # one wrong value makes a wrapped angle seem lifted
            lifted = wrong_values(times, [lift(x) for x in parts], smallest)
            known = {int(row) for wrong in found[name] for row in wrong.rows}
            more = [wrong for wrong in lifted if known.isdisjoint(wrong.rows.tolist())]
            found[name] = tuple(sorted([*found[name], *more], key=lambda wrong: wrong.rows[0]))
    for name in recording.inputs:
        parts = recording.each(recording.values, name)
        found[name] = wrong_at_jumps(times, parts, _resolution(recording, name))
    for name, stretches in limited.items():
        found[name] = tuple(
            sorted([*found.get(name, ()), *stretches], key=lambda wrong: wrong.rows[0])
        )
    return found


def _clipped(recording: Recording, name: str) -> tuple[WrongValues, ...]:
    """The stretches in which a column stays at its limit; none of an angle that turns over."""
    parts = recording.each(recording.unwrapped, name)
    known = np.concatenate(parts)
    known = known[np.isfinite(known)]
    turns = len(known) and np.ptp(known) > _Options.whole_turn * TURN
    if name in recording.angles and turns:
        return ()
    return clipped(parts, _resolution(recording, name))


def _resolution(recording: Recording, name: str) -> float | None:
    return resolution(np.concatenate(recording.each(recording.values, name)))


def without_wrong_values(recording: Recording) -> tuple[Recording, tuple[str, ...]]:
    """The recording without its wrong values, and a message for each kind of them in a column."""
    wrong = wrong_values_of(recording)
    rows = {n: np.concatenate([w.rows for w in of]) for n, of in wrong.items() if of}
    lines = (line for name, of in wrong.items() for line in in_words(recording, name, of).values())
    return recording.without(rows), tuple(f"{line}: left out" for line in lines)


def in_words(recording: Recording, name: str, wrong: Sequence[WrongValues]) -> dict[str, str]:
    """The wrong values of a column in a line for each kind of `WrongValues`: how many, where the
    first ones are."""
    times, found = np.concatenate([recording.times(run) for run in recording.runs]), {}
    for kind in ("clipped", "stuck", "outliers"):
        of_kind = [stretch for stretch in wrong if stretch.kind == kind]
        if not of_kind:
            continue
        count, first = sum(len(stretch.rows) for stretch in of_kind), of_kind[0]
        apart = f" in {len(of_kind)} stretches" if 1 < len(of_kind) < count else ""
        run = f" of run {recording.runs[first.run]}" if len(recording.runs) > 1 else ""
        when = f"the first at {times[first.rows[0]]:.6g} s{run}"
        if kind == "clipped":
            factor, unit = recording.factors[name], recording.unit(name)
            limits = sorted({one.limit / factor for one in of_kind if one.limit is not None})
            shown = f"{' and '.join(f'{one:.6g}' for one in limits)} {unit}".rstrip()
            found[kind] = f"{name} saturates at {shown}: {count} samples{apart}, {when}"
        elif kind == "stuck":
            found[kind] = f"{name} is stuck: {count} samples{apart} repeat the one before, {when}"
        else:
            most = max(stretch.off or 0.0 for stretch in of_kind) / recording.factors[name]
            size = f"up to {most:.2g} {recording.unit(name)}".rstrip()
            many = f"{count} outlier{'s' * (count > 1)}{apart}"
            found[kind] = f"{name} has {many}, {size} off, {when}"
    return found


def turning_points(x: np.ndarray, prominence: float) -> np.ndarray:
    """The places, rising, at which x (n,) turns by at least the prominence."""
    from scipy import signal  # takes half a second: loaded when first used

    turns = [signal.find_peaks(sign * x, prominence=prominence)[0] for sign in (1, -1)]
    return np.sort(np.concatenate(turns))


@dataclasses.dataclass(frozen=True)
class Accelerations:
    """Positions q, speeds v, accelerations a (d, W) and inputs u (k, W) at the centres of windows;
    run (W,) and time (W,) of each."""

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    u: np.ndarray
    run: np.ndarray
    time: np.ndarray

    def taken(self, keep: np.ndarray) -> Accelerations:
        """The windows of these places."""
        fields = (getattr(self, f.name) for f in dataclasses.fields(self))
        return Accelerations(*(x[..., keep] for x in fields))

    def held_out(self, angles: Sequence[bool]) -> np.ndarray:
        """RMS (d,) that fits to every other block of windows leave in the blocks between, where
        some positions are angles."""
        return held_out(scaled(functions(self.q, self.v, angles, self.u)), self.a.T)


def accelerations(traits: Traits, inputs: Sequence[str]) -> Accelerations | None:
    """Accelerations of the positions beside some inputs; None where no window holds them."""
    names = traits.recording.positions
    if not names:
        return None
    # Second derivatives want narrower windows than values do.
    size = max(2 * min(traits.noise[n].size for n in names) // 3, _Options.narrowest)
    columns = np.stack([traits.columns[n] for n in (*names, *inputs)])
    fits = local_fits(traits.times, columns, size, _Options.degree)
    if fits is None:
        return None
    dim = len(names)
    (q, v, a), u = (x[:dim] for x in (fits.values, fits.slopes, fits.curvatures)), fits.values[dim:]
    found = Accelerations(q, v, a, u, fits.run, fits.centres)
    known = np.asarray(np.isfinite(np.concatenate([q, v, a, u])).all(axis=0))
    return found.taken(known) if known.sum() >= 2 * _Options.block else None


def scaled(table: np.ndarray) -> np.ndarray:
    """Columns (W, k) of unit size."""
    return table / np.maximum(table.std(axis=0) + np.abs(table.mean(axis=0)), 1e-300)


def fitted(table: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Coefficients of a least-squares fit with a small ridge."""
    normal = table.T @ table / len(table) + _Options.ridge * np.eye(table.shape[1])
    return np.linalg.solve(normal, table.T @ target / len(table))


def missed(table: np.ndarray, target: np.ndarray, c: np.ndarray) -> np.ndarray:
    """RMS (d,) of the accelerations that coefficients leave."""
    return np.sqrt(np.mean((target - table @ c) ** 2, axis=0))


def held_out(table: np.ndarray, target: np.ndarray) -> np.ndarray:
    """RMS (d,) that fits to every other block of windows leave in the blocks between."""
    half = np.arange(len(table)) // _Options.block % 2
    parts = [(half == b, half != b) for b in (0, 1)]
    left = [missed(table[a], target[a], fitted(table[b], target[b])) for a, b in parts]
    return np.sqrt(np.mean(np.square(left), axis=0))


def functions(q: np.ndarray, v: np.ndarray, angles: Sequence[bool], u: np.ndarray) -> np.ndarray:
    """(W, k) functions of positions, speeds and inputs that accelerations are made of."""
    found = [np.ones_like(q[0]), *v, *(x * np.abs(x) for x in v), *u]
    scaled = (q - q.mean(axis=1, keepdims=True)) / np.maximum(q.std(axis=1, keepdims=True), 1e-300)
    for x, s, angle in zip(q, scaled, angles, strict=True):
        found += [np.sin(x), np.cos(x), np.sin(2 * x), np.cos(2 * x)] if angle else [s, s**2, s**3]
    for i, j in itertools.combinations(range(len(q)), 2):
        if not (angles[i] and angles[j]):
            found.append(scaled[i] * scaled[j])
            continue
        apart, products = q[i] - q[j], (v[i] ** 2, v[j] ** 2, v[i] * v[j])
        found += [f(m * apart) for m in (1, 2) for f in (np.sin, np.cos)]
        found += [f(apart) * w for f in (np.sin, np.cos) for w in products]
    return np.stack(found, axis=1)
