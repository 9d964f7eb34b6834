"""The flow of a law, factored out of the pairs where that leaves the simplest map."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.errors import FitError
from gfnn_jax.families.terms import Terms
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.rates import rates
from gfnn_jax.models.generating_functions.sweeps import trial_residual
from gfnn_jax.models.hamiltonians.cost_of_flow import CONTRACTING, FREQUENCY_STATES, contraction_of

TRIAL_PAIRS = 1_000  # by which it is found out where a flow is to be factored out


def factored_out(flows: Sequence[Flow], data: Dataset, seed: int) -> tuple[Flow, Dataset]:
    """The pairs without one of these flows: before, after, or half on either side of what is
    learned, whichever leaves the map that a small S comes closest to."""

    def misfit(rest: Dataset) -> float:
        rows = np.random.default_rng(seed).permutation(len(rest))[:TRIAL_PAIRS]
        return trial_residual(rest.take(rows))

    tried = [(flow, data.without(*pieces)) for flow in flows for pieces in around(flow)]
    errors = [misfit(rest) for _, rest in tried]
    return tried[0] if errors[0] <= 2 * min(errors) else tried[int(np.argmin(errors))]


def flow_of(family: Terms, params, data: Dataset) -> Flow:
    """The flow of a law over dt, to roundoff: to be factored out.

    data: without a base map. Raises FitError where it has no image of some of the states.
    """
    y0, y1, dt, scale = data.y0, data.y1, data.dt, data.scale
    problem = Problem(y0, y1, dt, scale)
    (steps,) = problem.fine_steps(family, params, np.arange(len(y0)))
    fastest = rates(family, params, y0[:FREQUENCY_STATES])
    by_newton = not contraction_of(fastest, dt, steps) <= CONTRACTING
    flow = Flow(family, params, dt, scale, steps.stages, steps.substeps, by_newton)
    failed = ~np.isfinite(np.concatenate([flow.image(y0), flow.inverse().image(y1)])).all(axis=1)
    if failed.any():
        raise FitError(
            f"base: the flow of the given H fails for {int(failed.sum())} of {len(y0) + len(y1)} "
            "states within one step. Check its formula and units, or leave these states out"
        )
    return flow


def around(flow: Flow) -> list[tuple[Flow | None, Flow | None]]:
    """Pieces (before, after) around what is learned: half of the flow on either side, which
    keeps the symmetry in time, or all of it on one, which suits a kick."""
    half = dataclasses.replace(flow, dt=0.5 * flow.dt)
    return [(half, half), (flow, None), (None, flow)]
