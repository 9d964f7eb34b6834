"""The implicit step: a Newton solve down to roundoff, with implicit-function derivatives.

The solve finds x with r(θ, x) = 0 for one lane; a batch is a ``vmap`` of it. Three rules:

- Every iterate is judged by the residual that was evaluated *at it*, so "ok" is never a guess, and
  the gradient belonging to the returned x is at hand without another evaluation.
- Finished lanes are frozen: a slow or bad lane costs the others the common loop, never a bit.
- Status is data. Non-finite values are tested for, since ``while err > tol`` ends silently on NaN.

Derivatives of ``root`` come from the implicit function theorem, in forward and reverse mode; those of
``iterate`` from the iterations that ran, which is what an honest symplecticity defect needs.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

OK, LEFT_DOMAIN, STOPPED_AT_EDGE, NOT_CONVERGED, NON_FINITE = range(5)
STATUS_NAMES = ("ok", "left the domain", "stopped at the domain's edge", "not converged", "non-finite")

# Elimination is unrolled up to this size; beyond it LAPACK's call overhead no longer matters.
_UNROLL_UP_TO = 8
_HALVINGS = 12


class Info(NamedTuple):
    """How a solve ended, per lane: status, Newton updates made, and the residual relative to scale."""

    status: Int[Array, "*batch"]
    iterations: Int[Array, "*batch"]
    residual: Float[Array, "*batch"]


def small_solve(matrix: Float[Array, "n n"], rhs: Float[Array, "n"]) -> Float[Array, "n"]:
    """Solve matrix @ x = rhs by Gaussian elimination with partial pivoting, unrolled for n <= 8.

    Under vmap it compiles to a few fused loops over the batch, 10-25 times faster than a batched
    LAPACK call at these sizes. Linear in ``rhs``, so it can be transposed.
    """
    n = rhs.shape[0]
    if n > _UNROLL_UP_TO:
        return jnp.linalg.solve(matrix, rhs)
    rows = [[matrix[i, j] for j in range(n)] + [rhs[i]] for i in range(n)]
    for k in range(n):
        for i in range(k + 1, n):  # bubble the largest pivot up
            swap = jnp.abs(rows[i][k]) > jnp.abs(rows[k][k])
            upper = [jnp.where(swap, b, a) for a, b in zip(rows[k], rows[i], strict=True)]
            lower = [jnp.where(swap, a, b) for a, b in zip(rows[k], rows[i], strict=True)]
            rows[k], rows[i] = upper, lower
        inverse = 1.0 / rows[k][k]
        for i in range(k + 1, n):
            factor = rows[i][k] * inverse
            rows[i] = [a - factor * b for a, b in zip(rows[i], rows[k], strict=True)]
    x: list[Any] = [None] * n
    for k in reversed(range(n)):
        tail = sum((rows[k][j] * x[j] for j in range(k + 1, n)), start=jnp.zeros_like(rhs[0]))
        x[k] = (rows[k][n] - tail) / rows[k][k]
    return jnp.stack(x)


class _Iterate(NamedTuple):
    x: Any
    residual: Any
    aux: Any
    error: Any  # largest residual relative to its floor
    iterations: Any
    open: Any  # still to be improved


def iterate(
    evaluate: Callable, theta: Any, guess: Float[Array, "n"], floor: Float[Array, "n"],
    *, fixed: int, most: int,
):  # fmt: skip
    """The iterations themselves: ``evaluate(theta, x) -> (residual (n,), aux)``.

    ``fixed`` Newton updates run in every lane, then damped ones while a lane is open, up to
    ``most``. A lane closes when its residual is at the roundoff ``floor`` (n,), or when it no longer
    shrinks below sqrt(eps) of the scale. Returns x, aux at x, Info.
    """
    eps = jnp.finfo(guess.dtype).eps
    nearly = 1.0 / jnp.sqrt(eps)  # in units of the floor: sqrt(eps) of the scale

    def judge(x):
        residual, aux = evaluate(theta, x)
        return residual, aux, jnp.max(jnp.abs(residual) / floor)

    def direction(x, residual):
        return small_solve(jax.jacfwd(lambda y: evaluate(theta, y)[0])(x), residual)

    def newton(state):
        x = state.x - direction(state.x, state.residual)
        residual, aux, error = judge(x)
        return _Iterate(x, residual, aux, error, state.iterations + 1, state.open)

    def damped(state):
        step = direction(state.x, state.residual)
        # Close to the floor only the full step makes sense: what is left is roundoff, or quadratic.
        shortest = jnp.where(state.error < nearly, 1.0, 0.5**_HALVINGS)

        def trial(factor):
            x = state.x - factor * step
            return factor, x, *judge(x)

        def worse(t):
            factor, _, _, _, error = t
            return ~(error < state.error) & (factor > shortest)

        one = jnp.ones((), guess.dtype)
        _, x, residual, aux, error = jax.lax.while_loop(
            worse, lambda t: trial(0.5 * t[0]), trial(one)
        )
        pick = partial(jnp.where, error < state.error)
        iterations = state.iterations + 1
        goes_on = (error > 1.0) & (error < 0.5 * state.error) | (error > nearly)
        return _Iterate(
            pick(x, state.x),
            pick(residual, state.residual),
            jax.tree.map(pick, aux, state.aux),
            pick(error, state.error),
            iterations,
            (error < state.error) & goes_on & (iterations < most),
        )

    residual, aux, error = judge(guess)
    first = _Iterate(guess, residual, aux, error, jnp.zeros((), jnp.int32), jnp.array(True))
    state = first
    for _ in range(fixed):
        state = newton(state)
    # Where full Newton went astray, start again, damped: this lane only.
    astray = ~(state.error < nearly) & ~(state.error < first.error)
    state = jax.tree.map(partial(jnp.where, astray), first, state)
    state = state._replace(open=(state.error > 1.0) & jnp.isfinite(state.error))
    state = jax.lax.while_loop(lambda s: s.open, damped, state)
    finite = jnp.isfinite(state.error)
    status = jnp.where(state.error <= nearly, OK, jnp.where(finite, NOT_CONVERGED, NON_FINITE))
    return state.x, state.aux, Info(status.astype(jnp.int32), state.iterations, state.error * eps)


@partial(jax.custom_jvp, nondiff_argnums=(0, 4, 5))
def root(evaluate, theta, guess, floor, fixed: int, most: int):
    """As ``iterate``, with derivatives in θ by the implicit function theorem.

    dx = −(∂r/∂x)⁻¹ (∂r/∂θ) dθ; the guess and the floor have no influence. ``evaluate`` must not
    close over anything that is differentiated.
    """
    return iterate(evaluate, theta, guess, floor, fixed=fixed, most=most)


@root.defjvp
def _root_jvp(evaluate, fixed, most, primals, tangents):
    theta, guess, floor = primals
    x, aux, info = root(evaluate, theta, guess, floor, fixed, most)
    _, residual_dot = jax.jvp(lambda t: evaluate(t, x)[0], (theta,), (tangents[0],))
    matrix = jax.jacfwd(lambda y: evaluate(theta, y)[0])(x)
    x_dot = -small_solve(matrix, residual_dot)
    _, aux_dot = jax.jvp(lambda t, y: evaluate(t, y)[1], (theta, x), (tangents[0], x_dot))
    integer_dot = np.zeros((), jax.dtypes.float0)
    info_dot = Info(integer_dot, integer_dot, jnp.zeros_like(info.residual))
    return (x, aux, info), (x_dot, aux_dot, info_dot)
