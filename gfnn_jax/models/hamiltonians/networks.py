"""Learn H as a network: by Levenberg–Marquardt at the midpoints, corrected through the flow.

    ∇H_{k+1}(½(z₀ + z₁)) = ∇H_k(½(z₀ + z₁)) − J(z₁ − Φ_k(z₀))/h,      Φ_k the flow of H_k over h

The first round, without Φ, is exact to O(h²). Each round takes up what the flow of the last one
misses, a deferred correction: its fixed point is the H whose flow maps z₀ to z₁. No derivative of
the flow in the weights is needed, and every round trains by the same compiled program.
"""

import dataclasses
import time

import jax
import numpy as np

from gfnn_jax.budget import NETWORK
from gfnn_jax.candidates.assemble import Candidate
from gfnn_jax.coordinates import to_user
from gfnn_jax.dataset.measured_error import measured_error
from gfnn_jax.dataset.rows import residual_weight
from gfnn_jax.errors import FitError
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.mlp import Mlp, amplitude_of
from gfnn_jax.fitting.levenberg_marquardt import GradientFit, Limits
from gfnn_jax.flows.collocation import Steps
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.rates import rates, substeps_for
from gfnn_jax.generating.charts import MIDPOINT
from gfnn_jax.models.hamiltonians.learned_law import LearnedHamiltonian
from gfnn_jax.models.hamiltonians.problem import LawProblem, omega_h_of, operations_of
from gfnn_jax.models.hamiltonians.search import unfit_for_law


@dataclasses.dataclass(frozen=True)
class NetworkOptions:
    """Tuned on a pendulum of 600 pairs at dt 0.3.

    hidden, activation: of the network. pairs: that it is fitted to, at most. iterations: of the
    first round and of each later one. gained: a round that lowers the held-out error by less has
    not helped; idle: such rounds in a row end the search. stages, reach: of the flow, and h‖H''‖
    of one substep: its own error is then far below that of any network. states: at which the flow's
    frequencies are measured. short: radians of a step (ωh) up to which rounds are known to gain
    tenfold and more. resolved: of the tolerance, what rounds may leave over of the gradient.
    """

    hidden: tuple[int, ...] = (16, 16, 16)
    activation: str = "gelu"
    pairs: int = 2_000
    iterations: tuple[int, int] = (40, 20)
    gained: float = 0.1
    idle: int = 3
    stages: int = 5
    reach: float = 1.0
    states: int = 500
    short: float = 0.5
    resolved: float = 0.1


OPTIONS = NetworkOptions()


def learn_network(problem: LawProblem, *, seed: int, max_iterations: int) -> LearnedHamiltonian:
    """The network H whose flow is nearest to these pairs. It has no formula and no posterior.

    max_iterations: of all rounds. Raises FitError where the pairs are not of one autonomous flow.
    """
    data, tolerance, budget = problem.data, problem.tolerance, problem.budget
    unfit = unfit_for_law(data, problem.scene)
    if data.varied:
        unfit = "they differ in dt or in parameters"
    if unfit is not None:
        raise FitError(f"expected pairs of one autonomous flow to learn a network H from: {unfit}")
    started, count = time.perf_counter(), len(data.training[: OPTIONS.pairs])
    rows = np.concatenate([data.training[:count], data.validation])
    y0, y1, dt, scale = data.y0[rows], data.y1[rows], data.dt, data.scale
    w, wanted = MIDPOINT.evaluation_point(y0, y1), MIDPOINT.target_gradient(y0, y1, dt)
    angles = tuple(a for a in data.coordinates.angles if a < data.dim)
    inputs = box_inputs(w, angles=angles, cyclic=data.coordinates.cyclic)
    family = Mlp(inputs, OPTIONS.hidden, OPTIONS.activation, amplitude_of(w, wanted))
    params, label = family.init(jax.random.key(seed), np.float64), f"H, {family.label}"
    weight, target = residual_weight(MIDPOINT, scale, dt), wanted
    work = 2.0 * w[:count].size * family.num_parameters**2  # of an iteration
    best = None
    idle = done = 0
    while idle < OPTIONS.idle and done < max_iterations and not budget.over:
        result = GradientFit(
            w[:count],
            target[:count],
            validation=(w[count:], target[count:]),
            weight=weight,
            limits=Limits(
                OPTIONS.iterations[done > 0],
                block=lambda n: budget.unit(f"{n} iterations of {label}", NETWORK, n * work),
                target_rms=OPTIONS.resolved * tolerance.bound,
            ),
        ).train(family, params)
        params, done = jax.tree.map(np.asarray, result.params), done + max(result.iterations, 1)
        substeps = substeps_for(family, params, y0[: OPTIONS.states], dt, OPTIONS.reach)
        flow = Flow(family, params, dt, scale, OPTIONS.stages, substeps)
        images = np.asarray(_images(flow, y0))
        error = measured_error(data, tolerance, to_user(data.coordinates, images[count:]))
        problem.on_progress(f"{label}: {done} iterations, error {error.relative:.2e}")
        better = best is None or error.relative < (1 - OPTIONS.gained) * best[1].relative
        idle = 0 if better else idle + 1
        if best is None or error.relative < best[1].relative:
            best = flow, error, result.train_rms
        if error.bound <= tolerance.bound or not np.isfinite(images).all():
            break
        target = family.gradient(params, w) + wanted - MIDPOINT.target_gradient(y0, images, dt)
    if best is None:
        raise FitError("expected time and iterations to train a network with, got none")
    flow, error, train_rms = best
    fastest = rates(family, flow.params, y0[: OPTIONS.states])
    steps = Steps(flow.stages, flow.substeps)
    candidate = Candidate.of(
        error,
        validated=True,
        label=label,
        family=family.name,
        chart="flow",
        num_parameters=family.num_parameters,
        operations=operations_of(family, y0.shape[1], fastest, dt, steps),
        train_rms=train_rms,
        fit_seconds=time.perf_counter() - started,
        learns="hamiltonian",
    )
    omega_h = omega_h_of(family, flow.params, data, fastest)
    messages = ()
    if error.bound > tolerance.bound and omega_h > OPTIONS.short:
        messages = (
            f"a network H learns little from steps that turn by {omega_h:.2g} radians (ωh): sample "
            "with a smaller dt, or learn H as terms",
        )
    return LearnedHamiltonian(candidate, flow, (), None, omega_h, messages)


@jax.jit
def _images(flow: Flow, z):
    return flow.step(z)[0]
