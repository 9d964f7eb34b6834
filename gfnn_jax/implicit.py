"""The implicit step: a Newton solve down to roundoff, with implicit-function derivatives.

The solve finds x with r(θ, x) = 0 for one lane; a batch is a ``vmap`` of it. Three rules:

- Every iterate is judged by the residual that was evaluated *at it*, so "ok" is never a guess, and
  the gradient belonging to the returned x is at hand without another evaluation.
- Finished lanes are frozen: a slow or bad lane costs the others the common loop, never a bit.
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
_HALVINGS = 12
# A frozen Jacobian serves while each update leaves at most this part of the residual.
_CONTRACTION = 0.1
# A residual of this many eps of the size of its terms is the floor: a few roundings of that size.
_FLOOR_EPS = 4.0


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
    n = rhs.shape[0]
    if n > _UNROLL_UP_TO:
        return jnp.linalg.solve(matrix, rhs)
    # The right-hand side apart from the rows: only so is all this linear in it.
    rows, x = [matrix[i] for i in range(n)], [rhs[i] for i in range(n)]
    for k in range(n):
        for i in range(k + 1, n):  # bubble the largest pivot up
            swap = jnp.abs(rows[i][k]) > jnp.abs(rows[k][k])
            rows[k], rows[i] = jnp.where(swap, rows[i], rows[k]), jnp.where(swap, rows[k], rows[i])
            x[k], x[i] = jnp.where(swap, x[i], x[k]), jnp.where(swap, x[k], x[i])
        rows[k], x[k] = rows[k] / rows[k][k], x[k] / rows[k][k]
        for i in range(k + 1, n):
            factor = rows[i][k]
            rows[i], x[i] = rows[i] - factor * rows[k], x[i] - factor * x[k]
    for k in reversed(range(n)):
        for j in range(k + 1, n):
            x[k] = x[k] - rows[k][j] * x[j]
    return jnp.stack(x)


class _Iterate(NamedTuple):
    x: Any
    residual: Any
    aux: Any
    merit: Any  # largest residual, what damping makes smaller
    error: Any  # largest residual relative to its roundoff floor
    iterations: Any
    contracts: Any  # the frozen Jacobian still serves
    open: Any  # still to be improved


def iterate(
    evaluate: Callable, theta: Any, guess: Vector, *, most: int
) -> tuple[Vector, Any, Info]:
    """The iterations themselves: ``evaluate(theta, x) -> (residual (n,), size (n,), aux)``.

    ``size`` is that of the terms whose difference the residual is: a few eps of it is roundoff.
    Updates with the Jacobian at the guess (it is evaluated there together with the residual, with
    which it shares most of its work) as long as they contract: from a good guess one or two. Then,
    for the lanes that are left, Newton's method with a fresh Jacobian, a step halved until the
    residual falls. A lane closes when its residual is at the roundoff floor, or is close to it and
    no longer halves, or cannot be made smaller. At most ``most`` updates.
    Returns x, aux at x, Info.
    """
    eps = float(jnp.finfo(guess.dtype).eps)
    settled = eps**-0.25  # in floors: 3e-12 of the size in float64, 1e-5 in float32
    true = jnp.array(True)

    def judged(x, iterations, residual, size, aux):
        merit = jnp.max(jnp.abs(residual))
        error = jnp.max(jnp.abs(residual) / size) / (_FLOOR_EPS * eps)
        return _Iterate(x, residual, aux, merit, error, iterations, true, true)

    def at(x, iterations):
        residual, size, aux = evaluate(theta, x)
        return judged(x, iterations, residual, size, aux)

    def linearised(x, iterations):
        """The iterate at x and its Jacobian ∂r/∂x."""

        def with_aux(x):
            residual, size, aux = evaluate(theta, x)
            return residual, (residual, size, aux)

        matrix, (residual, size, aux) = jax.jacfwd(with_aux, has_aux=True)(x)
        return judged(x, iterations, residual, size, aux), matrix

    def updated(state, new):
        """The better of two iterates, and whether it can be improved further."""
        better, halved = new.merit < state.merit, new.merit < 0.5 * state.merit
        kept = jax.tree.map(partial(jnp.where, better), new, state)
        left = (kept.error > settled) | (kept.error > 1.0) & halved
        room = left & (new.iterations < most)
        contracts = room & (new.merit < _CONTRACTION * state.merit)
        return kept._replace(
            iterations=new.iterations, contracts=contracts, open=room & (better | state.contracts)
        )

    first, matrix = linearised(guess, jnp.zeros((), jnp.int32))
    inverse = small_solve(matrix, jnp.eye(guess.shape[0], dtype=guess.dtype))

    def frozen(state):
        step = jnp.sum(inverse * state.residual[None, :], axis=1)
        return updated(state, at(state.x - step, state.iterations + 1))

    def newton(state):
        iterations = state.iterations + 1
        _, matrix = linearised(state.x, iterations)
        step = small_solve(matrix, state.residual)
        # Close to the floor only the full step makes sense: what is left is roundoff.
        shortest = jnp.where(state.error < settled, 1.0, 0.5**_HALVINGS).astype(guess.dtype)

        def too_long(attempt):
            factor, new = attempt
            return state.open & ~(new.merit < state.merit) & (factor > shortest)

        def halved(attempt):
            factor = 0.5 * attempt[0]
            return factor, at(state.x - factor * step, iterations)

        # The loop makes the first trial too: a step of twice the length, never tried, is halved.
        untried = state._replace(merit=jnp.full_like(state.merit, jnp.inf))
        two = jnp.full_like(shortest, 2.0)
        _, new = jax.lax.while_loop(too_long, halved, (two, untried))
        state = state._replace(contracts=~true)
        return updated(state, new._replace(iterations=iterations))

    state = frozen(first)
    state = jax.lax.while_loop(lambda s: s.open & s.contracts, frozen, state)
    state = jax.lax.while_loop(lambda s: s.open, newton, state)
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
    return iterate(evaluate, theta, guess, most=most)


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
