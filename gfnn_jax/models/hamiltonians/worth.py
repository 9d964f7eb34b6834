"""Cost of the law that a library may give, foretold before the library is fitted."""

from __future__ import annotations

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.fitting.significance import significant
from gfnn_jax.flows.rates import rates
from gfnn_jax.models.hamiltonians.cost_of_flow import FREQUENCY_STATES, operations_of
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw
from gfnn_jax.models.hamiltonians.steps_of_law import bound_of


def too_dear(
    problem: Problem,
    family,
    last: FittedLaw,
    data: Dataset,
    tolerance: Tolerance,
    dearest: float,
) -> bool:
    """Return whether a step of no law of this library costs up to ``dearest`` operations.

    One Gauss–Newton problem at the last law tells which terms the tolerance asks for: those whose
    absence would double the mean square that it allows. What the linear problem leaves unknown is
    of the order of the last law's error squared, and is allowed too.
    """
    if not np.isfinite(dearest):
        return False
    fit = last.fit
    fastest = rates(last.family, fit.coefficients, data.y0[:FREQUENCY_STATES])

    def cost(family) -> float:
        return operations_of(family, 2 * family.dim, fastest, problem.dt, fit.steps)

    if cost(family) <= dearest:
        return False
    known = dict(zip(last.family.term_names, fit.coefficients, strict=True))
    start = np.array([known.get(name, 0.0) for name in family.term_names])
    rows = data.training[: max(len(last.rows), 2 * family.num_parameters)]
    found = problem.linearised(family, start, fit.steps, rows)
    if not np.isfinite(found.norm) or found.rows <= family.num_parameters:
        return False
    allowed = max(bound_of(tolerance, problem.scale), last.error.relative**2)
    kept, _ = significant(found, start, np.sqrt(found.rows), allowed)
    return not kept.size or cost(family.take(tuple(kept.tolist()))) > dearest
