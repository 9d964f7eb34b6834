"""Linear starts of a fit of H through its flow: midpoint, logarithm, forward logarithm."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from gfnn_jax.families.family import at_time
from gfnn_jax.fitting.base_map import field_for
from gfnn_jax.fitting.turns import backwards, forward_logarithm, tangent, turns
from gfnn_jax.phase_space import apply_j, symplectic_form


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
    terms = family.term_gradients(z, args) * weight[:, None]
    rows = terms.reshape(-1, terms.shape[-1])
    size = np.linalg.norm(rows, axis=0)
    size = np.where(size > 0, size, 1.0)
    return np.linalg.lstsq(rows / size, (gradient * weight).ravel(), rcond=1e-12)[0] / size
