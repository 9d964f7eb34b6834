"""Pairs that the map found contradicts by far more than it does the pairs around them.

Neighbours tell an outlier where states are dense (`diagnosis.outliers`); a map that
all pairs agree on tells it anywhere. What a map cannot represent is smooth: its residual is as
large at the neighbours. A gross error of measurement stands alone. So may a state at the rim of the
data, as of the closest passages; there a smaller size of the map errs far more still, while it
finds the same gross error. Of a law, which has no sizes, a message names both.

That the residuals of all pairs are looked at is work of the search: it is left out, and told, where
the budget has no room for it.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from gfnn_jax.budget import FLOW
from gfnn_jax.candidates.assemble import Candidate, stepped
from gfnn_jax.dataset.measured_error import error_of_each
from gfnn_jax.diagnosis.outliers import Options as Screen
from gfnn_jax.diagnosis.outliers import around, named
from gfnn_jax.errors import OutOfTime
from gfnn_jax.learn.request import Request, diagnose_request
from gfnn_jax.learn.searches import Searched, searched
from gfnn_jax.models.generating_functions.sweeps import LinearSweep, Size


class Options:
    """Limits by which pairs are told that the map misses by far (study: hard, outliers)."""

    # A residual beyond so many times what all but two of its neighbours stay below, and the median
    # of all. Of normal noise and d = 1 it is four times the median in one of 60,000 pairs.
    beyond: float = 5.0
    but: int = 2
    # Those neighbours' residuals are ordinary, below so many times the median: a map that cannot
    # follow a close passage errs around it too.
    ordinary: float = 2.5
    # Where they are not: of a search without them, the RMS residual of the others over that
    # before. A map is spoilt around a gross error; without a close passage it is hardly better
    # elsewhere.
    mended: float = 0.1
    # Gross errors are apart from the others: residuals between so many times the median and beyond
    # are fewer by this factor than they. What a map cannot represent has a tail without a gap.
    tail: float = 3.0
    apart: float = 0.5
    # Where there is none just there: residuals below the smallest of them, down to this part of
    # it, are fewer. One or two of few pairs lie apart by chance: fewer than so many need a wider
    # gap.
    gap: float = 0.6
    several: int = 5
    wide_gap: float = 0.1
    # A smaller size is the next one whose median residual is so many times larger. A row is at the
    # rim where that size leaves more of it by this factor, and the two differ there by so many
    # times what they do at the median.
    coarser: float = 2.0
    more: float = 1.3
    differ: float = 3.0
    roundoff: float = 1e-10  # of the spread: below it residuals are arithmetic
    # of the pairs: gross errors of a twentieth of the states of sequences, two pairs each
    most: float = 0.12
    rounds: int = 3  # large ones hide smaller ones
    # The RMS residual of all pairs over that of the others, for a search without them to be worth
    # its time; and by how much that of the others may rise then.
    spoilt: float = 1.15
    rise: float = 1.02
    # Operations, as of flows in NumPy, of a pair in the trees of its state and image, and of
    # finding the neighbours of both, ÷ (2d)².
    of_trees: int = 500
    of_neighbours: int = 1_400


_WHAT = "the search for pairs that the map misses by far"


def without_gross_errors(request: Request, found: Searched) -> tuple[Searched, list[str]]:
    """Searched again without gross errors, as long as that lowers what is left over of the others,
    or without states that the map cannot follow, where the others then meet the tolerance; as it
    is, where the tolerance is met, there are none, or too many. And what is to be said of them."""
    wrong, rim, count = np.zeros(0, int), np.zeros(0, int), len(found.data)
    watch = dataclasses.replace(request.watch, factors=None, checkpoints=None, on_better=None)
    request = dataclasses.replace(request, watch=watch)
    for _ in range(Options.rounds):
        left = _residuals(found)
        if left is None:
            break
        try:
            sizes, work_of_look = left
            with request.budget.unit(_WHAT, FLOW, work_of_look):
                size = sizes()
            middle = np.median(size)
            known = len(size) > Screen.neighbours and middle > 0
            far = np.flatnonzero(size > Options.beyond * middle)
            if not (known and len(far)):
                break
            # A search without them is followed by another look at the residuals.
            width = found.data.y0.shape[1]
            work = Options.of_trees * len(size) + Options.of_neighbours * width**2 * len(far)
            with request.budget.unit(_WHAT, FLOW, work, then=(FLOW, work_of_look)):
                near = around(found.data, found.data.scale, size, far, Options.but)
        except OutOfTime:
            request.budget.leave_out(_WHAT, request.budget.ended)
            break
        rows, rise = _standing_alone(size, far, near, Options.ordinary), Options.rise
        if not len(rows):
            rows, rise = _standing_alone(size, far, near, np.inf), Options.mended
        gone = len(wrong) + len(rim) + len(rows)
        if not len(rows) or gone > Options.most * count:
            break
        others = np.setdiff1d(np.arange(len(size)), rows)
        if not _rms(size) > Options.spoilt * _rms(size[others]):
            break
        at_rim = _at_the_rim(found, rows)
        request.watch.on_progress(f"without {gone} of {count} pairs that the map misses by far")
        data = found.data.take(others)
        again = searched(request, data, diagnose_request(request, data))
        left = _residuals(again)
        if left is not None:
            with request.budget.free(FLOW, left[1]):
                rms = _rms(left[0]())
            if not rms <= rise * _rms(size[others]):
                break
        # These pairs are exact: without them the tolerance is to be met, and no more lost there.
        if at_rim and (left is not None or not _follows(found, again, rows)):
            break
        gone = found.data.row[rows]
        wrong, rim = (wrong, np.append(rim, gone)) if at_rim else (np.append(wrong, gone), rim)
        found = again
    messages = []
    if len(wrong):
        messages.append(
            f"{_named(wrong, count)} are far from the map of the others: outliers, or states at "
            "the edge of the data that it cannot follow. They are left out. If they are right, add "
            "pairs there"
        )
    if len(rim):
        messages.append(
            f"{_named(rim, count)} lie at the edge of the data, where S cannot follow them: the "
            "map is fitted, and its error stated, without them"
        )
    return found, messages


def _named(rows: np.ndarray, count: int) -> str:
    return f"{len(rows)} of {count} pairs (numbers {named(np.sort(rows))}, from 0)"


def _rms(size) -> float:
    return float(np.sqrt(np.mean(size**2)))


def _residuals(found: Searched) -> tuple[Callable[[], np.ndarray], float] | None:
    """The sizes (N,) of what the best map leaves of every pair, () -> sizes, and the operations
    that these take; of a law by its steps ÷ scale, of S in its gradient, which has the same unit.
    None where it meets the tolerance, is neither, or has dry friction: its steps are not smooth
    where a body turns, and no error of a measurement is."""
    law, data, tolerance = found.law, found.data, found.tolerance
    best = _best(found)
    if best is None or tolerance.met_by(best) or best.validation_relative <= Options.roundoff:
        return None
    if data.structure is not None or data.varied:
        return None
    work = len(data) * best.operations
    if law is not None and best is law.candidate:
        flow = law.flow
        if law.widths:
            return None
        return lambda: _sizes((flow.image(data.y0) - data.y1) / data.scale), work
    swept = _swept(found)
    if swept is None:
        return None
    sweep, size = swept
    return lambda: _sizes(sweep.residuals(size)), work


def _best(found: Searched) -> Candidate | None:
    """The more accurate of the law and the first of the generated maps."""
    law, entry = found.law, next(iter(found.found.ranking), None)
    both = (law and law.candidate, entry and entry.candidate)
    known = (candidate for candidate in both if candidate is not None)
    return min(known, key=lambda candidate: candidate.validation_relative, default=None)


def _swept(found: Searched) -> tuple[LinearSweep, Size] | None:
    """The sweep and size of the first generated map, where the sweep is of these pairs."""
    entry = next(iter(found.found.ranking), None)
    if entry is None or not entry.sweep.linear:
        return None
    return (entry.sweep, entry.size) if entry.sweep.data.pairs is found.data.pairs else None


def _sizes(left: np.ndarray) -> np.ndarray:
    size = np.linalg.norm(left, axis=1)
    return np.where(np.isfinite(size), size, np.inf)


def _at_the_rim(found: Searched, rows: np.ndarray) -> bool:
    """Return whether these rows lie, for the most part, where S cannot follow: there a smaller
    size of its sweep leaves more, and more than elsewhere. A gross error is the same for both."""
    swept = _swept(found)
    if swept is None or (found.law is not None and _best(found) is found.law.candidate):
        return False
    (sweep, chosen), others = swept, np.ones(len(found.data), bool)
    others[rows] = False
    left = sweep.residuals(chosen)
    size = _sizes(left)
    for smaller in reversed(sweep.sizes[: sweep.sizes.index(chosen)]):
        coarse = sweep.residuals(smaller)
        if np.median(_sizes(coarse)[others]) > Options.coarser * np.median(size[others]):
            differ = _sizes(coarse - left)
            more = _sizes(coarse)[rows] > Options.more * size[rows]
            apart = differ[rows] > Options.differ * np.median(differ[others])
            return bool(np.mean(more & apart) > 0.5)
    return False


def _follows(found: Searched, again: Searched, rows: np.ndarray) -> bool:
    """Return whether the steps of the map that was found again, without these rows, are solved
    there, and err there by no more than the map before did over all pairs, added up."""
    entry = again.found.ranking[0]
    pairs = found.data.pairs.take(rows)
    steps = stepped(entry.map, np.asarray(pairs.z0), pairs.dt, pairs.args, timed=False)
    images = np.where(steps.failed[:, None], np.nan, steps.images)
    error = error_of_each(found.data, found.tolerance, images, rows)
    before = found.found.ranking[0].candidate.validation_bound
    return bool(np.sum(error**2) <= len(found.data) * before**2)


def _standing_alone(
    size: np.ndarray, far: np.ndarray, around: np.ndarray, ordinary: float
) -> np.ndarray:
    """Rows of ``far`` whose residual is far beyond ``around``, that of their neighbours.

    ordinary: times the median of all, that those neighbours' residuals stay below."""
    middle = np.median(size)
    alone = far[(size[far] > Options.beyond * around) & (around < ordinary * middle)]
    between = np.sum((size > Options.tail * middle) & (size <= Options.beyond * middle))
    if between < Options.apart * len(alone):
        return alone
    falling, ordered = alone[np.argsort(-size[alone])], np.sort(size)
    count, least = np.arange(1, len(falling) + 1), size[falling]
    reach = np.where(count < Options.several, Options.wide_gap, Options.gap) * least
    below = np.searchsorted(ordered, least) - np.searchsorted(ordered, reach, "right")
    apart = np.flatnonzero(below < Options.apart * count)
    return np.sort(falling[: apart[-1] + 1]) if len(apart) else falling[:0]
