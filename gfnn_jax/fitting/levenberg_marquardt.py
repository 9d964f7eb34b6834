"""Fit any family S(params, w) to target gradients by Levenberg–Marquardt, with acceleration.

The loss is a sum of squares, F(θ) = Σ ‖∇S(θ, w) − g‖², so that the Jacobian A of the residual r
gives nearly all of its curvature. A network of a thousand parameters then gains an order of
magnitude in tens of iterations, where first-order methods take tens of thousands.

An iteration linearises once, at about 4dNP² flops for N pairs and P parameters (the product AᵀA;
A itself costs less), and then tries steps θ + δ₁ + δ₂ under growing damping μ until one lowers F:

    (AᵀA + μI) δ₁ = −Aᵀr,        (AᵀA + μI) δ₂ = −½ Aᵀ r″(δ₁, δ₁).

δ₁ is the step of Levenberg (1944) and Marquardt (1963), and μ follows Nielsen (IMM-REP-1999-05).
δ₂ follows the bend of the valley (Transtrum & Sethna, arXiv:1201.5885): it costs a few gradient
evaluations, no second Jacobian, and saves most of the iterations.

Normal equations square the condition number of A. Damping makes that harmless here, where a step
needs only to lead downhill, but it does take float64: anything less is refused.

Memory: A is never held whole. The peak is 2 P² + 4 · 2d · chunk · P numbers in linearising and 3 P²
in a trial, whatever N; each also keeps a few activations of S for every pair of a chunk.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
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

# δ₂ is a correction: where it is not small beside δ₁ the expansion has failed and δ₁ goes alone.
LARGEST_ACCELERATION = 0.75
# Damping grown by 2^(1 + 2 + ... + 10) without descent: F is flat to roundoff.
MAX_TRIALS = 11
BLOCK = 10  # iterations that are made together: a unit of a fit's budget
# Of members that are trained together: damping after a step that has not lowered F.
TOGETHER_GROWTH = 4.0

Rows = Float[Array | np.ndarray, "_ _"]


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


def levenberg_marquardt(
    family: Family,
    params: Any,
    w: Rows,
    target_gradient: Rows,
    *,
    validation: tuple[Rows, Rows],
    weight: Any = 1.0,
    max_iterations: int = 200,
    block: Callable[[int], AbstractContextManager] = lambda iterations: nullcontext(),
    target_rms: float = 0.0,
    patience: int = 20,
    chunk: int = 500,
    on_progress: Callable[[LMState], Any] | None = None,
    checkpoint: Callable[[LMState], Any] | None = None,
    resume: LMState | None = None,
) -> LMResult:
    """Minimise the mean of ‖weight · (∇S(params, w) − target_gradient)‖² over the pairs.

    family:      what is compiled for it serves every set of data of the same shape.
    params:      any pytree of float64 arrays: the start.
    w, target_gradient: (N, 2d) each, as a chart makes them from pairs of states.
    validation:  (w, target_gradient) of pairs kept apart; the parameters that fit them best are
                 returned.
    weight:      (2d,), or one for all: what makes a row of ∇S unit-free.
    max_iterations: when to stop. A run repeats to the last bit on one machine with the same number
                 of threads.
    block:       gives the context in which the next so many iterations are made; it raises
                 OutOfTime to stop before them.
    target_rms:  stop once the validation RMS is as small.
    patience:    stop when train_rms fell by less than 1 % in so many iterations.
    chunk:       at most so many pairs have their Jacobian in memory at once.
    on_progress: called with the state after every iteration.
    checkpoint:  likewise, to save the state. Given back as ``resume`` the fit goes on as though it
                 had never stopped, bit for bit (``params`` then only lends its structure).
    """
    theta, layout = _flattened(params)
    rows = (np.asarray(a) for a in (w, target_gradient, *validation))
    w, target_gradient, held_w, held_target = rows
    _check(theta, w, target_gradient, held_w, held_target)
    weight = np.broadcast_to(np.asarray(weight, theta.dtype), w.shape[-1:])
    # On the device once, not in every iteration.
    chunks = jax.device_put(_chunked(w, target_gradient, weight, chunk))
    held = jax.device_put((held_w, held_target, weight[None, :]))

    linearize = partial(_linearize, family, chunks, layout=layout)
    attempt = partial(_attempt, family, chunks, layout=layout)

    def descend(theta, damping):
        return _descend(theta, damping, linearize, attempt)

    def validation_rms(theta):
        return math.sqrt(float(_loss(family, held, theta, layout=layout)))

    started = time.perf_counter()
    _compile(family, chunks, held, theta, layout)
    compile_seconds = time.perf_counter() - started
    options = _Options(
        max_iterations, block, target_rms, patience, (on_progress, checkpoint)
    )  # fmt: skip
    first = _first_state(theta, math.nan, validation_rms(theta)) if resume is None else resume
    state, why = _trained(first, descend, validation_rms, w.size, options)
    params = _unflattened(np.asarray(state.best_theta), layout)
    return _result(state, params, compile_seconds, why)


def levenberg_marquardt_together(
    family: Family,
    members: Sequence[Any],
    w: Rows,
    target_gradient: Rows,
    *,
    validation: tuple[Rows, Rows],
    weight: Any = 1.0,
    shares: Float[np.ndarray, "_ _"],
    max_iterations: int = 200,
    block: Callable[[int], AbstractContextManager] = lambda iterations: nullcontext(),
    target_rms: float = 0.0,
    patience: int = 20,
    chunk: int = 500,
    on_progress: Callable[[LMState], Any] | None = None,
    checkpoint: Callable[[LMState], Any] | None = None,
    resume: LMState | None = None,
) -> LMResult:
    """Minimise that loss for E members of a family at once, each from its own start and with its
    own shares of the pairs; one program linearises and tries a step of all of them.

    members: E starts, pytrees of one structure. shares: (E, N), 0 or more, of mean 1: what the
    square of a pair's residual counts in each member's loss. All else is as for
    `levenberg_marquardt`, but for this: a member whose step does not lower its loss waits with four
    times the damping for the next iteration; validation errors are those of the members' mean ∇S;
    theta and best_theta of a state are (E, P), its damping (E,); the params that are returned have
    a leading axis E. The memory is E times as much.

    On the devices of the fit (`fitting.row_blocks`) members are trained one at a time on each: to
    the same bits on any number of devices, which one batch of all members would not give.
    """
    flat = [_flattened(member) for member in members]
    theta, layout = np.stack([t for t, _ in flat]), flat[0][1]
    rows = (np.asarray(a) for a in (w, target_gradient, *validation))
    w, target_gradient, held_w, held_target = rows
    _check(theta, w, target_gradient, held_w, held_target)
    weight = np.broadcast_to(np.asarray(weight, theta.dtype), w.shape[-1:])
    held = jax.device_put((held_w, held_target, weight[None, :]))
    *points, weights = _chunked(w, target_gradient, weight, chunk)
    padding = weights.shape[0] * weights.shape[1] - len(w)
    parts = np.pad(np.sqrt(shares), ((0, 0), (0, padding))).reshape(-1, *weights.shape[:2], 1)
    on_device = tuple(points), parts * weights

    def descend(theta, damping):
        theta, losses, damping = program(theta, damping)
        if not np.isfinite(losses).all():
            raise ValueError("∇S(params, w) is not finite on the training pairs at the start")
        return theta, float(np.mean(losses)), np.asarray(damping)

    def validation_rms(theta):
        return math.sqrt(float(_loss_of_mean(family, held, theta, layout=layout)))

    started, unknown = time.perf_counter(), np.full(len(theta), math.nan)
    compiled = _compiled_on_devices if row_blocks.devices() else _compiled_together
    program = compiled(family, on_device, theta, layout)
    _loss_of_mean.lower(family, held, theta, layout=layout).compile()
    compile_seconds = time.perf_counter() - started
    options = _Options(
        max_iterations, block, target_rms, patience, (on_progress, checkpoint)
    )  # fmt: skip
    first = _first_state(theta, unknown, validation_rms(theta)) if resume is None else resume
    state, why = _trained(first, descend, validation_rms, w.size, options)
    each = [_unflattened(one, layout) for one in np.asarray(state.best_theta)]
    return _result(state, jax.tree.map(lambda *a: np.stack(a), *each), compile_seconds, why)


def _compiled_together(family, rows, theta, layout):
    """One trial step of all members (θ, μ) -> (θ, F, μ), compiled."""
    given = (family, *jax.device_put(rows))
    unknown = np.full(len(theta), math.nan)
    _descend_together.lower(*given, theta, unknown, layout=layout).compile()
    return partial(_descend_together, *given, layout=layout)


def _compiled_on_devices(family, rows, theta, layout):
    """The same, each member by itself on the next device that is free."""
    points, weights = rows
    own = [weights[i : i + 1] for i in range(len(theta))]
    placed = {d: jax.device_put((family, points, own), d) for d in row_blocks.devices()}

    def compile_on(device, _) -> None:
        family, points, own = placed[device]
        unknown = np.full(1, math.nan)
        _descend_together.lower(family, points, own[0], theta[:1], unknown, layout=layout).compile()

    def program(theta, damping):
        def of_one(i: int, device):
            family, points, own = placed[device]
            start = theta[i : i + 1], damping[i : i + 1]
            found = _descend_together(family, points, own[i], *start, layout=layout)
            return jax.tree.map(np.asarray, found)

        found = row_blocks.each(of_one, range(len(theta)))
        return tuple(np.concatenate(parts) for parts in zip(*found, strict=True))

    row_blocks.each(compile_on, placed)
    return program


class _Options(NamedTuple):
    """Limits of a training, and the callbacks that see its states."""

    max_iterations: int
    block: Callable[[int], AbstractContextManager]
    target_rms: float
    patience: int
    told: tuple[Callable[[LMState], Any] | None, ...]


def _trained(state: LMState, descend, validation_rms, size: int, options: _Options):
    """The last state from this one on, and why there is no further one."""
    started, seconds_before = time.perf_counter(), state.seconds

    def reason_to_stop(state):
        if state.best_validation_rms <= options.target_rms:
            return "target"
        if state.iteration >= options.max_iterations:
            return "iterations"
        if state.iteration - state.landmark_iteration >= options.patience:
            return "no progress"
        return None

    def iterate(state):
        """The next state, or None where no step lowers F."""
        step = descend(state.theta, state.damping)
        if step is None:
            return None
        theta, loss, damping = step
        train_rms = math.sqrt(loss / size)
        seconds = seconds_before + time.perf_counter() - started
        state = _next_state(state, theta, damping, train_rms, validation_rms(theta), seconds)
        for report in options.told:
            if report is not None:
                report(state)
        return state

    while (stopped_because := reason_to_stop(state)) is None:
        try:
            with options.block(BLOCK):
                for _ in range(BLOCK):
                    further = iterate(state)
                    if further is None:
                        return state, "no progress"
                    state = further
                    if reason_to_stop(state) is not None:
                        break
        except OutOfTime:
            return state, "budget"
    return state, stopped_because


def _result(state: LMState, params, compile_seconds: float, stopped_because: str) -> LMResult:
    return LMResult(
        params=jax.tree.map(jnp.asarray, params),
        train_rms=state.train_rms,
        validation_rms=state.best_validation_rms,
        iterations=state.iteration,
        seconds=state.seconds,
        compile_seconds=compile_seconds,
        stopped_because=stopped_because,
    )


def _descend(theta, damping, linearize, attempt):
    """One iteration: (θ, F, μ) of the first trial step that lowers F, or None where none does."""
    matrix, slope, loss = linearize(theta)
    if not math.isfinite(float(loss)):
        raise ValueError("∇S(params, w) is not finite on the training pairs at the start")
    if math.isnan(damping):
        damping = 1e-3 * float(np.max(np.diagonal(np.asarray(matrix))))
    growth = 2.0
    for _ in range(MAX_TRIALS):
        trial, trial_loss, promised = attempt(theta, matrix, slope, np.float64(damping))
        decrease = float(loss - trial_loss)
        # False for NaN as well: a failed factorisation or an overflow is a step too long.
        if decrease > 0:
            gain = decrease / float(promised)
            return trial, float(trial_loss), damping * max(1 / 3, 1 - (2 * gain - 1) ** 3)
        damping, growth = damping * growth, 2 * growth
    return None


def _flattened(params):
    """Parameters (P,) of a pytree, and its layout: hashable, for `_unflattened`."""
    leaves, structure = jax.tree.flatten(params)
    theta = np.concatenate([np.ravel(leaf) for leaf in leaves])
    return theta, (structure, tuple(np.shape(leaf) for leaf in leaves))


def _unflattened(theta, layout):
    structure, shapes = layout
    ends = np.cumsum([math.prod(shape) for shape in shapes]).tolist()
    starts = [0, *ends[:-1]]
    leaves = [theta[i:j].reshape(s) for i, j, s in zip(starts, ends, shapes, strict=True)]
    return structure.unflatten(leaves)


def _compile(family, chunks, held, theta, layout) -> None:
    """Have an iteration's three programs compiled, where they are not yet."""
    matrix = jax.ShapeDtypeStruct((theta.size, theta.size), theta.dtype)
    damping = jax.ShapeDtypeStruct((), theta.dtype)
    _linearize.lower(family, chunks, theta, layout=layout).compile()
    _attempt.lower(family, chunks, theta, matrix, theta, damping, layout=layout).compile()
    _loss.lower(family, held, theta, layout=layout).compile()


def _residual(family, layout, theta, w, target_gradient, weight):
    return weight * (family.gradient(_unflattened(theta, layout), w) - target_gradient)


def _jacobian(family, layout, theta, w, weight):
    """A of one chunk, (rows · 2d, P): a reverse sweep through each directional derivative of S,
    which costs less than reversing the reverse sweep of ∇S."""

    def directional(theta, w, unit):
        params = _unflattened(theta, layout)
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
def _linearize(family, chunks, theta, *, layout):
    """AᵀA (P, P), Aᵀr (P,) and F."""

    def term(w, target_gradient, weight):
        r = _residual(family, layout, theta, w, target_gradient, weight).ravel()
        a = _jacobian(family, layout, theta, w, weight)
        return a.T @ a, a.T @ r, r @ r

    return _total(term, chunks)


@partial(jax.jit, static_argnames="layout")
def _attempt(family, chunks, theta, matrix, slope, damping, *, layout):
    """Trial θ (P,), its F, and the decrease that δ₁ promises."""
    factor = jnp.linalg.cholesky(matrix + damping * jnp.eye(theta.size, dtype=theta.dtype))
    step = -cho_solve((factor, True), slope)

    def bend(*part):
        """Aᵀ r″(δ₁, δ₁) of one chunk: two nested directional derivatives, one reverse sweep."""

        def residual_at(theta):
            return _residual(family, layout, theta, *part)

        _, pull_back = jax.vjp(residual_at, theta)

        def along(theta):
            return jax.jvp(residual_at, (theta,), (step,))[1]

        return pull_back(jax.jvp(along, (theta,), (step,))[1])[0]

    correction = -0.5 * cho_solve((factor, True), _total(bend, chunks))
    ratio = 2 * jnp.linalg.norm(correction) / jnp.linalg.norm(step)
    trial = theta + step + jnp.where(ratio <= LARGEST_ACCELERATION, correction, 0)
    loss = _total(lambda *part: jnp.sum(_residual(family, layout, trial, *part) ** 2), chunks)
    return trial, loss, step @ (damping * step - slope)


@partial(jax.jit, static_argnames="layout")
def _loss(family, rows, theta, *, layout):
    """The mean square of a component of the residual."""
    return jnp.mean(_residual(family, layout, theta, *rows) ** 2)


@partial(jax.jit, static_argnames="layout")
def _descend_together(family, points, weights, thetas, dampings, *, layout):
    """One trial step of every member: θ (E, P), F and μ (E,) after it, θ as before where F did not
    fall. The products AᵀA of all members are one batched product of matrices."""

    def of_one(theta, damping, weight):
        chunks = (*points, weight)
        matrix, slope, loss = _linearize(family, chunks, theta, layout=layout)
        first = 1e-3 * jnp.max(jnp.diagonal(matrix))
        damping = jnp.where(jnp.isnan(damping), first, damping)
        trial, trial_loss, promised = _attempt(
            family, chunks, theta, matrix, slope, damping, layout=layout
        )
        decrease = loss - trial_loss
        better = decrease > 0
        shrunk = damping * jnp.maximum(1 / 3, 1 - (2 * decrease / promised - 1) ** 3)
        return (
            jnp.where(better, trial, theta),
            jnp.where(better, trial_loss, loss),
            jnp.where(better, shrunk, TOGETHER_GROWTH * damping),
        )

    return jax.vmap(of_one)(thetas, dampings, weights)


@partial(jax.jit, static_argnames="layout")
def _loss_of_mean(family, held, thetas, *, layout):
    """The mean square of a component of the residual of the members' mean ∇S."""
    each = jax.vmap(lambda theta: _residual(family, layout, theta, *held))(thetas)
    return jnp.mean(jnp.mean(each, axis=0) ** 2)


def _chunked(w, target_gradient, weight, chunk):
    """All three as equal chunks (num_chunks, rows, 2d); weight 0 marks padding. NumPy."""
    num_chunks = -(-len(w) // chunk)
    rows = -(-len(w) // num_chunks)
    padding = num_chunks * rows - len(w)
    # Padding repeats a state, where S is as finite as on the data.
    take = np.concatenate([np.arange(len(w)), np.zeros(padding, int)])
    weights = (np.arange(take.size) < len(w))[:, None] * weight[None, :]
    return tuple(a.reshape(num_chunks, rows, -1) for a in (w[take], target_gradient[take], weights))


def _first_state(theta, damping, validation_rms):
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


def _check(theta, *data):
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
