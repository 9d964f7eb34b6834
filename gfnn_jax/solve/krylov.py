"""Linear systems of a batch that are known by their products alone: GMRES, lane by lane.

    min ‖b − A x‖ over the Krylov space of A and b

As the adaptive simpler GMRES of Jiránek & Rozložník (SIAM J. Matrix Anal. Appl. 31 (2010), 1483):
directions d_k with A d_k orthonormal, each begun from the residual where that has shrunk, else from
A d_{k−1}. There is no Hessenberg matrix, and the method never breaks down. Memory: 2 `SPACE`
vectors for each lane.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from gfnn_jax.arrays import namespace

SPACE = 20  # directions before a restart
_NOTHING = 1e-12  # of an image: what is left of it is roundoff, and the space exhausted
_SHRUNK = 0.8  # of a residual: below it the next direction begins from it
_RESTART = 1e-8  # of a residual: where one of the solves to roundoff begins again
_MOST = 12  # restarts of a system that is solved to roundoff
_STALLED = 0.5  # of the residual: a restart that leaves more has met roundoff


class _Search(NamedTuple):
    x: Any
    residual: Any
    norm: Any  # of the residual, (B,)
    begin: Any  # of the next direction, a unit vector (B, n)
    pairs: Any  # (SPACE, 2, B, n): directions, and A of them
    count: Any


def solve(product: Callable, rhs: Any, tolerance: float):
    """x (B, n) with ‖rhs − A x‖ ≤ tolerance ‖rhs‖, or the best of `SPACE` directions; NumPy or JAX.

    product: v (B, n) -> A v, lane by lane. A lane that is there stays as it is.
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
        pair = _unit(pair, xp.where(size > _NOTHING * norm_of(image), size, 0.0)[None])
        along = xp.sum(s.residual * pair[1], axis=-1)
        moved = xp.where(s.norm > goal, along, 0.0)[None, :, None] * pair
        residual = s.residual - moved[1]
        norm = norm_of(residual)
        here = (xp.arange(SPACE) == s.count).reshape(-1, 1, 1, 1)
        shrunk = (norm < _SHRUNK * s.norm)[:, None]
        return _Search(
            s.x + moved[0], residual, norm, xp.where(shrunk, _unit(residual, norm), pair[1]),
            xp.where(here, pair[None], s.pairs), s.count + 1,
        )  # fmt: skip

    return _while(xp, goes_on, further, first).x


def differentiable(product: Callable, rhs: Any, tolerance: float):
    """As `solve`, by JAX: with the derivatives of A⁻¹ rhs, which are solved for in the same way."""

    def solved(product, rhs):
        return solve(product, rhs, tolerance)

    return jax.lax.custom_linear_solve(product, rhs, solved, solved)


def solve_to_roundoff(product: Callable, rhs: Any):
    """x (B, n) with A x = rhs, as `solve` with restarts until a residual no longer shrinks. JAX.

    Linear in rhs: it has derivatives of either mode.
    """

    def solved(product, rhs):
        def goes_on(state):
            _, _, norm, earlier, count = state
            return (count < _MOST) & jax.numpy.any(norm < _STALLED * earlier)

        def again(state):
            x, residual, norm, earlier, count = state
            tried = x + solve(product, residual, _RESTART)
            left = rhs - product(tried)
            new = norm_of(left)
            better = (norm < _STALLED * earlier) & (new < norm)
            return (
                jax.numpy.where(better[:, None], tried, x),
                jax.numpy.where(better[:, None], left, residual),
                jax.numpy.where(better, new, norm), norm, count + 1,
            )  # fmt: skip

        norm = norm_of(rhs)
        begun = (jax.numpy.zeros_like(rhs), rhs, norm, jax.numpy.full_like(norm, np.inf), 0)
        return jax.lax.while_loop(goes_on, again, begun)[0]

    return jax.lax.custom_linear_solve(product, rhs, solved, solved)


def norm_of(rows):
    """Euclid's norm (...) of each row."""
    xp = namespace(rows)
    return xp.sqrt(xp.sum(rows * rows, axis=-1))


def _unit(rows, size):
    """The rows by their size; 0 where that is 0."""
    xp, some = namespace(rows), (size > 0)[..., None]
    return xp.where(some, rows / xp.where(some, size[..., None], 1.0), 0.0)


def _while(xp, goes_on, further, state):
    """``state = further(state)`` while it goes on."""
    if xp is not np:
        return jax.lax.while_loop(goes_on, further, state)
    while goes_on(state):
        state = further(state)
    return state
