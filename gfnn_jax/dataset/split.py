"""Split of the pairs: those that train a fit, those that choose, those that state the error.

Training rows determine coefficients. Validation rows choose: size, chart, terms. Test rows are
looked at once, when all is chosen, and state the error. Runs are kept whole, or cut into
blocks of time, since two pairs of one orbit that share a state's noise would judge each other too
kindly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gfnn_jax.dataset.runs import steps_between
from gfnn_jax.phase_space import Pairs, sizes


class Options:
    """Options of the split (benchmarks/stated_errors.py)."""

    # Of the pairs, those that validate, and again those that test: a part, at least, at most.
    fraction: float = 0.1
    fewest: int = 4
    most: int = 2_000
    # Fewer pairs than these have none to spare for a test: they state the error by cross-
    # validation.
    fewest_split: int = 60
    parts: int = 4  # blocks that are held out, of one long run
    outside: float = 0.05  # of the training pairs, by which errors outside the data are measured


def enough_to_state() -> int:
    """Pairs of runs, of which three stretches or more are held out to state an error: fewer have no
    scatter that bounds it."""
    return int(3 * Options.fewest / Options.fraction)


class Split(NamedTuple):
    """Rows (n,) of each part, shuffled. test: empty where the pairs are few. stretch: (N,) the
    number of the stretch of a run that each row is in; rows of different stretches, two correlation
    times long or more, err independently."""

    training: np.ndarray
    validation: np.ndarray
    test: np.ndarray
    stretch: np.ndarray

    def take(self, rows: np.ndarray) -> Split:
        """The split of these rows alone, (n,) of the N rows, each in its part."""
        place = np.full(len(self.stretch), -1)
        place[rows] = np.arange(len(rows))
        train, validation, test = (p[p >= 0] for p in (place[part] for part in self[:3]))
        return Split(train, validation, test, self.stretch[rows])


def split_rows(pairs: Pairs, seed: int) -> Split:
    """Training, validation and test rows, drawn by the seed.

    pairs: with their runs and places. Whole runs are held out; a run longer than all that is to be
    held out is cut into blocks of time first, between which a correlation time is left out.
    """
    rng, count = np.random.default_rng(seed), len(pairs)
    target = max(Options.fewest, int(Options.fraction * count))
    tested = count >= Options.fewest_split
    goes_on = steps_between(pairs) > 0  # from each row to the next
    # Single pairs are stretches of their own.
    if not goes_on.any():
        order, target = rng.permutation(count), min(target, Options.most)
        ends = target, (1 + tested) * target
        return Split(order[ends[1] :], order[: ends[0]], order[ends[0] : ends[1]], np.arange(count))
    block = _blocks(goes_on, target, max(Options.fewest, target // Options.parts))
    lengths = np.bincount(block)
    order = rng.permutation(len(lengths))
    # Blocks in random order until there are rows enough: the last one may bring more.
    before = np.cumsum(lengths[order]) - lengths[order]
    validating = order[before < target]
    testing = order[(before >= target) & (before < 2 * target)] if tested else order[:0]
    part = np.where(np.isin(block, validating), 1, np.where(np.isin(block, testing), 2, 0))
    gap = correlation_time(pairs, goes_on)
    apart = _apart(goes_on, part, gap)
    kept = [rng.permutation(np.flatnonzero(apart & (part == p))) for p in range(3)]
    stretch = _blocks(goes_on, 0, max(Options.fewest, 2 * gap))
    return Split(kept[0], kept[1][: Options.most], kept[2][: Options.most], stretch)


def _apart(goes_on: np.ndarray, part: np.ndarray, gap: int) -> np.ndarray:
    """(N,) the rows that lie more than ``gap`` steps from the next row of a part that judges them:
    a training row from those that validate, both from those that test."""
    run = np.concatenate([[0], np.cumsum(~goes_on)])
    apart = np.ones(len(part), bool)
    # The border belongs to the part that judges less: training rows give way to both.
    for border in np.flatnonzero(goes_on & (part[1:] != part[:-1])):
        low, high = part[border], part[border + 1]
        first = border - gap + 1 if low < high else border + 1
        rows = np.arange(max(first, 0), min(first + gap, len(part)))
        own = run[border] if low < high else run[border + 1]
        apart[rows[(run[rows] == own) & (part[rows] == min(low, high))]] = False
    return apart


def correlation_time(pairs: Pairs, goes_on: np.ndarray) -> int:
    """Steps after which the states of runs have lost all but 1/e of their correlation, 1 at least,
    and no more than a quarter of the blocks that are held out.

    It is the slowest coordinate's, by the mean of z(t) z(t + k) over all runs.
    """
    z = np.asarray(pairs.z0, np.float64)
    x = (z - z.mean(axis=0)) / sizes(z)
    most = max(1, int(Options.fraction * len(x)) // Options.parts**2)
    together = np.ones(len(x), bool)
    for step in range(1, most):
        together = together[:-1] & goes_on[step - 1 :]
        rows = np.flatnonzero(together)
        if not len(rows):
            return step
        if np.all(np.mean(x[rows] * x[rows + step], axis=0) < np.exp(-1)):
            return step
    return most


def outermost(y: np.ndarray, free: tuple[int, ...] = ()) -> np.ndarray:
    """Mark the outermost twentieth of the states y (N, 2d), (N,) bool, by Mahalanobis'
    distance. free: coordinates that do not count, as angles that cover their circle."""
    counted = y[:, [i for i in range(y.shape[1]) if i not in free]]
    centred = counted - counted.mean(axis=0)
    inverse = np.linalg.pinv(centred.T @ centred, rcond=1e-12, hermitian=True)
    distance = np.sum((centred @ inverse) * centred, axis=1)
    return distance > np.quantile(distance, 1 - Options.outside)


def _blocks(goes_on: np.ndarray, longest: int, part: int) -> np.ndarray:
    """The number of the block that each row is in: a run, or, of one longer than ``longest``, so
    many consecutive rows."""
    starts = np.concatenate([[True], ~goes_on])
    run = np.cumsum(starts) - 1
    place = np.arange(len(starts)) - np.flatnonzero(starts)[run]
    cut = (np.bincount(run)[run] > longest) & (place % part == 0)
    return np.cumsum(starts | cut) - 1
