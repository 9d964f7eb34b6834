"""Uncertainty of least-squares coefficients, whatever the residuals are made of.

The coefficients of min ‖A c − b‖ move by (AᵀA)⁻¹ Aᵀ r when b moves by r. With r independent row by
row their covariance is (AᵀA)⁻¹ (Aᵀ diag(r²) A) (AᵀA)⁻¹: each row counts with its own residual
(White, Econometrica 48 (1980) 817), so that a part of phase space where the map is worse is known
worse, and no other. A row that the coefficients have bent towards themselves, of leverage h, has a
residual of r / (1 − h) (MacKinnon & White, J. Econometrics 29 (1985) 305).

Rows of a sequence share the noise of their states. A pair of states with errors e₀, e₁ leaves
r = P e₀ + Q e₁, and e₁ is the e₀ of the next pair: the score Aᵀ r of all rows holds each state's
error once, by Aᵀ Q of one pair and Aᵀ P of the next, which nearly cancel where A is smooth
(`scores`). The size of the noise is that of `dataset.noise.of_pairs`.

What the terms cannot represent is not independent: it stays, however many pairs there are. Of
``rows`` such residuals only as many count as there are terms, each in its own part of phase space.
"""

import numpy as np
from scipy.special import gammainc

from gfnn_jax.dataset.rows import of_pairs
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

    taken: degrees of freedom that noise takes of them (`uncertainty.degrees_of_freedom`); None:
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
    left: tuple[np.ndarray, np.ndarray],
    *,
    noise: float | None,
    ridge: float = 0.0,
    scores: np.ndarray | None = None,
) -> np.ndarray:
    """(size, size): rootᵀ root is the covariance of the coefficients of the leading terms.

    left: rows of A (n, size) among those of ``train``, and their residuals (n,).
    noise: the part of its mean square that is noise; None: not known, and then none of it is.
    ridge: of `least_squares.solve`. scores: (k, size) of these rows' noise, from
    `uncertainty.scores`; None: it is independent from row to row. Directions that are not told, of
    columns scaled to one, are 0, as in the solution.
    """
    (sample, residual), spectrum = left, train.spectrum(size)
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


def scores(
    slopes: np.ndarray,
    residual: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    goes_on: np.ndarray,
) -> np.ndarray:
    """(k, m): what one deviation of each state's each coordinate adds to Aᵀ r; the sum of the rows'
    squares is the covariance of Aᵀ r.

    slopes: A (n, 2d, m) of pairs in their order. residual: r (n, 2d). first, second: P and Q
    (n, 2d, 2d). goes_on: (n − 1,) whether the image of a pair is the state of the next.
    """
    step = np.linalg.solve(second, np.concatenate([residual[..., None], -first], axis=-1))
    deviation = of_pairs(step[..., 0], step[..., 1:], np.flatnonzero(goes_on))
    of_first, of_second = (part.swapaxes(1, 2) @ slopes for part in (first, second))
    of_first[1:][goes_on] += of_second[:-1][goes_on]
    alone = of_second[np.append(~goes_on, True)]
    each = np.concatenate([of_first, alone]) * deviation[:, None]
    return each.reshape(-1, slopes.shape[-1])


def degrees_of_freedom(slopes: np.ndarray, residual: np.ndarray, scores: np.ndarray) -> float:
    """Degrees of freedom that the noise of these scores (k, m) takes of the residual (n, 2d) in a
    fit of A = slopes (n, 2d, m): as many as there are terms, were the rows independent."""
    rows = np.concatenate([slopes, residual[..., None]], axis=-1)
    root = Triangle.of(rows.reshape(-1, rows.shape[-1])).spectrum().root()
    return float(np.sum((scores @ root) ** 2) / np.mean(residual**2))
