"""Fixed-point iteration for a batch of systems that are too large for matrices, and Newton–Krylov.

The solve finds x (B, n) with r(shared, lanes, x) = 0 by x ← x − unit · r, which contracts where a
map is near the identity, or is kicked. A lane that does not contract, or too slowly, starts again
by Newton's method: each step comes from products with the Jacobian alone, and is halved until the
residual is smaller. Each iterate is judged by the residual at it, as in `solve.newton`. Status is
data. A lane that has converged is frozen.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.solve import krylov
from gfnn_jax.solve.krylov import norm_of
from gfnn_jax.solve.newton import Evaluation, floors, largest, relative, settled_floors, where
from gfnn_jax.solve.status import NON_FINITE, NOT_CONVERGED, OK, Info

MOST = 100  # updates, and those of a derivative: a contraction of 0.7 reaches roundoff


class Options:
    """Options of the fixed-point iteration (benchmarks/many.py)."""

    # Near roundoff a lane continues while two updates (q moves p and p moves q) leave no more
    # than this part of its residual.
    shrinks: float = 0.7
    # A lane whose error after ``first`` or more updates n is not below slow^n has Newton updates
    # instead, each of which costs as much as some fifty.
    slow: float = 0.8
    first: int = 10
    most_newton: int = 40  # updates of Newton's method
    linear: float = 1e-4  # relative residual of their linear systems
    shortest: float = 2.0**-20  # smallest part of a Newton step
    close: float = 1e-15  # residual relative to its terms, in NumPy: roundoff
    solved: float = 1e-14  # relative residual above which a lane has Newton updates in NumPy
    stale: int = 4  # updates in NumPy without a better lane, after which the iteration ends


@runtime_checkable
class Contraction(Protocol):
    """Equation r(shared, lanes, x) = 0 as x = x − unit · r: a hashable constant."""

    def evaluate(self, shared: Any, lanes: Any, x: Any) -> Evaluation:
        """Residual at x, in units of ``unit``."""
        ...

    def unit(self, shared: Any, lanes: Any) -> Any:
        """Units (B, n) of the residual."""
        ...

    def product(self, shared: Any, lanes: Any, x: Any) -> Callable[[Any], Any]:
        """Linear map v (B, n) -> (∂r/∂x) v at x, with v in units of ``unit``. NumPy or JAX."""
        ...


class _Iterate(NamedTuple):
    x: Any
    residual: Any
    aux: Any
    error: Any  # largest residual relative to its roundoff floor
    earlier: Any  # error one update ago
    iterations: Any
    open: Any


class _Damped(NamedTuple):
    x: Any
    residual: Any
    aux: Any
    error: Any
    step: Any  # Newton step from x, and the part of it (B, 1) to be tried next
    part: Any
    iterations: Any
    open: Any


def iterate(
    equation: Contraction, shared: Any, lanes: Any, guess: Any, *, most: int
) -> tuple[Any, Any, Info]:
    """Iterate from guess (B, n); return (x, aux at x, Info). most: fixed-point updates."""
    unit, settled = equation.unit(shared, lanes), settled_floors(guess.dtype)
    evaluation = equation.evaluate(shared, lanes, guess)
    start = floors(evaluation)
    begun = _Iterate(
        guess,
        evaluation.residual,
        evaluation.aux,
        start,
        jnp.full_like(start, jnp.inf),
        jnp.zeros(guess.shape[0], jnp.int32),
        start > 1.0,
    )

    def improve(state: _Iterate) -> _Iterate:
        x = state.x - unit * state.residual
        evaluation = equation.evaluate(shared, lanes, x)
        error, iterations = floors(evaluation), state.iterations + 1
        further = (error > settled) | ((error > 1.0) & (error < Options.shrinks * state.earlier))
        fast = (
            (iterations < Options.first)
            | (error <= settled)
            | (error < Options.slow ** iterations.astype(error.dtype) * start)
        )
        new = _Iterate(
            x,
            evaluation.residual,
            evaluation.aux,
            error,
            state.error,
            iterations,
            further & fast & jnp.isfinite(error) & (iterations < most),
        )
        return where(state.open, new, state)

    state = jax.lax.while_loop(lambda s: jnp.any(s.open), improve, begun)
    info = _info(state.error, state.iterations, settled)
    return newton_krylov(equation, shared, lanes, (state.x, state.aux, info), guess)


def newton_krylov(
    equation: Contraction, shared: Any, lanes: Any, done: tuple[Any, Any, Info], guess: Any
) -> tuple[Any, Any, Info]:
    """Solve the lanes of ``done`` = (x, aux at x, Info) that are not ok by Newton's method.

    It starts from guess (B, n); each step is halved until the residual is smaller. The other lanes
    are returned as they are. A guess that is not finite, as of a state that a rollout has given up,
    takes no updates.
    """
    unit, settled = equation.unit(shared, lanes), settled_floors(guess.dtype)
    _, aux, info = done
    most, infinite = info.iterations + Options.most_newton, jnp.full_like(guess, jnp.inf)
    begun = _Damped(  # the first step is zero and leads to the guess
        guess,
        infinite,
        aux,
        infinite[:, 0],
        jnp.zeros_like(guess),
        jnp.ones_like(guess[:, :1]),
        info.iterations,
        (info.status != OK) & jnp.isfinite(largest(guess)),
    )

    def improve(state: _Damped) -> _Damped:
        x = state.x - state.part * state.step
        evaluation = equation.evaluate(shared, lanes, x)
        error, iterations = floors(evaluation), state.iterations + 1
        better = state.open & (norm_of(evaluation.residual) < norm_of(state.residual))
        further = (error > settled) | ((error > 1.0) & (error < 0.5 * state.error))
        further = better & further & (iterations < most)
        rhs = jnp.where(further[:, None], evaluation.residual, 0.0)
        step = krylov.differentiable(equation.product(shared, lanes, x), rhs, Options.linear)
        new = _Damped(
            x,
            evaluation.residual,
            evaluation.aux,
            error,
            unit * step,
            jnp.ones_like(state.part),
            iterations,
            further,
        )
        # Close to the floor only the full step makes sense: what is left is roundoff.
        shortest = jnp.where(state.error <= settled, 1.0, Options.shortest)
        halved = state._replace(part=0.5 * state.part, open=state.part[:, 0] > shortest)
        return where(better, new, where(state.open, halved, state))

    state = jax.lax.while_loop(lambda s: jnp.any(s.open), improve, begun)
    found = state.x, state.aux, _info(state.error, state.iterations, settled)
    return where(info.status == OK, done, found)


def _info(error, iterations, settled: float) -> Info:
    failed = jnp.where(jnp.isfinite(error), NOT_CONVERGED, NON_FINITE)
    status = jnp.where(error <= settled, OK, failed)
    return Info(status.astype(jnp.int32), iterations, relative(error))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def root(equation: Contraction, shared: Any, lanes: Any, guess: Any):
    """Solve as ``iterate``, with derivatives by the implicit function theorem.

    Derivatives exist in shared and lanes; the guess has no influence. Their linear equation is
    solved by products with the Jacobian.
    """
    return iterate(equation, shared, lanes, guess, most=MOST)


@root.defjvp
def _root_jvp(equation, primals, tangents):
    shared, lanes, guess = primals
    x, aux, info = root(equation, shared, lanes, guess)
    theta, theta_dot = (shared, lanes), tangents[:2]
    _, residual_dot = jax.jvp(lambda s, c: equation.evaluate(s, c, x).residual, theta, theta_dot)
    product = equation.product(shared, lanes, x)
    x_dot = -equation.unit(shared, lanes) * krylov.solve_to_roundoff(product, residual_dot)
    _, aux_dot = jax.jvp(
        lambda s, c, y: equation.evaluate(s, c, y).aux, (*theta, x), (*theta_dot, x_dot)
    )
    integer_dot: Any = np.zeros(info.status.shape, jax.dtypes.float0)
    info_dot = Info(integer_dot, integer_dot, jnp.zeros_like(info.residual))
    return (x, aux, info), (x_dot, aux_dot, info_dot)


def refine(equation: Contraction, shared: Any, lanes: Any, guess: Any):
    """Solve in NumPy from a close guess (B, n): (x, aux, error (B,)).

    error: the largest residual relative to its terms. Each lane ends with its best iterate. Lanes
    that the fixed point does not solve have Newton updates from the guess.
    """

    def evaluated(x):
        evaluation = equation.evaluate(shared, lanes, x)
        return x, evaluation, largest(evaluation.residual / evaluation.size)

    with np.errstate(all="ignore"):
        unit, stale = equation.unit(shared, lanes), 0
        new = best = evaluated(guess)
        for _ in range(MOST):
            if stale == Options.stale or (best[2] <= Options.close).all():
                break
            new = evaluated(new[0] - unit * new[1].residual)
            better = new[2] < best[2]
            best, stale = where(better, new, best), 0 if better.any() else stale + 1
        best = where(best[2] <= Options.solved, best, evaluated(guess))
        while (left := ~(best[2] <= Options.solved)).any():
            product = equation.product(shared, lanes, best[0])
            step = krylov.solve(
                product, np.where(left[:, None], best[1].residual, 0.0), Options.linear
            )
            new = evaluated(best[0] - unit * step)
            better = left & (new[2] < Options.shrinks * best[2])
            best = where(better, new, best)
            if not better.any():
                break
        x, evaluation, error = best
        return x, evaluation.aux, error
