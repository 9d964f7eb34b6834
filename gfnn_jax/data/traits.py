"""The traits of a recording's columns that both its summary and the search for mistakes need."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from gfnn_jax.data.wrong_values import WrongValues, wrong_values_of
from gfnn_jax.signals.derivatives import Derivatives, Relation, derivatives, window
from gfnn_jax.signals.noise import Noise, noise, resolution
from gfnn_jax.signals.steps import median_step

if TYPE_CHECKING:
    from gfnn_jax.data.recording import Recording

_MOST_IGNORED = 8  # columns without a role that are looked at
_MOST_GONE = 0.5  # of the rows; where more lack a position, columns take turns, and all rows count


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
        found = [recording.values(name, run) for run in recording.runs]
        return [x[np.isfinite(x)] for x in found]

    def by_run(self, name: str) -> list[np.ndarray]:
        """A column of `columns`, (n_r,) of each run."""
        return np.split(self.columns[name], np.cumsum([len(t) for t in self.times])[:-1])


def traits(recording: Recording) -> Traits:
    """The traits of a recording, in seconds for a million rows."""
    ignored = [name for name in recording.ignored if name in recording.factors][:_MOST_IGNORED]
    names = [*recording.columns, *ignored]
    times = [recording.times(run) for run in recording.runs]
    columns = {
        name: np.concatenate([recording.unwrapped(name, run) for run in recording.runs])
        for name in names
    }
    steps = {
        n: resolution(np.concatenate([recording.values(n, run) for run in recording.runs]))
        for n in names
    }
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
    return np.flatnonzero(~gone) if gone.mean() <= _MOST_GONE else np.arange(len(gone))
