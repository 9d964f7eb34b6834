"""Arcs of what S generates: what Gauss–Newton with latent states asks of them. NumPy.

S of positions, S(q, Q): the state of a node is x_n = (q_n, q_{n+1}), two true positions; momenta do
not enter, and with them nothing that positions leave open. Its step is the discrete Euler–Lagrange
equation

    ∂₂S(q_n, q_{n+1}) + ∂₁S(q_{n+1}, q_{n+2}) = 0

solved for q_{n+2} by one iteration of Newton's method from the position that the arc has there:
where the arc is an orbit nothing is left to solve, and until then the defect is the one that
linearising the equation itself would give.

S in a chart: F(z, Z) = ∇S(w) − g is 0 where S maps z onto Z, w and g of the chart.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from gfnn_jax.coordinates import (
    CARTESIAN,
    Coordinates,
    inner_slopes,
    nearest_image,
    to_inner,
)
from gfnn_jax.generating.charts import AnyChart
from gfnn_jax.solve.latent_arcs import Defects, Observed, observed_whole


@dataclasses.dataclass(frozen=True, eq=False)
class PositionArcs:
    """S of parameters ``given`` and of coefficients ``basis`` (m, n) p beside them, and the time h
    of its step.

    family: of (q, Q), linear in its coefficients. Readings of a node are (A, L, 2d), both
    positions; the second is to be NaN at all nodes but the last.
    """

    family: Any
    dt: float
    given: Any
    basis: np.ndarray

    def defects(self, p: np.ndarray, x: np.ndarray) -> Defects:
        arcs, length, m = x.shape
        d, w = m // 2, x.reshape(-1, m)
        params = self.given + self.family.unflatten(self.basis @ p)
        gradient, hessian = self.family.gradient_and_hessian(params, w)
        gradient, hessian = (a.reshape(arcs, length, *a.shape[1:]) for a in (gradient, hessian))
        coming, going = hessian[:, :-1], hessian[:, 1:]
        known = gradient[:, :-1, d:] + gradient[:, 1:, :d]
        by_state = np.concatenate(
            [coming[..., d:, :d], coming[..., d:, d:] + going[..., :d, :d]], axis=-1
        )
        right = np.concatenate([known[..., None], by_state], axis=-1)
        if self.basis.shape[1]:
            terms = self.family.term_gradients(w) @ self.basis
            terms = terms.reshape(arcs, length, m, -1)
            right = np.concatenate([right, terms[:, :-1, d:] + terms[:, 1:, :d]], axis=-1)
        solved = -np.linalg.solve(going[..., :d, d:], right)
        closing = np.concatenate([x[:, :-1, d:] - x[:, 1:, :d], solved[..., 0]], axis=-1)
        moved = np.zeros((arcs, length - 1, d, m))
        moved[..., range(d), range(d, m)] = 1.0
        by_state = np.concatenate([moved, solved[..., 1 : 1 + m]], axis=-2)
        of_terms = solved[..., 1 + m :]
        return Defects(
            closing, by_state, np.concatenate([np.zeros_like(of_terms), of_terms], axis=-2)
        )

    def observe(self, p: np.ndarray, x: np.ndarray) -> Observed:
        return observed_whole(x, len(p))

    def take(self, arcs: np.ndarray) -> PositionArcs:
        return self


def nodes_of(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Arcs of positions (A, L + 1, d) as nodes: their states (A, L, 2d), which the readings
    themselves are at first, and what is read of them, each position once."""
    x = np.concatenate([q[:, :-1], q[:, 1:]], axis=-1)
    y = x.copy()
    y[:, :-1, q.shape[-1] :] = np.nan
    return x, y


_LANES = 4_096  # steps whose matrices are computed at once


@dataclasses.dataclass(frozen=True, eq=False)
class GeneratedOnArcs:
    """The map that S = Σ c_j φ_j generates, on arcs in which these steps ``moves`` (A, L − 1).

    ends: affine pieces (before, after) around what S generates. along: a family whose rows are
    wanted: F is then that of S = 0, its derivatives in the states stay those of S, and Γ is in the
    coefficients of this family. None: no coefficient is free. joint: F is that of S all the same,
    where ``along`` is its own family: `Readings.fit` then moves states and coefficients together.
    coordinates: of S, where the arcs' states are the user's, whose noise is independent: that of
    p_r and of φ is not.
    """

    family: Any
    chart: AnyChart
    dt: float
    moves: np.ndarray
    ends: tuple[Sequence[Any], Sequence[Any]] = ((), ())
    along: Any = None
    joint: bool = False
    coordinates: Coordinates = CARTESIAN

    def defects(self, p: np.ndarray, x: np.ndarray) -> Defects:
        width, free = x.shape[-1], 0 if self.along is None else self.along.num_parameters
        found = np.zeros((*self.moves.shape, width, 1 + width + free))
        found[..., 1 : 1 + width] = np.eye(width)
        lanes = np.flatnonzero(self.moves)
        for first in range(0, len(lanes), _LANES):
            some = np.unravel_index(lanes[first : first + _LANES], self.moves.shape)
            found[some] = self._linearised(p, x[:, :-1][some], x[:, 1:][some])
        return Defects(found[..., 0], found[..., 1 : 1 + width], found[..., 1 + width :])

    def _linearised(self, p: np.ndarray, y0: np.ndarray, y1: np.ndarray) -> np.ndarray:
        """[c, Φ, Γ] (n, 2d, 1 + 2d + free) of steps from z to Z (n, 2d)."""
        before, after = self._of_states(y0.shape[-1])
        own = None
        if not self.coordinates.plain:
            own = [inner_slopes(self.coordinates, y) for y in (y0, y1)]
            y0, y1 = (to_inner(self.coordinates, y) for y in (y0, y1))
            y1 = y0 + nearest_image(y1 - y0, self.coordinates.angles)
        for piece in self.ends[0]:
            y0 = piece.image(y0)
        for piece in reversed(self.ends[1]):
            y1 = piece.inverse().image(y1)
        w, target = self.chart.evaluation_point(y0, y1), self.chart.target_gradient(y0, y1, self.dt)
        gradient, hessian = self.family.gradient_and_hessian(self.family.unflatten(p), w)
        miss = -target if self.along is not None and not self.joint else gradient - target
        first, second = (hessian @ of[0] - of[1] for of in (before, after))
        if own is not None:
            first, second = first @ own[0], second @ own[1]
        parts = [miss[..., None], first]
        if self.along is not None:
            parts.append(self.along.term_gradients(w))
        # F + ∂F/∂z δz + ∂F/∂Z δZ + ∇φ δc = 0, for δZ.
        return -np.linalg.solve(second, np.concatenate(parts, axis=-1))

    def observe(self, p: np.ndarray, x: np.ndarray) -> Observed:
        return observed_whole(x, 0 if self.along is None else self.along.num_parameters)

    def take(self, arcs: np.ndarray) -> GeneratedOnArcs:
        return dataclasses.replace(self, moves=self.moves[arcs])

    def _of_states(self, width: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """(∂w, ∂g) in z, and in Z, (2d, 2d) each."""
        first = second = eye = np.eye(width)
        for piece in self.ends[0]:
            first = piece.matrix @ first
        for piece in self.ends[1]:
            second = piece.matrix @ second
        none = np.zeros_like(eye)
        return [
            (self.chart.evaluation_point(*e).T, self.chart.target_gradient(*e, self.dt).T)
            for e in ((first.T, none), (none, np.linalg.inv(second).T))
        ]
