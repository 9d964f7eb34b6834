"""Newton's method for a batch of small systems, down to roundoff, with implicit derivatives.

The solve finds x (B, n) with r(shared, lanes, x) = 0, a system for each lane. Three rules:

- Every iterate is judged by the residual that was evaluated *at it*. "ok" is never a guess, and the
  gradient of S at the returned x needs no further evaluation.
- Finished lanes are frozen. Lanes that need more updates than most are gathered from the batch. A
  slow or failed lane changes no bit of the others and takes none of their time.
- Status is data. Non-finite values are tested for, since ``while err > tol`` ends silently on NaN.

Derivatives of ``root`` come from the implicit function theorem, in forward and reverse mode. Those
of ``iterate`` are those of the iterations that ran, which an honest symplecticity defect needs.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.arrays import namespace
from gfnn_jax.solve.linear import small_solve, solve_and_sign
from gfnn_jax.solve.status import NON_FINITE, NOT_CONVERGED, OK, Info


class Rules(NamedTuple):
    """Numbers of the iteration: those of `iterate`, and of the C that `exports` writes of it."""

    floor: float = 4.0  # roundoff: a residual of this many eps of the size of its terms
    halves: float = 0.5  # near the floor a lane goes on while an update leaves less than this part
    # The first step is tried whole where the update with the same step has left at most
    # ``straight`` of the residual, else the part ``begin`` of it: a whole step may lead past folds,
    # small steps seldom do.
    straight: float = 0.01
    begin: float = 0.125
    # Largest change of the residual's slope along a step, relative to the steeper slope; largest
    # difference between the residual's change and its estimate from the two slopes (trapezoidal
    # rule), relative to that change, beyond ``rounding`` floors.
    bent: float = 0.35
    off_path: float = 0.05
    rounding: float = 4.0
    # The next part of a step is this times what the slope's change allows, that change taken to be
    # within these parts of ``bent``.
    longer: float = 0.95
    least_bent: float = 0.25
    most_bent: float = 2.0
    halvings: int = 30  # of a step, before a lane is given up


RULES = Rules()
# Where one update is not enough, max(_FEWEST, B // _PART) lanes of a batch are gathered at a time
# for _VISIT updates. With fewer lanes fewer wait for the slowest, but all are scanned more often.
# Tuned on CPUs (benchmarks/speed.py); where all lanes of a batch are hard, gathering costs up to a
# fifth more than waiting.
_FEWEST, _PART, _VISIT = 32, 32, 2
_QUADRATIC = 1e-9  # a residual this small is at roundoff after another update


class Evaluation(NamedTuple):
    """Evaluation of an equation at x: residual (B, n), size (B, n) of its terms, and aux.

    A few eps of the size is roundoff. aux: a pytree of (B, ...) that belongs to x.
    """

    residual: Any
    size: Any
    aux: Any


@runtime_checkable
class Equation(Protocol):
    """Equation r(shared, lanes, x) = 0 for each lane: a hashable constant.

    Everything that may change is in the arguments. shared: a pytree common to all lanes. lanes: a
    pytree of (B, ...). x: (B, n).
    """

    def evaluate(self, shared: Any, lanes: Any, x: Any) -> Evaluation:
        """Residual at x."""
        ...

    def linearise(self, shared: Any, lanes: Any, x: Any) -> tuple[Evaluation, Any]:
        """Residual at x, and its Jacobian ∂r/∂x (B, n, n)."""
        ...


class _Iterate(NamedTuple):
    """State of the iteration of each lane; every leaf is (B, ...)."""

    x: Any
    residual: Any
    aux: Any
    error: Any  # largest residual relative to its roundoff floor
    sign: Any  # of det ∂r/∂x at the guess
    step: Any  # the Newton step from x, and the part of it to be tried next
    factor: Any
    iterations: Any
    open: Any  # True for lanes that need further updates

    @property
    def merit(self):
        """Largest residual of each lane (B,)."""
        return largest(self.residual)


def iterate(
    equation: Equation, shared: Any, lanes: Any, guess: Any, *, most: int, gather: bool = True
) -> tuple[Any, Any, Info]:
    """Iterate from guess (B, n); return (x, aux at x, Info).

    The first update uses the Jacobian at the guess, which shares most of its work with the
    residual. From a guess as close as the root of roundoff it is the only one. The lanes that are
    left have Newton updates with a fresh Jacobian. Each step is halved until it stays near the
    Newton path r(x) = (1 − t) r(guess) (Deuflhard, "Newton Methods for Nonlinear Problems", 2004,
    chapter 3). The path ends at the solution of the guess's own branch, or at a fold, where the
    sign of det ∂r/∂x would change; the lane is then given up instead of led to another branch. A
    step over a pair of folds keeps the sign and may shrink the residual, but shows in the slopes. A
    lane closes when its residual is at the roundoff floor, or is close to it and no longer halves,
    or cannot be made smaller.

    most: number of updates, 1 or more. gather: True takes open lanes out of the batch; else all
    lanes wait for the slowest.
    """
    settled = settled_floors(guess.dtype)
    size = guess.shape[0]
    ones, zeros = jnp.ones(size, guess.dtype), jnp.zeros(size, jnp.int32)
    newton = partial(_newton, equation, most=most, settled=settled)

    evaluation, matrix = equation.linearise(shared, lanes, guess)
    step, sign = solve_and_sign(matrix, evaluation.residual)
    first = _Iterate(
        guess,
        evaluation.residual,
        evaluation.aux,
        floors(evaluation),
        sign,
        step,
        ones,
        zeros,
        open=zeros < 1,
    )
    x = guess - step
    evaluation = equation.evaluate(shared, lanes, x)
    second = first._replace(
        x=x, residual=evaluation.residual, aux=evaluation.aux, error=floors(evaluation)
    )

    before, after = first.merit, second.merit
    smaller = after < before
    done = smaller & ~_goes_on(second.error, after, before, settled)
    # A lane whose first step is no number, as of a state that a rollout has given up, would halve
    # it in vain at every step of the batch.
    leads_on = jnp.isfinite(before) & jnp.isfinite(largest(step))
    begun = ~done & leads_on & (smaller | (first.error > settled)) & (most > 1)
    straight = (second.error <= settled) | (after <= RULES.straight * before)
    state = where(smaller & ~begun, second, first)._replace(
        factor=jnp.where(straight, ones, RULES.begin * ones),
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
    """Error in roundoff floors up to which a lane counts as solved.

    It is 3e-12 of the size of the terms in float64, 1e-5 in float32.
    """
    return float(jnp.finfo(dtype).eps) ** -0.25


def floors(evaluation: Evaluation):
    """Largest residual of each lane, in units of its roundoff floor."""
    eps = float(jnp.finfo(evaluation.residual.dtype).eps)
    return largest(evaluation.residual / evaluation.size) / (RULES.floor * eps)


def relative(error):
    """Convert an error in roundoff floors to one relative to the residual's terms."""
    return error * (RULES.floor * float(jnp.finfo(error.dtype).eps))


def _goes_on(error, merit, merit_before, settled: float):
    """Return whether a lane with this error needs a further update."""
    return (error > settled) | ((error > 1.0) & (merit < RULES.halves * merit_before))


def _newton(equation, shared, lanes, state: _Iterate, *, most, settled) -> _Iterate:
    """Try a part of each open lane's step: take it where it stays near the path, else halve it."""
    part, merit = state.factor[:, None], state.merit
    x = state.x - part * state.step
    evaluation, matrix = equation.linearise(shared, lanes, x)
    residual = evaluation.residual
    step, sign_here = solve_and_sign(matrix, residual)
    error, new_merit = floors(evaluation), largest(residual)
    # The residual's slope along the step at its end; at its beginning it is -state.residual.
    slope = -jnp.sum(matrix * state.step[:, None, :], axis=-1)
    bent = largest(slope + state.residual) / jnp.maximum(largest(slope), merit)
    on_path = state.residual + 0.5 * part * (slope - state.residual)
    floor = RULES.floor * float(jnp.finfo(x.dtype).eps) * jnp.max(evaluation.size, axis=-1)
    near = (
        largest(residual - on_path)
        <= RULES.off_path * state.factor * merit + RULES.rounding * floor
    )
    by_the_path = (bent <= RULES.bent) & near & (sign_here == state.sign)
    settled_here = state.error <= settled
    better = state.open & (by_the_path | (settled_here & (new_merit < merit)))
    iterations = state.iterations + 1
    further = _goes_on(error, new_merit, merit, settled) & (iterations < most)
    # The next part is as long as the slope's change allows, if it goes on as it did.
    likely = jnp.clip(bent, RULES.least_bent * RULES.bent, RULES.most_bent * RULES.bent)
    longer = RULES.longer * RULES.bent / likely * state.factor
    new = _Iterate(
        x,
        residual,
        evaluation.aux,
        error,
        state.sign,
        step,
        jnp.minimum(longer, 1.0),
        iterations,
        further,
    )
    # Close to the floor only the full step makes sense: what is left is roundoff.
    shortest = jnp.where(settled_here, 1.0, 0.5**RULES.halvings).astype(x.dtype)
    halved = state._replace(
        factor=jnp.where(state.open, 0.5 * state.factor, state.factor),
        open=state.open & (state.factor > shortest),
    )
    return where(better, new, halved)


def largest(rows):
    """Largest entry of each row in magnitude; infinite where one is NaN. NumPy or JAX.

    XLA's maximum of a long row ignores NaN on a CPU.
    """
    size = abs(rows)
    return namespace(rows).where(size == size, size, np.inf).max(axis=-1)


def where(chosen, one, other):
    """Select lanes: the leaves of ``one`` where ``chosen`` (B,), else those of ``other``."""
    xp = namespace(chosen)
    return jax.tree.map(
        lambda a, b: xp.where(chosen.reshape(chosen.shape + (1,) * (a.ndim - 1)), a, b), one, other
    )


def _gathered(newton, shared, lanes, state: _Iterate, few: int) -> _Iterate:
    """Apply Newton's method to the open lanes alone, ``few`` at a time; the others do not wait."""
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
    """Pack the leaves (B, ...) of a tree into one array (B, k); with the function that unpacks it.

    One gather and one scatter then serve all leaves.
    """
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
    """Solve as ``iterate``, with derivatives by the implicit function theorem.

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


def solved(
    equation: Equation, shared: Any, lanes: Any, guess: Any, most: int, unrolled: bool | int
) -> tuple[Any, Any, Info]:
    """``root``; where ``unrolled`` ``iterate``, with a number of updates of its own if it is one:
    derivatives are then those of the iterations that ran."""
    if not unrolled:
        return root(equation, shared, lanes, jax.lax.stop_gradient(guess), most)
    most = most if unrolled is True else unrolled
    return iterate(equation, shared, lanes, guess, most=most, gather=False)


def refine(equation: Equation, shared: Any, lanes: Any, guess: Any, updates: int = 6):
    """Solve by Newton updates in NumPy from a guess (B, n) known to be close: (x, aux, error (B,)).

    It serves fits, where the data give the evaluation points: there is no predictor and no choice
    of branches, and nothing is compiled. A lane keeps its iterate where an update does not make the
    residual smaller. error: the largest residual relative to the size of its terms.
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
                break  # quadratic convergence: small residuals are roundoff now
        x, evaluation, _ = state
        return x, evaluation.aux, np.abs(evaluation.residual / evaluation.size).max(axis=-1)
