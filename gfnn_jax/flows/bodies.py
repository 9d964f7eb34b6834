"""Rigid bodies on joints with friction and inputs: their law, and H whose flow is the map.

    M(q) v̇ + C(q, v) + ∇V(q) + offsets + ∂R/∂v = G u,      H = ½ pᵀ M(q)⁻¹ p + V(q)

M and the other forces are linear in the bodies' inertial parameters (`families.rigid_bodies`).
Derivatives of H are JAX's.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gfnn_jax.arrays import as_row, namespace, pytree
from gfnn_jax.families.family import DifferentiatedByJax, OfCoefficients
from gfnn_jax.families.friction import Friction
from gfnn_jax.families.rigid_bodies import PER_LINK, Bodies
from gfnn_jax.phase_space import split
from gfnn_jax.solve.linear import small_solve


@pytree()
class OfBodies(DifferentiatedByJax, OfCoefficients):
    """H = ½ pᵀ M(q)⁻¹ p + V(q) of bodies on joints; params are π (10 k), then the inertias (k) of
    rotors, as the joints feel them, and constant forces (k) that the joints hold against."""

    bodies: Bodies

    name = "rigid bodies"

    @property
    def dim(self) -> int:
        return self.bodies.dim

    @property
    def num_parameters(self) -> int:
        return (PER_LINK + 2) * self.dim

    @property
    def term_names(self) -> tuple[str, ...]:
        """Names of the params."""
        own = [f"{name}{i + 1}" for name in ("rotor", "offset") for i in range(self.dim)]
        return (*self.bodies.parameter_names, *own)

    @property
    def operations(self) -> tuple[int, int]:
        """Floating-point operations of a gradient, and of a gradient with its Hessian."""
        gradient = 2_000 * self.dim**2  # of Newton's and Euler's equations for each column of M
        return gradient, 2 * self.dim * gradient

    def law(self, params, friction: Friction, losses, gains) -> BodiesLaw:
        """The law of these params, with friction R = Σ ρ_k r_k and gains (k, inputs)."""
        rigid, last = PER_LINK * self.dim, (PER_LINK + 1) * self.dim
        own = params[:rigid], params[rigid:last], params[last:]
        return BodiesLaw(self.bodies, *own, friction, losses, gains)

    def value(self, params, w, args=None):
        """H, shape (...)."""
        q, p = split(w)
        law = self.law(params, Friction.of([], self.dim), np.zeros(0), np.zeros((self.dim, 0)))
        held = (as_row(law.offsets, q) * q).sum(-1) + self.bodies.potential(law.parameters, q)
        return 0.5 * (p * law.velocity(q, p)).sum(-1) + held


@pytree()
class BodiesLaw:
    """Law of bodies on joints: π ``parameters`` (10 k), rotors (k), constant forces ``offsets``
    (k), friction R = Σ ρ_k r_k with ρ ``losses``, and gains (k, inputs)."""

    bodies: Bodies
    parameters: Any
    rotors: Any
    offsets: Any
    friction: Friction
    losses: Any
    gains: Any

    powers = None  # of a system's parameters: it has none

    @property
    def dim(self) -> int:
        return self.bodies.dim

    def at(self, args: Any) -> BodiesLaw:
        """The law itself: it depends on no parameters of a system."""
        return self

    def masses(self, q: Any) -> Any:
        """M(q) (..., k, k), with the rotors."""
        rigid = self.bodies.masses(self.parameters, q)
        return rigid + as_row(namespace(q).eye(self.dim) * self.rotors[:, None], rigid)

    def momentum(self, q: Any, v: Any) -> Any:
        """p (..., k) of velocities."""
        return (self.masses(q) * v[..., None, :]).sum(-1)

    def velocity(self, q: Any, p: Any) -> Any:
        """v (..., k) of momenta."""
        return small_solve(self.masses(q), p)

    def balance(self, q: Any, v: Any) -> tuple[Any, Any]:
        """M (..., k, k) and all forces but those of inputs (..., k): M a = forces + G u."""
        lost = self.friction.forces(v, self.losses)
        held = self.bodies.forces(self.parameters, q, v, 0 * v) + self.offsets
        return self.masses(q), -held - lost

    def losses_by_v(self, q: Any, v: Any, u: Any = None) -> Any:
        """∂²R/∂v∂v (..., k, k)."""
        return self.friction.stiffness(v, self.losses, u)
