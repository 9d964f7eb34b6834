"""Gross errors that are many: pairs far from a polynomial map that resists them, before any fit.

Neighbours tell few outliers (`diagnosis.local_jacobians.outliers`), since many hide each other, and
a map that is found tells those that did not spoil the search for it (`learn.gross_errors`). A state
that is a gross error spoils two pairs of a sequence: a twentieth of the states is a tenth of the
pairs.

Both z1 and z0 are fitted, the one by a polynomial in the other, since an error in z0 moves a row
of the first fit itself and stands in the second as a residual. The fits minimise the sum of
absolute residuals, which has one minimum, and then Tukey's biweight (MM-estimation, Yohai, Ann.
Statist. 15 (1987) 642, with a convex start in place of one by resampling, which regressors of a
bounded domain allow). What no polynomial follows, a close passage or chaos, is not cut off from the
rest by a gap, has its like around it, or is not bridged by the states before and after it; then
nothing is said.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import combinations_with_replacement

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from gfnn_jax.coordinates import nearest_image
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.diagnosis.local_jacobians import looked_for_errors
from gfnn_jax.solve.robust import Biweight, robust

# Times the median residual: beyond the second, a pair is a gross error. Those between the two are
# fewer than this part of them. Of normal noise and d = 1 one pair of 100,000 is beyond the first.
_ORDINARY, _BEYOND, _BETWEEN = 4.0, 8.0, 0.1
_FEWEST, _MOST = 5, 0.45  # gross errors; of all pairs
# Among so many neighbours of the state or of the image all but so many are ordinary; of all that
# are far from the polynomial so many stand alone in that way.
_NEIGHBOURS, _BUT, _ALONE = 10, 4, 0.8
# Of the stretches of sequences between two good states so many are bridged by the polynomial, by
# no more than so many steps.
_BRIDGED, _LONGEST = 0.8, 10
# A state is a regressor within so many robust deviations of the median: others have too much
# weight in a fit.
_WITHIN = 8.0
_PAIRS_PER_TERM, _MOST_TERMS, _MOST_ROWS = 8, 130, 3_000
_GAINED = 0.9  # of the residual, that a higher degree must leave
_USABLE = 0.25  # of the moves' size: a polynomial that leaves more says nothing
_ABSOLUTE, _BIWEIGHT = 8, 7  # rounds of either loss
_TUKEY = Biweight(6.0)  # in medians
_SPANNED = 1e-12  # of the largest: a smaller eigenvalue of a Gram matrix is roundoff


def gross_errors(data: Dataset, goes_on: np.ndarray, left_out: np.ndarray) -> np.ndarray:
    """Rows of the pairs that are gross errors; none where it is not certain which they are.

    goes_on: (N − 1,) whether the image of a pair is the state of the next. left_out: (N,) bool,
    pairs that are known to be wrong, and are not named again.
    """
    none = np.zeros(0, int)
    if data.varied or data.structure is not None:
        return none
    rows = looked_for_errors(len(data.y0))
    if len(rows) < len(data.y0):
        within = goes_on[rows[:-1]] & (np.diff(rows) == 1)
        return rows[gross_errors(data.take(rows), within, left_out[rows])]
    best = None
    for model in _models(data, ~left_out):
        if best is not None and not model.left < _GAINED * best.left:
            continue
        best = model
    if best is None or not best.left < _USABLE:
        return none
    size = np.where(left_out, np.inf, best.sizes)
    far = np.flatnonzero((size > _BEYOND) & ~left_out)
    between = np.sum((size > _ORDINARY) & (size <= _BEYOND))
    # Those that neighbours told before are gross errors too: beside them there may be few.
    few = not len(far) or len(far) + left_out.sum() < _FEWEST
    if few or len(far) > _MOST * len(size) or between > _BETWEEN * len(far):
        return none
    if goes_on.any():
        return _borne_out(best, far, goes_on, left_out)
    alone = far[_ordinary_around(data, best.unit, size, far)]
    return alone if len(alone) >= _ALONE * len(far) else none


class _Model:
    """Polynomials of one degree, y0 -> y1 and back.

    sizes: (N,) the larger residual of either, in units of its median; 0 where neither state is a
    regressor. left: the larger median, in units of the moves'. unit: (2d,) robust deviations.
    """

    def __init__(self, data: Dataset, known: np.ndarray, degree: int):
        self._angles, self._degree = data.coordinates.angles, degree
        self._free = tuple(i for i in data.coordinates.cyclic if i not in self._angles)
        self.y0, self.y1 = data.y0, data.y1
        both = np.concatenate([self.y0, self.y1])
        self._centre = np.median(both, axis=0)
        unit = robust(both - self._centre, axis=0)
        self.unit = np.where(unit > 0, unit, data.scale)
        move = nearest_image(self.y1 - self.y0, self._angles) / self.unit
        self._ahead, ahead, left = self._fitted(self.y0, move, known)
        _, back, left_back = self._fitted(self.y1, -move, known)
        self.sizes = np.maximum(ahead, back)
        size = np.median(np.linalg.norm(move - np.median(move, axis=0), axis=1))
        self.left = max(left, left_back) / size if size > 0 else np.inf

    def bridge(self, first: int, steps: int, last: int) -> float:
        """Distance of the image of row ``last`` from ``steps`` steps from the state of row
        ``first``, in units of the median residual and the number of steps."""
        coefficients, median = self._ahead
        y = self.y0[first : first + 1]
        for _ in range(steps):
            y = y + self.unit * (self._design(y) @ coefficients)
        off = nearest_image(y - self.y1[last], self._angles) / self.unit
        return float(np.linalg.norm(off)) / (steps * median)

    def _fitted(self, y, move, known):
        """((coefficients, median residual), every row's residual in units of it, the median)."""
        inside = self._within(y)
        rows = np.flatnonzero(inside & known)
        if len(rows) > _MOST_ROWS:
            rows = np.sort(np.random.default_rng(0).choice(rows, _MOST_ROWS, replace=False))
        design = self._design(y)
        coefficients, median = _resistant(design[rows], move[rows])
        size = np.linalg.norm(move - design @ coefficients, axis=1)
        in_units = size / median if median > 0 else np.where(size > 0, np.inf, 0.0)
        return (coefficients, median), np.where(inside, in_units, 0.0), median

    def _within(self, y):
        far = np.abs(y - self._centre) > _WITHIN * self.unit
        far[:, [*self._angles, *self._free]] = False
        return ~far.any(axis=1)

    def _design(self, y):
        """Monomials (N, m) of the coordinates, of an angle's cosine and sine."""
        x = (y - self._centre) / (_WITHIN / 2 * self.unit)
        columns = []
        for i in range(y.shape[1]):
            if i in self._angles:
                columns += [np.cos(y[:, i]), np.sin(y[:, i])]
            elif i not in self._free:
                columns.append(x[:, i])
        products: dict[tuple[int, ...], np.ndarray] = {(): np.ones(len(y))}
        for k in range(1, self._degree + 1):
            for term in combinations_with_replacement(range(len(columns)), k):
                products[term] = products[term[:-1]] * columns[term[-1]]
        return np.stack(list(products.values()), axis=1)


def _models(data: Dataset, known: np.ndarray) -> Iterator[_Model]:
    """Models by rising degree, as far as the pairs tell their terms."""
    coordinates, width = data.coordinates, data.y0.shape[1]
    width += len(coordinates.angles) - len(set(coordinates.cyclic) - set(coordinates.angles))
    most = min(_MOST_TERMS, int(known.sum()) // _PAIRS_PER_TERM)
    degree = 1
    while math.comb(width + degree, degree) <= most:
        yield _Model(data, known, degree)
        degree += 1


def _resistant(design, move) -> tuple[np.ndarray, float]:
    """Coefficients (m, 2d) and the median size of the residuals."""
    values, vectors = np.linalg.eigh(design.T @ design)
    known = values > _SPANNED * values[-1]
    turn = vectors[:, known] / np.sqrt(values[known])
    basis, weight = design @ turn, np.ones(len(design))
    coefficients, median = np.zeros((basis.shape[1], move.shape[1])), 0.0
    floor = np.finfo(float).eps * np.abs(move).max(initial=0.0)
    for n in range(_ABSOLUTE + _BIWEIGHT):
        weighted = basis.T * weight
        ridge = _SPANNED * np.eye(len(weighted))
        coefficients = np.linalg.solve(weighted @ basis + ridge, weighted @ move)
        size = np.linalg.norm(move - basis @ coefficients, axis=1)
        median = max(float(np.median(size)), floor)
        if median == 0:
            break
        if n < _ABSOLUTE:
            weight = median / np.maximum(size, median)
        else:
            weight = _TUKEY.weights(size / median)
    return turn @ coefficients, median


def _ordinary_around(data: Dataset, unit, size, rows) -> np.ndarray:
    """Mark the rows that have ordinary neighbours, of the state or of the image: a state that is a
    gross error has no neighbours but its like."""
    near_one = np.zeros(len(rows), bool)
    for y in (data.y0 / unit, data.y1 / unit):
        near = cKDTree(y).query(y[rows], k=_NEIGHBOURS + 1)[1][:, 1:]
        near_one |= np.sort(size[near], axis=1)[:, -1 - _BUT] < _ORDINARY
    return near_one


def _borne_out(model: _Model, rows, goes_on, left_out) -> np.ndarray:
    """The rows, of sequences as far as the states around them bear it out: the state before a
    gross error leads to the one after it. None where most are not."""
    wrong = left_out.copy()
    wrong[rows] = True
    begins = np.concatenate([[True], ~goes_on])
    ends = np.concatenate([~goes_on, [True]])
    # Stretches of wrong pairs within a sequence.
    first = np.flatnonzero(wrong & (begins | ~np.concatenate([[False], wrong[:-1]])))
    last = np.flatnonzero(wrong & (ends | ~np.concatenate([wrong[1:], [False]])))
    kept, inner, bridged = [], 0, 0
    for one, other in zip(first.tolist(), last.tolist(), strict=True):
        steps = other - one + 1
        if not (begins[one] or ends[other]):
            inner += 1
            if steps > _LONGEST or not model.bridge(one, steps, other) <= _BEYOND:
                continue
            bridged += 1
        kept.append(np.arange(one, other + 1))
    if not kept or bridged < _BRIDGED * inner:
        return rows[:0]
    found = np.concatenate(kept)
    return found[~left_out[found]]
