"""The noise of the states, from what a fitted map leaves over."""

from __future__ import annotations

import numpy as np

from gfnn_jax.candidates.assemble import stepped
from gfnn_jax.coordinates import CARTESIAN, nearest_image
from gfnn_jax.dataset.noise import of_halves, of_pairs
from gfnn_jax.dataset.runs import next_of
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import Pairs, sizes

_APART = 1e-4  # of the coordinates' sizes: the step of the central differences
_PROBES = 4  # random directions of each half of the coordinates


def state_noise(map_: SymplecticMap, pairs: Pairs, taken: float) -> np.ndarray:
    """Standard deviation (2d,) of each coordinate's noise, from the residuals of these pairs.

    pairs: with their runs and places, in the order of these. taken: the part of the residuals'
    degrees of freedom that the map's coefficients took.
    """
    z0, z1 = np.asarray(pairs.z0), np.asarray(pairs.z1)
    width, size = z0.shape[1], sizes(z0)
    residual = _difference(map_, z1, _images(map_, pairs, z0))
    jacobian = np.empty((len(z0), width, width))
    for j, apart in enumerate(_APART * size):
        offset = apart * (np.arange(width) == j)
        jacobian[:, :, j] = _change(map_, pairs, offset) / apart
    known = np.isfinite(residual).all(axis=1) & np.isfinite(jacobian).all(axis=(1, 2))
    shared = np.flatnonzero(next_of(pairs, np.flatnonzero(known)))
    return of_pairs(residual[known], jacobian[known], shared) / np.sqrt(1.0 - taken)


def noise_of_sites(map_: SymplecticMap, pairs: Pairs) -> np.ndarray:
    """The same (2d,) where all positions have one noise, and all momenta one, as of equal sites.

    The sums of squares of M's rows are means of (M v)² over random signs v: the steps that they
    take do not depend on d (Hutchinson, Commun. Stat. Simul. 18 (1989) 1059).
    """
    z0, z1 = np.asarray(pairs.z0), np.asarray(pairs.z1)
    dim, size, rng = pairs.dim, sizes(z0), np.random.default_rng(0)
    residual = _difference(map_, z1, _images(map_, pairs, z0))
    halves = np.arange(2 * dim) // dim
    grown = np.zeros((2, len(z0), 2 * dim))
    for half in (0, 1):
        apart = _APART * float(size[halves == half].min())
        for _ in range(_PROBES):
            signs = rng.choice([-1.0, 1.0], z0.shape) * (halves == half)
            grown[half] += (_change(map_, pairs, apart * signs) / apart) ** 2 / _PROBES
    known = np.isfinite(residual).all(axis=1) & np.isfinite(grown).all(axis=(0, 2))
    return of_halves(residual[known], grown[:, known])


def _images(map_: SymplecticMap, pairs: Pairs, z) -> np.ndarray:
    return stepped(map_, z, pairs.dt, pairs.args, timed=False).images


def _change(map_: SymplecticMap, pairs: Pairs, offset) -> np.ndarray:
    """(N, 2d), what the step changes by when the states of the pairs change by the offset, to
    second order."""
    z0 = np.asarray(pairs.z0)
    ahead, behind = (_images(map_, pairs, z0 + sign * offset) for sign in (1, -1))
    return _difference(map_, ahead, behind) / 2


def _difference(map_: SymplecticMap, one, other) -> np.ndarray:
    plain = map_.coordinates.forward is CARTESIAN.forward
    return nearest_image(one - other, map_.coordinates.angles if plain else ())
