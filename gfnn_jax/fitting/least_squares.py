"""Fits of families that are linear in their parameters: one least-squares solve, on the host.

The loss (paper, eq. (3)) is quadratic in S, so with S = Σ c_j φ_j it is ‖A c − b‖², A the stacked
gradients of the terms and b the target gradients. Rows of [A b] are folded block by block into
their triangle (`fitting.triangle`), whose leading columns answer for every smaller family whose
terms come first.

A size is judged by a triangular solve (`residuals`). The coefficients of a finalist come from the
singular values of its leading columns, which give the rank, the condition number and every ridge
parameter at once (`solve`).

Memory for m parameters: one block of rows and the triangle, whatever the number of pairs.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from gfnn_jax.errors import FitError
from gfnn_jax.families.products import Products
from gfnn_jax.families.sines import Sines
from gfnn_jax.fitting import row_blocks
from gfnn_jax.fitting.triangle import Triangle


class Options:
    """Options of the solves (benchmarks/constants.py)."""

    # Rows that are folded at once stay in the cache: 16 MiB take a quarter longer per row. A
    # block of 1,500 terms takes 50 ms on two cores.
    block_bytes: int = 2 * 2**20
    fewest_rows: int = 256
    # Rows of a part that a device folds, for each term: to merge two parts takes a third as many
    # operations as rows as there are terms. An accelerator wants larger ones: with these an H100
    # is 31 times as fast as a core for 1,000 terms (benchmarks/gpu.sh); others were not tried.
    part_on_cpu: int = 4
    part_on_accelerators: int = 16
    # Standard deviations of chance by which a ridge must lower the held-out squares. Of
    # Hénon–Heiles with noise of 1e-2 and 10⁴ pairs (benchmarks/bands.py) chance alone chose 0.01:
    # 4 times the error.
    certain: float = 3.0
    # A leading block is judged by a triangular solve where the smallest diagonal entry of R,
    # relative to its column, is no smaller than this, and where there are as many rows per term.
    well_conditioned: float = 1e-13
    well_determined: float = 1.5


# Rows per term, the fewest that the terms of S are fitted to. Of 70 clean pairs of a pendulum half
# as many gain two digits by a map that is 1.7 times as dear, and twice as many lose one and a half
# (benchmarks/constants.py).
ROWS_PER_TERM = 3
# Ridge parameters tried, relative to the largest singular value; the first is plain least squares.
_RIDGES = (0.0, *(10.0**k for k in range(-13, 0)))


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


def reduce(
    family: Any,
    rows: Iterable[Sequence[np.ndarray]],
    weight: np.ndarray,
    on_block: Callable[[], Any] | None = None,
) -> Triangle:
    """The triangle of a linear family, from (w, target_gradient), each (N, 2d), in parts; with args
    (N, k) as the third where the family depends on them.

    rows:     any number of such pairs of arrays, which need never be in memory together.
    weight:   (2d,), what a row of ∇S is multiplied by: h divided by the scale of the conjugate
              coordinate, so that the result does not depend on the units of q and p.
    on_block: called before each block of rows; it may raise to stop.

    Raises FitError where a term's gradient or a target is not finite.
    """

    def reporting(parts: Iterator[Any]) -> Iterator[Any]:
        for part in parts:
            if on_block is not None:
                on_block()
            yield part

    if row_blocks.devices():
        found = _on_devices(family, rows, weight, reporting)
    else:
        found = _of_parts(family, reporting(_blocks(rows, family.num_parameters)), weight)
    if not found.finite:
        raise FitError("expected finite gradients of all terms and finite targets on the pairs")
    return found


def _of_parts(family: Any, parts: Iterable[Sequence[Any]], weight) -> Triangle:
    """The triangle of these blocks of (w, target_gradient), and args."""
    m = family.num_parameters

    def rows() -> Iterator[np.ndarray]:
        for w, target, *args in parts:
            block = np.empty((w.size, m + 1), order="F")
            gradients = family.term_gradients(w, *args) * weight[:, None]
            block[:, :m] = gradients.reshape(-1, m)
            block[:, m] = (target * weight).ravel()
            yield block

    return Triangle.of_blocks(rows(), m)


def _on_devices(family: Any, rows, weight, reporting: Callable[[Iterator], Iterator]) -> Triangle:
    """The triangle of rows that are shared out among devices."""
    m = family.num_parameters
    on_host = row_blocks.devices()[0].platform == "cpu" or not accelerator_takes(family)
    least = (Options.part_on_cpu if on_host else Options.part_on_accelerators) * (m + 1)

    def of_part(part, device) -> Triangle:
        if on_host:
            return _of_parts(family, _blocks([part], m), weight)
        pairs = _pairs_of(m, part[0].shape[1], least)
        return Triangle(factor_on_device(family, part, weight, pairs, device), part[0].size)

    def of_both(one: Triangle, other: Triangle, device) -> Triangle:
        if on_host:
            return one.merge(other)
        factor = merged_on_device(one.factor, other.factor, device)
        return Triangle(factor, one.rows + other.rows)

    found = row_blocks.tree(of_part, reporting(_blocks(rows, m, least)), of_both)
    return Triangle.empty(m) if found is None else found


def _blocks(rows, num_parameters: int, least: int = 0) -> Iterator[tuple[np.ndarray, ...]]:
    """(w, target_gradient), and args, of as many pairs as one block holds, or ``least`` rows."""
    for part in rows:
        part = tuple(np.asarray(a, np.float64) for a in part)
        pairs = _pairs_of(num_parameters, part[0].shape[1], least)
        for first in range(0, len(part[0]), pairs):
            yield tuple(a[first : first + pairs] for a in part)


def _pairs_of(num_parameters: int, width: int, least: int) -> int:
    """Number of pairs of states (2d,) of this width in a block."""
    return max(
        1,
        max(Options.fewest_rows, Options.block_bytes // (8 * (num_parameters + 1)), least) // width,
    )


def residuals(train: Triangle, held: Triangle, sizes: Sequence[int]) -> list[tuple[float, float]]:
    """(train_rms, validation_rms) of the leading ``size`` terms, for each of these sizes.

    Of the plain solution, by one triangular solve, where the training rows determine it well; else
    as `solve` has them, which costs an SVD.
    """
    found = []
    for size in sizes:
        a, b = train.leading(size)
        diagonal = np.abs(np.diagonal(a))
        well_conditioned = (diagonal > Options.well_conditioned * np.linalg.norm(a, axis=0)).all()
        if not well_conditioned or train.rows < Options.well_determined * size:
            fit = solve(train, held, size)
            found.append((fit.train_rms, fit.validation_rms))
        else:
            c = scipy.linalg.solve_triangular(a, b, check_finite=False)
            found.append((_rms(train.residual_norm(size), train), _rms(held.missed(c), held)))
    return found


def _rms(norm: Any, of: Triangle) -> float:
    return float(norm) / math.sqrt(of.rows)


def solve(train: Triangle, held: Triangle, num_terms: int) -> LeastSquaresFit:
    """Coefficients of the leading ``num_terms`` terms.

    Scaled columns; the ridge parameter with the smallest error on the held-out rows where that is
    smaller than the plain one's by more than their noise makes it by chance, so that too few data
    give a regularised fit and others the plain one: what a ridge shrinks, no posterior knows of.
    """
    found = train.spectrum(num_terms)
    filters = np.stack([found.inverse, *(found.ridged(ridge) for ridge in _RIDGES[1:])])
    tried = found.solution(filters)
    errors = held.missed(tried)
    best = int(np.argmin(errors))
    apart = held.image_norm(tried[:, best] - tried[:, 0])
    by_chance = Options.certain * 2 * apart * errors[best] / math.sqrt(max(held.rows, 1))
    if not errors[0] ** 2 - errors[best] ** 2 > by_chance:
        best = 0
    c, error = tried[:, best], errors[best]
    # A coefficient no larger than rounding of b would make it is zero, if held-out pairs agree.
    # A symmetry of S that is broken by 1e-17 biases the rounding of every step in one direction.
    noise = 4 * np.finfo(np.float64).eps * train.norm * found.deviations(filters[best])
    rounded = np.where(np.abs(c) > noise, c, 0.0)
    rounded_error = held.missed(rounded)
    if rounded_error <= 1.01 * error:
        c, error = rounded, rounded_error
    return LeastSquaresFit(
        coefficients=c,
        train_rms=_rms(train.missed(c), train),
        validation_rms=_rms(error, held),
        rank=found.rank,
        condition=found.condition,
        ridge=_RIDGES[best],
    )


def accelerator_takes(family: Any) -> bool:
    """Return whether the gradients of its terms can be traced by JAX."""
    return isinstance(family, (Products, Sines))


def factor_on_device(
    family: Any, rows: Sequence[np.ndarray], weight, pairs: int, device
) -> np.ndarray:
    """R of [A b] of rows (w, target_gradient), and args, filled up to so many pairs: one shape, one
    program."""
    count = len(rows[0])
    taken = np.minimum(np.arange(max(pairs, count)), count - 1)
    weights = (taken == np.arange(len(taken)))[:, None] * np.asarray(weight)
    filled = tuple(array[taken] for array in rows)
    return np.asfortranarray(_factor_on_device(*jax.device_put((family, filled, weights), device)))


def merged_on_device(one: np.ndarray, other: np.ndarray, device) -> np.ndarray:
    """R of the stacked [one; other]."""
    return np.asfortranarray(_merged_on_device(*jax.device_put((one, other), device)))


@jax.jit
def _factor_on_device(family, rows, weights):
    w, target, *args = rows
    gradients = family.term_gradients(w, *args) * weights[..., None]
    block = jnp.concatenate([gradients, (target * weights)[..., None]], axis=-1)
    return jnp.linalg.qr(block.reshape(-1, block.shape[-1]), mode="r")


@jax.jit
def _merged_on_device(one, other):
    return jnp.linalg.qr(jnp.concatenate([one, other]), mode="r")
