"""Steps of a law's flow: the cheapest that are fine enough, and the held-out error by them.

The error of a step is Z_predicted − Z, in the user's coordinates; the steps' own (truncation) is
held to a tenth of the tolerance.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from gfnn_jax.coordinates import to_user
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import OneStepError, Tolerance, measured_error
from gfnn_jax.fitting.gauss_newton import FlowFit
from gfnn_jax.flows.collocation import Steps, images, truncation
from gfnn_jax.flows.rates import MOST_SUBSTEPS
from gfnn_jax.models.hamiltonians.cost_of_flow import operations_of
from gfnn_jax.models.hamiltonians.options import OPTIONS, LawOptions

NEAR_ROUNDOFF = 3e-15  # of the spread


def validation_error(family, fit: FlowFit, data: Dataset, tolerance: Tolerance) -> OneStepError:
    """Error by steps that resolve the held-out pairs: an unresolved passage says nothing of the
    law."""
    steps = resolving(family, fit.coefficients, fit.steps, data, tolerance)
    return error_of_steps(family, fit.coefficients, steps, data, tolerance)


def error_of_steps(
    family, coefficients, steps: Steps, data: Dataset, tolerance: Tolerance
) -> OneStepError:
    """Error of these steps over the held-out pairs."""
    states, (dt, args) = data.y0[data.validation], data.given(data.validation)
    found = images(family, coefficients, states, dt, steps, args=args, scale=data.scale).states
    return measured_error(data, tolerance, to_user(data.coordinates, found))


def bound_of(tolerance: Tolerance, scale) -> float:
    """The tolerance as a part of the coordinates' scale."""
    bound = tolerance.bound
    return bound if tolerance.relative else bound / float(scale.max())


def resolving(family, coefficients, steps: Steps, data: Dataset, tolerance: Tolerance) -> Steps:
    """Keep these steps, or, where the law misses the tolerance by them, take finer ones: halved
    until they resolve the held-out pairs, or there are as many as a flow may have."""
    bound, states = bound_of(tolerance, data.scale), data.y0[data.validation]
    if error_of_steps(family, coefficients, steps, data, tolerance).bound <= tolerance.bound:
        return steps
    (dt, args), scale = data.given(data.validation), data.scale
    while 2 * steps.substeps <= MOST_SUBSTEPS:
        off = truncation(family, coefficients, states, dt, steps, args=args, scale=scale) / scale
        if np.sqrt(np.mean(off**2)) <= OPTIONS.truncation * bound:
            break
        steps = dataclasses.replace(steps, substeps=2 * steps.substeps)
    return steps


def cheapest(
    problem, family, fit: FlowFit, fastest, data: Dataset, tolerance: Tolerance, options: LawOptions
) -> Steps:
    """Steps whose own error is a tenth of the tolerance; near roundoff, or at it, where that is not
    twice as dear."""

    def cost(steps: Steps) -> float:
        return operations_of(family, 2 * family.dim, fastest, problem.dt, steps)

    bound = max(options.truncation * bound_of(tolerance, problem.scale), 0.3 * fit.rms)
    tolerances = (bound, min(bound, NEAR_ROUNDOFF), None)
    found = problem.fine_steps(family, fit.coefficients, data.training, tolerances)
    return next(s for s in reversed(found) if s == found[0] or cost(s) < 2 * cost(found[0]))
