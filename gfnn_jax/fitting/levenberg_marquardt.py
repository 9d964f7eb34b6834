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
"""

from __future__ import annotations

import math
import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float

from gfnn_jax.families import Family
from gfnn_jax.fitting.training import Limits, LMResult, LMState, first_state, result_of, trained
from gfnn_jax.phase_space import require_x64
from gfnn_jax.solve.levenberg_marquardt import Nielsen, Tried

# δ₂ is a correction: where it is not small beside δ₁ the expansion has failed and δ₁ goes alone.
LARGEST_ACCELERATION = 0.75
OF_LARGEST = 1e-3  # the first damping, of the largest entry on AᵀA's diagonal

Rows = Float[Array | np.ndarray, "_ _"]


def levenberg_marquardt(
    family: Family,
    params: Any,
    w: Rows,
    target_gradient: Rows,
    *,
    validation: tuple[Rows, Rows],
    weight: Any = 1.0,
    limits: Limits = Limits(),  # noqa: B008, it is frozen
    chunk: int = 500,
    resume: LMState | None = None,
) -> LMResult:
    """Minimise the mean of ‖weight · (∇S(params, w) − target_gradient)‖² over the pairs.

    family:      what is compiled for it serves every set of data of the same shape.
    params:      any pytree of float64 arrays: the start.
    w, target_gradient: (N, 2d) each, as a chart makes them from pairs of states.
    validation:  (w, target_gradient) of pairs kept apart; the parameters that fit them best are
                 returned.
    weight:      (2d,), or one for all: what makes a row of ∇S unit-free.
    limits:      when to stop, and what is called with the states.
    chunk:       at most so many pairs have their Jacobian in memory at once.
    resume:      a state that was reported: the fit goes on from there as though it had never
                 stopped, bit for bit (``params`` then only lends its structure).
    """
    theta, layout = flattened(params)
    w, target_gradient, weight, held = prepared(theta, w, target_gradient, validation, weight)
    # On the device once, not in every iteration.
    chunks = jax.device_put(chunked(w, target_gradient, weight, chunk))

    def linearised(theta):
        """Trial steps from θ, of any damping: all of them share one linearisation."""
        matrix, slope, loss = linearize(family, chunks, theta, layout=layout)
        if not math.isfinite(float(loss)):
            raise ValueError("∇S(params, w) is not finite on the training pairs at the start")

        def tried(damping) -> Tried:
            if math.isnan(damping):
                damping = OF_LARGEST * float(np.max(np.diagonal(np.asarray(matrix))))
            found = attempt(
                family, chunks, theta, matrix, slope, np.float64(damping), layout=layout
            )
            trial, trial_loss, promised = found
            decrease = float(loss - trial_loss)
            return Tried((trial, float(trial_loss)), decrease, damping, float(promised))

        return tried

    def validation_rms(theta):
        return math.sqrt(float(_loss(family, held, theta, layout=layout)))

    started = time.perf_counter()
    _compile(family, chunks, held, theta, layout)
    compile_seconds = time.perf_counter() - started
    first = first_state(theta, math.nan, validation_rms(theta)) if resume is None else resume
    state, why = trained(first, linearised, Nielsen(), validation_rms, w.size, limits)
    params = unflattened(np.asarray(state.best_theta), layout)
    return result_of(state, params, compile_seconds, why)


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
    attempt.lower(family, chunks, theta, matrix, theta, damping, layout=layout).compile()
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
def attempt(family, chunks, theta, matrix, slope, damping, *, layout):
    """Trial θ (P,), its F, and the decrease that δ₁ promises."""
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


def prepared(theta, w, target_gradient, validation, weight):
    """Rows w, target_gradient (N, 2d) and weight (2d,) as arrays, and on the device those that
    validate, with their weight. Raises as `_check_rows` does."""
    w, target_gradient, *held = (np.asarray(a) for a in (w, target_gradient, *validation))
    _check_rows(theta, w, target_gradient, *held)
    weight = np.broadcast_to(np.asarray(weight, theta.dtype), w.shape[-1:])
    return w, target_gradient, weight, jax.device_put((*held, weight[None, :]))


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
