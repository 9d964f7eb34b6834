"""Newton's method for a batch of small systems, down to roundoff, with implicit derivatives.

The solve finds x (B, n) with r(shared, lanes, x) = 0, a system for each lane. Three rules:

- Every iterate is judged by the residual that was evaluated *at it*, so "ok" is never a guess, and
  what belongs to the returned x (the gradient of S) is at hand without another evaluation.
- Finished lanes are frozen, and those that need more updates than most are gathered from the batch
  for them: a slow or bad lane costs the others neither a bit nor its own time.
- Status is data. Non-finite values are tested for, since ``while err > tol`` ends silently on NaN.

Derivatives of ``root`` come from the implicit function theorem, in forward and reverse mode; those
of ``iterate`` from the iterations that ran, which is what an honest symplecticity defect needs.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.arrays import namespace
from gfnn_jax.solve.linear import small_solve, solve_and_sign
from gfnn_jax.solve.status import NON_FINITE, NOT_CONVERGED, OK, Info

_HALVINGS = 30
# How much the residual's slope along a step may change, as a part of the steeper slope; how far the
# residual's change may be from what these slopes tell (the trapezoidal rule), as a part of it.
_BENT, _OFF_PATH = 0.35, 0.05
# The first step is tried whole where the update with the same step has left this of the residual,
# else by this part: it may lead past any number of folds, and seldom does so by small steps.
_STRAIGHT, _BEGIN = 0.01, 0.125
# A residual of this many eps of the size of its terms is the floor: a few roundings of that size.
_FLOOR_EPS = 4.0
# Where one update is not enough, this many lanes of a batch, or this part of it, are gathered at a
# time for so many updates: the fewer, the less waits for the hardest, the more often all are seen.
# Tuned on CPUs (benchmarks/speed.py); where all lanes of a batch are hard, it costs up to a fifth
# more than to wait.
_FEWEST, _PART, _VISIT = 32, 32, 2
_QUADRATIC = 1e-9  # a residual so small is at roundoff after another update


class Evaluation(NamedTuple):
    """residual (B, n); size (B, n) of the terms whose difference it is: a few eps of it is
    roundoff; aux: a pytree of (B, ...) that belongs to x."""

    residual: Any
    size: Any
    aux: Any


@runtime_checkable
class Equation(Protocol):
    """r(shared, lanes, x) = 0 for each lane: a hashable constant, everything else is in its
    arguments. shared: a pytree common to all lanes. lanes: a pytree of (B, ...). x: (B, n)."""

    def evaluate(self, shared: Any, lanes: Any, x: Any) -> Evaluation:
        """The residual at x."""
        ...

    def linearise(self, shared: Any, lanes: Any, x: Any) -> tuple[Evaluation, Any]:
        """The residual at x and its Jacobian ∂r/∂x (B, n, n)."""
        ...


class _Iterate(NamedTuple):
    """Where each lane stands; every leaf is (B, ...)."""

    x: Any
    residual: Any
    aux: Any
    error: Any  # largest residual relative to its roundoff floor
    sign: Any  # of det ∂r/∂x at the guess
    step: Any  # the Newton step from x, and the part of it to be tried next
    factor: Any
    iterations: Any
    open: Any  # still to be improved

    @property
    def merit(self):
        """The largest residual."""
        return largest(self.residual)


def iterate(
    equation: Equation, shared: Any, lanes: Any, guess: Any, *, most: int, gather: bool = True
) -> tuple[Any, Any, Info]:
    """The iterations themselves, from guess (B, n): (x, aux at x, Info).

    One update with the Jacobian at the guess, where it is evaluated together with the residual,
    with which it shares most of its work: from a guess as close as the root of roundoff that is
    all. For the lanes that are left, Newton's method with a fresh Jacobian, a step halved until it
    stays by the Newton path r(x) = (1 − t) r(guess) (Deuflhard, "Newton Methods for Nonlinear
    Problems", 2004, chapter 3), which ends at the solution of the guess's own branch or at a fold:
    there the sign of det ∂r/∂x would change, and the lane is given up, not led to another branch.
    A step over a pair of folds keeps the sign and may shrink the residual; it shows in the slopes.
    A lane closes when its residual is at the roundoff floor, or is close to it and no longer
    halves, or cannot be made smaller.

    most: updates, 1 or more. gather: whether open lanes are taken out of the batch; else all wait
    for the slowest.
    """
    settled = settled_floors(guess.dtype)
    size = guess.shape[0]
    ones, zeros = jnp.ones(size, guess.dtype), jnp.zeros(size, jnp.int32)
    newton = partial(_newton, equation, most=most, settled=settled)

    evaluation, matrix = equation.linearise(shared, lanes, guess)
    step, sign = solve_and_sign(matrix, evaluation.residual)
    first = _Iterate(
        guess, evaluation.residual, evaluation.aux, floors(evaluation), sign, step, ones, zeros,
        open=zeros < 1,
    )  # fmt: skip
    x = guess - step
    evaluation = equation.evaluate(shared, lanes, x)
    second = first._replace(
        x=x, residual=evaluation.residual, aux=evaluation.aux, error=floors(evaluation)
    )  # fmt: skip

    before, after = first.merit, second.merit
    smaller = after < before
    done = smaller & ~_goes_on(second.error, after, before, settled)
    begun = ~done & (smaller | (first.error > settled)) & (most > 1)
    straight = (second.error <= settled) | (after <= _STRAIGHT * before)
    state = where(smaller & ~begun, second, first)._replace(
        factor=jnp.where(straight, ones, _BEGIN * ones),
        iterations=jnp.where(begun, 0, 1).astype(jnp.int32),  # the loop makes the first one again
        open=begun,
    )
    any_size = not isinstance(size, int)  # a batch of any size is exported: nothing is gathered
    if most > 1 and gather and not any_size and size > (few := max(_FEWEST, size // _PART)):
        state = _gathered(newton, shared, lanes, state, few)
    elif most > 1:
        state = jax.lax.while_loop(
            lambda s: jnp.any(s.open), lambda s: newton(shared, lanes, s), state
        )
    finite = jnp.isfinite(state.error)
    status = jnp.where(state.error <= settled, OK, jnp.where(finite, NOT_CONVERGED, NON_FINITE))
    residual = relative(state.error)
    return state.x, state.aux, Info(status.astype(jnp.int32), state.iterations, residual)


def settled_floors(dtype) -> float:
    """The error in floors up to which a lane is solved: 3e-12 of the size in float64, 1e-5 in
    float32."""
    return float(jnp.finfo(dtype).eps) ** -0.25


def floors(evaluation: Evaluation):
    """The largest residual of each lane, in units of its roundoff floor."""
    eps = float(jnp.finfo(evaluation.residual.dtype).eps)
    return largest(evaluation.residual / evaluation.size) / (_FLOOR_EPS * eps)


def relative(error):
    """An error in floors as a part of the residual's terms."""
    return error * (_FLOOR_EPS * float(jnp.finfo(error.dtype).eps))


def _goes_on(error, merit, merit_before, settled: float):
    """Whether a lane that came to this error is still to be improved."""
    return (error > settled) | ((error > 1.0) & (merit < 0.5 * merit_before))


def _newton(equation, shared, lanes, state: _Iterate, *, most, settled) -> _Iterate:
    """Try a part of each open lane's step: take it where it stays by the path, else halve it."""
    part, merit = state.factor[:, None], state.merit
    x = state.x - part * state.step
    evaluation, matrix = equation.linearise(shared, lanes, x)
    residual = evaluation.residual
    step, sign_here = solve_and_sign(matrix, residual)
    error, new_merit = floors(evaluation), largest(residual)
    # The residual's slope along the step at its end; at its beginning it is -state.residual.
    slope = -jnp.sum(matrix * state.step[:, None, :], axis=-1)
    bent = largest(slope + state.residual) / jnp.maximum(largest(slope), merit)
    told = state.residual + 0.5 * part * (slope - state.residual)
    floor = _FLOOR_EPS * float(jnp.finfo(x.dtype).eps) * jnp.max(evaluation.size, axis=-1)
    near = largest(residual - told) <= _OFF_PATH * state.factor * merit + 4 * floor
    by_the_path = (bent <= _BENT) & near & (sign_here == state.sign)
    settled_here = state.error <= settled
    better = state.open & (by_the_path | (settled_here & (new_merit < merit)))
    iterations = state.iterations + 1
    further = _goes_on(error, new_merit, merit, settled) & (iterations < most)
    # The next part is as long as the slope's change allows, if it goes on as it did.
    longer = 0.95 * _BENT / jnp.clip(bent, 0.25 * _BENT, 2 * _BENT) * state.factor
    new = _Iterate(
        x, residual, evaluation.aux, error, state.sign, step, jnp.minimum(longer, 1.0),
        iterations, further,
    )  # fmt: skip
    # Close to the floor only the full step makes sense: what is left is roundoff.
    shortest = jnp.where(settled_here, 1.0, 0.5**_HALVINGS).astype(x.dtype)
    halved = state._replace(
        factor=jnp.where(state.open, 0.5 * state.factor, state.factor),
        open=state.open & (state.factor > shortest),
    )
    return where(better, new, halved)


def largest(rows):
    """The largest entry of each row in magnitude. NumPy or JAX."""
    return abs(rows).max(axis=-1)


def where(chosen, one, other):
    """Of each lane, the leaves of one where ``chosen`` (B,), else of the other."""

    xp = namespace(chosen)
    return jax.tree.map(
        lambda a, b: xp.where(chosen.reshape(chosen.shape + (1,) * (a.ndim - 1)), a, b), one, other
    )


def _gathered(newton, shared, lanes, state: _Iterate, few: int) -> _Iterate:
    """Newton's method on the open lanes alone, ``few`` at a time: the others need not wait."""
    count = state.open.shape[0]
    lane = jnp.arange(count)
    given, lanes_of = _packed(lanes, state.x.dtype)
    packed, state_of = _packed(state, state.x.dtype)

    def busy(carry):
        return jnp.any(carry[0].open) & (carry[1] < _VISIT)

    def visit(packed):
        # The first open lanes, by a partial sort of their numbers: compiled in no time.
        first = jnp.where(state_of(packed).open, count - lane, 0).astype(jnp.float32)
        _, chosen = jax.lax.top_k(first, few)

        def gather(rows):
            return rows.at[chosen].get(mode="promise_in_bounds", unique_indices=True)

        own = lanes_of(gather(given))
        part, _ = jax.lax.while_loop(
            busy,
            lambda carry: (newton(shared, own, carry[0]), carry[1] + 1),
            (state_of(gather(packed)), 0),
        )
        # Where fewer than ``few`` are open, lanes that are closed come along unchanged.
        rows, _ = _packed(part, packed.dtype)
        return packed.at[chosen].set(rows, mode="promise_in_bounds", unique_indices=True)

    packed = jax.lax.while_loop(lambda p: jnp.any(state_of(p).open), visit, packed)
    return state_of(packed)


def _packed(tree: Any, dtype) -> tuple[Any, Callable]:
    """The leaves (B, ...) of a tree as columns of one array (B, k), and what takes such an array
    apart again: one gather and one scatter serve all of them."""
    leaves, structure = jax.tree.flatten(tree)
    columns = [leaf.reshape(leaf.shape[0], -1).astype(dtype) for leaf in leaves]
    ends = np.cumsum([column.shape[1] for column in columns])[:-1]

    def unpacked(rows):
        parts = jnp.split(rows, ends, axis=1)
        return structure.unflatten(
            part.reshape(rows.shape[0], *leaf.shape[1:]).astype(leaf.dtype)
            for part, leaf in zip(parts, leaves, strict=True)
        )

    return jnp.concatenate(columns, axis=1), unpacked


@partial(jax.custom_jvp, nondiff_argnums=(0, 4))
def root(equation: Equation, shared: Any, lanes: Any, guess: Any, most: int):
    """As ``iterate``, with derivatives in shared and lanes by the implicit function theorem.

    dx = −(∂r/∂x)⁻¹ (∂r/∂θ) dθ, θ = (shared, lanes); the guess has no influence.
    """
    return iterate(equation, shared, lanes, guess, most=most)


@root.defjvp
def _root_jvp(equation, most, primals, tangents):
    shared, lanes, guess = primals
    x, aux, info = root(equation, shared, lanes, guess, most)
    theta, theta_dot = (shared, lanes), tangents[:2]
    _, residual_dot = jax.jvp(lambda s, c: equation.evaluate(s, c, x).residual, theta, theta_dot)
    _, matrix = equation.linearise(shared, lanes, x)
    x_dot = -small_solve(matrix, residual_dot)
    _, aux_dot = jax.jvp(
        lambda s, c, y: equation.evaluate(s, c, y).aux, (*theta, x), (*theta_dot, x_dot)
    )
    integer_dot: Any = np.zeros(info.status.shape, jax.dtypes.float0)
    info_dot = Info(integer_dot, integer_dot, jnp.zeros_like(info.residual))
    return (x, aux, info), (x_dot, aux_dot, info_dot)


def refine(equation: Equation, shared: Any, lanes: Any, guess: Any, updates: int = 6):
    """Newton updates in NumPy from a guess (B, n) known to be close: (x, aux, error (B,)).

    For fits, where the data give the evaluation points: no predictor and no branches, and nothing
    is compiled. A lane keeps what it has where an update does not make its residual smaller. error:
    the largest residual relative to the size of its terms.
    """
    with np.errstate(all="ignore"):
        state = (guess, *equation.linearise(shared, lanes, guess))
        for _ in range(updates):
            x, evaluation, matrix = state
            tried = x - small_solve(matrix, evaluation.residual)
            new = (tried, *equation.linearise(shared, lanes, tried))
            before, after = (np.abs(s[1].residual).max(axis=-1) for s in (state, new))
            better = after < before
            if better.any():
                state = where(better, new, state)
            if not (better & (before > _QUADRATIC)).any():
                break  # what was so small is roundoff now
        x, evaluation, _ = state
        return x, evaluation.aux, np.abs(evaluation.residual / evaluation.size).max(axis=-1)
