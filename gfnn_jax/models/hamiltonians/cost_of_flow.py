"""Cost of a step of a flow, in counted operations: how fast its stages converge."""

from __future__ import annotations

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.families.sums import matrix_free
from gfnn_jax.flows.collocation import Steps
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.gauss import gauss
from gfnn_jax.flows.rates import rates
from gfnn_jax.phase_space import symplectic_form

FAST = np.pi / 2  # of ωh: from here on other laws are not far from the same pairs
CONTRACTING = 0.8  # a fixed point's factor up to which it is preferred to Newton's method
FREQUENCY_STATES = 500  # by which frequencies are known


def contraction_of(fastest, dt: float, steps: Steps) -> float:
    """The factor by which the stages' fixed point contracts in the end, where it is largest."""
    radius = np.abs(np.linalg.eigvals(gauss(steps.stages).matrix)).max()
    return float(dt / steps.substeps * fastest.max() * radius)


def operations_of(family, width: int, fastest, dt: float, steps: Steps) -> float:
    """Floating-point operations per step of states (2d,), width 2d: as many iterations as roundoff
    takes at this factor."""
    gradient, with_hessian = family.operations
    s = steps.stages
    factor = contraction_of(fastest, dt, steps)
    if factor > CONTRACTING and not matrix_free(family):
        one = s * with_hessian + (s * width) ** 3 * 2 / 3
        return float(steps.substeps * 4 * one)
    iterations = 2 + np.log(1e-16) / np.log(np.clip(factor, 1e-3, CONTRACTING))
    return float(steps.substeps * iterations * s * (gradient + 2 * width * s))


def flow_operations(flow: Flow, data: Dataset) -> float:
    """Floating-point operations per step of the flow."""
    fastest = rates(flow.family, flow.params, data.y0[:FREQUENCY_STATES])
    steps = Steps(flow.stages, flow.substeps)
    return operations_of(flow.family, len(data.scale), fastest, float(flow.dt), steps)


def omega_h_of(family, coefficients, data: Dataset, fastest) -> float:
    """The fastest oscillation of the linearised flow, radians per step, its median over states."""
    if not matrix_free(family):
        some = slice(FREQUENCY_STATES)
        z, args = data.y0[some], data.given(some)[1]
        _, hessian = family.gradient_and_hessian(coefficients, z, args)
        turned = symplectic_form(data.dim) @ hessian
        fastest = np.abs(np.linalg.eigvals(turned).imag).max(axis=-1)
    return float(data.dt * np.median(fastest))
