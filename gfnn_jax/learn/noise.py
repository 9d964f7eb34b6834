"""The noise of the states, from what a fitted map leaves over."""

from __future__ import annotations

import numpy as np

from gfnn_jax.coordinates import CARTESIAN, nearest_image
from gfnn_jax.fitting.shared_noise import variances
from gfnn_jax.learn.assemble import stepped
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import Pairs, sizes

_APART = 1e-4  # of the coordinates' sizes: the step of the central differences


def state_noise(map_: SymplecticMap, pairs: Pairs, taken: float) -> np.ndarray:
    """Standard deviation (2d,) of each coordinate's noise, from the residuals of these pairs.

    taken: the part of the residuals' degrees of freedom that the map's coefficients took.
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
    shared = np.flatnonzero(np.all(z1[:-1] == z0[1:], axis=1))
    return np.sqrt(variances(r, m, shared) / (1.0 - taken))
