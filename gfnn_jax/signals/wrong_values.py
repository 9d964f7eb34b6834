"""Wrong values of a column: outliers, single or in a row, and stretches of a sensor that was stuck
or at its limit.

*Roughness* is how far samples are from cubics through their four neighbours: noise, a sensor's
single counts, and what of the motion is not smooth.

*Outliers*: samples that these cubics miss by far are suspected. A polynomial through the samples on
both sides then tells what the suspected ones should be, and how well it can: at a kink, a step or
with few samples a period the sides themselves do not lie on it, and nothing is said. An outlier
begins and ends abruptly; a short swing of the motion rises and falls from sample to sample. Nor is
it one that is off by a whole turn: an angle that was not lifted.

*Stuck*: equal values, then a jump to where the motion is by then. A body that rests starts slowly
from where it rested, and a coarse sensor shows its turning points by equal values beside which it
moves by its smallest step. Only a sensor that was stuck while the motion went on catches up in one
step, with a jump far above the steps around it.

*Clipped*: values that stay at the very extreme of their column, entered or left by a step that a
smooth turn does not make. A sensor has such a limit where that happens more than once, but for the
beginnings of runs, where a body may be held (`clipped`).

An input may jump and may be a pulse. What it cannot be is smooth on both sides of a jump, with one
sample between them that is far beyond either (`wrong_at_jumps`).
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.polynomial.legendre import legvander

from gfnn_jax.arrays import stretches_of
from gfnn_jax.signals.steps import Runs

TURN = 2 * np.pi


class _Options:
    """Thresholds, chosen on recordings of test systems with and without wrong values
    (`benchmarks/random_recordings.py`)."""

    # Roughness
    block: int = 16  # samples, of which the roughest counts
    ordinary: float = 0.8  # of the blocks: what spoils fewer than the others is not the sensor's
    # Outliers
    suspected: float = 10.0  # times the median miss of samples nearby
    nearby: int = 64
    of_median: float = 0.94  # that miss, of white noise of unit size
    joined: int = 6  # samples from one suspected one to the next of the same stretch
    beside: int = 2  # on either side, whose cubics an outlier spoils
    longest: int = 40  # of a stretch
    side: int = 8  # on either side of it, as many as it has if these are more, fitted by a
    degree: int = 5  # polynomial of this degree
    widest: float = 1.5  # of the duration of so many samples without a gap
    far: float = 10.0  # standard deviations of what the sides tell
    rough: float = 3.0  # times the ordinary roughness
    of_turn: float = 0.1  # of a turn, that one is away from it
    abrupt: float = 3.0  # times as far off as the sample beside it, that its ends are
    # Stuck
    fewest: int = 5  # equal values: two or three are what a camera makes of a frame that it dropped
    around: int = 8  # steps before and behind
    jump: float = 3.0  # times the fastest of these, at least
    resolutions: float = 2.0  # of the motion in a step: slower, equal values are a sensor's digits
    # At jumps
    smooth: int = 3  # degree of the polynomial of each side
    beyond: float = 0.5  # of the jump, beyond both sides: the overshoot of a real one is less
    # Clipped
    flat: int = 3  # equal extremes in a row that a sensor's limit makes
    entered: float = 4.0  # resolutions: a smooth turn has a shorter step beside its extreme


@dataclasses.dataclass(frozen=True)
class WrongValues:
    """A stretch of wrong values of one column.

    run: its number. rows: (k,) samples, the runs one after another. off: how far they are from
    where the samples around them lead; None of a sensor that was stuck or at its ``limit``.
    """

    run: int
    rows: np.ndarray
    off: float | None
    limit: float | None = None

    @property
    def kind(self) -> str:
        """ "clipped", "stuck" or "outliers"."""
        if self.limit is not None:
            return "clipped"
        return "stuck" if self.off is None else "outliers"


def wrong_values(times: Runs, runs: Runs, resolution: float | None) -> tuple[WrongValues, ...]:
    """The wrong values of a column (n_r,) of each run, NaN where missing, in the order of time."""
    begins = np.cumsum([0, *map(len, times)])
    known = [np.flatnonzero(np.isfinite(x)) for x in runs]
    series = [(t[k], x[k], b + k) for t, x, k, b in zip(times, runs, known, begins, strict=False)]
    misses, step, found = [_misses(t, x) for t, x, _ in series], resolution or 0.0, []
    rough = _roughness(misses)
    for run, (t, x, rows) in enumerate(series):
        moving = np.ones(len(x), bool)
        for begin, end in _stuck(t, x, step, rough):
            moving[begin:end] = False
            found.append(WrongValues(run, rows[begin:end], None))
        miss = misses[run]
        if not moving.all():
            t, x, rows = t[moving], x[moving], rows[moving]
            miss = _misses(t, x)
        for begin, end, off in _outliers(t, x, miss, step, rough):
            found.append(WrongValues(run, rows[begin:end], off))
    return tuple(sorted(found, key=lambda stretch: stretch.rows[0]))


def clipped(runs: Runs, resolution: float | None) -> tuple[WrongValues, ...]:
    """The stretches at a limit of a column (n_r,) of each run, NaN where missing, with all other
    samples that are equal to it."""
    whole = np.concatenate(runs)
    begins, found = np.cumsum([0, *map(len, runs)]), []
    if not np.isfinite(whole).any():
        return ()
    least = max(_Options.entered * (resolution or 0.0), 1e-9 * float(np.nanstd(whole)))
    for limit in (float(np.nanmin(whole)), float(np.nanmax(whole))):
        flats = [stretches_of(x == limit) for x in runs]
        abrupt = 0
        for x, own in zip(runs, flats, strict=True):
            for begin, end in own:
                sides = np.abs(x[[begin - 1, min(end, len(x) - 1)]] - limit)
                abrupt += begin > 0 and end - begin >= _Options.flat and bool((sides > least).any())
        for run, own in enumerate(flats if abrupt > 1 else []):
            rows = (np.arange(begin, end) + begins[run] for begin, end in own)
            found += [WrongValues(run, one, None, limit) for one in rows]
    return tuple(sorted(found, key=lambda stretch: stretch.rows[0]))


def wrong_at_jumps(times: Runs, runs: Runs, resolution: float | None) -> tuple[WrongValues, ...]:
    """The samples of an input (n_r,) of each run that are beyond both sides of a jump."""
    begins, found, side = np.cumsum([0, *map(len, times)]), [], _Options.side
    for run, (t, x, begin) in enumerate(zip(times, runs, begins, strict=False)):
        ways = np.diff(x)
        usual = np.abs(ways[np.isfinite(ways)])
        high = _Options.suspected * float(np.median(usual)) if len(usual) else 0.0
        turns = -ways[:-1] * ways[1:] > high**2  # not where a value is missing
        for k in 1 + np.flatnonzero(turns):
            if not side <= k < len(x) - side:
                continue
            sides = np.arange(k - side, k), np.arange(k + 1, k + 1 + side)
            led = [_led(t[rows] - t[k], x[rows], resolution or 0.0) for rows in sides]
            off, jump = x[k] - np.array([at for at, _ in led]), abs(led[0][0] - led[1][0])
            least = _Options.far * max(sigma for _, sigma in led)
            beyond = float(np.abs(off).min()) if off[0] * off[1] > 0 else 0.0
            if jump > least and beyond > max(least, _Options.beyond * jump):
                found.append(WrongValues(run, np.array([begin + k]), beyond))
    return tuple(found)


def _led(t: np.ndarray, x: np.ndarray, resolution: float) -> tuple[float, float]:
    """Value that samples (n,) of a side lead to at time 0, and its standard deviation."""
    q, r = np.linalg.qr(np.vander(t / np.abs(t).max(), _Options.smooth + 1))
    left = x - q @ (q.T @ x)
    sigma = max(resolution, float(np.sqrt(left @ left / (len(x) - _Options.smooth - 1))))
    reach = np.linalg.solve(r.T, np.eye(len(r))[-1])
    return float(q.T @ x @ reach), sigma * float(np.sqrt(1 + reach @ reach))


def _misses(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Distances (n,) from the cubics; 0 for the first two and the last two samples."""
    found = np.zeros(len(x))
    n, places = len(x) - 4, (0, 1, 3, 4)
    if n < 1:
        return found
    cubic = np.zeros(n)
    for j in places:
        weight = np.ones(n)
        for m in places:
            if m != j:
                weight *= (t[2:-2] - t[m : m + n]) / (t[j : j + n] - t[m : m + n])
        cubic += weight * x[j : j + n]
    found[2:-2] = np.abs(x[2:-2] - cubic)
    return found


def _roughness(runs: Runs) -> float:
    """The largest miss that is ordinary in a column, of the `_misses` (n_r,) of its runs: 3.4
    standard deviations of white noise. Infinite where no run has a block of samples."""
    size = _Options.block
    whole = [miss[: len(miss) // size * size].reshape(-1, size) for miss in runs]
    largest = np.concatenate([blocks.max(axis=1) for blocks in whole] or [np.empty(0)])
    return float(np.quantile(largest, _Options.ordinary)) if len(largest) else np.inf


def _outliers(
    t: np.ndarray, x: np.ndarray, miss: np.ndarray, resolution: float, rough: float
) -> list[tuple[int, int, float]]:
    """(begin, end, how far off at most) of stretches of samples of a run (n,).

    t, x: without missing values. miss: the `_misses` (n,). resolution: the smallest step between
    values, 0 if it is unknown. rough: of the column (`_roughness`)."""
    if len(x) < 2 * _Options.side + 1 or not miss.max() > _Options.rough * rough:
        return []
    usual = np.maximum(_nearby(miss), max(resolution, 1e-12 * np.ptp(x)))
    suspected = miss > _Options.suspected * usual
    at = np.flatnonzero(suspected)
    if len(at) == 0:
        return []
    clean = ~suspected
    for k in range(1, _Options.beside + 1):
        clean[k:] &= ~suspected[:-k]
        clean[:-k] &= ~suspected[k:]
    right = np.flatnonzero(clean)
    parts, found = np.split(at, np.flatnonzero(np.diff(at) > _Options.joined) + 1), []
    series = _Series(t, x, right, float(np.median(np.diff(t))), usual, _Options.rough * rough)
    while parts:
        first, *parts = parts
        outlier = series.outlier(first[0], first[-1])
        if outlier is None and parts:  # all between a jump and the one that leads back
            outlier = series.outlier(first[0], parts[0][-1])
            parts = parts if outlier is None else parts[1:]
        if outlier is not None:
            found.append(outlier)
    return found


class _Series(NamedTuple):
    """Samples (n,), those of them that are right (K,), the median step, how far cubics usually
    miss them (n,), and how far off one must be."""

    t: np.ndarray
    x: np.ndarray
    right: np.ndarray
    step: float
    usual: np.ndarray
    least: float

    def outlier(
        self, first: int | np.integer, last: int | np.integer
    ) -> tuple[int, int, float] | None:
        """(begin, end, how far off) of the stretch with the suspected samples from ``first`` to
        ``last``; None where it is none, or too few samples around it tell."""
        begin, end = first - _Options.beside, last + _Options.beside + 1
        count = max(_Options.side, end - begin)
        before = self.right[self.right < begin][-count:]
        behind = self.right[self.right >= end][:count]
        if end - begin > _Options.longest or min(len(before), len(behind)) < count:
            return None
        widest = _Options.widest * self.step * (2 * count + end - begin)
        if self.t[behind[-1]] - self.t[before[0]] > widest:
            return None
        sides = np.concatenate([before, behind])
        noise = float(self.usual[first]) / _Options.of_median
        outlier = _apart(self.t, self.x, np.arange(begin, end), sides, noise)
        return outlier if outlier is not None and outlier[2] > self.least else None


def _nearby(miss: np.ndarray) -> np.ndarray:
    """The median of the block that a sample is in, or of the one before or behind if it is more."""
    blocks = np.array_split(miss, max(len(miss) // _Options.nearby, 1))
    medians = np.pad([np.median(block) for block in blocks], 1, mode="edge")
    most = np.maximum(np.maximum(medians[:-2], medians[2:]), medians[1:-1])
    return np.repeat(most, [len(block) for block in blocks])


def _apart(
    t: np.ndarray, x: np.ndarray, rows: np.ndarray, sides: np.ndarray, sigma: float
) -> tuple[int, int, float] | None:
    """(begin, end, how far off) of the samples among ``rows`` that the polynomial of the ``sides``
    misses by far; None where it does not tell."""
    middle, half = t[rows].mean(), np.ptp(t[sides]) / 2
    q, r = np.linalg.qr(legvander((t[sides] - middle) / half, _Options.degree))
    coefficients = q.T @ x[sides]
    left = x[sides] - q @ coefficients
    sigma = max(sigma, float(np.sqrt(left @ left / (len(sides) - _Options.degree - 1))))
    reach = np.linalg.solve(r.T, legvander((t[rows] - middle) / half, _Options.degree).T)
    off = np.abs(x[rows] - coefficients @ reach)
    far = np.flatnonzero(off > _Options.far * sigma * np.sqrt(1 + np.sum(reach**2, axis=0)))
    if len(far) == 0 or far[0] == 0 or far[-1] == len(rows) - 1:
        return None
    first, last = far[0], far[-1]
    if off[first] < _Options.abrupt * off[first - 1] or off[last] < _Options.abrupt * off[last + 1]:
        return None
    if abs(np.median(off[far]) - TURN) < _Options.of_turn * TURN:
        return None
    return int(rows[first]), int(rows[last]) + 1, float(off[far].max())


def _stuck(t: np.ndarray, x: np.ndarray, resolution: float, rough: float) -> list[tuple[int, int]]:
    """(begin, end) of the samples of a run (n,) that repeat the one before ``begin``.

    t, x: without missing values. resolution: the smallest step between values, 0 if it is unknown.
    rough: of the column (`_roughness`), which the motion goes in a step at least."""
    if len(x) < _Options.fewest:
        return []
    times = np.diff(t)
    ways = np.abs(np.diff(x)) * np.minimum(np.median(times) / times, 1.0)  # a gap makes a long way
    slow = max(_Options.resolutions * resolution, rough)
    found = []
    for begin, end in stretches_of(ways == 0):
        if end - begin + 1 < _Options.fewest or end == len(ways):
            continue
        before = ways[max(begin - _Options.around, 0) : begin]
        behind = ways[end + 1 :][: _Options.around]
        around = [part for part in (before, behind) if len(part) == _Options.around]
        moves = any(np.median(part) > slow for part in around)
        fastest = max((part.max() for part in around), default=0.0)
        way = max(_Options.fewest * slow, _Options.jump * fastest)
        if moves and ways[end] > way:
            found.append((begin + 1, end + 1))
    return found
