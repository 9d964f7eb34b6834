"""The rows that a fit takes: each once, and none that contradicts the rows around it.

Neighbours tell few *outliers*, since many hide each other (`outliers`), and a map that is found
tells those that did not spoil the search for it (`learn.gross_errors`). *Gross errors* that are
many are pairs far from a polynomial map that resists them, before any fit (`gross_errors`). A state
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

import math
from collections.abc import Iterator

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from gfnn_jax.arrays import products
from gfnn_jax.coordinates import Coordinates, nearest_image
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.runs import Identified, first_occurrences, steps_between
from gfnn_jax.dataset.structures import Structure
from gfnn_jax.dataset.varied import given_by
from gfnn_jax.diagnosis import local_jacobians
from gfnn_jax.solve.noise import Biweight, robust


class Options:
    """Options of the screens (benchmarks/hard_cases.py, benchmarks/constants.py)."""

    most_outliers: float = 0.05  # of the pairs may be left out
    # A pair is an outlier that its neighbours' fit misses by so many standard deviations.
    outlying: float = 30.0
    outlier_rounds: int = 5
    # Where there are fewer pairs than so many neighbourhoods hold, more deviations make an
    # outlier, by that factor. Of 4,000 times 20 clean pairs of a kicked pendulum the most is 102
    # deviations: a fit to a few neighbours is now and then good by chance.
    neighbourhoods: int = 10
    # Pairs that are looked at for gross errors, in blocks of a sequence: 50,000 take two seconds.
    most_looked_at: int = 50_000
    block: int = 1_000
    # Of more terms than a few (above) only pairs are looked at that an affine map of all misses
    # by so many times the median, and so many that tell what is usual: 2,000 pairs of 32 degrees
    # of freedom take a second instead of eight.
    suspect: float = 3.0
    usual: int = 100
    # Times the median residual: beyond the second, a pair is a gross error. Those between the two
    # are fewer than this part of them. Of normal noise and d = 1 one pair of 100,000 is beyond
    # the first.
    ordinary: float = 4.0
    beyond: float = 8.0
    between: float = 0.1
    # gross errors; of all pairs
    fewest_errors: int = 5
    most_errors: float = 0.45
    # Among so many neighbours of the state or of the image all but so many are ordinary; of all
    # that are far from the polynomial so many stand alone in that way.
    neighbours: int = 10
    but: int = 4
    alone: float = 0.8
    # Of the stretches of sequences between two good states so many are bridged by the polynomial,
    # by no more than so many steps.
    bridged: float = 0.8
    longest: int = 10
    # A state is a regressor within so many robust deviations of the median: others have too much
    # weight in a fit.
    within: float = 8.0
    pairs_per_monomial: int = 8
    most_terms: int = 130
    most_rows: int = 3_000
    gained: float = 0.9  # of the residual, that a higher degree must leave
    usable: float = 0.25  # of the moves' size: a polynomial that leaves more says nothing
    # rounds of either loss
    absolute: int = 8
    biweight: int = 7
    spanned: float = 1e-12  # of the largest: a smaller eigenvalue of a Gram matrix is roundoff


def clean(
    found: Identified,
    coordinates: Coordinates,
    structure: Structure | None = None,
    jumps: bool = False,
) -> tuple[Dataset, list[str]]:
    """The data set without copies, without gross errors that are certain, and, where they are few,
    without outliers; and warnings about what was left out. jumps: whether an angle is wrapped that
    was not named: pairs contradict their neighbours where it jumps, and none is an error.

    Raises FitError where too few are left, or states have no inner coordinates.
    """
    (pairs, row), messages = found, []
    first = first_occurrences(pairs)
    copies = len(pairs) - len(first)
    if copies:
        messages.append(f"{copies} of {len(pairs)} pairs are copies of others: each counts once")
        pairs, row = pairs.take(first), row[first]
        if structure is None:
            local_jacobians.check_number(pairs)
    data = Dataset.of(pairs, coordinates, structure, row)
    if structure is not None or jumps:  # of many dimensions too few pairs have neighbours
        return data, messages
    everyone, count = data, len(data)
    found_outliers = outliers(data.y0, data.y1, data.scale, given_by(data))
    few = len(found_outliers) <= Options.most_outliers * count
    wrong = np.zeros(count, bool)
    wrong[found_outliers[: len(found_outliers) if few else 0]] = True
    gross = gross_errors(data, steps_between(pairs) == 1, wrong)
    wrong[gross] = True
    kept = np.flatnonzero(~wrong)
    if len(gross):
        data = everyone.lifted_anew(kept)  # the interval of an angle is that of what is left
        if not few:
            found_outliers = kept[outliers(data.y0, data.y1, data.scale, given_by(data))]
            few = len(found_outliers) <= Options.most_outliers * count
            kept = np.setdiff1d(kept, found_outliers) if few else kept
            data = everyone.lifted_anew(kept)
    elif len(kept) < count:
        data = data.take(kept)
    if len(found_outliers):
        messages.append(
            f"{len(found_outliers)} of {count} pairs contradict the pairs around them "
            f"(numbers {named(row[found_outliers])}, from 0): "
            + (
                "outliers, they are left out"
                if few
                else "too many for outliers, they are kept. Is q first, and does z1 follow z0?"
            )
        )
    if len(gross):
        messages.append(
            f"{len(gross)} of {count} pairs (numbers {named(row[gross])}, from 0) are far from a "
            "polynomial fitted to the others: outliers, they are left out"
        )
    return data, messages


def named(rows: np.ndarray) -> str:
    """Write the numbers of the first rows."""
    return ", ".join(map(str, rows[:5])) + (", …" if len(rows) > 5 else "")


def around(data: Dataset, unit: np.ndarray, size: np.ndarray, rows, but: int) -> np.ndarray:
    """Bound (n,) on the residuals ``size`` (N,) of all ``but`` so many of the neighbours of these
    rows, of the state or of the image: a state that is a gross error has none but its like."""
    found = np.full(len(rows), np.inf)
    for y in (data.y0 / unit, data.y1 / unit):
        near = cKDTree(y).query(y[rows], k=Options.neighbours + 1)[1][:, 1:]
        found = np.minimum(found, np.sort(size[near], axis=1)[:, -1 - but])
    return found


def outliers(y0, y1, scale, given=None) -> np.ndarray:
    """Rows of the pairs whose move contradicts that of the pairs around them.

    y0, y1: (N, 2d) with angles lifted. given: (N, k) of unit sizes, what else a move depends on. A
    pair's move is predicted from its neighbours, by an affine
    fit. An outlier misses it by many times what that fit leaves over among them: the deleted
    studentised residual. A steep or noisy map leaves much over everywhere and has no outliers.
    Outliers hide each other: the others are looked at again without those found.
    """
    x, move = np.asarray(y0) / scale, (np.asarray(y1) - np.asarray(y0)) / scale
    x = x if given is None else np.concatenate([x, given], axis=1)
    rows, found = looked_for_errors(len(x)), []
    few = Options.neighbourhoods * local_jacobians.NEIGHBOURS_PER_TERM * (1 + x.shape[1]) / len(x)
    for _ in range(Options.outlier_rounds):
        outlying = _studentised(x[rows], move[rows]) > Options.outlying * max(1.0, few)
        if not outlying.any():
            break
        found.append(rows[outlying])
        rows = rows[~outlying]
    return np.sort(np.concatenate([np.zeros(0, int), *found]))


def _studentised(x, move):
    """The error of each move (N, 2d) predicted by its neighbours, over its standard deviation."""
    n, width = x.shape
    terms = 1 + width
    count = local_jacobians.NEIGHBOURS_PER_TERM * terms
    if n <= count:
        return np.zeros(n)
    tree, floor = cKDTree(x), 1e-13 * (1 + np.abs(move).max())
    error, deviation = np.zeros(n), np.zeros(n)
    rows = _suspect(x, move) if terms > local_jacobians.MANY_TERMS else np.arange(n)
    for block in np.array_split(rows, 1 + len(rows) // 10_000):  # in bounded memory
        near = tree.query(x[block], k=count + 1)[1][:, 1:]
        offset = x[near] - x[block][:, None, :]
        design = np.concatenate([np.ones((*offset.shape[:2], 1)), offset], axis=-1)
        moves, kept = move[near], np.ones(near.shape)
        for _ in range(2):  # the second time without the neighbour that fits worst: an outlier?
            inverse = local_jacobians.pseudo_inverse(design * kept[..., None])
            solution = inverse @ (moves * kept[..., None])
            rest = np.sum((moves - design @ solution) ** 2, axis=-1) * kept
            deviation[block] = np.sqrt(rest.sum(axis=1) / (kept.sum(axis=1) - terms))
            kept[np.arange(len(block)), np.argmax(rest, axis=1)] = 0.0
        growth = np.sqrt(1 + np.sum(inverse[:, 0] ** 2, axis=-1))
        error[block] = np.linalg.norm(move[block] - solution[:, 0], axis=1) / growth
    # With so few neighbours a fit is now and then exact by chance.
    return error / (np.maximum(deviation, np.median(deviation[rows])) + floor)


def looked_for_errors(count: int) -> np.ndarray:
    """Rows of so many pairs that are looked at for gross errors: all, or blocks of every part."""
    blocks = -(-count // Options.block)
    apart = -(-blocks // (Options.most_looked_at // Options.block))
    return np.flatnonzero(np.arange(count) // Options.block % apart == 0)


def _suspect(x, move) -> np.ndarray:
    """Rows whose move one affine map of all pairs misses by more than usual, and a few others: in
    many dimensions neighbours are far apart, and tell little more than all pairs do."""
    design = np.column_stack([np.ones(len(x)), x])
    rest = move - design @ np.linalg.lstsq(design, move, rcond=None)[0]
    size = np.linalg.norm(rest, axis=1)
    far = size > Options.suspect * np.median(size)
    far[: Options.usual] = True
    return np.flatnonzero(far)


_TUKEY = Biweight(6.0)  # in medians


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
        if best is not None and not model.left < Options.gained * best.left:
            continue
        best = model
    if best is None or not best.left < Options.usable:
        return none
    size = np.where(left_out, np.inf, best.sizes)
    far = np.flatnonzero((size > Options.beyond) & ~left_out)
    between = np.sum((size > Options.ordinary) & (size <= Options.beyond))
    # Those that neighbours told before are gross errors too: beside them there may be few.
    few = not len(far) or len(far) + left_out.sum() < Options.fewest_errors
    if few or len(far) > Options.most_errors * len(size) or between > Options.between * len(far):
        return none
    if goes_on.any():
        return _borne_out(best, far, goes_on, left_out)
    alone = far[around(data, best.unit, size, far, Options.but) < Options.ordinary]
    return alone if len(alone) >= Options.alone * len(far) else none


class _Model:
    """Polynomials of one degree, y0 -> y1 and back.

    sizes: (N,) the larger residual of either, in units of its median; 0 where neither state is a
    regressor. left: the larger median, in units of the moves'. unit: (2d,) robust deviations."""

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
        if len(rows) > Options.most_rows:
            rows = np.sort(np.random.default_rng(0).choice(rows, Options.most_rows, replace=False))
        design = self._design(y)
        coefficients, median = _resistant(design[rows], move[rows])
        size = np.linalg.norm(move - design @ coefficients, axis=1)
        in_units = size / median if median > 0 else np.where(size > 0, np.inf, 0.0)
        return (coefficients, median), np.where(inside, in_units, 0.0), median

    def _within(self, y):
        far = np.abs(y - self._centre) > Options.within * self.unit
        far[:, [*self._angles, *self._free]] = False
        return ~far.any(axis=1)

    def _design(self, y):
        """Monomials (N, m) of the coordinates, of an angle's cosine and sine."""
        x = (y - self._centre) / (Options.within / 2 * self.unit)
        columns = []
        for i in range(y.shape[1]):
            if i in self._angles:
                columns += [np.cos(y[:, i]), np.sin(y[:, i])]
            elif i not in self._free:
                columns.append(x[:, i])
        return products(np.reshape(columns, (-1, len(y))).T, self._degree)


def _models(data: Dataset, known: np.ndarray) -> Iterator[_Model]:
    """Models by rising degree, as far as the pairs tell their terms."""
    coordinates, width = data.coordinates, data.y0.shape[1]
    width += len(coordinates.angles) - len(set(coordinates.cyclic) - set(coordinates.angles))
    most = min(Options.most_terms, int(known.sum()) // Options.pairs_per_monomial)
    degree = 1
    while math.comb(width + degree, degree) <= most:
        yield _Model(data, known, degree)
        degree += 1


def _resistant(design, move) -> tuple[np.ndarray, float]:
    """Coefficients (m, 2d) and the median size of the residuals."""
    values, vectors = np.linalg.eigh(design.T @ design)
    known = values > Options.spanned * values[-1]
    turn = vectors[:, known] / np.sqrt(values[known])
    basis, weight = design @ turn, np.ones(len(design))
    coefficients, median = np.zeros((basis.shape[1], move.shape[1])), 0.0
    floor = np.finfo(float).eps * np.abs(move).max(initial=0.0)
    for n in range(Options.absolute + Options.biweight):
        weighted = basis.T * weight
        ridge = Options.spanned * np.eye(len(weighted))
        coefficients = np.linalg.solve(weighted @ basis + ridge, weighted @ move)
        size = np.linalg.norm(move - basis @ coefficients, axis=1)
        median = max(float(np.median(size)), floor)
        if median == 0:
            break
        if n < Options.absolute:
            weight = median / np.maximum(size, median)
        else:
            weight = _TUKEY.weights(size / median)
    return turn @ coefficients, median


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
            if steps > Options.longest or not model.bridge(one, steps, other) <= Options.beyond:
                continue
            bridged += 1
        kept.append(np.arange(one, other + 1))
    if not kept or bridged < Options.bridged * inner:
        return rows[:0]
    found = np.concatenate(kept)
    return found[~left_out[found]]
