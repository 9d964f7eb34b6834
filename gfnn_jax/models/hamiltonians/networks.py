"""Learn H as a network: by Levenberg–Marquardt at the midpoints, corrected through the flow.

    ∇H_{k+1}(½(z₀ + z₁)) = ∇H_k(½(z₀ + z₁)) − J(z₁ − Φ_k(z₀))/h,      Φ_k the flow of H_k over h

The first round, without Φ, is exact to O(h²). Each round takes up what the flow of the last one
misses, a deferred correction: its fixed point is the H whose flow maps z₀ to z₁. No derivative of
the flow in the weights is needed, and every round trains by the same compiled program.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from gfnn_jax.budget import NETWORK, Budget
from gfnn_jax.candidates.candidate import Candidate, with_error
from gfnn_jax.coordinates import to_user
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import OneStepError, Tolerance, measured_error
from gfnn_jax.dataset.rows import residual_weight
from gfnn_jax.errors import FitError
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.mlp import Mlp, amplitude_of
from gfnn_jax.fitting.levenberg_marquardt import Limits, levenberg_marquardt
from gfnn_jax.flows.collocation import Steps
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.rates import rates, substeps_for
from gfnn_jax.generating.charts import MIDPOINT
from gfnn_jax.models.hamiltonians.choose_law import unfit_for_law
from gfnn_jax.models.hamiltonians.cost_of_flow import contraction_of, omega_h_of, operations_of
from gfnn_jax.models.hamiltonians.learned_law import LearnedHamiltonian
from gfnn_jax.scenes.scene import Scene


@dataclasses.dataclass(frozen=True)
class NetworkOptions:
    """Tuned on a pendulum of 600 pairs at dt 0.3.

    hidden, activation: of the network. pairs: that it is fitted to, at most. iterations: of the
    first round and of each later one. gained: a round that lowers the held-out error by less has
    not helped; idle: such rounds in a row end the search. stages, reach: of the flow, and h‖H''‖
    of one substep: its own error is then far below that of any network.
    """

    hidden: tuple[int, ...] = (16, 16, 16)
    activation: str = "gelu"
    pairs: int = 2_000
    iterations: tuple[int, int] = (40, 20)
    gained: float = 0.1
    idle: int = 3
    stages: int = 5
    reach: float = 1.0


OPTIONS = NetworkOptions()
_STATES = 500  # at which the flow's frequencies are measured
_SHORT = 0.5  # radians of a step (ωh) up to which rounds are known to gain tenfold and more
_RESOLVED = 0.1  # of the tolerance: what rounds may leave over of the gradient


def learn_network(
    data: Dataset,
    tolerance: Tolerance,
    scene: Scene | None,
    *,
    seed: int,
    max_iterations: int,
    budget: Budget,
    on_progress: Callable[[str], Any] = lambda message: None,
) -> LearnedHamiltonian:
    """The network H whose flow is nearest to these pairs. It has no formula and no posterior.

    data: without a base map. max_iterations: of all rounds. Raises FitError where the pairs are
    not of one autonomous flow.
    """
    unfit = unfit_for_law(data, scene)
    if data.varied:
        unfit = "they differ in dt or in parameters"
    if unfit is not None:
        raise FitError(f"expected pairs of one autonomous flow to learn a network H from: {unfit}")
    started = time.perf_counter()
    count = len(data.training[: OPTIONS.pairs])
    rows = np.concatenate([data.training[:count], data.validation])
    y0, y1, dt, scale = data.y0[rows], data.y1[rows], data.dt, data.scale
    w, wanted = MIDPOINT.evaluation_point(y0, y1), MIDPOINT.target_gradient(y0, y1, dt)
    coordinates = data.coordinates
    inputs = box_inputs(
        w,
        angles=tuple(a for a in coordinates.angles if a < data.dim),
        cyclic=coordinates.cyclic,
    )
    family = Mlp(inputs, OPTIONS.hidden, OPTIONS.activation, amplitude_of(w, wanted))
    params, label = family.init(jax.random.key(seed), np.float64), f"H, {family.label}"
    weight, target = residual_weight(MIDPOINT, scale, dt), wanted
    work = 2.0 * w[:count].size * family.num_parameters**2  # of an iteration
    best: _Round | None = None
    idle = done = 0
    while idle < OPTIONS.idle and done < max_iterations and not budget.over:
        result = levenberg_marquardt(
            family,
            params,
            w[:count],
            target[:count],
            validation=(w[count:], target[count:]),
            weight=weight,
            limits=Limits(
                OPTIONS.iterations[done > 0],
                block=lambda n: budget.unit(f"{n} iterations of {label}", NETWORK, n * work),
                target_rms=_RESOLVED * tolerance.bound,
            ),
        )
        params, done = jax.tree.map(np.asarray, result.params), done + max(result.iterations, 1)
        substeps = substeps_for(family, params, y0[:_STATES], dt, OPTIONS.reach)
        flow = Flow(family, params, dt, scale, OPTIONS.stages, substeps)
        images = np.asarray(_images(flow, y0))
        error = measured_error(data, tolerance, to_user(coordinates, images[count:]))
        on_progress(f"{label}: {done} iterations, error {error.relative:.2e}")
        better = best is None or error.relative < (1 - OPTIONS.gained) * best.error.relative
        idle = 0 if better else idle + 1
        if best is None or error.relative < best.error.relative:
            best = _Round(flow, images[count:], error, result.train_rms)
        if error.bound <= tolerance.bound or not np.isfinite(images).all():
            break
        target = family.gradient(params, w) + wanted - MIDPOINT.target_gradient(y0, images, dt)
    if best is None:
        raise FitError("expected time and iterations to train a network with, got none")
    return _learned(best, label, data, tolerance, y0, time.perf_counter() - started)


class _Round(NamedTuple):
    """A flow, its images of the held-out states and their error, and the training residual."""

    flow: Flow
    images: np.ndarray
    error: OneStepError
    train_rms: float


def _learned(
    best: _Round, label: str, data: Dataset, tolerance: Tolerance, y0, seconds: float
) -> LearnedHamiltonian:
    flow, error, dt = best.flow, best.error, data.dt
    family = flow.family
    finer = _images(dataclasses.replace(flow, substeps=2 * flow.substeps), y0)
    fastest = rates(family, flow.params, y0[:_STATES])
    steps = Steps(flow.stages, flow.substeps)
    candidate = Candidate(
        label=label,
        family=family.name,
        chart="flow",
        num_parameters=family.num_parameters,
        operations=operations_of(family, y0.shape[1], fastest, dt, steps),
        validation_rms=error.rms,
        validation_relative=error.relative,
        validation_bound=error.bound,
        deviations=error.deviations,
        train_rms=best.train_rms,
        fit_seconds=seconds,
        learns="hamiltonian",
    )
    off = best.images - np.asarray(finer)[-len(best.images) :]
    truncation = float(np.abs(off / data.scale).max())
    omega_h = omega_h_of(family, flow.params, data, fastest)
    messages = ()
    if error.bound > tolerance.bound and omega_h > _SHORT:
        messages = (
            f"a network H learns little from steps that turn by {omega_h:.2g} radians (ωh): sample "
            "with a smaller dt, or learn H as terms",
        )
    return LearnedHamiltonian(
        with_error(candidate, error),
        flow,
        (),
        None,
        truncation,
        omega_h,
        contraction_of(fastest, dt, steps),
        float("nan"),
        (),
        0,
        messages,
        stalled=False,
        covariance=None,
    )


@jax.jit
def _images(flow: Flow, z):
    return flow.step(z)[0]
