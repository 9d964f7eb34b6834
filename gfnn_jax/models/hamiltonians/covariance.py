"""Covariance of a law's coefficients, from each row's own residual."""

from __future__ import annotations

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.runs import looked_at
from gfnn_jax.families.sums import Sums
from gfnn_jax.families.terms import Terms
from gfnn_jax.fitting import shared_noise, uncertainty
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.flows.collocation import Steps
from gfnn_jax.flows.uniform import without_forces
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw
from gfnn_jax.models.hamiltonians.options import OPTIONS
from gfnn_jax.models.hamiltonians.steps_of_law import NEAR_ROUNDOFF
from gfnn_jax.models.hamiltonians.unexplained import unexplained, unexplained_of_sites

_FEWEST_SAMPLED = 2_000  # pairs that tell noise from misfit; of many sites, numbers


def covariance_root(found: FittedLaw, problem: Problem, data: Dataset, steps: Steps) -> np.ndarray:
    """(m, m): rootᵀ root is the covariance of the coefficients. What is noise, a generator of
    polynomials tells, which does not explain it, of sites the terms of a larger library; what they
    explain is misfit, of these steps too."""
    fit, count = found.fit, found.family.num_parameters
    most = max(_FEWEST_SAMPLED, OPTIONS.sampled_rows * count // data.y0.shape[1])
    structure = data.structure
    if structure is not None:
        most = max(structure.fewest(data.y0.shape[1]), _FEWEST_SAMPLED // data.y0.shape[1])
    places, goes_on = looked_at(data.pairs, fit.used, most)
    rows = fit.used[places]
    unit, scale = problem.unit(rows), problem.scale
    images = problem.images(found.family, fit.coefficients, rows, steps, derivatives=True)
    residual = images.states - data.y1[rows]
    if not np.isfinite(residual).all():  # of a flow that runs away from some of the states
        return np.full((count, count), np.nan)
    slopes = images.by_coefficient / unit[..., None]
    left, scores, states, noise = residual / unit, None, None, None
    family = without_forces(found.family)
    if isinstance(family, Terms):  # of many coordinates both would take too much
        if goes_on.any():
            first = images.by_state * scale
            second = np.broadcast_to(-np.diag(scale), first.shape)
            scores = shared_noise.scores(
                slopes, left, first / unit[..., None], second / unit[..., None], goes_on
            )
            states = first, second, goes_on
        degree = int(np.max(np.sum(family.powers, axis=1)))
        noise = unexplained(data, rows, residual, count, degree, states)
    elif structure is not None and isinstance(family, Sums):
        noise = unexplained_of_sites(found, problem, data, rows, steps, slopes, left)
    return uncertainty.root(
        fit.triangle,
        count,
        slopes.reshape(-1, count),
        np.hypot(left, NEAR_ROUNDOFF).ravel(),
        noise=noise,
        scores=scores,
    )
