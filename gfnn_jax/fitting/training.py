"""Training in iterations: the state of one, when there is no further one, what came of it.

A method makes an iteration; here it is repeated in blocks, units of a fit's budget, and the
parameters are kept that fit the validation pairs best.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.errors import OutOfTime
from gfnn_jax.solve.levenberg_marquardt import Rule, Tried, descended

BLOCK = 10  # iterations that are made together: a unit of a fit's budget


class LMState(NamedTuple):
    """All that the next iteration depends on: arrays and numbers, ready for a checkpoint.

    theta, best_theta: flattened parameters (P,), of now and of the best validation error so far.
    damping:           μ; NaN before the first iteration, which takes it from AᵀA. (E,) of members
                       that are trained together, whose theta are (E, P).
    iteration:         iterations done.
    train_rms, validation_rms, best_validation_rms: of ∇S − target_gradient, per
                       component.
    landmark_rms, landmark_iteration: the train_rms that progress is measured from, and its time.
    seconds:           time spent so far, without compilation.
    """

    theta: Any
    best_theta: Any
    damping: Any
    iteration: int
    train_rms: float
    validation_rms: float
    best_validation_rms: float
    landmark_rms: float
    landmark_iteration: int
    seconds: float


class LMResult(NamedTuple):
    """params: the parameters with the lowest validation error met, in the pytree that was given.

    train_rms is of the last iteration, validation_rms of ``params``; both are per component of ∇S,
    so that dt times them is the one-step state error to first order in dt. iterations and seconds
    include what was resumed from. stopped_because: target, iterations, budget or no progress.
    """

    params: Any
    train_rms: float
    validation_rms: float
    iterations: int
    seconds: float
    compile_seconds: float
    stopped_because: str


class Limits(NamedTuple):
    """Limits of a training, and what is called with its states.

    max_iterations: most iterations. A run repeats to the last bit on one machine with the same
                number of threads.
    block:      gives the context in which the next so many iterations are made; it raises
                OutOfTime to stop before them.
    target_rms: stop once the validation RMS is as small.
    patience:   stop when train_rms fell by less than 1 % in so many iterations.
    reports:    called with the state after every iteration.
    """

    max_iterations: int = 200
    block: Callable[[int], AbstractContextManager] = lambda iterations: nullcontext()
    target_rms: float = 0.0
    patience: int = 20
    reports: tuple[Callable[[LMState], Any], ...] = ()


@dataclasses.dataclass(frozen=True)
class _Training:
    """A training where it stands: `solve.levenberg_marquardt` makes its iterations.

    linearised: θ -> trial steps from there, of each damping one. size: numbers in the residual.
    """

    state: LMState
    linearised: Callable[[Any], Callable[[Any], Tried]]
    validation_rms: Callable[[Any], float]
    size: int
    limits: Limits
    started: float

    @property
    def stopped_because(self) -> str | None:
        """The reason why there is no further iteration, None where there is one."""
        state, limits = self.state, self.limits
        if state.best_validation_rms <= limits.target_rms:
            return "target"
        if state.iteration >= limits.max_iterations:
            return "iterations"
        if state.iteration - state.landmark_iteration >= limits.patience:
            return "no progress"
        return None

    @cached_property
    def _steps(self) -> Callable[[Any], Tried]:
        return self.linearised(self.state.theta)

    def tried(self, damping: Any, failures: int) -> Tried:
        return self._steps(damping)

    def moved(self, there: Any, damping: Any) -> tuple[_Training, bool]:
        """The training at θ and F of a step, validated and reported."""
        theta, loss = there
        train_rms, held_rms = math.sqrt(loss / self.size), self.validation_rms(theta)
        seconds = time.perf_counter() - self.started
        state = _next_state(self.state, theta, damping, train_rms, held_rms, seconds)
        for report in self.limits.reports:
            report(state)
        further = dataclasses.replace(self, state=state)
        return further, further.stopped_because is not None


def trained(
    state: LMState, linearised, rule: Rule, validation_rms, size: int, limits: Limits
) -> tuple[LMState, str]:
    """The last state from this one on, and why there is no further one."""
    started = time.perf_counter() - state.seconds
    here = _Training(state, linearised, validation_rms, size, limits, started)
    while (stopped_because := here.stopped_because) is None:
        try:
            with limits.block(BLOCK):
                found = descended(here, rule, BLOCK, here.state.damping)
                here = found.problem
        except OutOfTime:
            return here.state, "budget"
        if found.stuck:
            return here.state, "no progress"
    return here.state, stopped_because


def result_of(state: LMState, params, compile_seconds: float, stopped_because: str) -> LMResult:
    return LMResult(
        params=jax.tree.map(jnp.asarray, params),
        train_rms=state.train_rms,
        validation_rms=state.best_validation_rms,
        iterations=state.iteration,
        seconds=state.seconds,
        compile_seconds=compile_seconds,
        stopped_because=stopped_because,
    )


def first_state(theta, damping, validation_rms):
    return LMState(
        theta=np.asarray(theta),
        best_theta=np.asarray(theta),
        damping=damping,
        iteration=0,
        train_rms=math.nan,
        validation_rms=validation_rms,
        best_validation_rms=validation_rms,
        landmark_rms=math.inf,
        landmark_iteration=0,
        seconds=0.0,
    )


def _next_state(state, theta, damping, train_rms, validation_rms, seconds):
    theta, iteration = np.asarray(theta), state.iteration + 1
    better = validation_rms < state.best_validation_rms
    progress = train_rms < 0.99 * state.landmark_rms
    return LMState(
        theta=theta,
        best_theta=theta if better else state.best_theta,
        damping=damping,
        iteration=iteration,
        train_rms=train_rms,
        validation_rms=validation_rms,
        best_validation_rms=validation_rms if better else state.best_validation_rms,
        landmark_rms=train_rms if progress else state.landmark_rms,
        landmark_iteration=iteration if progress else state.landmark_iteration,
        seconds=seconds,
    )
