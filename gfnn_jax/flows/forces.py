"""Rayleigh friction and inputs beside a Hamiltonian, in the stages of its flow.

    q̇ = ∂H/∂p = v,      ṗ = −∂H/∂q − ∂R/∂v(v) + G u(t),      R = Σ ρ_k r_k(v)

The d'Alembert principle with forces: Gauss collocation of these equations has order 2s. Such a flow
keeps no multiple of the symplectic form, except where friction is uniform (`flows.uniform`).

An input is a polynomial in time over each step: its value at the step's begin and the coefficients
of τ, τ², … stand among the args, and `families.family.at_time` moves them to a stage's time.
"""

import dataclasses
from math import comb
from typing import Any

import numpy as np

from gfnn_jax.arrays import as_row, beside, matmul, namespace, pytree
from gfnn_jax.families.family import AroundAnother, at_time, parameter_gradients
from gfnn_jax.families.friction import Friction
from gfnn_jax.families.lagrangian import pushed
from gfnn_jax.phase_space import split


class WithForces(AroundAnother):
    """Family of H of which forces change the field; ``family`` is that of H alone."""

    @property
    def name(self) -> str:
        return "terms with friction"

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the args that are no inputs."""
        return getattr(self.family, "parameters", ())

    def inside(self, params, args):
        """Params and args of H, whose value is the energy that friction loses and inputs supply."""
        return params[..., : self.family.num_parameters], self._inner(args)

    def _inner(self, args):
        """Args of H."""
        return args


@pytree("num_inputs", "degree")
class Forced(WithForces):
    """H of ``family`` with friction and inputs; params are those of H, then ρ (F,), then G (d, k)
    row by row.

    friction: the terms r_k. num_inputs: k. degree: of the inputs' polynomials; the last
    (degree + 1) k of the args are the coefficients of τ⁰ of each input, then those of τ¹, ….

    In place of ∇H stands the field (∂H/∂q + ∂R/∂v − G u, ∂H/∂p), which J turns into the velocity,
    and in place of its Hessian that field's derivative. ``value`` is H.
    """

    family: Any
    friction: Friction
    num_inputs: int = 0
    degree: int = 0

    @property
    def label(self) -> str:
        losses, inputs = self.friction.count, self.num_inputs
        return f"{self.family.label}, {losses} of friction, {inputs} inputs"

    @property
    def num_parameters(self) -> int:
        return self.family.num_parameters + self.friction.count + self.dim * self.num_inputs

    @property
    def term_names(self) -> tuple[str, ...]:
        """Names of the terms of H, of R, and of G."""
        gains = [f"u{j + 1} on q{i + 1}" for i in range(self.dim) for j in range(self.num_inputs)]
        return (*self.family.term_names, *self.friction.names, *gains)

    @property
    def _driven(self) -> bool:
        """Return whether terms of H have inputs."""
        return getattr(getattr(self.family, "terms", None), "driven", False)

    @property
    def operations(self) -> tuple[int, int]:
        """Operations of H, with the Hessian that friction's derivative takes."""
        gradient, with_hessian = self.family.operations
        more = 8 * self.friction.count * self.dim + 2 * self.dim * self.num_inputs
        return gradient + more, with_hessian + more + 4 * self.dim**3

    def take(self, rows) -> Any:
        """The family of these terms of H and R alone, all gains with them; the one of H where no
        forces are left."""
        of_h, losses = self.family.num_parameters, self.friction.count
        own = self.family.take([j for j in rows if j < of_h])
        kept = [j - of_h for j in rows if of_h <= j < of_h + losses]
        if not kept and not self.num_inputs:
            return own
        return dataclasses.replace(self, family=own, friction=self.friction.take(kept))

    def term_gradients(self, w, args=None):
        """The field of every term of H and R (..., 2d, m), those of R as if v were p: to start
        from. NumPy."""
        q, p = split(w)
        frictions = np.swapaxes(self.friction.residuals(p, self._inputs(args), q), -1, -2)
        frictions = np.concatenate([frictions, np.zeros_like(frictions)], axis=-2)
        return np.concatenate(
            [self.family.term_gradients(w, self._inner(args)), frictions], axis=-1
        )

    def multiplier(self, params, dt) -> None:
        """Return None: no multiple of the symplectic form is kept."""
        return None

    def at_time(self, args, after):
        """args a time ``after`` later: the inputs' polynomials about that time."""
        if not self.num_inputs:
            return at_time(self.family, args, after)
        xp = namespace(args, after)
        count = (self.degree + 1) * self.num_inputs
        powers, lanes = range(self.degree + 1), args.shape[:-1]
        axes = max(len(lanes), xp.ndim(after))  # of stages and lanes
        lanes = (*(1,) * (axes - len(lanes)), *lanes)
        jets = args[..., -count:].reshape(*lanes, self.degree + 1, self.num_inputs)
        after_ = xp.reshape(after, (*(1,) * (axes - xp.ndim(after)), *xp.shape(after), 1))
        shifted = [
            sum(comb(i, j) * after_ ** (i - j) * jets[..., i, :] for i in powers[j:])
            for j in powers
        ]
        later = xp.concatenate(xp.broadcast_arrays(*shifted), axis=-1)
        if args.shape[-1] == count:
            return later
        return beside(at_time(self.family, args[..., :-count], after), later)

    def gradient(self, params, w, args=None):
        """(∂H/∂q + ∂R/∂v − G u, ∂H/∂p), shape (..., 2d)."""
        own, losses, gains = self.parts(params)
        gradient = self.family.gradient(own, w, self._inner(args))
        return self._field(gradient, losses, gains, split(w)[0], args)

    def gradient_and_hessian(self, params, w, args=None):
        """Field and its derivative (..., 2d, 2d), which is not symmetric."""
        own, losses, gains = self.parts(params)
        gradient, hessian = self.family.gradient_and_hessian(own, w, self._inner(args))
        (q, _), (_, v) = split(w), split(gradient)
        field = self._field(gradient, losses, gains, q, args)
        by_v = self.friction.stiffness(v, losses, self._inputs(args), q)
        derivative, by_q = self._beside(hessian, by_v), self.friction.by_place(q, v, losses)
        if by_q is None:
            return field, derivative
        of_q = np.eye(self.dim, 2 * self.dim)
        return field, derivative + matmul(of_q.T, matmul(by_q, of_q))

    def parameter_gradients(self, params, w, args=None, along=None):
        """∂/∂params of the field (..., 2d, m); of a family ``along`` of other terms of H those of
        its coefficients alone. NumPy."""
        own, losses, _ = self.parts(params)
        inner, dim = self._inner(args), self.dim
        q, v = split(w)[0], split(self.family.gradient(own, w, inner))[1]
        columns = parameter_gradients(self.family, own, w, inner, along)
        u = self._inputs(args)
        columns = self._beside(columns, self.friction.stiffness(v, losses, u, q))
        if along is not None:
            return columns
        frictions = np.swapaxes(self.friction.residuals(v, u, q), -1, -2)
        pushes = -(np.eye(dim)[:, :, None] * u[..., None, None, :]).reshape(*u.shape[:-1], dim, -1)
        pushes = np.broadcast_to(pushes, (*w.shape[:-1], dim, dim * self.num_inputs))
        more = np.concatenate([frictions, pushes], axis=-1)
        more = np.concatenate([more, np.zeros_like(more)], axis=-2)
        return np.concatenate([columns, more], axis=-1)

    def power(self, params, w, args=None):
        """Energy per unit of time at states w (..., 2d): lost by each friction (..., F), supplied
        by each input (..., k); by a term that has several, by the first of them."""
        own, losses, gains = self.parts(params)
        v = split(self.family.gradient(own, w, self._inner(args)))[1]
        u = self._inputs(args)
        lost = self.friction.power(v, u, split(w)[0])
        lost = as_row(losses, lost) * lost
        supplied = pushed(namespace(gains).swapaxes(gains, -1, -2), v) * u
        if not self._driven:
            return lost, supplied
        f = self.family.terms.potentials(split(w)[0], 1, u)
        along = as_row(own, f.value) * (f.slope * v[..., None, :]).sum(-1)
        return lost, supplied + matmul(along, self.family.terms.first_inputs(self.num_inputs))

    def parts(self, params) -> tuple[Any, Any, Any]:
        """The params of H, ρ (F,) and G (d, k)."""
        own, count = self.family.num_parameters, self.friction.count
        gains = params[..., own + count :]
        gains = gains.reshape(*gains.shape[:-1], self.dim, self.num_inputs)
        return params[..., :own], params[..., own : own + count], gains

    def _inner(self, args):
        """Args of H: inputs, where its terms have such."""
        if args is None:
            return None
        if self._driven:
            return self._inputs(args)
        others = args.shape[-1] - (self.degree + 1) * self.num_inputs
        return args[..., :others] if others else None

    def _inputs(self, args):
        """u (..., k) at the time of these args."""
        if not self.num_inputs:
            return np.zeros(0)
        start = args.shape[-1] - (self.degree + 1) * self.num_inputs
        return args[..., start : start + self.num_inputs]

    def _field(self, gradient, losses, gains, q, args):
        along_q, along_p = split(gradient)
        along_q = along_q + self.friction.forces(along_p, losses, self._inputs(args), q)
        if self.num_inputs:
            along_q = along_q - pushed(gains, self._inputs(args))
        return namespace(gradient).concatenate([along_q, along_p], axis=-1)

    def _beside(self, columns, by_v):
        """Derivatives (..., 2d, n) of ∇H with those of the friction, whose speed ∂H/∂p moves too:
        ∂²R/∂v² times the rows of p beside the rows of q."""
        along_q, along_p = columns[..., : self.dim, :], columns[..., self.dim :, :]
        along_q = along_q + matmul(by_v, along_p)
        return namespace(columns).concatenate([along_q, along_p], axis=-2)
