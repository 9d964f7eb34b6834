"""The linear part of a map, by regression of its pairs, and what begins with it.

A *base map* R is factored out where no chart covers the data without it. Far from the identity
(return maps, stroboscopic maps) the map's linear part is a large rotation and every near-identity
chart folds. R(z) = the time-1 flow of the affine Hamiltonian field ż = A (z − c) + b, A a
Hamiltonian matrix (J A symmetric), so that R is symplectic exactly; its half R^½ is the time-½
flow. S then generates R^−½-conjugated data, R^½ z -> R^−½ Z: the even split keeps reversibility.

*Turns* of the states around their centre have a sense. A step tells a turn only up to whole ones: 4
radians forwards are 2π − 4 = 2.28 backwards. The sense is that of the eigenvector v, the sign of
i v*Jv (Krein's): an H with a minimum turns forwards, as a positive kinetic energy does beside a
well. What turns backwards is either an H with a maximum, or a turn by π to 2π in a step; a longer
one looks like a short one.

*Linear starts* of a fit of H through its flow: midpoint, logarithm, forward logarithm.
"""

import math
from itertools import combinations_with_replacement

import numpy as np
import scipy.linalg

from gfnn_jax.families.family import at_time
from gfnn_jax.maps.piece import Affine
from gfnn_jax.phase_space import apply_j, symplectic_form


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
    half, half_shift = _affine_flow(generator, field, 0.5)
    return Affine(half, centre, half_shift)


def _affine_flow(generator, field, time):
    """exp(time·A) and the shift it gives to the centre: the flow of ẋ = A x + b from x = 0."""
    width = len(generator)
    augmented = np.zeros((width + 1, width + 1))
    augmented[:width, :width], augmented[:width, width] = generator, field
    exponential = scipy.linalg.expm(time * augmented)
    return exponential[:width, :width], exponential[:width, width]


def field_for(generator, shift):
    """The b whose time-1 flow moves the centre by ``shift``: the flow's shift is linear in b."""
    width = len(generator)
    response = np.column_stack([_affine_flow(generator, unit, 1.0)[1] for unit in np.eye(width)])
    return np.linalg.lstsq(response, shift, rcond=None)[0]


# Rows per term of a cubic regression, those nearest to the centre; with fewer it is affine. Tuned
# on Hénon–Heiles at dt 0.5 to 6: all of 400 pairs miss the turns at dt 4, the nearest half do not.
_ROWS_OF_TANGENT = 6
_ON_CIRCLE, _SENSE = (
    0.3,
    0.05,
)  # how far |λ| may be from 1, and the least |i v*Jv| ÷ |v|², of a turn
_REAL = 1e-6  # of a logarithm: a larger imaginary part is none of rounding


def tangent(z0, z1, scale) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(centre, its image (2d,), Jacobian there (2d, 2d)) of the map z0 -> z1 (N, 2d), by a cubic
    regression or, where the pairs are few, an affine one."""
    width, centre = z0.shape[1], z0.mean(axis=0)
    x = (z0 - centre) / scale
    order = np.argsort(np.linalg.norm(x, axis=1), kind="stable")

    degree = 3 if len(x) >= _ROWS_OF_TANGENT * math.comb(width + 3, 3) else 1
    products = [
        list(t)
        for k in range(1, degree + 1)
        for t in combinations_with_replacement(range(width), k)
    ]
    near = order[: _ROWS_OF_TANGENT * (1 + len(products))]
    columns = [np.ones(len(near)), *(np.prod(x[near][:, t], axis=1) for t in products)]
    moved = (z1 - z0)[near] / scale
    known = np.linalg.lstsq(np.column_stack(columns), moved, rcond=None)[0]
    jacobian = np.eye(width) + known[1 : 1 + width].T * (scale[:, None] / scale[None, :])
    return centre, centre + scale * known[0], jacobian


def turns(jacobian, scale) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(angles, λ, V): of each eigenvalue λ of a Jacobian (2d, 2d) the angle by which its plane
    turns, in (−π, π), forwards positive; 0 where it is no turn. V: the eigenvectors. scale: (2d,)
    sizes of the coordinates."""
    eigenvalues, vectors = np.linalg.eig(jacobian)
    dim = len(scale) // 2
    form = symplectic_form(dim) / np.mean(scale[:dim] * scale[dim:])
    sense = -np.real(1j * np.einsum("ai,ab,bi->i", vectors.conj(), form, vectors))
    sense /= np.sum(np.abs(vectors / scale[:, None]) ** 2, axis=0)
    turn = (np.abs(np.abs(eigenvalues) - 1) < _ON_CIRCLE) & (np.abs(sense) > _SENSE)
    angles = np.where(turn, np.sign(sense) * np.angle(eigenvalues), 0.0)
    return angles, eigenvalues, vectors


def backwards(angles) -> float:
    """The largest of the angles that turn backwards, as a positive number; 0 where none does."""
    return float(max(0.0, -np.min(angles)))


def forward_logarithm(jacobian, scale) -> np.ndarray | None:
    """The real logarithm that turns every plane forwards, by up to 2π. None where there is none."""
    angles, eigenvalues, vectors = turns(jacobian, scale)
    whole = np.where(angles < 0, -2j * np.pi * np.sign(np.angle(eigenvalues)), 0.0)
    logarithm = (vectors * (np.log(eigenvalues.astype(complex)) + whole)) @ np.linalg.inv(vectors)
    if not np.abs(logarithm.imag).max() <= _REAL * (1 + np.abs(logarithm).max()):
        return None
    return logarithm.real


def midpoint_start(family, z0, z1, dt, scale, args=None) -> np.ndarray:
    """The linear problem (z₁ − z₀)/h = J∇H(½(z₀ + z₁), t + ½h): exact to O(h²). dt: a number or
    (N,)."""
    h = dt[:, None] if np.ndim(dt) else dt
    args = at_time(family, args, 0.5 * dt)
    return fitted_gradients(family, 0.5 * (z0 + z1), -apply_j(z1 - z0) / h, scale, args)


def log_start(family, z0, z1, dt: float, scale) -> np.ndarray | None:
    """The quadratic H whose flow is the pairs' affine regression: its logarithm over h. None where
    it has no real one."""
    width = z0.shape[1]
    centre = z0.mean(axis=0)
    design = np.column_stack([np.ones(len(z0)), (z0 - centre) / scale])
    solution = np.linalg.lstsq(design, (z1 - z0) / scale, rcond=None)[0]
    augmented = np.eye(width + 1)
    augmented[:width, :width] += solution[1:].T
    augmented[:width, width] = solution[0]
    logarithm = scipy.linalg.logm(augmented)
    if not np.abs(np.imag(logarithm)).max() <= 1e-6 * (1 + np.abs(logarithm).max()):
        return None
    generator = np.real(logarithm) / dt
    unit = scale[:, None] / scale[None, :]
    matrix = -symplectic_form(width // 2) @ (generator[:width, :width] * unit)
    offset = -apply_j(scale * generator[:width, width])
    gradient = (z0 - centre) @ (0.5 * (matrix + matrix.T)) + offset
    return fitted_gradients(family, z0, gradient, scale)


def forward_start(family, z0, z1, dt: float, scale) -> tuple[float, np.ndarray] | None:
    """(angle, the quadratic H) where a plane around the centre turns backwards by this angle: the H
    that turns it forwards instead, by more than π in a step. None where none does."""
    centre, image, jacobian = tangent(z0, z1, scale)
    angle = backwards(turns(jacobian, scale)[0])
    logarithm = forward_logarithm(jacobian, scale) if angle > 0 else None
    if logarithm is None:
        return None
    form = symplectic_form(z0.shape[1] // 2)
    matrix = -form @ logarithm
    generator = form @ (0.5 * (matrix + matrix.T))
    velocity = ((z0 - centre) @ generator.T + field_for(generator, image - centre)) / dt
    return angle, fitted_gradients(family, z0, -apply_j(velocity), scale)


def fitted_gradients(family, z, gradient, scale, args=None) -> np.ndarray:
    """Coefficients whose ∇H is closest to gradients (N, 2d) at states z with these args, each in
    the unit of what it changes."""
    dim = z.shape[1] // 2
    weight = 1.0 / np.roll(scale, dim)
    if (offset := getattr(family, "offset", None)) is not None:
        gradient = gradient - offset(z, args)
    terms = family.term_gradients(z, args) * weight[:, None]
    rows = terms.reshape(-1, terms.shape[-1])
    size = np.linalg.norm(rows, axis=0)
    size = np.where(size > 0, size, 1.0)
    return np.linalg.lstsq(rows / size, (gradient * weight).ravel(), rcond=1e-12)[0] / size
