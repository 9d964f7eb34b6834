"""Uncertainty of least-squares coefficients, whatever the residuals are made of.

The coefficients of min ‖A c − b‖ move by (AᵀA)⁻¹ Aᵀ r when b moves by r. With r independent row by
row their covariance is (AᵀA)⁻¹ (Aᵀ diag(r²) A) (AᵀA)⁻¹: each row counts with its own residual
(White, Econometrica 48 (1980) 817), so that a part of phase space where the map is worse is known
worse, and no other. A row that the coefficients have bent towards themselves, of leverage h, has a
residual of r / (1 − h) (MacKinnon & White, J. Econometrics 29 (1985) 305).

Rows of a sequence share the noise of their states: `fitting.shared_noise` says what that does to
Aᵀ r, in the place of the rows' own residuals.

What the terms cannot represent is not independent: it stays, however many pairs there are. Of
``rows`` such residuals only as many count as there are terms, each in its own part of phase space.
"""

from __future__ import annotations

import numpy as np
from scipy.special import gammainc

from gfnn_jax.fitting.triangle import Triangle

# A row is never taken for one that the coefficients reproduce whatever it says.
_MOST_LEVERAGE = 0.9
# Variance of a misfit beside that of residuals which differ from one part of phase space to another
# by chance: it is alike along an orbit. With 1, bands of two deviations held 86 to 90 % of the true
# errors at step 100 (benchmarks/bands.py, Hénon–Heiles without noise) and were 1.3 RMS errors wide.
ALIKE = 2.0
# The mean of a variance that fewer terms tell does not exist.
_FEWEST_TERMS, _TINY = 3, 1e-280


def variance(triangle: Triangle, size: int, taken: float | None = None) -> float:
    """Mean square per degree of freedom that the leading ``size`` terms leave of these rows.

    taken: degrees of freedom that noise takes of them (`shared_noise.degrees_of_freedom`); None:
    noise is independent from row to row, and takes ``size``.
    """
    left = triangle.residual_norm(size) ** 2
    return left / max(triangle.rows - (size if taken is None else taken), 1.0)


def misfit(explained: float, terms: int, variance: float) -> float:
    """The sum of squares that ``terms`` further terms are to be expected to stand for, which
    explain ``explained`` of a residual; noise of this variance alone gives variance · χ²(terms).

    The posterior mean, never 0: every entry of the triangular factor that belongs to a further term
    is normal, of a variance v no smaller than that of the noise, and 1/v is its prior density.
    """
    if terms < 1 or not variance > 0:
        return max(explained, 0.0)
    shape = max(terms, _FEWEST_TERMS) / 2 - 1
    most = explained / (2 * variance)
    upper = float(gammainc(shape + 1, most))
    # The mean of v; its limit where far less is explained than noise would, and nothing is left of
    # the integrals.
    mean = variance * (1 + 1 / shape)
    if upper > _TINY:
        mean = 0.5 * explained * float(gammainc(shape, most)) / (shape * upper)
    return terms * max(mean - variance, 0.0)


def root(
    train: Triangle,
    size: int,
    sample: np.ndarray,
    residual: np.ndarray,
    *,
    noise: float | None,
    ridge: float = 0.0,
    scores: np.ndarray | None = None,
) -> np.ndarray:
    """(size, size): rootᵀ root is the covariance of the coefficients of the leading terms.

    sample, residual: rows of A (n, size) among those of ``train``, and of what is left over (n,).
    noise: the part of its mean square that is noise; None: not known, and then none of it is.
    ridge: of `least_squares.solve`. scores: (k, size) of these rows' noise, from
    `shared_noise.scores`; None: it is independent from row to row. Directions that are not told, of
    columns scaled to one, are 0, as in the solution.
    """
    spectrum = train.spectrum(size)
    along, degrees = spectrum.root(ridge), max(spectrum.degrees_of_freedom(ridge), 1.0)
    leverage = np.minimum(np.sum((sample @ along) ** 2, axis=1), _MOST_LEVERAGE)
    rows = np.linalg.qr((residual / (1 - leverage))[:, None] * sample, mode="r")
    share = 0.0 if noise is None else min(noise, 1.0)
    misfit = (1 - share) * ALIKE * max(train.rows / degrees, 1.0)
    of_noise = rows if scores is None else np.linalg.qr(scores, mode="r")
    both = np.concatenate([np.sqrt(share) * of_noise, np.sqrt(misfit) * rows])
    weighted = np.linalg.qr(np.sqrt(train.rows / len(sample)) * both, mode="r")
    found = np.zeros((size, size))
    found[: len(weighted)] = (weighted @ along) @ along.T
    return found
