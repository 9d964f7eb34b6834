"""Fits of families that are linear in their parameters: one least-squares solve.

The loss (paper, eq. (3)) is quadratic in S, so with S = Σ c_j φ_j it is ‖A c − b‖², A the stacked
gradients of the terms and b the wanted gradients. It is solved by QR and SVD, never by the normal
equations alone: A's rows are reduced chunk by chunk to the triangular factor R of [A b] (which
holds all that the data say), columns are scaled, and the SVD of R gives rank, condition number and
every ridge parameter at once. Memory: one chunk of rows and R, 8 (chunk·2d + m)(m + 1) bytes for
m parameters, whatever the number of pairs.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_CHUNK_BYTES = 256 * 2**20
# Ridge parameters tried, relative to the largest singular value; the first is plain least squares.
_RIDGES = (0.0, *(10.0**k for k in range(-13, 0)))


class LeastSquaresFit(NamedTuple):
    """Coefficients and how well determined they are.

    train_rms: per-component RMS of h(∇S − wanted) in the rows' scale. validation_rms: the same on
    held-out rows. rank: numerical rank of the scaled columns. condition: their condition number.
    ridge: the parameter that validation chose, relative to the largest singular value.
    """

    coefficients: Float[Array, "_"]
    train_rms: float
    validation_rms: float
    rank: int
    condition: float
    ridge: float


def _rows(family, w, wanted, weight):
    """Weighted rows [A b] of a chunk: (N 2d, m + 1)."""
    features = jax.vmap(family.gradient_features)(w) * weight[None, :, None]
    rows = jnp.concatenate([features, (wanted * weight[None, :])[..., None]], axis=-1)
    return rows.reshape(-1, rows.shape[-1])


@jax.jit
def _fold(family, factor, w, wanted, weight):
    """R of the stacked [R; rows of this chunk]: the QR step that forgets the rows."""
    rows = _rows(family, w, wanted, weight)
    return jnp.linalg.qr(jnp.concatenate([factor, rows]), mode="r")


# Compiled once for each kind of family and shape of chunk, whatever the data.
_COMPILED: dict[Any, Any] = {}


def chunk_size(num_parameters: int, dim: int) -> int:
    """Pairs per chunk that keep its rows within 256 MiB."""
    return max(64, _CHUNK_BYTES // (8 * 2 * dim * (num_parameters + 1)))


class Reduced(NamedTuple):
    """All that the data say about a family: the triangular factors of [A b], small terms first.

    factor, rows: of the training rows; validation_factor, validation_rows: of those held out.
    Leading columns answer for every smaller family whose terms are the leading ones.
    """

    factor: np.ndarray
    rows: int
    validation_factor: np.ndarray
    validation_rows: int
    seconds: float
    compile_seconds: float


def reduce(family, train, validation, weight) -> Reduced:
    """Reduce (w, wanted) of training and held-out pairs, (N, 2d) each, for a linear family.

    weight: (2d,), what a row of ∇S is multiplied by: h divided by the scale of the conjugate
    coordinate, so that the result does not depend on the units of q and p.
    """
    n = chunk_size(family.num_parameters, train[0].shape[-1] // 2)

    def chunks(w, wanted):
        return ((w[i : i + n], wanted[i : i + n]) for i in range(0, len(w), n))

    return reduce_chunks(family, chunks(*train), chunks(*validation), weight)


def reduce_chunks(family, train: Iterable, validation: Iterable, weight) -> Reduced:
    """As ``reduce``, of chunks of (w, wanted) that need never be in memory together."""
    started = time.perf_counter()
    stage = _Stage(family, jnp.asarray(weight))
    factor, rows = stage.factor(train)
    held, held_rows = stage.factor(validation)
    seconds = time.perf_counter() - started - stage.compile_seconds
    return Reduced(factor, rows, held, held_rows, seconds, stage.compile_seconds)


class _Stage:
    """The chunk-wise reduction of one family's rows, compilation timed apart."""

    def __init__(self, family, weight):
        self.family, self.weight = family, weight
        self.compile_seconds = 0.0

    def factor(self, chunks: Iterable) -> tuple[np.ndarray, int]:
        """R of [A b] over chunks of (w, wanted), and the number of rows seen."""
        m = self.family.num_parameters + 1
        factor, seen = jnp.zeros((0, m)), 0
        for w, wanted in chunks:
            factor = self._fold(factor, jnp.asarray(w), jnp.asarray(wanted))
            seen += w.size
        return np.asarray(factor), seen

    def _fold(self, factor, w, wanted):
        arguments = (self.family, factor, w, wanted, self.weight)
        kind = (jax.tree.structure(self.family), factor.shape, w.shape)
        if kind not in _COMPILED:
            started = time.perf_counter()
            _COMPILED[kind] = _fold.lower(*arguments).compile()
            self.compile_seconds += time.perf_counter() - started
        return _COMPILED[kind](*arguments)


def solve(reduced: Reduced, num_terms: int) -> LeastSquaresFit:
    """Coefficients of the leading ``num_terms`` terms.

    Scaled columns; the ridge parameter with the smallest validation error among a ladder, zero
    included, so that noisy or too few data give a regularised fit and clean ones the plain one.
    """
    a, b = reduced.factor[:, :num_terms], reduced.factor[:, -1]
    held_a, held_b = reduced.validation_factor[:, :num_terms], reduced.validation_factor[:, -1]
    column = np.linalg.norm(a, axis=0)
    column = np.where(column > 0, column, 1.0)
    u, s, vt = np.linalg.svd(a / column, full_matrices=False)
    along = u.T @ b
    cutoff = np.finfo(np.float64).eps * max(a.shape) * s[0]
    known = s > cutoff
    plain = np.where(known, 1.0 / np.where(known, s, 1.0), 0.0)
    filters = np.stack([plain, *(s / (s**2 + (r * s[0]) ** 2) for r in _RIDGES[1:])])
    tried = (vt.T @ (filters * along).T) / column[:, None]
    errors = np.linalg.norm(held_a @ tried - held_b[:, None], axis=0)
    best = int(np.argmin(errors))
    c, error = tried[:, best], errors[best]
    # A coefficient no larger than rounding of b would make it is zero, if held-out pairs agree.
    # A symmetry of S that is broken by 1e-17 biases the rounding of every step in one direction.
    rounding = 4 * np.finfo(np.float64).eps * np.linalg.norm(b)
    noise = rounding * np.linalg.norm(vt.T * filters[best], axis=1) / column
    told = np.where(np.abs(c) > noise, c, 0.0)
    told_error = np.linalg.norm(held_a @ told - held_b)
    if told_error <= 1.01 * error:
        c, error = told, told_error
    return LeastSquaresFit(
        coefficients=jnp.asarray(c),
        train_rms=float(np.linalg.norm(a @ c - b) / np.sqrt(reduced.rows)),
        validation_rms=float(error / np.sqrt(reduced.validation_rows)),
        rank=int(known.sum()),
        condition=float(s[0] / s[-1]) if s[-1] > 0 else float("inf"),
        ridge=_RIDGES[best],
    )


def fit(family, train, validation, weight) -> LeastSquaresFit:
    """Fit one linear family: ``reduce`` and ``solve`` in one go."""
    return solve(reduce(family, train, validation, weight), family.num_parameters)
