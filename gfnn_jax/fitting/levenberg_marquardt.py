"""Fit any family S(params, w) to target gradients by Levenberg–Marquardt, with acceleration.

The loss is a sum of squares, F(θ) = Σ ‖∇S(θ, w) − g‖², so that the Jacobian A of the residual r
gives nearly all of its curvature. A network of a thousand parameters then gains an order of
magnitude in tens of iterations, where first-order methods take tens of thousands.

An iteration linearises once, at about 4dNP² flops for N pairs and P parameters (the product AᵀA;
A itself costs less), and then tries steps θ + δ₁ + δ₂ under growing damping μ until one lowers F:

    (AᵀA + μI) δ₁ = −Aᵀr,        (AᵀA + μI) δ₂ = −½ Aᵀ r″(δ₁, δ₁).

δ₁ is the step of Levenberg and Marquardt, and μ follows Nielsen (`solve.levenberg_marquardt`).
δ₂ follows the bend of the valley (Transtrum & Sethna, arXiv:1201.5885): it costs a few gradient
evaluations, no second Jacobian, and saves most of the iterations.

Normal equations square the condition number of A. Damping makes that harmless here, where a step
needs only to lead downhill, but it does take float64: anything less is refused.

Memory: A is never held whole. The peak is 2 P² + 4 · 2d · chunk · P numbers in linearising and 3 P²
in a trial, whatever N; each also keeps a few activations of S for every pair of a chunk.

A training repeats iterations in blocks, units of a fit's budget, and keeps the parameters that fit
the validation pairs best. Several networks are trained together: one program linearises and tries a
step of all, and a member whose step does not lower its loss waits with more damping for the next
iteration, so that no member's search makes the others wait.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float

from gfnn_jax.errors import OutOfTime
from gfnn_jax.families import Family
from gfnn_jax.fitting import row_blocks
from gfnn_jax.phase_space import require_x64
from gfnn_jax.solve.levenberg_marquardt import Nielsen, Rule, Tried, descended

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
    damping: Any = math.nan
    iteration: int = 0
    train_rms: float = math.nan
    validation_rms: float = math.inf
    best_validation_rms: float = math.inf
    landmark_rms: float = math.inf
    landmark_iteration: int = 0
    seconds: float = 0.0

    def after(self, theta, damping, train_rms: float, validation_rms: float) -> LMState:
        """The state after a step to θ."""
        theta, iteration = np.asarray(theta), self.iteration + 1
        errors = {"train_rms": train_rms, "validation_rms": validation_rms}
        found = self._replace(theta=theta, damping=damping, iteration=iteration, **errors)
        if validation_rms < self.best_validation_rms:
            found = found._replace(best_theta=theta, best_validation_rms=validation_rms)
        if train_rms < 0.99 * self.landmark_rms:
            found = found._replace(landmark_rms=train_rms, landmark_iteration=iteration)
        return found


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
        state = self.state.after(theta, damping, train_rms, held_rms)
        state = state._replace(seconds=time.perf_counter() - self.started)
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


# δ₂ is a correction: where it is not small beside δ₁ the expansion has failed and δ₁ goes alone.
LARGEST_ACCELERATION = 0.75
OF_LARGEST = 1e-3  # the first damping, of the largest entry on AᵀA's diagonal
Rows = Float[Array | np.ndarray, "_ _"]


@dataclasses.dataclass(frozen=True, eq=False)
class GradientFit:
    """Pairs whose target gradients a family is fitted to: it minimises the mean of
    ‖weight · (∇S(params, w) − target_gradient)‖².

    w, target_gradient: (N, 2d) each, as a chart makes them from pairs of states.
    validation:  (w, target_gradient) of pairs kept apart; the parameters that fit them best are
                 returned.
    weight:      (2d,), or one for all: what makes a row of ∇S unit-free.
    limits:      when to stop, and what is called with the states.
    chunk:       at most so many pairs have their Jacobian in memory at once.
    resume:      a state that was reported: the fit goes on from there as though it had never
                 stopped, bit for bit (the params then only lend their structure).

    What is compiled for a family serves every set of data of the same shape.
    """

    w: Rows
    target_gradient: Rows
    validation: tuple[Rows, Rows]
    weight: Any = 1.0
    limits: Limits = Limits()  # noqa: RUF009, it is frozen
    chunk: int = 500
    resume: LMState | None = None

    def train(self, family: Family, params: Any) -> LMResult:
        """Train one network from ``params``, any pytree of float64 arrays."""
        theta, layout = flattened(params)
        w, target_gradient, weight, held = self._prepared(theta)
        # On the device once, not in every iteration.
        chunks = jax.device_put(chunked(w, target_gradient, weight, self.chunk))

        def linearised(theta):
            """Trial steps from θ, of any damping: all of them share one linearisation."""
            matrix, slope, loss = linearize(family, chunks, theta, layout=layout)
            if not math.isfinite(float(loss)):
                raise ValueError("∇S(params, w) is not finite on the training pairs at the start")

            def tried(damping) -> Tried:
                if math.isnan(damping):
                    damping = OF_LARGEST * float(np.max(np.diagonal(np.asarray(matrix))))
                trial, trial_loss, promised = attempt(
                    family, chunks, theta, (matrix, slope), np.float64(damping), layout=layout
                )
                decrease = float(loss - trial_loss)
                return Tried((trial, float(trial_loss)), decrease, damping, float(promised))

            return tried

        def validation_rms(theta):
            return math.sqrt(float(_loss(family, held, theta, layout=layout)))

        started = time.perf_counter()
        _compile(family, chunks, held, theta, layout)
        compile_seconds = time.perf_counter() - started
        state, why = self._trained(theta, math.nan, linearised, Nielsen(), validation_rms)
        params = unflattened(np.asarray(state.best_theta), layout)
        return result_of(state, params, compile_seconds, why)

    def train_together(
        self, family: Family, members: Sequence[Any], shares: Float[np.ndarray, "_ _"]
    ) -> LMResult:
        """Train E members of a family at once, each from its own start and with its own shares of
        the pairs; one program linearises and tries a step of all of them.

        members: E starts, pytrees of one structure. shares: (E, N), 0 or more, of mean 1: what the
        square of a pair's residual counts in each member's loss. All else is as for ``train``, but
        for this: a member whose step does not lower its loss waits with four times the damping for
        the next iteration; validation errors are those of the members' mean ∇S; theta and
        best_theta of a state are (E, P), its damping (E,); the params that are returned have a
        leading axis E. The memory is E times as much.

        On the devices of the fit (`fitting.row_blocks`) members are trained one at a time on each:
        to the same bits on any number of devices, which one batch of all members would not give.
        """
        flat = [flattened(member) for member in members]
        theta, layout = np.stack([t for t, _ in flat]), flat[0][1]
        w, target_gradient, weight, held = self._prepared(theta)
        *points, weights = chunked(w, target_gradient, weight, self.chunk)
        padding = weights.shape[0] * weights.shape[1] - len(w)
        parts = np.pad(np.sqrt(shares), ((0, 0), (0, padding))).reshape(-1, *weights.shape[:2], 1)
        on_device = tuple(points), parts * weights

        def linearised(theta):
            """The trial step of every member from θ (E, P)."""

            def tried(damping) -> Tried:
                theta_, losses, decrease, promised, used = program(theta, damping)
                if not np.isfinite(losses).all():
                    raise ValueError(
                        "∇S(params, w) is not finite on the training pairs at the start"
                    )
                there = theta_, float(np.mean(losses))
                return Tried(there, np.asarray(decrease), np.asarray(used), np.asarray(promised))

            return tried

        def validation_rms(theta):
            return math.sqrt(float(_loss_of_mean(family, held, theta, layout=layout)))

        started, unknown = time.perf_counter(), np.full(len(theta), math.nan)
        compiled = _compiled_on_devices if row_blocks.devices() else _compiled_together
        program = compiled(family, on_device, theta, layout)
        _loss_of_mean.lower(family, held, theta, layout=layout).compile()
        compile_seconds = time.perf_counter() - started
        state, why = self._trained(theta, unknown, linearised, WAITING, validation_rms)
        each = [unflattened(one, layout) for one in np.asarray(state.best_theta)]
        params = jax.tree.map(lambda *a: np.stack(a), *each)
        return result_of(state, params, compile_seconds, why)

    def _trained(
        self, theta, damping, linearised, rule: Rule, validation_rms
    ) -> tuple[LMState, str]:
        state, theta = self.resume, np.asarray(theta)
        if state is None:
            rms = validation_rms(theta)
            state = LMState(theta, theta, damping, validation_rms=rms, best_validation_rms=rms)
        return trained(state, linearised, rule, validation_rms, np.size(self.w), self.limits)

    def _prepared(self, theta):
        """Rows w, target_gradient (N, 2d) and weight (2d,) as arrays, and on the device those that
        validate, with their weight. Raises as `_check_rows` does."""
        data = (self.w, self.target_gradient, *self.validation)
        w, target_gradient, *held = (np.asarray(a) for a in data)
        _check_rows(theta, w, target_gradient, *held)
        weight = np.broadcast_to(np.asarray(self.weight, theta.dtype), w.shape[-1:])
        return w, target_gradient, weight, jax.device_put((*held, weight[None, :]))


def flattened(params):
    """Parameters (P,) of a pytree, and its layout: hashable, for `unflattened`."""
    leaves, structure = jax.tree.flatten(params)
    theta = np.concatenate([np.ravel(leaf) for leaf in leaves])
    return theta, (structure, tuple(np.shape(leaf) for leaf in leaves))


def unflattened(theta, layout):
    structure, shapes = layout
    ends = np.cumsum([math.prod(shape) for shape in shapes]).tolist()
    starts = [0, *ends[:-1]]
    leaves = [theta[i:j].reshape(s) for i, j, s in zip(starts, ends, shapes, strict=True)]
    return structure.unflatten(leaves)


def _compile(family, chunks, held, theta, layout) -> None:
    """Have an iteration's three programs compiled, where they are not yet."""
    matrix = jax.ShapeDtypeStruct((theta.size, theta.size), theta.dtype)
    damping = jax.ShapeDtypeStruct((), theta.dtype)
    linearize.lower(family, chunks, theta, layout=layout).compile()
    attempt.lower(family, chunks, theta, (matrix, theta), damping, layout=layout).compile()
    _loss.lower(family, held, theta, layout=layout).compile()


def residual(family, layout, theta, w, target_gradient, weight):
    return weight * (family.gradient(unflattened(theta, layout), w) - target_gradient)


def _jacobian(family, layout, theta, w, weight):
    """A of one chunk, (rows · 2d, P): a reverse sweep through each directional derivative of S,
    which costs less than reversing the reverse sweep of ∇S."""

    def directional(theta, w, unit):
        params = unflattened(theta, layout)
        return jax.jvp(lambda w: family.value(params, w), (w,), (unit,))[1]

    units = jnp.eye(w.shape[-1], dtype=w.dtype)
    over_units = jax.vmap(jax.grad(directional), (None, None, 0))
    rows = jax.vmap(over_units, (None, 0, None))(theta, w, units)
    return (weight[:, :, None] * rows).reshape(-1, theta.size)


def _total(term, chunks):
    """The sum of term(w, target_gradient, weight) over the chunks, one at a time."""

    def add(sums, part):
        return jax.tree.map(jnp.add, sums, term(*part)), None

    shapes = jax.eval_shape(lambda parts: term(*(a[0] for a in parts)), chunks)
    zeros = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    return jax.lax.scan(add, zeros, chunks)[0]


@partial(jax.jit, static_argnames="layout")
def linearize(family, chunks, theta, *, layout):
    """AᵀA (P, P), Aᵀr (P,) and F."""

    def term(w, target_gradient, weight):
        r = residual(family, layout, theta, w, target_gradient, weight).ravel()
        a = _jacobian(family, layout, theta, w, weight)
        return a.T @ a, a.T @ r, r @ r

    return _total(term, chunks)


@partial(jax.jit, static_argnames="layout")
def attempt(family, chunks, theta, normal, damping, *, layout):
    """Trial θ (P,), its F, and the decrease that δ₁ promises. normal: AᵀA and Aᵀr."""
    matrix, slope = normal
    factor = jnp.linalg.cholesky(matrix + damping * jnp.eye(theta.size, dtype=theta.dtype))
    step = -cho_solve((factor, True), slope)

    def bend(*part):
        """Aᵀ r″(δ₁, δ₁) of one chunk: two nested directional derivatives, one reverse sweep."""

        def residual_at(theta):
            return residual(family, layout, theta, *part)

        _, pull_back = jax.vjp(residual_at, theta)

        def along(theta):
            return jax.jvp(residual_at, (theta,), (step,))[1]

        return pull_back(jax.jvp(along, (theta,), (step,))[1])[0]

    correction = -0.5 * cho_solve((factor, True), _total(bend, chunks))
    ratio = 2 * jnp.linalg.norm(correction) / jnp.linalg.norm(step)
    trial = theta + step + jnp.where(ratio <= LARGEST_ACCELERATION, correction, 0)
    loss = _total(lambda *part: jnp.sum(residual(family, layout, trial, *part) ** 2), chunks)
    return trial, loss, step @ (damping * step - slope)


@partial(jax.jit, static_argnames="layout")
def _loss(family, rows, theta, *, layout):
    """The mean square of a component of the residual."""
    return jnp.mean(residual(family, layout, theta, *rows) ** 2)


def chunked(w, target_gradient, weight, chunk):
    """All three as equal chunks (num_chunks, rows, 2d); weight 0 marks padding. NumPy."""
    num_chunks = -(-len(w) // chunk)
    rows = -(-len(w) // num_chunks)
    padding = num_chunks * rows - len(w)
    # Padding repeats a state, where S is as finite as on the data.
    take = np.concatenate([np.arange(len(w)), np.zeros(padding, int)])
    weights = (np.arange(take.size) < len(w))[:, None] * weight[None, :]
    return tuple(a.reshape(num_chunks, rows, -1) for a in (w[take], target_gradient[take], weights))


def _check_rows(theta, *data):
    names = ("w", "target_gradient", "the validation's w", "the validation's target_gradient")
    for name, array in zip(("params", *names), (theta, *data), strict=True):
        if array.dtype != np.float64:
            raise TypeError(
                f"{name} must be float64, not {array.dtype}: normal equations need it; "
                'switch it on with jax.config.update("jax_enable_x64", True)'
            )
        if not np.isfinite(array).all():
            raise ValueError(f"{name} has entries that are NaN or infinite")
    w, target, held_w, held_target = data
    for a, b in ((w, target), (held_w, held_target), (w[:1], held_w[:1])):
        if a.shape != b.shape or len(a) == 0:
            raise ValueError(
                f"w and target_gradient must be (N, 2d) with N > 0: got {[x.shape for x in data]}"
            )
    require_x64("Levenberg–Marquardt")


# One trial in an iteration: a member whose step fails waits with four times the damping.
WAITING = Nielsen(growth=4.0, trials=1)


def _compiled_together(family, rows, theta, layout):
    """One trial step of all members, compiled: `_try_together`'s of (θ, μ)."""
    given = (family, *jax.device_put(rows))
    unknown = np.full(len(theta), math.nan)
    _try_together.lower(*given, theta, unknown, layout=layout).compile()
    return partial(_try_together, *given, layout=layout)


def _compiled_on_devices(family, rows, theta, layout):
    """The same, each member by itself on the next device that is free."""
    points, weights = rows
    own = [weights[i : i + 1] for i in range(len(theta))]
    placed = {d: jax.device_put((family, points, own), d) for d in row_blocks.devices()}

    def compile_on(device, _) -> None:
        family, points, own = placed[device]
        unknown = np.full(1, math.nan)
        _try_together.lower(family, points, own[0], theta[:1], unknown, layout=layout).compile()

    def program(theta, damping):
        def of_one(i: int, device):
            family, points, own = placed[device]
            start = theta[i : i + 1], damping[i : i + 1]
            found = _try_together(family, points, own[i], *start, layout=layout)
            return jax.tree.map(np.asarray, found)

        found = row_blocks.each(of_one, range(len(theta)))
        return tuple(np.concatenate(parts) for parts in zip(*found, strict=True))

    row_blocks.each(compile_on, placed)
    return program


@partial(jax.jit, static_argnames="layout")
def _try_together(family, points, weights, thetas, dampings, *, layout):
    """One trial step of every member: θ (E, P) and F (E,) after it, as before where F did not fall;
    the decrease of F, the promised one, and μ (E,). The products AᵀA of all members are one batched
    product of matrices."""

    def of_one(theta, damping, weight):
        chunks = (*points, weight)
        matrix, slope, loss = linearize(family, chunks, theta, layout=layout)
        first = OF_LARGEST * jnp.max(jnp.diagonal(matrix))
        damping = jnp.where(jnp.isnan(damping), first, damping)
        trial, trial_loss, promised = attempt(
            family, chunks, theta, (matrix, slope), damping, layout=layout
        )
        better = loss - trial_loss > 0
        theta = jnp.where(better, trial, theta)
        losses = jnp.where(better, trial_loss, loss)
        return theta, losses, loss - trial_loss, promised, damping

    return jax.vmap(of_one)(thetas, dampings, weights)


@partial(jax.jit, static_argnames="layout")
def _loss_of_mean(family, held, thetas, *, layout):
    """The mean square of a component of the residual of the members' mean ∇S."""
    each = jax.vmap(lambda theta: residual(family, layout, theta, *held))(thetas)
    return jnp.mean(jnp.mean(each, axis=0) ** 2)
