"""A Lagrangian as a quadratic form of the velocities, at many states at once.

    L = ½ vᵀ M(q) v + w(q)·v − V(q)

M, w and −V are d² + d + 1 functions of q, each a sum S_rj θ_j f_j(q) over the terms of L, with
f = ∏ q_i^n_i cos(m·q + φ). Where terms are cosines alone, the derivatives of these functions are
such sums too, with the weights −S_rj m_ji of sines and −S_rj m_ji m_jk of cosines: a sine and a
cosine of each term, and products of matrices, are all that a state costs. Arrays have the states
last.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from gfnn_jax.families.lagrangian import Terms


class Parts(NamedTuple):
    """M (d, d, N) and w (d, N), their derivatives in q (…, d, N) and second ones (…, d, d, N);
    the force −∂V/∂q (d, N) and its derivatives (d, d, N); the potentials f_j (P, N) of the terms
    and their slopes (P, d, N). What was not asked for may be empty."""

    masses: np.ndarray
    drift: np.ndarray
    masses_by: np.ndarray
    drift_by: np.ndarray
    force: np.ndarray
    masses_by_two: np.ndarray
    drift_by_two: np.ndarray
    force_by: np.ndarray
    potentials: np.ndarray
    slopes: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Quadratic:
    """Terms, but for their phases, as they make M, w and −V.

    terms: which these are. weights: S (R, P), R = d² + d + 1. of_slopes: (R d, P), −S_rj m_ji.
    of_curvatures: (R d², P), −S_rj m_ji m_jk. modes: m (P, d). plain: whether the terms are cosines
    alone. products, linear, constant: A, b and c of `Terms.quadratic`, as (P d, d), (P, d, 1) and
    (P, 1).
    """

    terms: Terms
    weights: np.ndarray
    of_slopes: np.ndarray
    of_curvatures: np.ndarray
    modes: np.ndarray
    plain: bool
    products: np.ndarray
    linear: np.ndarray
    constant: np.ndarray

    @classmethod
    def of(cls, terms: Terms) -> Quadratic:
        A, b, c = terms.quadratic()
        count, d = b.shape
        weights = np.concatenate([A.reshape(count, d * d), b, c[:, None]], axis=1).T
        modes = terms.modes.astype(float)
        slopes = -weights[:, None] * modes.T
        curvatures = slopes[:, :, None] * modes.T
        return cls(
            terms,
            np.ascontiguousarray(weights),
            slopes.reshape(-1, count),
            curvatures.reshape(-1, count),
            modes,
            not np.any(terms.powers),
            A.reshape(count * d, d),
            b[..., None],
            c[:, None],
        )

    def is_of(self, terms: Terms) -> bool:
        """Return whether these are the terms, of any phases."""
        own = self.terms
        same = own.speeds is terms.speeds and own.modes is terms.modes
        return same and own.powers is terms.powers

    def parts(self, terms: Terms, theta: np.ndarray, q: np.ndarray, order: int) -> Parts:
        """The parts of L at q (d, N), with coefficients θ (P, 1) or (P, N); with ``order`` 1 or 2
        second derivatives too, with 2 the slopes of each term. terms: these with any phases, (P,)
        or (N, P)."""
        (count, d), num = self.modes.shape, q.shape[1]
        curved = slopes = nothing = np.zeros(0)
        if self.plain:
            phase = self.modes @ q
            phase += terms.phases.T if terms.phases.ndim > 1 else terms.phases[:, None]
            f, sin = np.cos(phase), np.sin(phase)
            weighted = theta * f
            sums, steep = self.weights @ weighted, self.of_slopes @ (theta * sin)
            if order:
                curved = self.of_curvatures @ weighted
            if order > 1:
                slopes = -sin[:, None] * self.modes[..., None]
        else:
            found = terms.potentials(q.T, order=2 if order else 1)
            f, slopes = found.value.T, found.slope.transpose(1, 2, 0)
            sums = self.weights @ (theta * f)
            steep = self.weights @ (theta[:, None] * slopes).reshape(count, d * num)
            if order:
                curvature = theta[:, None, None] * found.curvature.transpose(1, 2, 3, 0)
                curved = self.weights @ curvature.reshape(count, d * d * num)
        steep = steep.reshape(len(sums), d, num)
        M, w = slice(d * d), slice(d * d, d * d + d)
        by_two = (nothing, nothing, nothing)
        if order:
            curved = curved.reshape(len(sums), d, d, num)
            by_two = (curved[M].reshape(d, d, d, d, num), curved[w], curved[-1])
        return Parts(
            sums[M].reshape(d, d, num),
            sums[w],
            steep[M].reshape(d, d, d, num),
            steep[w],
            steep[-1],
            *by_two,
            f,
            slopes,
        )

    def residuals(self, parts: Parts, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """d/dt ∂ℓ_j/∂v − ∂ℓ_j/∂q (P, d, N) of each term ℓ_j along motion with velocities v and
        accelerations a (d, N)."""
        (count, d), num = self.modes.shape, v.shape[1]
        moved = (self.products @ v).reshape(count, d, num)
        kinetic = np.einsum("pin,in->pn", 0.5 * moved + self.linear, v) + self.constant
        moved += self.linear
        rows = (self.products @ a).reshape(count, d, num)
        rows *= parts.potentials[:, None]
        along = np.einsum("pin,in->pn", parts.slopes, v)
        rows += moved * along[:, None]
        rows -= kinetic[:, None] * parts.slopes
        return rows

    def momenta(self, parts: Parts, v: np.ndarray) -> np.ndarray:
        """∂ℓ_j/∂v (P, d, N) of each term."""
        moved = (self.products @ v).reshape(*self.modes.shape, v.shape[1]) + self.linear
        return moved * parts.potentials[:, None]
