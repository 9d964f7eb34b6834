"""The noise of states that stand in two pairs each, and what it does to a fit.

A pair of states with errors e₀, e₁ leaves r = P e₀ + Q e₁. In a sequence e₁ is the e₀ of the next
pair, so that neighbouring rows are not independent: the score Aᵀ r of all rows holds each state's
error once, by Aᵀ Q of one pair and Aᵀ P of the next, which nearly cancel where A is smooth. The
size of the noise is that of `dataset.noise.of_pairs`.
"""

from __future__ import annotations

import numpy as np

from gfnn_jax.dataset.noise import of_pairs
from gfnn_jax.fitting.triangle import Triangle


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
