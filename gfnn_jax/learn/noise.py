"""The noise of the states, from what a fitted map leaves over."""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

from gfnn_jax.coordinates import CARTESIAN, nearest_image
from gfnn_jax.learn.assemble import stepped
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import Pairs, sizes

_APART = 1e-4  # of the coordinates' sizes: the step of the central differences
# Where the residuals cannot tell two coordinates' noise apart, each is given half of its own
# residual's variance, by this weight beside the moments' own.
_PRIOR = 0.1


def state_noise(map_: SymplecticMap, pairs: Pairs, taken: float) -> np.ndarray:
    """Standard deviation (2d,) of each coordinate's noise, from the residuals of these pairs.

    taken: the part of the residuals' degrees of freedom that the map's coefficients took.

    A pair of states with errors e₀, e₁ leaves r = e₁ − M e₀, M the step's Jacobian. The second
    moments of r are linear in the variances: Σ + M Σ Mᵀ for one pair, and −Σ Mᵀ between a pair and
    the next one where they share a state. Non-negative least squares over all entries.
    """
    z0, z1 = np.asarray(pairs.z0), np.asarray(pairs.z1)
    width, size, coordinates = z0.shape[1], sizes(z0), map_.coordinates
    angles = coordinates.angles if coordinates.forward is CARTESIAN.forward else ()
    given = pairs.dt, pairs.args
    steps = stepped(map_, z0, *given, timed=False)
    residual = nearest_image(z1 - steps.images, angles)
    jacobian = np.empty((len(z0), width, width))
    for j, apart in enumerate(_APART * size):
        offset = apart * (np.arange(width) == j)
        ahead, behind = (
            stepped(map_, z0 + s * offset, *given, timed=False).images for s in (1, -1)
        )
        jacobian[:, :, j] = nearest_image(ahead - behind, angles) / (2 * apart)
    known = np.isfinite(residual).all(axis=1) & np.isfinite(jacobian).all(axis=(1, 2))
    z0, z1, r, m = z0[known], z1[known], residual[known], jacobian[known]
    deviation = np.sqrt(np.mean(r**2, axis=0))
    deviation = np.where(deviation > 0, deviation, size)
    r, m = r / deviation, m * deviation[None, None, :] / deviation[None, :, None]
    one = np.einsum("nik,njk->ijk", m, m) / len(r)
    unit = np.arange(width)
    one[unit, unit, unit] += 1.0
    shared = np.flatnonzero(np.all(z1[:-1] == z0[1:], axis=1))
    between = np.zeros((width, width, width))
    between[unit, :, unit] = -m[shared + 1].sum(axis=0).T / len(r)
    moments = r.T @ r / len(r), r[shared].T @ r[shared + 1] / len(r)
    parts = one.reshape(-1, width), between.reshape(-1, width), _PRIOR * np.eye(width)
    target = *(moment.ravel() for moment in moments), np.full(width, 0.5 * _PRIOR)
    variance, _ = nnls(np.concatenate(parts), np.concatenate(target))
    variance = np.maximum(variance, 1.0 / len(r))  # so many residuals tell no less
    return deviation * np.sqrt(variance / (1.0 - taken))
