"""Fixed-point iteration for a batch of systems that are too large for matrices.

The solve finds x (B, n) with r(shared, lanes, x) = 0 by x ← x − unit · r, which contracts where a
map is near the identity, or is kicked. Iterates are judged as those of Newton's method are, each by
the residual at it; status is data; a lane that is done is frozen.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.solve.newton import Evaluation, floors, largest, relative, settled_floors, where
from gfnn_jax.solve.status import NON_FINITE, NOT_CONVERGED, OK, Info

MOST = 100  # updates, of a derivative too: roundoff at a factor of 0.7
# Near roundoff a lane goes on while two updates, as q moves p and p moves q, leave no more of its
# residual than this.
_SHRINKS = 0.7
_CLOSE = 1e-15  # in NumPy, of the residual's terms: roundoff
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
    """The iterations from guess (B, n): (x, aux at x, Info)."""
    unit, settled = equation.unit(shared, lanes), settled_floors(guess.dtype)

    def improve(state: _Iterate) -> _Iterate:
        x = state.x - unit * state.residual
        evaluation = equation.evaluate(shared, lanes, x)
        error, iterations = floors(evaluation), state.iterations + 1
        further = (error > settled) | ((error > 1.0) & (error < _SHRINKS * state.earlier))
        new = _Iterate(
            x, evaluation.residual, evaluation.aux, error, state.error, iterations,
            further & jnp.isfinite(error) & (iterations < most),
        )  # fmt: skip
        return where(state.open, new, state)

    evaluation = equation.evaluate(shared, lanes, guess)
    error = floors(evaluation)
    count = jnp.zeros(guess.shape[0], jnp.int32)
    begun = _Iterate(
        guess, evaluation.residual, evaluation.aux, error, jnp.full_like(error, jnp.inf), count,
        error > 1.0,
    )  # fmt: skip
    state = jax.lax.while_loop(lambda s: jnp.any(s.open), improve, begun)
    finite = jnp.isfinite(state.error)
    status = jnp.where(state.error <= settled, OK, jnp.where(finite, NOT_CONVERGED, NON_FINITE))
    residual = relative(state.error)
    return state.x, state.aux, Info(status.astype(jnp.int32), state.iterations, residual)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def root(equation: Contraction, shared: Any, lanes: Any, guess: Any):
    """As ``iterate``, with derivatives in shared and lanes by the implicit function theorem, whose
    linear equation is iterated too; the guess has no influence."""
    return iterate(equation, shared, lanes, guess, most=MOST)


@root.defjvp
def _root_jvp(equation, primals, tangents):
    shared, lanes, guess = primals
    x, aux, info = root(equation, shared, lanes, guess)
    theta, theta_dot = (shared, lanes), tangents[:2]
    _, residual_dot = jax.jvp(lambda s, c: equation.evaluate(s, c, x).residual, theta, theta_dot)
    _, along = jax.linearize(lambda y: equation.evaluate(shared, lanes, y).residual, x)
    unit = equation.unit(shared, lanes)

    def again(dot, _):
        return dot - unit * (residual_dot + along(dot)), None

    x_dot, _ = jax.lax.scan(again, -unit * residual_dot, length=MOST)
    _, aux_dot = jax.jvp(
        lambda s, c, y: equation.evaluate(s, c, y).aux, (*theta, x), (*theta_dot, x_dot)
    )
    integer_dot: Any = np.zeros(info.status.shape, jax.dtypes.float0)
    info_dot = Info(integer_dot, integer_dot, jnp.zeros_like(info.residual))
    return (x, aux, info), (x_dot, aux_dot, info_dot)


def refine(equation: Contraction, shared: Any, lanes: Any, guess: Any):
    """The same in NumPy: (x, aux, error (B,)), the error relative to the residual's terms.

    Each lane's best iterate is what it ends with.
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
        x, evaluation, error = best
        return x, evaluation.aux, error
