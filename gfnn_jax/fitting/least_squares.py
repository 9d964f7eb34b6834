"""Fits of families that are linear in their parameters: one least-squares solve, on the host.

The loss (paper, eq. (3)) is quadratic in S, so with S = Σ c_j φ_j it is ‖A c − b‖², A the stacked
gradients of the terms and b the target gradients. Rows of [A b] are folded block by block into the
triangular factor R of [A b], which holds all that the data say; the normal equations would square
the condition number. Leading columns of R answer for every smaller family whose terms come first.

A size is judged by a triangular solve (`residuals`). The coefficients of a finalist come from the
SVD of its leading block of R with scaled columns, which gives the rank, the condition number and
every ridge parameter at once (`solve`).

Memory for m parameters: one block of rows and R, whatever the number of pairs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from gfnn_jax.errors import FitError
from gfnn_jax.fitting import accelerated, row_blocks
from gfnn_jax.fitting.triangular import folded
from gfnn_jax.threads import one_thread

# Rows that are folded at once stay in the cache: 16 MiB take a quarter longer per row. A block of
# 1,500 terms takes 50 ms on two cores.
_BLOCK_BYTES, _FEWEST_ROWS = 2 * 2**20, 256
# Rows of a part that a device folds, for each term: to merge two parts takes a third as many
# operations as rows as there are terms. An accelerator wants larger ones, and was not at hand to
# tell how large.
_PART_ON_CPU, _PART_ON_ACCELERATORS = 4, 16
# Ridge parameters tried, relative to the largest singular value; the first is plain least squares.
_RIDGES = (0.0, *(10.0**k for k in range(-13, 0)))
# Standard deviations of chance by which a ridge must lower the held-out squares. Of Hénon–Heiles
# with noise of 1e-2 and 10⁴ pairs (benchmarks/bands.py) chance alone chose 0.01: 4 times the error.
_CERTAIN = 3.0
# A leading block is judged by a triangular solve where the smallest diagonal entry of R, relative
# to its column, is no smaller than this, and where there are as many rows per term.
_WELL_CONDITIONED, _WELL_DETERMINED = 1e-13, 1.5


class LeastSquaresFit(NamedTuple):
    """Coefficients and how well determined they are.

    coefficients: (terms,) NumPy. train_rms: per-component RMS of weight · (∇S − target_gradient).
    validation_rms: the same on held-out rows. rank: numerical rank of the scaled columns.
    condition: their condition number. ridge: the parameter that the held-out rows chose, relative
    to the largest singular value.
    """

    coefficients: np.ndarray
    train_rms: float
    validation_rms: float
    rank: int
    condition: float
    ridge: float


class Reduced(NamedTuple):
    """All that some rows say about a family: the triangular factor (m + 1, m + 1) of [A b], and how
    many rows it stands for."""

    factor: np.ndarray
    rows: int


def reduce(
    family: Any,
    rows: Iterable[Sequence[np.ndarray]],
    weight: np.ndarray,
    on_block: Callable[[], Any] | None = None,
) -> Reduced:
    """The factor of [A b] of a linear family, from (w, target_gradient), each (N, 2d), in parts;
    with args (N, k) as the third where the family depends on them.

    rows:     any number of such pairs of arrays, which need never be in memory together.
    weight:   (2d,), what a row of ∇S is multiplied by: h divided by the scale of the conjugate
              coordinate, so that the result does not depend on the units of q and p.
    on_block: called before each block of rows; it may raise to stop.

    Raises FitError where a term's gradient or a target is not finite.
    """
    if row_blocks.devices():
        return _finite(_reduced_on_devices(family, rows, weight, on_block))
    m = family.num_parameters
    factor, seen = np.zeros((m + 1, m + 1), order="F"), 0
    for part in _blocks(rows, m):
        if on_block is not None:
            on_block()
        block = _block_of(family, part, weight)
        with one_thread():
            factor = folded(factor, block)
        seen += len(block)
    return _finite(Reduced(factor, seen))


def _block_of(family: Any, part: Sequence[Any], weight) -> np.ndarray:
    """[A b] of these rows: LAPACK works in place on columns that are contiguous."""
    (w, target, *args), m = part, family.num_parameters
    block = np.empty((w.size, m + 1), order="F")
    gradients = family.term_gradients(w, *args) * weight[:, None]
    block[:, :m] = gradients.reshape(-1, m)
    block[:, m] = (target * weight).ravel()
    return block


def _finite(reduced: Reduced) -> Reduced:
    if not np.isfinite(reduced.factor).all():
        raise FitError("expected finite gradients of all terms and finite targets on the pairs")
    return reduced


def _reduced_on_devices(family: Any, rows, weight, on_block) -> Reduced:
    """The factor of rows that are shared out among devices."""
    m = family.num_parameters
    on_host = row_blocks.devices()[0].platform == "cpu" or not accelerated.takes(family)
    least = (_PART_ON_CPU if on_host else _PART_ON_ACCELERATORS) * (m + 1)

    def parts() -> Iterator[tuple[np.ndarray, ...]]:
        for part in _blocks(rows, m, least):
            if on_block is not None:
                on_block()
            yield part

    def of_part(part, device) -> Reduced:
        if not on_host:
            pairs = _pairs_of(m, part[0].shape[1], least)
            return Reduced(accelerated.factor(family, part, weight, pairs, device), part[0].size)
        factor = np.zeros((m + 1, m + 1), order="F")
        for block in _blocks([part], m):
            factor = folded(factor, _block_of(family, block, weight))
        return Reduced(factor, part[0].size)

    def of_both(one: Reduced, other: Reduced, device) -> Reduced:
        seen = one.rows + other.rows
        if not on_host:
            return Reduced(accelerated.merged(one.factor, other.factor, device), seen)
        return Reduced(folded(one.factor, other.factor, triangular=True), seen)

    found = row_blocks.tree(of_part, parts(), of_both)
    return Reduced(np.zeros((m + 1, m + 1), order="F"), 0) if found is None else found


def merged(one: Reduced, other: Reduced) -> Reduced:
    """The factor of the rows of both."""
    with one_thread():
        factor = folded(np.array(one.factor, order="F"), np.array(other.factor, order="F"))
    return Reduced(factor, one.rows + other.rows)


def _blocks(rows, num_parameters: int, least: int = 0) -> Iterator[tuple[np.ndarray, ...]]:
    """(w, target_gradient), and args, of as many pairs as one block holds, or ``least`` rows."""
    for part in rows:
        part = tuple(np.asarray(a, np.float64) for a in part)
        pairs = _pairs_of(num_parameters, part[0].shape[1], least)
        for first in range(0, len(part[0]), pairs):
            yield tuple(a[first : first + pairs] for a in part)


def _pairs_of(num_parameters: int, width: int, least: int) -> int:
    """How many pairs of states (2d,) of this width a block holds."""
    return max(1, max(_FEWEST_ROWS, _BLOCK_BYTES // (8 * (num_parameters + 1)), least) // width)


def residuals(train: Reduced, held: Reduced, sizes: Sequence[int]) -> list[tuple[float, float]]:
    """(train_rms, validation_rms) of the leading ``size`` terms, for each of these sizes.

    Of the plain solution, by one triangular solve, where the training rows determine it well; else
    as `solve` has them, which costs an SVD.
    """
    return [_residual(train, held, size) for size in sizes]


def _residual(train: Reduced, held: Reduced, size: int) -> tuple[float, float]:
    a, b = train.factor[:size, :size], train.factor[:, -1]
    column = np.linalg.norm(a, axis=0)
    diagonal = np.abs(np.diagonal(a))
    well_conditioned = (diagonal > _WELL_CONDITIONED * column).all()
    if not well_conditioned or train.rows < _WELL_DETERMINED * size:
        fit = solve(train, held, size)
        return fit.train_rms, fit.validation_rms
    c = scipy.linalg.solve_triangular(a, b[:size], check_finite=False)
    return _rms(np.linalg.norm(b[size:]), train.rows), _rms(_missed(held, c), held.rows)


def _missed(reduced: Reduced, coefficients) -> float:
    """‖A c − b‖ of the leading terms."""
    size = len(coefficients)
    top = reduced.factor[:size, :size] @ coefficients - reduced.factor[:size, -1]
    return float(np.hypot(np.linalg.norm(top), np.linalg.norm(reduced.factor[size:, -1])))


def _rms(norm: Any, rows: int) -> float:
    return float(norm) / math.sqrt(rows)


def solve(train: Reduced, held: Reduced, num_terms: int) -> LeastSquaresFit:
    """Coefficients of the leading ``num_terms`` terms.

    Scaled columns; the ridge parameter with the smallest error on the held-out rows where that is
    smaller than the plain one's by more than their noise makes it by chance, so that too few data
    give a regularised fit and others the plain one: what a ridge shrinks, no posterior knows of.
    """
    # Below its leading block R has zeros in these columns.
    a, b = train.factor[:num_terms, :num_terms], train.factor[:num_terms, -1]
    held_a, held_b = held.factor[:num_terms, :num_terms], held.factor[:num_terms, -1]
    held_rest = np.linalg.norm(held.factor[num_terms:, -1])
    column = np.linalg.norm(a, axis=0)
    column = np.where(column > 0, column, 1.0)
    u, s, vt = np.linalg.svd(a / column, full_matrices=False)
    along = u.T @ b
    cutoff = np.finfo(np.float64).eps * len(train.factor) * s[0]
    known = s > cutoff
    plain = np.where(known, 1.0 / np.where(known, s, 1.0), 0.0)
    filters = np.stack([plain, *(_ridge_filter(s, ridge) for ridge in _RIDGES[1:])])
    tried = (vt.T @ (filters * along).T) / column[:, None]
    errors = np.hypot(np.linalg.norm(held_a @ tried - held_b[:, None], axis=0), held_rest)
    best = int(np.argmin(errors))
    apart = np.linalg.norm(held_a @ (tried[:, best] - tried[:, 0]))
    by_chance = _CERTAIN * 2 * apart * errors[best] / math.sqrt(max(held.rows, 1))
    if not errors[0] ** 2 - errors[best] ** 2 > by_chance:
        best = 0
    c, error = tried[:, best], errors[best]
    # A coefficient no larger than rounding of b would make it is zero, if held-out pairs agree.
    # A symmetry of S that is broken by 1e-17 biases the rounding of every step in one direction.
    rounding = 4 * np.finfo(np.float64).eps * np.linalg.norm(train.factor[:, -1])
    noise = rounding * np.linalg.norm(vt.T * filters[best], axis=1) / column
    rounded = np.where(np.abs(c) > noise, c, 0.0)
    rounded_error = _missed(held, rounded)
    if rounded_error <= 1.01 * error:
        c, error = rounded, rounded_error
    return LeastSquaresFit(
        coefficients=c,
        train_rms=_rms(_missed(train, c), train.rows),
        validation_rms=_rms(error, held.rows),
        rank=int(known.sum()),
        condition=float(s[0] / s[-1]) if s[-1] > 0 else float("inf"),
        ridge=_RIDGES[best],
    )


def _ridge_filter(s, ridge: float):
    """What the singular values' reciprocals become: s / (s² + (ridge s₀)²); zero where s₀ is."""
    damped = s**2 + (ridge * s[0]) ** 2
    return np.divide(s, damped, out=np.zeros_like(s), where=damped > 0)


def fit(
    family: Any,
    train: tuple[np.ndarray, np.ndarray],
    held: tuple[np.ndarray, np.ndarray],
    weight: np.ndarray,
) -> LeastSquaresFit:
    """Fit one linear family to (w, target_gradient): ``reduce`` and ``solve`` in one go."""
    factors = [reduce(family, [rows], weight) for rows in (train, held)]
    return solve(factors[0], factors[1], family.num_parameters)
