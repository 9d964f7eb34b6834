"""Pairs that the map found contradicts by far more than it does the pairs around them.

Neighbours tell an outlier where states are dense (`diagnosis.local_jacobians.outliers`); a map that
all pairs agree on tells it anywhere. What a map cannot represent is smooth: its residual is as
large at the neighbours. A gross error of measurement stands alone.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.diagnosis.diagnosis import Diagnosis
from gfnn_jax.learn.diagnose import diagnose_request
from gfnn_jax.learn.request import Request
from gfnn_jax.learn.searches import Searched, searched
from gfnn_jax.models.generating_functions.sweeps import LinearSweep

# A residual beyond so many times what all but two of its neighbours stay below, and the median of
# all. Of normal noise and d = 1 it is four times the median in one of 60,000 pairs.
_BEYOND, _NEIGHBOURS, _BUT = 5.0, 10, 2
# Those neighbours' residuals are ordinary, below so many times the median: a map that cannot follow
# a close passage errs around it too.
_ORDINARY = 2.5
# Where they are not: of a search without them, the RMS residual of the others over that before. A
# map is spoilt around a gross error; without a close passage it is hardly better elsewhere.
_MENDED = 0.1
# Gross errors are apart from the others: residuals between so many times the median and _BEYOND are
# fewer by this factor than they. What a map cannot represent has a tail without a gap.
_TAIL, _APART = 3.0, 0.5
# Where there is none just there: residuals below the smallest of them, down to this part of it, are
# fewer. One or two of few pairs lie apart by chance: fewer than so many need a wider gap.
_GAP, _SEVERAL, _WIDE_GAP = 0.6, 5, 0.1
_ROUNDOFF = 1e-10  # of the spread: below it residuals are arithmetic
_MOST = 0.12  # of the pairs: gross errors of a twentieth of the states of sequences, two pairs each
_ROUNDS = 3  # large ones hide smaller ones
# The RMS residual of all pairs over that of the others, for a search without them to be worth its
# time; and by how much that of the others may rise then.
_SPOILT, _RISE = 1.15, 1.02


class Cleaned(NamedTuple):
    """The diagnosis and the search without gross errors, and what is to be said of those."""

    seen: Diagnosis
    found: Searched
    messages: list[str]


def without_gross_errors(request: Request, seen: Diagnosis, found: Searched) -> Cleaned:
    """Searched again without gross errors, as long as that lowers what is left over of the others;
    as it is, where the tolerance is met, there are none, or too many."""
    everyone, gone = found.data, 0
    count = len(everyone)
    request = dataclasses.replace(request, factors=None, checkpoints=None)
    for _ in range(_ROUNDS):
        size = _residuals(found)
        if size is None:
            break
        rows, rise = _standing_alone(found.data, size, _ORDINARY), _RISE
        if not len(rows):
            rows, rise = _standing_alone(found.data, size, np.inf), _MENDED
        if not len(rows) or gone + len(rows) > _MOST * count or request.budget.over:
            break
        others = np.setdiff1d(np.arange(len(size)), rows)
        if not _rms(size) > _SPOILT * _rms(size[others]):
            break
        request.say(f"without {gone + len(rows)} of {count} pairs that are gross errors")
        data = found.data.take(others)
        diagnosis = diagnose_request(request, data)
        again = searched(request, data, diagnosis, None)
        left = _residuals(again)
        if left is not None and not _rms(left) <= rise * _rms(size[others]):
            break
        seen, found, gone = diagnosis, again, gone + len(rows)
    if not gone:
        return Cleaned(seen, found, [])
    left_out = everyone.row[~np.isin(everyone.row, found.data.row)]
    rows = ", ".join(map(str, left_out[:5]))
    rows += ", …" if gone > 5 else ""
    return Cleaned(seen, found, [
        f"{gone} of {count} pairs (rows {rows}) are gross errors beside the map of the others: "
        "they were given no weight"
    ])  # fmt: skip


def _rms(size) -> float:
    return float(np.sqrt(np.mean(size**2)))


def _residuals(found: Searched) -> np.ndarray | None:
    """(N,) what the best map leaves of every pair; of a law by its steps ÷ scale, of S in its
    gradient, which has the same unit. None where it meets the tolerance, or is neither."""
    law, data, tolerance = found.law, found.data, found.tolerance
    entry = next(iter(found.found.ranking), None)
    best = min(
        (c for c in (law and law.candidate, entry and entry.candidate) if c is not None),
        key=lambda c: c.validation_relative, default=None,
    )  # fmt: skip
    if best is None or tolerance.met_by(best) or best.validation_relative <= _ROUNDOFF:
        return None
    if data.structure is not None or data.varied:
        return None
    if law is not None and best is law.candidate:
        left = (law.flow.image(data.y0) - data.y1) / data.scale
    elif entry is not None and isinstance(entry.sweep, LinearSweep) and _same(entry.sweep, data):
        left = entry.sweep.residuals(entry.size)
    else:
        return None
    size = np.linalg.norm(left, axis=1)
    return np.where(np.isfinite(size), size, np.inf)


def _same(sweep: LinearSweep, data: Dataset) -> bool:
    return sweep.data.pairs is data.pairs


def _standing_alone(data: Dataset, size, ordinary: float) -> np.ndarray:
    """The rows whose residual is far beyond those of all but a few of the neighbours, of the state
    or of the image: a state that is a gross error has no neighbours but its like.

    ordinary: times the median of all, that those neighbours' residuals stay below.
    """
    if len(size) <= _NEIGHBOURS:
        return np.zeros(0, int)
    middle = np.median(size)
    rows = np.flatnonzero(size > _BEYOND * middle)
    if not len(rows) or not middle > 0:
        return rows[:0]
    around = np.full(len(rows), np.inf)
    for y in (data.y0 / data.scale, data.y1 / data.scale):
        near = cKDTree(y).query(y[rows], k=_NEIGHBOURS + 1)[1][:, 1:]
        around = np.minimum(around, np.sort(size[near], axis=1)[:, -1 - _BUT])
    alone = rows[(size[rows] > _BEYOND * around) & (around < ordinary * middle)]
    between = np.sum((size > _TAIL * middle) & (size <= _BEYOND * middle))
    if between < _APART * len(alone):
        return alone
    falling, ordered = alone[np.argsort(-size[alone])], np.sort(size)
    count, least = np.arange(1, len(falling) + 1), size[falling]
    reach = np.where(count < _SEVERAL, _WIDE_GAP, _GAP) * least
    below = np.searchsorted(ordered, least) - np.searchsorted(ordered, reach, "right")
    apart = np.flatnonzero(below < _APART * count)
    return np.sort(falling[: apart[-1] + 1]) if len(apart) else falling[:0]
