"""Diagnosis of the map from the pairs by themselves: local Jacobians, of neighbours. NumPy.

The Jacobians give the determinant of each chart over the data, and how symplectic the data are.
Neighbours also tell which pairs are outliers, and the residuals of a fit whether there is friction.
"""

from __future__ import annotations

import math
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from gfnn_jax.errors import FitError
from gfnn_jax.generating.charts import AnyChart
from gfnn_jax.phase_space import Pairs, sizes, symplecticity_defect

# States at which a Jacobian is taken: so many, or as many as so many operations allow, in eight
# degrees of freedom 50 instead of ten seconds and more.
_CENTRES, _FEWEST_CENTRES, _OPERATIONS = 400, 50, 5e9
# Neighbours per unknown of a local fit: enough to average noise, few enough to stay local.
_NEIGHBOURS_PER_TERM = 3
# From so many pairs on the neighbourhoods keep their size: more pairs then average the noise away
# instead of shrinking them below it.
_LOCAL_ENOUGH, _MOST_NEIGHBOURS = 4_000, 1_000
# Neighbours are sought among so many pairs: a tree of a million takes a second more.
_MOST_AMONG = 200_000
_FILLED = 0.03  # of a neighbourhood's size: a thinner one says nothing of the direction across
_SPANNED = 1e-8  # a smaller singular value of a local fit is a direction without neighbours
# With more terms than these a local fit goes by its Gram matrix, which tells no directions apart
# that are smaller than the second figure: with 65 terms ten times as fast as singular values.
_MANY_TERMS, _SPANNED_OF_GRAM = 40, 1e-7
# Neighbourhoods grow until noise leaves no more than this error in the Jacobian's entries.
_SLOPE_ERROR = 0.05
# Pairs are held not to be symplectic whose Jacobians are known well enough, as a part of their
# distance from the identity, and miss by so many errors and by more than this part of it.
_KNOWN, _ERRORS, _MISSED = 0.06, 3.0, 0.1
# A pair is an outlier that its neighbours' fit misses by so many standard deviations.
_OUTLYING, _OUTLIER_ROUNDS = 30.0, 5
# Where there are fewer pairs than so many neighbourhoods hold, more deviations make an outlier, by
# that factor. Of 4,000 times 20 clean pairs of a kicked pendulum the most is 102 deviations: a fit
# to a few neighbours is now and then good by chance.
_NEIGHBOURHOODS = 10
# Pairs that are looked at for gross errors, in blocks of a sequence: 50,000 take two seconds.
_MOST_LOOKED_AT, _BLOCK = 50_000, 1_000
# Of more terms than a few (above) only pairs are looked at that an affine map of all misses by so
# many times the median, and so many that tell what is usual: 2,000 pairs of 32 degrees of freedom
# take a second instead of eight.
_SUSPECT, _USUAL = 3.0, 100
# Neighbours that spread less than this part of their largest spread do not fill a direction.
_THIN = 0.05
# What an affine fit within sequences may leave of a residual that agrees within them; neighbours
# among which the nearest one of another sequence is sought.
_EXPLAINED, _SEQUENCE_NEIGHBOURS = 0.25, 50
_NEARBY = 16  # neighbours that tell the size of what is left over at a state
# Times as much as a neighbour as far in the same sequence leaves over, one of another sequence does
# where something differs between them.
_ACROSS = 3.0
# A cubic law is fitted where there are so many pairs for each of its terms.
_PAIRS_PER_TERM = 10
# The changes of volume of the inner half of the states and of the outer: within a factor, or by so
# many standard errors, they are the same.
_ALIKE, _HALVES_APART = 3.0, 2.0
# A determinant this far from zero is safe; below the lower figure the chart folds inside the data.
SAFE, SINGULAR = 0.2, 0.03


def check_number(pairs: Pairs) -> None:
    """Raises FitError where there are fewer pairs than a local Jacobian needs."""
    if len(pairs) < 8 * pairs.dim:
        turned = 8 * len(pairs) < 2 * pairs.dim
        raise FitError(
            f"expected at least {8 * pairs.dim} different pairs for d = {pairs.dim}, "
            f"got {len(pairs)}" + turned * ": a row is a state; are the arrays transposed?"
        )


class ChartDeterminant(NamedTuple):
    """The determinant of a chart over the data.

    low: its 1 % quantile towards zero, counted in the sign of the majority (negative where the sign
    changes). sign: of the majority. negative: the fraction below zero.
    """

    low: float
    sign: int
    negative: float

    @property
    def valid(self) -> bool:
        """Return whether w determines z over the data."""
        return self.low > SINGULAR


def local_jacobians(y0, y1, scale, given=None, *, seed: int = 0) -> tuple[np.ndarray, float]:
    """Jacobians of y0 -> y1 at 50 to 400 of the states, (n, 2d, 2d), and the error of their entries
    in coordinates of unit size, infinite where most are not known in all directions.

    y0, y1: (N, 2d) with angles lifted; scale (2d,) makes the coordinates comparable. given: (N, k)
    of unit sizes, what else a move depends on. A local
    quadratic fit where there are pairs enough, else a local linear one; over more neighbours where
    the pairs are noisy.
    """
    n, of_state = y0.shape
    x, move = np.asarray(y0) / scale, (np.asarray(y1) - np.asarray(y0)) / scale
    x = x if given is None else np.concatenate([x, given], axis=1)
    width = x.shape[1]
    i, j = np.triu_indices(width)
    quadratic = n >= 20 * (1 + width + len(i))
    terms = 1 + width + (len(i) if quadratic else 0)
    fewest = _NEIGHBOURS_PER_TERM * terms
    count = min(n, max(fewest, min(_MOST_NEIGHBOURS, fewest * n // _LOCAL_ENOUGH)))
    affordable = max(_FEWEST_CENTRES, int(_OPERATIONS / (6 * count * terms**2)))
    chosen = _centres(n, min(_CENTRES, affordable), seed)
    among = _among(n, seed)
    tree = cKDTree(x[among])
    while True:
        _, near = tree.query(x[chosen], k=count)
        near = among[near]
        offset = x[near] - x[chosen][:, None, :]
        columns = [np.ones((*offset.shape[:2], 1)), offset]
        if quadratic:
            columns.append(offset[..., i] * offset[..., j])
        design = np.concatenate(columns, axis=-1)
        inverse = _pseudo_inverse(design)
        solution = inverse @ move[near]
        rest = move[near] - design @ solution
        noise = np.sqrt(np.sum(rest**2, axis=1) / max(1, count - terms))
        spread = np.sqrt(np.sum(inverse[:, 1 : 1 + width] ** 2, axis=-1))
        error = np.median(noise.max(axis=1) * spread.max(axis=1))
        if error <= _SLOPE_ERROR or count >= min(n, _MOST_NEIGHBOURS):
            break
        count = min(n, _MOST_NEIGHBOURS, 2 * count)
    slope = np.eye(of_state) + np.swapaxes(solution[:, 1 : 1 + of_state], 1, 2)
    # How far neighbours reach in the direction where they differ least, apart from what the other
    # columns tell of it: along a curve or a torus the rest of the map is anybody's guess.
    reach = 1 / (np.sqrt(count) * spread.max(axis=1) * np.sqrt(np.mean(offset**2, axis=(1, 2))))
    filled = _full_rank(design) & (reach > _FILLED)
    known = float(error + 0.5 * count * error**2) if np.mean(filled) > 0.5 else np.inf
    return slope * scale[:, None] / scale[None, :], known


def centres(y0, jacobians, seed: int) -> np.ndarray:
    """(n, 2d): the states among y0 (N, 2d) at which `local_jacobians` of this seed are."""
    return np.asarray(y0)[_centres(len(y0), len(jacobians), seed)]


def _centres(count: int, most: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).permutation(count)[:most]


def _among(count: int, seed: int) -> np.ndarray:
    """The rows of so many among which neighbours are sought."""
    if count <= _MOST_AMONG:
        return np.arange(count)
    return np.sort(_centres(count, _MOST_AMONG, seed))


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
    few = _NEIGHBOURHOODS * _NEIGHBOURS_PER_TERM * (1 + x.shape[1]) / len(x)
    for _ in range(_OUTLIER_ROUNDS):
        outlying = _studentised(x[rows], move[rows]) > _OUTLYING * max(1.0, few)
        if not outlying.any():
            break
        found.append(rows[outlying])
        rows = rows[~outlying]
    return np.sort(np.concatenate([np.zeros(0, int), *found]))


def _studentised(x, move):
    """The error of each move (N, 2d) predicted by its neighbours, over its standard deviation."""
    n, width = x.shape
    terms = 1 + width
    count = _NEIGHBOURS_PER_TERM * terms
    if n <= count:
        return np.zeros(n)
    tree, floor = cKDTree(x), 1e-13 * (1 + np.abs(move).max())
    error, deviation = np.zeros(n), np.zeros(n)
    rows = _suspect(x, move) if terms > _MANY_TERMS else np.arange(n)
    for block in np.array_split(rows, 1 + len(rows) // 10_000):  # in bounded memory
        near = tree.query(x[block], k=count + 1)[1][:, 1:]
        offset = x[near] - x[block][:, None, :]
        design = np.concatenate([np.ones((*offset.shape[:2], 1)), offset], axis=-1)
        moves, kept = move[near], np.ones(near.shape)
        for _ in range(2):  # the second time without the neighbour that fits worst: an outlier?
            inverse = _pseudo_inverse(design * kept[..., None])
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
    blocks = -(-count // _BLOCK)
    apart = -(-blocks // (_MOST_LOOKED_AT // _BLOCK))
    return np.flatnonzero(np.arange(count) // _BLOCK % apart == 0)


def _suspect(x, move) -> np.ndarray:
    """Rows whose move one affine map of all pairs misses by more than usual, and a few others: in
    many dimensions neighbours are far apart, and tell little more than all pairs do."""
    design = np.column_stack([np.ones(len(x)), x])
    rest = move - design @ np.linalg.lstsq(design, move, rcond=None)[0]
    size = np.linalg.norm(rest, axis=1)
    far = size > _SUSPECT * np.median(size)
    far[:_USUAL] = True
    return np.flatnonzero(far)


def _pseudo_inverse(design):
    """Pseudo-inverses of local designs (n, neighbours, terms). They take the map for the identity
    in what the neighbours do not span: a thin tube of data, the torus of a single orbit."""
    if design.shape[-1] <= _MANY_TERMS:
        return np.linalg.pinv(design, rcond=_SPANNED)
    across = np.swapaxes(design, 1, 2)
    gram = across @ design
    ridge = _SPANNED_OF_GRAM**2 * np.trace(gram, axis1=1, axis2=2)
    inverse = np.linalg.inv(gram + ridge[:, None, None] * np.eye(gram.shape[-1])) @ across
    return 2 * inverse - (inverse @ design) @ inverse  # a step of Newton's takes the ridge back


def _full_rank(design):
    """Return whether the neighbours of each local design (n, neighbours, terms) tell all terms
    apart."""
    terms = design.shape[-1]
    if terms <= _MANY_TERMS:
        return np.linalg.matrix_rank(design, rtol=_SPANNED) == terms
    squares = np.linalg.eigvalsh(np.swapaxes(design, 1, 2) @ design)
    return squares[:, 0] > _SPANNED_OF_GRAM**2 * squares[:, -1]


def chart_determinant(chart: AnyChart, jacobians, scale) -> ChartDeterminant:
    """The chart's determinant over the data; type 1's in coordinates of unit size."""
    dim = len(scale) // 2
    determinant = chart.determinant(np.asarray(jacobians))
    if chart.name == "type1":
        determinant = determinant * np.prod(scale[dim:] / scale[:dim])
    sign = 1 if np.median(determinant) >= 0 else -1
    return ChartDeterminant(
        float(np.quantile(sign * determinant, 0.01)), sign, float(np.mean(determinant < 0))
    )


def data_defect(jacobians, scale) -> float:
    """Median over the data of ‖Mᵀ J M − J‖ (largest entry, coordinates of unit size).

    For pairs of a symplectic map that of the local fits' error.
    """
    return float(np.median(symplecticity_defect(np.asarray(jacobians), np.asarray(scale))))


def look_symplectic(jacobians, error: float, scale) -> bool:
    """Return whether the pairs may be those of a symplectic map, as far as their local Jacobians
    tell.

    Every map of a short step is close to the identity and so to a symplectic one: the defect is
    held against M − 1, and against the Jacobians' own error. Columns in another order miss by a
    third of M − 1 or more, as does a rate of friction that is as large as the system's own.
    """
    move = np.abs(jacobians * scale[None, None, :] / scale[None, :, None] - np.eye(len(scale)))
    size = float(np.median(move.max(axis=(1, 2))))
    defect = data_defect(jacobians, scale)
    return error > _KNOWN * size or defect <= max(_ERRORS * error, _MISSED * size)


def volume_change(z, residual) -> tuple[float, float]:
    """(change of phase-space volume per step, its standard error) that a symplectic fit left over.

    z, residual: (N, 2d), states and Z − Z_predicted. The residual of a symplectic map is noise or
    has no divergence; friction is linear in z to first order, and its trace is the rate at which
    volumes shrink. The fit takes up a part of it, by a field without divergence that is not linear:
    the divergence is the mean of a cubic law's over the states, or a linear law's where the pairs
    are few. (0, inf) where the law explains less than half of the residual.

    Friction holds everywhere; a misfit may be concentrated where states are few, and a law fitted
    to it then has any divergence. The change is 0 where the inner half of the states and the outer
    one, by their distance from the mean in units of the spread, do not agree on it.
    """
    z, residual = np.asarray(z), np.asarray(residual)
    change, error = _divergence(z, residual)
    if not np.isfinite(error):
        return change, error
    distance = np.linalg.norm((z - z.mean(axis=0)) / sizes(z), axis=1)
    inside = distance <= np.median(distance)
    (one, its), (other, others) = (_divergence(z[h], residual[h]) for h in (inside, ~inside))
    alike = 1 / _ALIKE <= one / other <= _ALIKE if other else False
    agree = alike or abs(one - other) <= _HALVES_APART * np.hypot(its, others)
    return (change if agree else 0.0), error


def _divergence(z, residual) -> tuple[float, float]:
    """The mean divergence of the law that explains these residuals, and its standard error; (0,
    inf) where it explains less than half of them."""
    width = z.shape[1]
    size = sizes(z)
    x = (z - z.mean(axis=0)) / size
    few = len(z) < _PAIRS_PER_TERM * math.comb(width + 3, 3)
    degrees = range(2 if few else 4)
    terms = [t for k in degrees for t in combinations_with_replacement(range(width), k)]

    def monomials(terms):
        return np.stack([np.prod(x[:, list(term)], axis=1) for term in terms], axis=1)

    design = monomials(terms)
    coefficients = np.linalg.lstsq(design, residual, rcond=None)[0]
    rest = residual - design @ coefficients
    if np.mean(rest**2) > 0.5 * np.mean(residual**2):
        return 0.0, np.inf
    covariance = np.linalg.pinv(design.T @ design)
    change, variance = 0.0, 0.0
    for i in range(width):
        own = [j for j, term in enumerate(terms) if i in term]
        powers = np.array([terms[j].count(i) for j in own])
        lowered = monomials([_without(terms[j], i) for j in own])
        slope = np.zeros(len(terms))  # of each term, in direction i
        slope[own] = powers * lowered.mean(axis=0) / size[i]
        change += slope @ coefficients[:, i]
        variance += slope @ covariance @ slope * rest[:, i].var()
    return float(change), float(np.sqrt(variance))


def _without(term: tuple[int, ...], i: int) -> tuple[int, ...]:
    """The term with one factor of the i-th coordinate less."""
    place = term.index(i)
    return term[:place] + term[place + 1 :]


def sampled_dimension(y, scale) -> int:
    """Dimension of the set that the states y (N, 2d) were sampled from: 1 along a curve, 2d where
    they fill a region.

    Local principal components: in how many directions, in units of scale (2d,), the neighbours of a
    state spread by more than a twentieth of their largest spread, in the median over the states.
    """
    x, width = np.asarray(y) / scale, np.shape(y)[1]
    count = min(len(x), _NEIGHBOURS_PER_TERM * (1 + width))
    centres = np.linspace(0, len(x) - 1, min(_CENTRES, len(x))).astype(int)
    among = x[_among(len(x), 0)]
    _, near = cKDTree(among).query(x[centres], k=count)
    offset = among[near] - among[near].mean(axis=1, keepdims=True)
    spread = np.linalg.svd(offset, compute_uv=False)
    return int(np.median(np.sum(spread > _THIN * spread[:, :1], axis=1)))


def _in_local_units(z: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Residuals (N, 2d) ÷ their root mean square among the neighbours of z (N, 2d)."""
    count = min(len(z), _NEARBY)
    _, near = cKDTree(z).query(z, k=count)
    size = np.sqrt(np.mean(residual[near.reshape(len(z), count)] ** 2, axis=1))
    return residual / np.where(size > 0, size, 1.0)


def differs_between_sequences(z, residual, sequence) -> bool:
    """Return whether what a fit left over agrees within a sequence and differs between sequences:
    then something that the states do not hold, a parameter, differs between them.

    z, residual: (N, 2d), in units of the coordinates' sizes; sequence: (N,). Within, every other
    pair of a sequence is predicted by an affine fit to the rest of it; between, a pair by its
    nearest neighbour in other sequences, and by the next one of its own that is no nearer. Noise is
    predicted by none of them, a misfit by as far a neighbour of whichever sequence; where that is
    too far away to tell, as in many dimensions, nothing is. Residuals are looked at in units of
    their size nearby: a step magnifies the noise of the states, in close passages a hundred times,
    and a few of these would stand for all.
    """
    z = np.asarray(z)
    residual = _in_local_units(z, np.asarray(residual))
    total, within, rows = 0.0, 0.0, []
    for number in np.unique(sequence):
        own = np.flatnonzero(sequence == number)
        if len(own) < 4 * (1 + z.shape[1]):
            continue
        design = np.column_stack([np.ones(len(own)), z[own]])
        fitted = np.linalg.lstsq(design[::2], residual[own[::2]], rcond=None)[0]
        total += np.sum(residual[own[1::2]] ** 2)
        within += np.sum((residual[own[1::2]] - design[1::2] @ fitted) ** 2)
        rows.append(own)
    if len(rows) < 2 or not within < _EXPLAINED * total:
        return False
    rows = np.concatenate(rows)
    count = min(len(rows), _SEQUENCE_NEIGHBOURS)
    _, near = cKDTree(z[rows]).query(z[rows], k=count)
    other = sequence[rows][near] != sequence[rows][:, None]
    first = np.argmax(other, axis=1)  # the nearest of another sequence
    as_far = ~other & (np.arange(count) > first[:, None])
    known = other.any(axis=1) & as_far.any(axis=1)
    residual, near, places = residual[rows], near[known], np.arange(len(rows))[known]
    across, along = (
        np.sum((residual[places] - residual[near[np.arange(len(near)), k[known]]]) ** 2)
        for k in (first, np.argmax(as_far, axis=1))
    )
    return bool(across > 0.5 * np.sum(residual[places] ** 2) and across > _ACROSS * along)
