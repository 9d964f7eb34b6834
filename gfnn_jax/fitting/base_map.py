"""The base map R: an affine symplectic map factored out where no chart covers the data without it.

Far from the identity (return maps, stroboscopic maps) the map's linear part is a large rotation and
every near-identity chart folds. R(z) = the time-1 flow of the affine Hamiltonian field
ż = A (z − c) + b, A a Hamiltonian matrix (J A symmetric), so that R is symplectic exactly; its
half R^½ is the time-½ flow. S then generates R^−½-conjugated data, R^½ z -> R^−½ Z: the even split
keeps reversibility.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg

from gfnn_jax.maps.affine import Affine
from gfnn_jax.phase_space import symplectic_form


def fit_half_map(
    y0,
    y1,
    scale,
    *,
    angles: tuple[int, ...] = (),
    reversor: tuple[int, ...] | None = None,
) -> Affine | None:
    """R^½ for the pairs y0 -> y1, each (N, 2d), angles lifted: least squares, made symplectic.

    The regression's matrix M is turned into a Hamiltonian one, the projection of log M. R commutes
    with the shift of an angle: it only shifts angles and shears them by the momenta. With the signs
    (2d,) of a reversor ρ, the field is made reversible (ρc = c, ρAρ = −A, ρb = −b), and so the
    rest of the map stays. None where M has no real logarithm (a pair of negative eigenvalues).
    """
    y0, y1 = np.asarray(y0), np.asarray(y1)
    width = y0.shape[1]
    dim = width // 2
    centre = y0.mean(axis=0)
    signs = np.ones(width) if reversor is None else np.array(reversor, dtype=float)
    centre = 0.5 * (centre + signs * centre)
    plain = [i for i in range(width) if i not in angles]
    x, image = (y0 - centre) / scale, (y1 - centre) / scale
    design = np.column_stack([np.ones(len(x)), x[:, plain]])
    solution = np.linalg.lstsq(design, image - x, rcond=None)[0]
    matrix = np.eye(width)
    matrix[:, plain] += solution[1:].T
    matrix = matrix * scale[:, None] / scale[None, :]
    shift = solution[0] * scale

    form = symplectic_form(dim)
    logarithm = scipy.linalg.logm(matrix)
    if np.abs(np.imag(logarithm)).max(initial=0.0) > 1e-6 * (1 + np.abs(logarithm).max()):
        return None  # inversion with stretching: not the flow of any linear field
    logarithm = np.real(logarithm)
    symmetric = -form @ logarithm  # A = J·symmetric for a Hamiltonian A
    symmetric = 0.5 * (symmetric + symmetric.T)
    for i in angles:  # the quadratic Hamiltonian must not depend on an angle
        symmetric[i, :] = symmetric[:, i] = 0.0
    generator = form @ symmetric
    field = field_for(generator, shift)
    if reversor is not None:
        generator = 0.5 * (generator - signs[:, None] * generator * signs[None, :])
        field = 0.5 * (field - signs * field)
    half, half_shift = _flow(generator, field, 0.5)
    return Affine(half, centre, half_shift)


def _flow(generator, field, time):
    """exp(time·A) and the shift it gives to the centre: the flow of ẋ = A x + b from x = 0."""
    width = len(generator)
    augmented = np.zeros((width + 1, width + 1))
    augmented[:width, :width], augmented[:width, width] = generator, field
    exponential = scipy.linalg.expm(time * augmented)
    return exponential[:width, :width], exponential[:width, width]


def field_for(generator, shift):
    """The b whose time-1 flow moves the centre by ``shift``: the flow's shift is linear in b."""
    width = len(generator)
    response = np.column_stack([_flow(generator, unit, 1.0)[1] for unit in np.eye(width)])
    return np.linalg.lstsq(response, shift, rcond=None)[0]
