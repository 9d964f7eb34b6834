"""The implicit step: a Newton solve down to roundoff, with implicit-function derivatives.

The solve finds x with r(θ, x) = 0 for one lane; a batch is a ``vmap`` of it. Three rules:

- Every iterate is judged by the residual that was evaluated *at it*, so "ok" is never a guess, and
  the gradient belonging to the returned x is at hand without another evaluation.
- Finished lanes are frozen, and those of a batch that need more updates than most are taken out of
  it for them: a slow or bad lane costs the others neither a bit nor its own time.
- Status is data. Non-finite values are tested for, since ``while err > tol`` ends silently on NaN.

Derivatives of ``root`` come from the implicit function theorem, in forward and reverse mode; those
of ``iterate`` from the iterations that ran, which is what an honest symplecticity defect needs.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float, Int

OK, LEFT_DOMAIN, STOPPED_AT_EDGE, NOT_CONVERGED, NON_FINITE = range(5)
STATUS_NAMES = (
    "ok",
    "left the domain",
    "stopped at the domain's edge",
    "not converged",
    "non-finite",
)

# Elimination is unrolled up to this size; beyond it LAPACK's call overhead no longer matters.
_UNROLL_UP_TO = 8
_HALVINGS = 30
# How much the residual's slope along a step may change, as a part of the steeper slope; how far the
# residual's change may be from what these slopes tell (the trapezoidal rule), as a part of it.
_BENT, _OFF_PATH = 0.35, 0.05
# The first step is tried whole where the update with the same step has left this of the residual,
# else by this part: it may lead past any number of folds, and seldom does so by small steps.
_STRAIGHT, _BEGIN = 0.01, 0.125
# A residual of this many eps of the size of its terms is the floor: a few roundings of that size.
_FLOOR_EPS = 4.0
# Where one update is not enough, this many lanes of a batch, or this part of it, are visited at a
# time for so many updates: the fewer, the less waits for the hardest, the more often all are seen.
# Tuned on CPUs; where all lanes of a batch are hard, it costs up to a fifth more than to wait.
_FEWEST, _PART, _VISIT = 32, 32, 2


class Info(NamedTuple):
    """How a solve ended, per lane: status, Newton updates made, and the residual relative to
    the size of the terms that it is made of."""

    status: Int[Array, "*batch"]
    iterations: Int[Array, "*batch"]
    residual: Float[Array, "*batch"]


def small_solve(matrix: Matrix, rhs: Vector) -> Vector:
    """Solve matrix @ x = rhs by Gaussian elimination with partial pivoting, unrolled for n <= 8.

    Under vmap it compiles to a few fused loops over the batch, 10-25 times faster than a batched
    LAPACK call at these sizes. Linear in ``rhs``, so it can be transposed.
    """
    if rhs.shape[0] > _UNROLL_UP_TO:
        return jnp.linalg.solve(matrix, rhs)
    return _eliminate(matrix, rhs)[0]


def _solve_and_sign(matrix, rhs):
    """The solution, and the sign of the matrix' determinant."""
    if rhs.shape[0] > _UNROLL_UP_TO:
        return jnp.linalg.solve(matrix, rhs), jnp.linalg.slogdet(matrix)[0]
    return _eliminate(matrix, rhs)


def _eliminate(matrix, rhs):
    n, sign = rhs.shape[0], jnp.ones((), matrix.dtype)
    # The right-hand side apart from the rows: only so is all this linear in it.
    rows, x = [matrix[i] for i in range(n)], [rhs[i] for i in range(n)]
    for k in range(n):
        for i in range(k + 1, n):  # bubble the largest pivot up
            swap = jnp.abs(rows[i][k]) > jnp.abs(rows[k][k])
            rows[k], rows[i] = jnp.where(swap, rows[i], rows[k]), jnp.where(swap, rows[k], rows[i])
            x[k], x[i] = jnp.where(swap, x[i], x[k]), jnp.where(swap, x[k], x[i])
            sign = jnp.where(swap, -sign, sign)
        sign = sign * jnp.sign(rows[k][k])
        rows[k], x[k] = rows[k] / rows[k][k], x[k] / rows[k][k]
        for i in range(k + 1, n):
            factor = rows[i][k]
            rows[i], x[i] = rows[i] - factor * rows[k], x[i] - factor * x[k]
    for k in reversed(range(n)):
        for j in range(k + 1, n):
            x[k] = x[k] - rows[k][j] * x[j]
    return jnp.stack(x), sign


class _Iterate(NamedTuple):
    x: Any
    residual: Any
    aux: Any
    merit: Any  # largest residual
    floor: Any  # largest of the residuals' roundoff floors
    error: Any  # largest residual relative to its roundoff floor
    sign: Any  # of det ∂r/∂x at the guess
    step: Any  # the Newton step from x, and the part of it to be tried next
    factor: Any
    iterations: Any
    open: Any  # still to be improved


def _each(newton: Callable, theta, state: _Iterate) -> _Iterate:
    """Newton's method for one lane; a batch of it goes on as long as its slowest lane."""
    return jax.lax.while_loop(lambda s: s.open, partial(newton, theta), state)


def _some(newton: Callable, theta, state: _Iterate) -> _Iterate:
    """As ``_each``, but for one visit."""

    def goes_on(carry):
        return carry[0].open & (carry[1] < _VISIT)

    def again(carry):
        return newton(theta, carry[0]), carry[1] + 1

    return jax.lax.while_loop(goes_on, again, (state, 0))[0]


def _few_together(newton: Callable, theta, state: _Iterate) -> _Iterate:
    """As ``_each``; but of a batch only lanes that are open are visited, a few at a time: the
    others need not wait for them."""
    loop = custom_vmap(partial(_each, newton))

    @loop.def_vmap
    def _(size, batched, theta, state):
        own = batched[0]  # which parts of θ a lane has for itself
        axes = jax.tree.map(lambda its: 0 if its else None, own)
        state = jax.tree.map(
            lambda a, its: a if its else jnp.broadcast_to(a, (size, *jnp.shape(a))),
            state, batched[1],
        )  # fmt: skip
        everywhere = jax.tree.map(lambda _: True, state)
        few = max(_FEWEST, size // _PART)
        if size <= few:
            return jax.vmap(partial(_each, newton), (axes, 0))(theta, state), everywhere

        def visit(state):
            place = jnp.cumsum(state.open)  # of a lane among the open ones, from 1
            lanes = jnp.searchsorted(place, jnp.arange(1, few + 1), method="scan_unrolled")
            of_them = partial(jnp.take, indices=lanes, axis=0, mode="clip")
            given = jax.tree.map(lambda a, its: of_them(a) if its else a, theta, own)
            new = jax.vmap(partial(_some, newton), (axes, 0))(given, jax.tree.map(of_them, state))
            return jax.tree.map(lambda a, its: a.at[lanes].set(its, mode="drop"), state, new)

        return jax.lax.while_loop(lambda s: jnp.any(s.open), visit, state), everywhere

    return loop(theta, state)


def iterate(
    evaluate: Callable, theta: Any, guess: Vector, *, most: int, loop: Callable = _each
) -> tuple[Vector, Any, Info]:
    """The iterations themselves: ``evaluate(theta, x) -> (residual (n,), size (n,), aux)``.

    ``size`` is that of the terms whose difference the residual is: a few eps of it is roundoff.
    One update with the Jacobian at the guess, where it is evaluated together with the residual,
    with which it shares most of its work: from a guess as close as the root of roundoff that is
    all. For the lanes that are left, Newton's method with a fresh Jacobian, a step halved until it
    stays by the Newton path r(x) = (1 − t) r(guess) (Deuflhard, "Newton Methods for Nonlinear
    Problems", 2004, chapter 3), which ends at the solution of the guess's own branch or at a fold:
    there the sign of det ∂r/∂x would change, and the lane is given up, not led to another branch.
    A step over a pair of folds keeps the sign and may shrink the residual; it shows in the slopes.
    A lane closes when its residual is at the roundoff floor, or is close to it and no longer
    halves, or cannot be made smaller. At most ``most`` updates, 1 or more; ``loop`` makes them.
    Returns x, aux at x, Info.
    """
    eps = float(jnp.finfo(guess.dtype).eps)
    settled = eps**-0.25  # in floors: 3e-12 of the size in float64, 1e-5 in float32
    one = np.ones((), guess.dtype)

    def judged(x, residual, size, aux, iterations):
        merit = jnp.max(jnp.abs(residual))
        floor = _FLOOR_EPS * eps * jnp.max(size)
        error = jnp.max(jnp.abs(residual) / size) / (_FLOOR_EPS * eps)
        return _Iterate(
            x,
            residual,
            aux,
            merit,
            floor,
            error,
            one,
            jnp.zeros_like(x),
            one,
            iterations,
            np.array(True),
        )

    def linearised(theta, x):
        """(residual, size, aux) and the Jacobian ∂r/∂x at x."""

        def with_aux(x):
            residual, size, aux = evaluate(theta, x)
            return residual, (residual, size, aux)

        return jax.jacfwd(with_aux, has_aux=True)(x)

    def goes_on(new, old):
        halved = new.merit < 0.5 * old.merit
        return (new.error > settled) | (new.error > 1.0) & halved

    def frozen(x):
        """The guess with its step, the sign of the Jacobian there, and what the step leads to."""
        matrix, (residual, size, aux) = linearised(theta, x)
        step, sign = _solve_and_sign(matrix, residual)
        first = judged(x, residual, size, aux, jnp.zeros((), jnp.int32))._replace(
            step=step, sign=sign
        )
        residual, size, aux = evaluate(theta, x - step)
        second = judged(x - step, residual, size, aux, jnp.ones((), jnp.int32))
        return first, second._replace(sign=sign)

    def newton(theta, state):
        """Try a part of the step: take it where it stays by the path, else halve the part."""
        x = state.x - state.factor * state.step
        matrix, (residual, size, aux) = linearised(theta, x)
        new = judged(x, residual, size, aux, state.iterations + 1)
        step, sign_here = _solve_and_sign(matrix, residual)
        # The residual's slope along the step at its end; at its beginning it is -state.residual.
        slope = -matrix @ state.step
        steeper = jnp.maximum(jnp.max(jnp.abs(slope)), state.merit)
        bent = jnp.max(jnp.abs(slope + state.residual)) / steeper
        told = state.residual + 0.5 * state.factor * (slope - state.residual)
        off = jnp.max(jnp.abs(residual - told))
        near = _OFF_PATH * state.factor * state.merit + 4 * new.floor
        by_the_path = (bent <= _BENT) & (off <= near) & (sign_here == state.sign)
        better = by_the_path | (state.error <= settled) & (new.merit < state.merit)
        further = goes_on(new, state) & (new.iterations < most)
        # The next part is as long as the slope's change allows, if it goes on as it did.
        longer = 0.95 * _BENT / jnp.clip(bent, 0.25 * _BENT, 2 * _BENT) * state.factor
        new = new._replace(
            sign=state.sign, step=step, factor=jnp.minimum(one, longer), open=further
        )
        # Close to the floor only the full step makes sense: what is left is roundoff.
        shortest = jnp.where(state.error < settled, 1.0, 0.5**_HALVINGS).astype(guess.dtype)
        halved = state._replace(factor=0.5 * state.factor, open=state.factor > shortest)
        return jax.tree.map(partial(jnp.where, better), new, halved)

    first, second = frozen(guess)
    smaller = second.merit < first.merit
    done = smaller & ~goes_on(second, first)
    begun = ~done & (smaller | (first.error > settled)) & (most > 1)
    straight = (second.error <= settled) | (second.merit <= _STRAIGHT * first.merit)
    state = jax.tree.map(partial(jnp.where, smaller & ~begun), second, first)._replace(
        factor=jnp.where(straight, one, _BEGIN),
        iterations=jnp.where(begun, 0, 1).astype(jnp.int32),  # the loop makes the first one again
        open=begun,
    )
    state = loop(newton, theta, state)
    finite = jnp.isfinite(state.error)
    status = jnp.where(state.error <= settled, OK, jnp.where(finite, NOT_CONVERGED, NON_FINITE))
    residual = state.error * (_FLOOR_EPS * eps)
    return state.x, state.aux, Info(status.astype(jnp.int32), state.iterations, residual)


@partial(jax.custom_jvp, nondiff_argnums=(0, 3))
def root(evaluate, theta, guess, most: int):
    """As ``iterate``, with derivatives in θ by the implicit function theorem.

    dx = −(∂r/∂x)⁻¹ (∂r/∂θ) dθ; the guess has no influence. ``evaluate`` must not close over
    anything that is differentiated.
    """
    return iterate(evaluate, theta, guess, most=most, loop=_few_together)


@root.defjvp
def _root_jvp(evaluate, most, primals, tangents):
    theta, guess = primals
    x, aux, info = root(evaluate, theta, guess, most)
    _, residual_dot = jax.jvp(lambda t: evaluate(t, x)[0], (theta,), (tangents[0],))
    matrix = jax.jacfwd(lambda y: evaluate(theta, y)[0])(x)
    x_dot = -small_solve(matrix, residual_dot)
    _, aux_dot = jax.jvp(lambda t, y: evaluate(t, y)[2], (theta, x), (tangents[0], x_dot))
    integer_dot: Any = np.zeros((), jax.dtypes.float0)
    info_dot = Info(integer_dot, integer_dot, jnp.zeros_like(info.residual))
    return (x, aux, info), (x_dot, aux_dot, info_dot)
