"""Three positions in a row, of every run: what an S of positions alone is learned from. NumPy."""

from __future__ import annotations

import dataclasses

import numpy as np

from gfnn_jax.coordinates import Coordinates, lift, lift_sites, nearest_image
from gfnn_jax.data.recording import Recording
from gfnn_jax.errors import FitError

_EVEN = 0.01  # of a time step, by which times may miss an even grid
_HALF_TURN = np.pi  # moves of two lifts differ by whole turns
_ONE_TURN = 2 * np.pi * (1 + 1e-3)  # a column that ranges over more is a lift


@dataclasses.dataclass(frozen=True)
class Triples:
    """Positions q₋, q, q₊ (N, d) each, one step apart, so that their differences are the moves.

    run, place: (N,) the number of the run of each, in rising order, and its place there. dt: the
    time of a step; 1 where the recording has none. angles: indices of positions of period 2π.
    wrapped: whether their readings are known modulo 2π, and moves were lifted so as to be
    continuous over the data.
    """

    before: np.ndarray
    middle: np.ndarray
    after: np.ndarray
    run: np.ndarray
    place: np.ndarray
    dt: float
    angles: tuple[int, ...] = ()
    wrapped: bool = False

    def __len__(self) -> int:
        return len(self.middle)

    @property
    def dim(self) -> int:
        """Degrees of freedom d."""
        return self.middle.shape[1]

    def take(self, rows) -> Triples:
        """Triples of these rows."""
        names = ("before", "middle", "after", "run", "place")
        return dataclasses.replace(self, **{name: getattr(self, name)[rows] for name in names})

    def stretches(self) -> list[np.ndarray]:
        """Positions (n + 2, d) of every n triples in a row: those of one run whose moves go on from
        one to the next, each read once."""
        goes_on = (np.diff(self.run) == 0) & (np.diff(self.place) == 1)
        coming, going = np.split(self.moves, 2)
        goes_on &= np.abs(coming[1:] - going[:-1]).max(axis=1, initial=0.0) < _HALF_TURN
        found = []
        for rows in np.split(np.arange(len(self)), 1 + np.flatnonzero(~goes_on)):
            moves = np.concatenate([coming[rows[:1]], going[rows]])
            found.append(np.cumsum(np.concatenate([self.before[rows[:1]], moves]), axis=0))
        return found

    @property
    def moves(self) -> np.ndarray:
        """(2N, d): all displacements, first those to the middle."""
        return np.concatenate([self.middle - self.before, self.after - self.middle])

    @property
    def ends(self) -> np.ndarray:
        """(2N, 2d): the points w = (q, Q) of all displacements, in the same order."""
        first = np.concatenate([self.before, self.middle], axis=1)
        return np.concatenate([first, np.concatenate([self.middle, self.after], axis=1)])


def triples_of(recording: Recording, *, sites: bool = False) -> Triples:
    """The triples of a recording of positions, without those that have a missing value.

    sites: whether the positions are those of equal sites. Raises FitError where there are none, or
    the times are not even.
    """
    names = recording.positions
    if not names:
        raise FitError(f"{recording.source}: expected positions, got none")
    angles = tuple(names.index(name) for name in recording.angles)
    rows, runs, places, steps = [], [], [], []
    for number, run in enumerate(recording.runs):
        q, times = recording.array("positions", run), recording.times(run)
        if len(q) < 3:
            continue
        own = np.stack([q[:-2], q[1:-1], q[2:]], axis=1)
        known = np.isfinite(own).all(axis=(1, 2))
        rows.append(own[known])
        runs.append(np.full(known.sum(), number))
        places.append(np.flatnonzero(known))
        steps.append(np.stack([times[1:-1] - times[:-2], times[2:] - times[1:-1]], axis=1)[known])
    q = np.concatenate(rows) if rows else np.empty((0, 3, len(names)))
    if not len(q):
        raise FitError(
            f"{recording.source}: no run has three rows in succession with all positions"
        )
    dt = float(np.median(np.concatenate(steps)))
    off = np.abs(np.concatenate(steps) - dt).max()
    if off > _EVEN * dt:
        raise FitError(
            f"{recording.source}: a map needs positions at even times; the step is {dt:g} s, and "
            f"some are off by {off:.2g} s. A law takes uneven times: --learn lagrangian (learn=)"
        )
    whole = np.concatenate([recording.array("positions", run) for run in recording.runs])
    wrapped = bool(angles) and bool(np.nanmax(np.ptp(whole[:, angles], axis=0)) <= _ONE_TURN)
    run, place = np.concatenate(runs), np.concatenate(places)
    found = Triples(q[:, 0], q[:, 1], q[:, 2], run, place, dt, angles, wrapped)
    return _lifted(found, sites) if wrapped else found


def _lifted(triples: Triples, sites: bool) -> Triples:
    """Make moves continuous over the data: those to the middle within a turn, those from
    it as the states (q, Q − q) around them move."""
    dim, q = triples.dim, triples.middle
    angles = (*triples.angles, *(dim + i for i in triples.angles))
    coming, going = (
        nearest_image(move, triples.angles) for move in (q - triples.before, triples.after - q)
    )
    states = np.concatenate([q, coming], axis=1), np.concatenate([q + going, going], axis=1)
    z0, z1, _, _ = (lift_sites if sites else lift)(*states, Coordinates("positions", angles))
    middle, coming, going = z0[:, :dim], z0[:, dim:], z1[:, dim:]
    return dataclasses.replace(triples, before=middle - coming, middle=middle, after=middle + going)
