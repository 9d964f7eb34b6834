"""GMRES, lane by lane, for a batch of linear systems that are known by their products alone.

    min ‖b − A x‖ over the Krylov space of A and b

The method is the adaptive simpler GMRES of Jiránek & Rozložník (SIAM J. Matrix Anal. Appl. 31
(2010), 1483). Its directions d_k have orthonormal A d_k. Each starts from the residual where that
has shrunk, else from A d_{k−1}. There is no Hessenberg matrix, and the method never breaks down.
Memory: 2 `SPACE` vectors for each lane.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from gfnn_jax.arrays import namespace

SPACE = 20  # directions before a restart


class Options:
    """Options of GMRES and Newton–Krylov (benchmarks/many.py)."""

    nothing: float = 1e-12  # an image that shrinks to this part is roundoff: the space is exhausted
    shrunk: float = 0.8  # a residual that shrinks to this part begins the next direction
    restart: float = 1e-8  # relative residual at which a solve to roundoff restarts
    most: int = 12  # restarts of a system that is solved to roundoff
    # a restart that leaves more than this part of the residual has met roundoff
    stalled: float = 0.5


class _Search(NamedTuple):
    x: Any
    residual: Any
    norm: Any  # of the residual, (B,)
    begin: Any  # of the next direction, a unit vector (B, n)
    pairs: Any  # (SPACE, 2, B, n): directions, and A of them
    count: Any


def solve(product: Callable, rhs: Any, tolerance: float):
    """Solve for x (B, n) with ‖rhs − A x‖ ≤ tolerance ‖rhs‖ in at most `SPACE` directions.

    product: v (B, n) -> A v, lane by lane. A lane that has converged stays as it is. NumPy or JAX.
    """
    xp = namespace(rhs)
    start = norm_of(rhs)
    none = xp.zeros((SPACE, 2, *rhs.shape), rhs.dtype)
    first = _Search(xp.zeros_like(rhs), rhs, start, _unit(rhs, start), none, 0)
    goal = tolerance * start

    def goes_on(s: _Search):
        return (s.count < SPACE) & xp.any(s.norm > goal)

    def further(s: _Search) -> _Search:
        image = product(s.begin)
        pair = xp.stack([s.begin, image])
        for _ in range(2):  # twice is enough (Kahan)
            along = xp.sum(s.pairs[:, 1] * pair[None, 1], axis=-1)
            pair = pair - xp.sum(along[:, None, :, None] * s.pairs, axis=0)
        size = norm_of(pair[1])
        pair = _unit(pair, xp.where(size > Options.nothing * norm_of(image), size, 0.0)[None])
        along = xp.sum(s.residual * pair[1], axis=-1)
        moved = xp.where(s.norm > goal, along, 0.0)[None, :, None] * pair
        residual = s.residual - moved[1]
        norm = norm_of(residual)
        here = (xp.arange(SPACE) == s.count).reshape(-1, 1, 1, 1)
        shrunk = (norm < Options.shrunk * s.norm)[:, None]
        return _Search(
            s.x + moved[0],
            residual,
            norm,
            xp.where(shrunk, _unit(residual, norm), pair[1]),
            xp.where(here, pair[None], s.pairs),
            s.count + 1,
        )

    return _while(xp, goes_on, further, first).x


def differentiable(product: Callable, rhs: Any, tolerance: float):
    """Solve as `solve`, in JAX, with the derivatives of A⁻¹ rhs by solves of the same kind."""

    def solved(product, rhs):
        return solve(product, rhs, tolerance)

    return jax.lax.custom_linear_solve(product, rhs, solved, solved)


def solve_to_roundoff(product: Callable, rhs: Any):
    """Solve A x = rhs for x (B, n) by `solve`, restarted until the residual no longer shrinks. JAX.

    The solution is linear in rhs and has derivatives in forward and reverse mode.
    """

    def solved(product, rhs):
        def goes_on(state):
            _, _, norm, earlier, count = state
            return (count < Options.most) & jax.numpy.any(norm < Options.stalled * earlier)

        def again(state):
            x, residual, norm, earlier, count = state
            tried = x + solve(product, residual, Options.restart)
            left = rhs - product(tried)
            new = norm_of(left)
            better = (norm < Options.stalled * earlier) & (new < norm)
            return (
                jax.numpy.where(better[:, None], tried, x),
                jax.numpy.where(better[:, None], left, residual),
                jax.numpy.where(better, new, norm),
                norm,
                count + 1,
            )

        norm = norm_of(rhs)
        begun = (jax.numpy.zeros_like(rhs), rhs, norm, jax.numpy.full_like(norm, np.inf), 0)
        return jax.lax.while_loop(goes_on, again, begun)[0]

    return jax.lax.custom_linear_solve(product, rhs, solved, solved)


def norm_of(rows):
    """Euclidean norm (...) of each row."""
    xp = namespace(rows)
    return xp.sqrt(xp.sum(rows * rows, axis=-1))


def _unit(rows, size):
    """Divide the rows by their size; 0 where the size is 0."""
    xp, some = namespace(rows), (size > 0)[..., None]
    return xp.where(some, rows / xp.where(some, size[..., None], 1.0), 0.0)


def _while(xp, goes_on, further, state):
    """Repeat ``state = further(state)`` while ``goes_on(state)``, in NumPy or JAX."""
    if xp is not np:
        return jax.lax.while_loop(goes_on, further, state)
    while goes_on(state):
        state = further(state)
    return state
