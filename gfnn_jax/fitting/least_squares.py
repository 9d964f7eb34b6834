"""Fits of families that are linear in their parameters: one least-squares solve.

The loss (paper, eq. (3)) is quadratic in S, so with S = Σ c_j φ_j it is ‖A c − b‖², A the stacked
gradients of the terms and b the wanted gradients. It is solved by QR and SVD, never by the normal
equations alone: A's rows are reduced chunk by chunk to the triangular factor R of [A b] (which
holds all that the data say), columns are scaled, and the SVD of R gives rank, condition number and
every ridge parameter at once. Memory: one chunk of rows and R, 8 (chunk·2d + m)(m + 1) bytes for
m parameters, whatever the number of pairs.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import NamedTuple

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

    coefficients: Float[Array, "m"]
    train_rms: float
    validation_rms: float
    rank: int
    condition: float
    ridge: float


@partial(jax.jit, static_argnums=(0,))
def _rows(family, w, wanted, weight):
    """Weighted rows [A b] of a chunk: (N 2d, m + 1)."""
    features = jax.vmap(family.gradient_features)(w) * weight[None, :, None]
    rows = jnp.concatenate([features, (wanted * weight[None, :])[..., None]], axis=-1)
    return rows.reshape(-1, rows.shape[-1])


@jax.jit
def _fold(factor, rows):
    """R of the stacked [R; rows]: the QR step that forgets the rows."""
    return jnp.linalg.qr(jnp.concatenate([factor, rows]), mode="r")


def chunk_size(num_parameters: int, dim: int) -> int:
    """Pairs per chunk that keep its rows within 256 MiB."""
    return max(64, _CHUNK_BYTES // (8 * 2 * dim * (num_parameters + 1)))


def triangular_factor(family, chunks: Iterable, weight) -> tuple[np.ndarray, int]:
    """R of [A b] over chunks of (w, wanted), and the number of rows seen.

    Each chunk: w and wanted of shape (n, 2d). weight: (2d,) of the rows of one pair.
    """
    m = family.num_parameters + 1
    factor, seen = jnp.zeros((0, m)), 0
    for w, wanted in chunks:
        rows = _rows(family, jnp.asarray(w), jnp.asarray(wanted), jnp.asarray(weight))
        factor = _fold(factor, rows)
        seen += rows.shape[0]
    return np.asarray(factor), seen


def solve(factor: np.ndarray, num_rows: int, validation_factor: np.ndarray, validation_rows: int):
    """Coefficients from the triangular factors of the training and of the validation rows.

    Scaled columns; the ridge parameter with the smallest validation error among a ladder, zero
    included, so that noisy or too few data give a regularised fit and clean ones the plain one.
    """
    a, b = factor[:, :-1], factor[:, -1]
    column = np.linalg.norm(a, axis=0)
    column = np.where(column > 0, column, 1.0)
    u, s, vt = np.linalg.svd(a / column, full_matrices=False)
    along = u.T @ b
    eps = np.finfo(np.float64).eps
    cutoff = eps * max(a.shape) * s[0]
    rank = int(np.sum(s > cutoff))
    inverse = [np.where(s > cutoff, s, np.inf) for _ in _RIDGES[:1]]
    filters = [1.0 / inverse[0]] + [s / (s**2 + (r * s[0]) ** 2) for r in _RIDGES[1:]]
    candidates = (vt.T @ (np.stack(filters) * along).T) / column[:, None]
    errors = np.linalg.norm(
        validation_factor[:, :-1] @ candidates - validation_factor[:, -1:], axis=0
    )
    # Prefer the least ridge that is as good as the best one to within a few per cent.
    best = int(np.argmax(errors <= 1.02 * errors.min()))
    c = candidates[:, best]
    return LeastSquaresFit(
        coefficients=jnp.asarray(c),
        train_rms=float(np.linalg.norm(a @ c - b) / np.sqrt(num_rows)),
        validation_rms=float(errors[best] / np.sqrt(validation_rows)),
        rank=rank,
        condition=float(s[0] / s[-1]) if s[-1] > 0 else float("inf"),
        ridge=_RIDGES[best],
    )


def fit(family, train, validation, weight) -> LeastSquaresFit:
    """Fit a linear family to train = (w, wanted), each (N, 2d); validation likewise, held out.

    weight: (2d,), what a row of ∇S is multiplied by: h divided by the scale of the conjugate
    coordinate, so that the result does not depend on the units of q and p.
    """

    def chunks(w, wanted):
        n = chunk_size(family.num_parameters, w.shape[-1] // 2)
        return ((w[i : i + n], wanted[i : i + n]) for i in range(0, len(w), n))

    factors = [triangular_factor(family, chunks(*data), weight) for data in (train, validation)]
    return solve(*factors[0], *factors[1])
