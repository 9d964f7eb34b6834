"""Fixed-point iteration for a batch of systems that are too large for matrices, and Newton–Krylov.

The solve finds x (B, n) with r(shared, lanes, x) = 0 by x ← x − unit · r, which contracts where a
map is near the identity, or is kicked. A lane in which it does not, or hardly does, begins again by
Newton's method, each step from products with the Jacobian alone and halved until the residual is
smaller. Iterates are judged as those of `solve.newton` are, each by the residual at it; status is
data; a lane that is done is frozen.
"""

from __future__ import annotations

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

MOST = 100  # updates, of a derivative too: roundoff at a factor of 0.7
# Near roundoff a lane goes on while two updates, as q moves p and p moves q, leave no more of its
# residual than this.
_SHRINKS = 0.7
# A lane whose error after the first few updates is not below this power of their number has a
# Newton update instead, which costs as much as some fifty.
_SLOW, _FIRST = 0.8, 10
_MOST_NEWTON = 40  # updates of Newton's method
_LINEAR = 1e-4  # residual of their linear systems: a derivative of so many updates is at roundoff
_SHORTEST = 2.0**-20  # part of a Newton step
_CLOSE = 1e-15  # in NumPy, of the residual's terms: roundoff
_SOLVED = 1e-14  # of them: lanes above it have Newton updates in NumPy
_STALE = 4  # updates in NumPy that make no lane better: the end


@runtime_checkable
class Contraction(Protocol):
    """r(shared, lanes, x) = 0 as x = x − unit · r: a hashable constant."""

    def evaluate(self, shared: Any, lanes: Any, x: Any) -> Evaluation:
        """The residual at x, in these units."""
        ...

    def unit(self, shared: Any, lanes: Any) -> Any:
        """(B, n): the units of the residual."""
        ...

    def product(self, shared: Any, lanes: Any, x: Any) -> Callable[[Any], Any]:
        """v (B, n) -> (∂r/∂x) v at x, v in these units too. NumPy or JAX."""
        ...


class _Iterate(NamedTuple):
    x: Any
    residual: Any
    aux: Any
    error: Any  # largest residual relative to its roundoff floor
    earlier: Any  # the same an update ago
    iterations: Any
    open: Any


def iterate(
    equation: Contraction, shared: Any, lanes: Any, guess: Any, *, most: int
) -> tuple[Any, Any, Info]:
    """The iterations from guess (B, n): (x, aux at x, Info). most: of the fixed point."""
    unit, settled = equation.unit(shared, lanes), settled_floors(guess.dtype)
    evaluation = equation.evaluate(shared, lanes, guess)
    start = floors(evaluation)
    begun = _Iterate(
        guess, evaluation.residual, evaluation.aux, start, jnp.full_like(start, jnp.inf),
        jnp.zeros(guess.shape[0], jnp.int32), start > 1.0,
    )  # fmt: skip

    def improve(state: _Iterate) -> _Iterate:
        x = state.x - unit * state.residual
        evaluation = equation.evaluate(shared, lanes, x)
        error, iterations = floors(evaluation), state.iterations + 1
        further = (error > settled) | ((error > 1.0) & (error < _SHRINKS * state.earlier))
        fast = (
            (iterations < _FIRST)
            | (error <= settled)
            | (error < _SLOW ** iterations.astype(error.dtype) * start)
        )
        new = _Iterate(
            x, evaluation.residual, evaluation.aux, error, state.error, iterations,
            further & fast & jnp.isfinite(error) & (iterations < most),
        )  # fmt: skip
        return where(state.open, new, state)

    state = jax.lax.while_loop(lambda s: jnp.any(s.open), improve, begun)
    left = ~(state.error <= settled)
    again = begun._replace(open=left, iterations=state.iterations)
    return _newton(equation, shared, lanes, where(left, again, state))


def newton_krylov(
    equation: Contraction, shared: Any, lanes: Any, guess: Any, open_: Any
) -> tuple[Any, Any, Info]:
    """Newton's method alone, from guess (B, n), on the lanes that are open (B,): (x, aux at x,
    Info); the others keep their guess."""
    evaluation = equation.evaluate(shared, lanes, guess)
    error, count = floors(evaluation), jnp.zeros(guess.shape[0], jnp.int32)
    begun = _Iterate(guess, evaluation.residual, evaluation.aux, error, error, count, open_)
    return _newton(equation, shared, lanes, begun)


def _newton(equation, shared, lanes, state: _Iterate) -> tuple[Any, Any, Info]:
    unit, settled = equation.unit(shared, lanes), settled_floors(state.x.dtype)
    most = state.iterations + _MOST_NEWTON

    def improve(state: _Iterate) -> _Iterate:
        product = equation.product(shared, lanes, state.x)
        step = unit * krylov.differentiable(product, state.residual, _LINEAR)
        before = norm_of(state.residual)
        shortest = jnp.where(state.error <= settled, 1.0, _SHORTEST)  # what is left is roundoff

        def tried(part):
            x = state.x - part[:, None] * step
            evaluation = equation.evaluate(shared, lanes, x)
            return part, x, evaluation, norm_of(evaluation.residual) < before

        _, x, evaluation, smaller = jax.lax.while_loop(
            lambda made: jnp.any(state.open & ~made[3] & (made[0] > shortest)),
            lambda made: tried(jnp.where(made[3], 1.0, 0.5) * made[0]),
            tried(jnp.ones_like(before)),
        )
        error, iterations = floors(evaluation), state.iterations + 1
        further = (error > settled) | ((error > 1.0) & (error < 0.5 * state.error))
        new = _Iterate(
            x, evaluation.residual, evaluation.aux, error, state.error, iterations,
            further & (iterations < most),
        )  # fmt: skip
        return where(state.open & smaller, new, state._replace(open=state.open & smaller))

    state = jax.lax.while_loop(lambda s: jnp.any(s.open), improve, state)
    finite = jnp.isfinite(state.error)
    status = jnp.where(state.error <= settled, OK, jnp.where(finite, NOT_CONVERGED, NON_FINITE))
    residual = relative(state.error)
    return state.x, state.aux, Info(status.astype(jnp.int32), state.iterations, residual)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def root(equation: Contraction, shared: Any, lanes: Any, guess: Any):
    """As ``iterate``, with derivatives in shared and lanes by the implicit function theorem, whose
    linear equation is solved by products too; the guess has no influence."""
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
    """The same in NumPy: (x, aux, error (B,)), the error relative to the residual's terms.

    Each lane's best iterate is what it ends with; where a fixed point does not get there, of
    Newton's method from the guess, which is to be close.
    """

    def judged(x):
        evaluation = equation.evaluate(shared, lanes, x)
        return x, evaluation, largest(evaluation.residual / evaluation.size)

    with np.errstate(all="ignore"):
        unit, stale = equation.unit(shared, lanes), 0
        new = best = judged(guess)
        for _ in range(MOST):
            if stale == _STALE or (best[2] <= _CLOSE).all():
                break
            new = judged(new[0] - unit * new[1].residual)
            better = new[2] < best[2]
            best, stale = where(better, new, best), 0 if better.any() else stale + 1
        best = where(best[2] <= _SOLVED, best, judged(guess))
        while (left := ~(best[2] <= _SOLVED)).any():
            product = equation.product(shared, lanes, best[0])
            step = krylov.solve(product, np.where(left[:, None], best[1].residual, 0.0), _LINEAR)
            new = judged(best[0] - unit * step)
            better = left & (new[2] < _SHRINKS * best[2])
            best = where(better, new, best)
            if not better.any():
                break
        x, evaluation, error = best
        return x, evaluation.aux, error
