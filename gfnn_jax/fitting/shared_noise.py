"""The noise of states that stand in two pairs each: how large it is, and what it does to a fit.

A pair of states with errors e₀, e₁ leaves r = P e₀ + Q e₁. In a sequence e₁ is the e₀ of the next
pair, so that neighbouring rows are not independent: the score Aᵀ r of all rows holds each state's
error once, by Aᵀ Q of one pair and Aᵀ P of the next, which nearly cancel where A is smooth.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

from gfnn_jax.fitting.triangle import Triangle

# Where the residuals cannot tell two coordinates' noise apart, each is given half of its own
# residual's variance, by this weight beside the moments' own.
_PRIOR = 0.1


def variances(residual: np.ndarray, jacobian: np.ndarray, shared: np.ndarray) -> np.ndarray:
    """(2d,) variance of each coordinate's noise, from what pairs leave over, r = e₁ − M e₀.

    residual: (n, 2d). jacobian: M (n, 2d, 2d) of the step. shared: (k,) pairs whose image is the
    state of the next.

    The second moments of r are linear in the variances: Σ + M Σ Mᵀ for one pair, and −Σ Mᵀ between
    a pair and the next one where they share a state. Non-negative least squares over all entries.
    """
    width, count = residual.shape[1], len(residual)
    deviation = np.sqrt(np.mean(residual**2, axis=0))
    deviation = np.where(deviation > 0, deviation, deviation.max() or 1.0)
    r, m = residual / deviation, jacobian * deviation[None, None, :] / deviation[None, :, None]
    one = np.einsum("nik,njk->ijk", m, m) / count
    unit = np.arange(width)
    one[unit, unit, unit] += 1.0
    between = np.zeros((width, width, width))
    between[unit, :, unit] = -m[shared + 1].sum(axis=0).T / count
    moments = r.T @ r / count, r[shared].T @ r[shared + 1] / count
    parts = one.reshape(-1, width), between.reshape(-1, width), _PRIOR * np.eye(width)
    target = *(moment.ravel() for moment in moments), np.full(width, 0.5 * _PRIOR)
    variance, _ = nnls(np.concatenate(parts), np.concatenate(target))
    return deviation**2 * np.maximum(variance, 1.0 / count)  # so many residuals tell no less


def scores(
    slopes: np.ndarray, residual: np.ndarray, first: np.ndarray, second: np.ndarray,
    goes_on: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """(k, m): what one deviation of each state's each coordinate adds to Aᵀ r; the sum of the rows'
    squares is the covariance of Aᵀ r.

    slopes: A (n, 2d, m) of pairs in their order. residual: r (n, 2d). first, second: P and Q
    (n, 2d, 2d). goes_on: (n − 1,) whether the image of a pair is the state of the next.
    """
    step = np.linalg.solve(second, np.concatenate([residual[..., None], -first], axis=-1))
    deviation = np.sqrt(variances(step[..., 0], step[..., 1:], np.flatnonzero(goes_on)))
    of_first, of_second = (part.swapaxes(1, 2) @ slopes for part in (first, second))
    of_first[1:][goes_on] += of_second[:-1][goes_on]
    alone = of_second[np.append(~goes_on, True)]
    each = np.concatenate([of_first, alone]) * deviation[:, None]
    return each.reshape(-1, slopes.shape[-1])


def freedom(slopes: np.ndarray, residual: np.ndarray, scores: np.ndarray) -> float:
    """Degrees of freedom that the noise of these scores (k, m) takes of the residual (n, 2d) in a
    fit of A = slopes (n, 2d, m): as many as there are terms, were the rows independent."""
    rows = np.concatenate([slopes, residual[..., None]], axis=-1)
    root = Triangle.of(rows.reshape(-1, rows.shape[-1])).spectrum().root()
    return float(np.sum((scores @ root) ** 2) / np.mean(residual**2))
