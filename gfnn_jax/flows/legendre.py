"""The Hamiltonian of a Lagrangian: its Legendre transform, as one more family of H.

    H(q, p) = p·v − L(q, v),      ∂L/∂v(q, v) = M(q) v + a(q) = p

L has at most two factors v in a term, so that v is the solution of a small linear system, and with
∂H/∂q = −∂L/∂q and ∂H/∂p = v all derivatives are closed formulas (H. Goldstein, "Classical
Mechanics", section 8.1). A double pendulum's L has five terms where its H is rational.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from gfnn_jax.arrays import namespace, pytree
from gfnn_jax.families.family import OfCoefficients
from gfnn_jax.families.friction import Friction
from gfnn_jax.families.lagrangian import Derivatives, Lagrangian, Terms
from gfnn_jax.families.text import shown
from gfnn_jax.flows.forces import Forced
from gfnn_jax.flows.systems import OfSystems
from gfnn_jax.flows.uniform import Uniform
from gfnn_jax.phase_space import split
from gfnn_jax.solve.linear import small_solve


@pytree()
class Legendre(OfCoefficients):
    """H of L = Σ θ_j ℓ_j; params are θ (P,), ``terms`` the ℓ_j. H is not linear in θ. Where terms
    have inputs these are the args (..., inputs), as `flows.forces.Forced` gives them."""

    terms: Terms

    name = "Lagrangian"
    prefix = "Legendre transform of L = "  # of a formula

    @property
    def label(self) -> str:
        return f"L of {self.num_parameters} terms"

    @property
    def term_names(self) -> tuple[str, ...]:
        """Each ℓ_j as it stands in a formula: "v1 v2 cos(q1 - q2)"."""
        names = [[f"{letter}{i + 1}" for i in range(self.dim)] for letter in "qv"]
        return tuple(map(shown, self.terms.texts(*names)))

    def take(self, rows) -> Legendre:
        """The family of these terms alone."""
        return Legendre(self.terms.take(list(rows)))

    @property
    def dim(self) -> int:
        return self.terms.dim

    @property
    def num_parameters(self) -> int:
        return self.terms.count

    @property
    def operations(self) -> tuple[int, int]:
        """Floating-point operations of a gradient, and of a gradient with its Hessian."""
        d, count = self.dim, self.num_parameters
        gradient = count * (20 + 6 * d + 2 * d * d) + d**3
        return gradient, 2 * gradient + 6 * d**3

    def velocity(self, params, w):
        """v (..., d) at states w = (q, p)."""
        law, (q, p) = self._law(params), split(w)
        return small_solve(law.masses(q), p - law.momentum(q, namespace(q).zeros_like(q)))

    def value(self, params, w, args=None):
        """H, shape (...): the energy v·∂L/∂v − L."""
        return self._law(params).energy(split(w)[0], self.velocity(params, w))

    def gradient(self, params, w, args=None):
        """(−∂L/∂q, v), shape (..., 2d)."""
        v = self.velocity(params, w)
        by_q = self._law(params).derivatives(split(w)[0], v, args).by_q
        return namespace(w).concatenate([-by_q, v], axis=-1)

    def gradient_and_hessian(self, params, w, args=None):
        """∂H/∂w and ∂²H/∂w² (..., 2d, 2d), of M v(q, p) + a = p by the implicit function:

        H_pp = M⁻¹,  H_pq = ∂v/∂q = −M⁻¹ L_vq,  H_qq = −L_qq + L_qv M⁻¹ L_vq.
        """
        v, found = self._derivatives(params, w, args)
        xp, turn = namespace(w), partial(namespace(w).swapaxes, axis1=-1, axis2=-2)
        unit = xp.broadcast_to(np.eye(self.dim, dtype=w.dtype), found.by_vv.shape)
        inverse = turn(_solved(found.by_vv, unit))
        by_q = -_solved(found.by_vv, turn(found.by_vq))  # (..., q, v): rows are solved for
        if self.terms.leaders:  # no Hessian: the derivative of the field, not symmetric
            bent = -found.by_qq - found.by_qv @ turn(by_q)
            above = xp.concatenate([bent, -found.by_qv @ inverse], axis=-1)
        else:
            inverse = 0.5 * (inverse + turn(inverse))
            bent = -found.by_qq + by_q @ -found.by_vq
            above = xp.concatenate([0.5 * (bent + turn(bent)), by_q], axis=-1)
        below = xp.concatenate([turn(by_q), inverse], axis=-1)
        gradient = xp.concatenate([-found.by_q, v], axis=-1)
        return gradient, xp.concatenate([above, below], axis=-2)

    def parameter_gradients(self, params, w, args=None, along=None):
        """∂/∂θ of the gradient (..., 2d, P), or in the coefficients of a family ``along`` of other
        terms: ∂v/∂θ_j = −M⁻¹ ∂ℓ_j/∂v and −∂ℓ_j/∂q − L_qv ∂v/∂θ_j. NumPy."""
        if along is not None and not isinstance(along, Legendre):
            return along.term_gradients(w, args)
        q = split(w)[0]
        v, found = self._derivatives(params, w, args)
        terms = self.terms if along is None else along.terms
        value, slope, _ = terms.potentials(q, 1, args)
        motion, by_motion = terms.motion(v)
        by_v = -_solved(found.by_vv, value[..., None] * terms.acting(by_motion))  # (..., P, d)
        by_q = terms.acting(-slope * motion[..., None]) - by_v @ np.swapaxes(found.by_qv, -1, -2)
        return np.swapaxes(np.concatenate([by_q, by_v], axis=-1), -1, -2)

    def _derivatives(self, params, w, u=None) -> tuple[Any, Derivatives]:
        """v and the derivatives of L there."""
        v = self.velocity(params, w)
        return v, self._law(params).derivatives(split(w)[0], v, u)

    def _law(self, params) -> Lagrangian:
        none = np.zeros(0)
        return Lagrangian(
            self.terms, params, Friction.of([], self.dim), none, 0.0, none.reshape(self.dim, 0)
        )


def _solved(matrix, rows):
    """matrix⁻¹ of each row of (..., n, d)."""
    return small_solve(matrix[..., None, :, :], rows)


def family_of(law: Lagrangian, degree: int = 0) -> tuple[Any, np.ndarray]:
    """The family and the params of a law's flow: H by the Legendre transform, its friction and its
    inputs as forces, their dependence on parameters, and uniform friction where it has any.

    degree: of the inputs' polynomials in time over a step.
    """
    family: Any = Legendre(law.terms)
    params = [np.asarray(law.coefficients)]
    if law.friction.count or law.num_inputs or law.terms.leaders:
        family = Forced(family, law.friction, law.num_inputs, degree)
        params += [np.asarray(law.losses), np.asarray(law.gains).ravel()]
    if law.powers is not None:
        family = OfSystems(family, law.powers)
    if law.uniform != 0:
        family = Uniform(family)
        params.append(np.atleast_1d(law.uniform))
    return family, np.concatenate(params)


def law_of(family: Any, params: Any) -> Lagrangian:
    """The law behind the family and the params of a flow: the inverse of `family_of`."""
    uniform: Any = 0.0
    if isinstance(family, Uniform):
        family, params, uniform = family.family, params[:-1], params[-1]
    powers = None
    if isinstance(family, OfSystems):
        family, powers = family.family, family.powers
    if isinstance(family, Forced):
        own, losses, gains = family.parts(params)
        return Lagrangian(family.family.terms, own, family.friction, losses, uniform, gains, powers)
    dim, none = family.dim, np.zeros(0)
    return Lagrangian(
        family.terms, params, Friction.of([], dim), none, uniform, none.reshape(dim, 0), powers
    )
