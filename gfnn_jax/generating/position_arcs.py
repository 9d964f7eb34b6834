"""S(q, Q) along arcs of positions: what Gauss–Newton with latent positions asks of it. NumPy.

The state of a node is x_n = (q_n, q_{n+1}), two true positions; momenta do not enter, and with them
nothing that positions leave open. Its step is the discrete Euler–Lagrange equation

    ∂₂S(q_n, q_{n+1}) + ∂₁S(q_{n+1}, q_{n+2}) = 0

solved for q_{n+2} by one iteration of Newton's method from the position that the arc has there:
where the arc is an orbit nothing is left to solve, and until then the defect is the one that
linearising the equation itself would give.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from gfnn_jax.solve.arc_models import Defects, Observed


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
        m = x.shape[-1]
        by_state = np.broadcast_to(np.eye(m), (*x.shape, m))
        return Observed(x, by_state, np.broadcast_to(0.0, (*x.shape, len(p))))

    def take(self, arcs: np.ndarray) -> PositionArcs:
        return self


def nodes_of(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Arcs of positions (A, L + 1, d) as nodes: their states (A, L, 2d), which the readings
    themselves are at first, and what is read of them, each position once."""
    x = np.concatenate([q[:, :-1], q[:, 1:]], axis=-1)
    y = x.copy()
    y[:, :-1, q.shape[-1] :] = np.nan
    return x, y
