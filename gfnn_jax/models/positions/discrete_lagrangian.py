"""S(q, Q) from positions alone: a discrete Lagrangian, by one linear least-squares problem.

A type-1 generating function gives p = −h ∂S/∂q and P = h ∂S/∂Q. The momentum between two steps is
the same from either side, so that three positions in a row obey the discrete Euler–Lagrange
equations (Marsden & West, Acta Numerica 10 (2001) 357, eq. (1.3.3))

    ∂₂S(q₋, q) + ∂₁S(q, q₊) = 0,

which are linear in S and hold no momenta. Positions leave S open by a factor, by a constant and by
f(Q) − f(q). The factor is fixed by the mixed term: the mean of −h² ∂²S/∂q_i∂Q_i over the data is 1,
in the mean over the coordinates, each weighed by its mean square displacement. Of what is left
open, S is the one nearest to that of free motion, ½ |Q − q|² / h², in its coefficients: a symmetric
S has no f(Q) − f(q), but systems of one degree of freedom, or of several without coupling, leave
more open.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.coordinates import Coordinates, lift, lift_sites, nearest_image
from gfnn_jax.data.recording import Recording
from gfnn_jax.errors import FitError


class Options:
    """Options of the linear problem of S(q, Q), and of its data (benchmarks/positions.py)."""

    even: float = 0.01  # of a time step, by which times may miss an even grid
    sampled: int = 2_000  # positions by which the mixed term is taken
    # of the largest singular value: a smaller one is a combination that nothing tells
    null: float = 1e-13
    rows: int = 4_096  # of a part that is folded, and four for each term
    # of a displacement, by which mixed derivatives of terms are differences
    difference: float = 1e-4


_HALF_TURN = np.pi  # moves of two lifts differ by whole turns


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
    if off > Options.even * dt:
        raise FitError(
            f"{recording.source}: a map needs positions at even times; the step is {dt:g} s, and "
            f"some are off by {off:.2g} s. A law takes uneven times: --learn lagrangian"
        )
    whole = np.concatenate([recording.array("positions", run) for run in recording.runs])
    lifted = 2 * np.pi * (1 + 1e-3)  # a column that ranges over more is a lift
    wrapped = bool(angles) and bool(np.nanmax(np.ptp(whole[:, angles], axis=0)) <= lifted)
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


class Solved(NamedTuple):
    """The coefficients of S (m,), how many of their combinations the data tell, and the condition
    number of these.

    All S of this mixed term that the data can tell apart are ``free`` (m,), free motion, plus
    combinations of the orthonormal columns of ``determined`` (m, n). root: (n, m), rootᵀ root
    the covariance of the coefficients where what is left of the equations, in units of
    displacements, has standard deviation 1.
    """

    coefficients: np.ndarray
    rank: int
    condition: float
    free: np.ndarray
    determined: np.ndarray
    root: np.ndarray


def equations(family: Any, triples: Triples, size: np.ndarray) -> np.ndarray:
    """Contribution of each term to the Euler–Lagrange equations, h² ÷ the coordinates' sizes (d,)
    times: (N, d, m)."""
    count, dim = len(triples), triples.dim
    gradients = family.term_gradients(triples.ends)
    left = gradients[:count, dim:] + gradients[count:, :dim]
    return left * (triples.dt**2 / size)[:, None]


def displacement(triples: Triples) -> np.ndarray:
    """(d,) roots of the mean square displacements."""
    size = np.sqrt(np.mean(triples.moves**2, axis=0))
    return np.where(size > 0, size, 1.0)


def solve(family: Any, triples: Triples) -> Solved:
    """S of these triples: least squares among the S of this mixed term, nearest to free motion."""
    triangle = _folded(family, triples)
    mixed, w = _mixed_terms(family, triples), _sample(triples)
    # Coefficients of free motion, ½ |Q − q|² / h².
    moves = (w[:, triples.dim :] - w[:, : triples.dim]) / triples.dt**2
    target = np.concatenate([-moves, moves], axis=1)
    rows = family.term_gradients(w).reshape(target.size, -1)
    free = np.linalg.lstsq(rows, target.ravel(), rcond=Options.null)[0]
    free = free / (mixed @ free)
    # The changes of S that leave the mixed term as it is: all but the first column of Q.
    others = np.linalg.qr(np.column_stack([mixed, np.eye(len(mixed))]))[0][:, 1 : len(mixed)]
    u, values, v = np.linalg.svd(triangle @ others, full_matrices=False)
    determined = values > Options.null * values[0]
    along = u[:, determined].T @ (triangle @ free)
    coefficients = free - others @ (v[determined].T @ (along / values[determined]))
    condition = float(values[0] / values[determined][-1])
    directions = others @ v[determined].T
    root = (directions / values[determined]).T
    return Solved(coefficients, 1 + int(determined.sum()), condition, free, directions, root)


def residuals(family: Any, params: Any, triples: Triples) -> np.ndarray:
    """(N, d): h² times what S leaves of the equations, in units of the positions: about the error
    of q₊, where the mixed term is about 1 everywhere."""
    count, dim = len(triples), triples.dim
    gradient = np.asarray(family.gradient(params, triples.ends))
    return triples.dt**2 * (gradient[:count, dim:] + gradient[count:, :dim])


def _mixed_terms(family: Any, triples: Triples) -> np.ndarray:
    """Mean of −h² ∂²/∂q_i∂Q_i of every term of S, weighed as above: (m,)."""
    dim, w, size = triples.dim, _sample(triples), displacement(triples)
    total = np.zeros(family.num_parameters)
    for i, step in enumerate(Options.difference * size):
        off = np.zeros(2 * dim)
        off[i] = step
        ahead, behind = (family.term_gradients(v)[:, dim + i] for v in (w + off, w - off))
        total += size[i] ** 2 * np.mean(ahead - behind, axis=0) / (2 * step)
    return -(triples.dt**2) * total / np.sum(size**2)


def _sample(triples: Triples) -> np.ndarray:
    """Sample of the points w = (q, Q)."""
    return triples.ends[:: max(1, 2 * len(triples) * triples.dim // Options.sampled)]


def _folded(family: Any, triples: Triples) -> np.ndarray:
    """The triangular factor (m, m) of all equations, part by part: memory stays that of a part."""
    m, size = family.num_parameters, displacement(triples)
    part = max(1, (4 * m + Options.rows) // triples.dim)
    rows = np.empty((0, m))
    for first in range(0, len(triples), part):
        new = equations(family, triples.take(slice(first, first + part)), size)
        rows = np.asarray(np.linalg.qr(np.concatenate([rows, new.reshape(-1, m)]), mode="r"))
    return rows
