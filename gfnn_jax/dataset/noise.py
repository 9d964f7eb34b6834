"""The noise of measured states: the standard deviation of each coordinate, from what is left over.

What is known of the motion decides which of these tells it:

- `of_differences`: only that orbits are smooth, and their steps short.
- `of_pairs`: the Jacobian M of the map, of whose pairs e₁ − M e₀ is left over.
- `of_halves`: products of M with random signs, where all positions are alike, and all momenta.

Where the orbits themselves are known, the noise is what is left over of the states
(`solve.noise.of_residuals`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gfnn_jax.solve.linear import non_negative

# Where the residuals cannot tell two coordinates' noise apart, each is given half of its own
# residual's variance, by this weight beside the moments' own.
_PRIOR = 0.1


def of_differences(moves: Sequence[np.ndarray], order: int, alike: float) -> float | None:
    """One deviation for all coordinates, from the steps z_{k+1} − z_k (n, 2d) along each run.

    Differences of a high order leave nothing of a smooth orbit, and √C(2n, n) times the noise. None
    where those of this order and of the one before tell deviations that differ by more than the
    factor ``alike``.
    """
    found = []
    for n in (order - 1, order):
        differences = [np.diff(along, n - 1, axis=0) for along in moves if len(along) > n]
        size = np.sqrt(np.mean(np.concatenate(differences) ** 2))
        found.append(float(size / np.sqrt(math.comb(2 * n, n))))
    low, high = min(found), max(found)
    return found[-1] if 0 < high <= alike * low else None


def of_pairs(residual: np.ndarray, jacobian: np.ndarray, shared: np.ndarray) -> np.ndarray:
    """(2d,) from what pairs leave over, r = e₁ − M e₀.

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
    variance = non_negative(np.concatenate(parts), np.concatenate(target))
    # So many residuals tell no less.
    return deviation * np.sqrt(np.maximum(variance, 1.0 / count))


def of_halves(residual: np.ndarray, grown: np.ndarray) -> np.ndarray:
    """(2d,) where all positions have one noise, and all momenta one.

    residual: (n, 2d) of pairs. grown: (2, n, 2d), the sums Σ_j M_ij² over the positions j, and over
    the momenta: the mean square of r_i is s² + Σ_j M_ij² s_j², linear in the two variances.
    """
    halves = np.arange(residual.shape[1]) // (residual.shape[1] // 2)
    mean = np.array([np.mean(residual[:, halves == half] ** 2) for half in (0, 1)])
    factors = np.array(
        [[np.mean(grown[by][:, halves == half]) for by in (0, 1)] for half in (0, 1)]
    ) + np.eye(2)
    # In units of each half's own residual, as q and p may differ by orders of magnitude.
    relative = factors * mean / mean[:, None]
    rows = np.concatenate([relative, _PRIOR * np.eye(2)])
    found = non_negative(rows, np.concatenate([np.ones(2), np.full(2, 0.5 * _PRIOR)]))
    return np.sqrt(mean * found)[halves]
