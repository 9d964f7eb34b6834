"""Uniform friction, which keeps a multiple of the symplectic form, and so does its flow.

    q̇ = ∂H/∂p,      ṗ = −∂H/∂q − γ p

In the variables of Caldirola and Kanai, p̃ = e^(γτ) p with τ the time since the step began, this is
the Hamiltonian system of H̃(q, p̃, τ) = e^(γτ) H(q, e^(−γτ) p̃): P. Caldirola, Nuovo Cimento 18
(1941) 393; E. Kanai, Prog. Theor. Phys. 3 (1948) 440. Gauss collocation there is symplectic and of
order 2s; back in p its derivative A obeys AᵀJA = e^(−γh) J to roundoff at any h. Kinetic energy is
lost at the rate 2γT, whatever M(q) is: Rayleigh's R = γT.
"""

from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.arrays import as_row, beside, namespace, pytree
from gfnn_jax.families.family import at_time, parameter_gradients
from gfnn_jax.flows.forces import Forced, WithForces
from gfnn_jax.flows.systems import OfSystems
from gfnn_jax.phase_space import split

FRICTION = "friction"  # the name of γ among the terms


@pytree(eq=True)
class Uniform(WithForces):
    """H of ``family`` with uniform friction; params (m + 1,) are those of H and γ behind them.

    In place of ∇H stands the field (∂H/∂q + γp, ∂H/∂p), which J turns into the velocity, and in
    place of its Hessian that field's derivative. ``value`` is H, the energy that is lost.
    """

    family: Any

    @property
    def label(self) -> str:
        return f"{self.family.label}, friction"

    @property
    def num_parameters(self) -> int:
        return self.family.num_parameters + 1

    @property
    def term_names(self) -> tuple[str, ...]:
        """Names of the terms of H, and γ."""
        return (*self.family.term_names, FRICTION)

    def take(self, rows) -> Any:
        """The family of these terms alone; without γ the one without friction."""
        last = self.family.num_parameters
        own = self.family.take([j for j in rows if j != last])
        return Uniform(own) if last in list(rows) else own

    def multiplier(self, params, dt):
        """e^(−γ dt); None beside other forces, which keep no multiple of the symplectic form."""
        own = self.family.family if isinstance(self.family, OfSystems) else self.family
        if isinstance(own, Forced):
            return None
        return namespace(params, dt).exp(-params[-1] * dt)

    def gradient(self, params, w, args=None):
        """(∂H/∂q + γp, ∂H/∂p), shape (..., 2d)."""
        return self.family.gradient(params[:-1], w, args) + params[-1] * momenta(w)

    def gradient_and_hessian(self, params, w, args=None):
        """Field and its derivative (..., 2d, 2d), which is not symmetric."""
        gradient, hessian = self.family.gradient_and_hessian(params[:-1], w, args)
        more = np.eye(2 * self.dim, k=self.dim, dtype=hessian.dtype)  # of (p, 0) in (q, p)
        field = gradient + params[-1] * momenta(w)
        return field, hessian + params[-1] * as_row(more, hessian)

    def term_gradients(self, w, args=None):
        """The field of every term, γ's with them, shape (..., 2d, m + 1). NumPy."""
        own = self.family.term_gradients(w, args)
        return np.concatenate([own, momenta(w)[..., None]], axis=-1)

    def begun(self, args, lanes):
        """(family, args) of H̃ as a step begins from states ``lanes`` (B, 2d)."""
        xp = namespace(lanes)
        if args is None:
            args = xp.zeros((len(lanes) if xp is np else 1, 0), lanes.dtype)
        args = args if args.ndim > 1 else args[None]
        since = xp.zeros((len(args), 1), lanes.dtype)
        return CaldirolaKanai(self.family), xp.concatenate([args, since], axis=-1)

    def from_canonical(self, params, w, since):
        """(q, p) of states (q, p̃) (..., 2d) a time ``since`` (..., 1) after the step began."""
        q, p = split(w)
        shrunk = namespace(params, since).exp(-params[-1] * since)
        return namespace(w).concatenate([q, shrunk * p], axis=-1)

    def moved(self, params, z, moved, h):
        """Z − z (B, 2d) of a step of h, a number or (B, 1), that moves (q, p̃) by ``moved``."""
        xp, rate = namespace(params, z), params[-1]
        (along_q, along_p), p = split(moved), split(z)[1]
        return xp.concatenate([along_q, xp.expm1(-rate * h) * p + xp.exp(-rate * h) * along_p], -1)

    def moved_derivatives(self, params, image, by_state, by_params, h):
        """∂Z/∂z and ∂Z/∂params (B, 2d, ·) of the images Z (B, 2d), from those of (q, p̃), the last
        column of which is γ's where there are m + 1 of them. NumPy."""
        dim, h = self.dim, np.asarray(h)
        shrunk = np.exp(-params[-1] * h)[..., None]
        for derivative in (by_state, by_params):
            derivative[:, dim:] *= shrunk
        if by_params.shape[-1] == self.num_parameters:
            by_params[:, dim:, -1] -= h * image[:, dim:]
        return by_state, by_params


def without_forces(family) -> Any:
    """The family of H alone."""
    while isinstance(family, (Uniform, Forced, OfSystems)):
        family = family.family
    return family


class Power(NamedTuple):
    """Energy per unit of time: lost (..., F) by each friction, uniform friction the last where
    there is such; supplied (..., k) by each input."""

    lost: Any
    supplied: Any


def power(family, params, w, args=None) -> Power:
    """Power of the forces at states w (..., 2d), where ``family`` holds any. NumPy or JAX."""
    if isinstance(family, Uniform):
        lost, supplied = power(family.family, params[:-1], w, args)
        v = split(family.family.gradient(params[:-1], w, args))[1]
        xp = namespace(w)
        even = params[-1] * xp.sum(split(w)[1] * v, axis=-1, keepdims=True)
        return Power(xp.concatenate([lost, even], axis=-1), supplied)
    if isinstance(family, OfSystems):
        own, rest = family.inside(params, args)
        return power(family.family, own, w, rest)
    if isinstance(family, Forced):
        return Power(*family.power(params, w, args))
    return Power(w[..., :0], w[..., :0])


@pytree(eq=True)
class CaldirolaKanai:
    """H̃(q, p̃, τ) of ``family``, with the params of `Uniform`; τ is the last of the args."""

    family: Any

    @property
    def dim(self) -> int:
        return self.family.dim

    def at_time(self, args, after):
        """args a time ``after`` later: τ goes on, and so does the time of a drive."""
        xp = namespace(args, after)
        since = args[..., -1]
        if 0 < since.ndim < xp.ndim(after):  # of stages and lanes
            since = as_row(since, after)
        since = (since + after)[..., None]
        if args.shape[-1] == 1:
            return since
        return beside(at_time(self.family, args[..., :-1], after), since)

    def gradient(self, params, w, args):
        """∂H̃/∂(q, p̃) = (g ∂H/∂q, ∂H/∂p), g = e^(γτ)."""
        growth, inner, others = self._inner(params, w, args)
        return _grown(self.family.gradient(params[:-1], inner, others), growth)

    def gradient_and_hessian(self, params, w, args):
        """∂H̃/∂w and ∂²H̃/∂w²: the block of q is multiplied by g, that of p divided by it."""
        growth, inner, others = self._inner(params, w, args)
        gradient, hessian = self.family.gradient_and_hessian(params[:-1], inner, others)
        xp, of_p = namespace(hessian), np.arange(2 * self.dim) >= self.dim
        by = xp.where(~(of_p[:, None] | of_p), growth[..., None], xp.ones_like(hessian))
        by = xp.where(of_p[:, None] & of_p, 1 / growth[..., None], by)
        return _grown(gradient, growth), hessian * by

    def parameter_gradients(self, params, w, args, along=None):
        """∂/∂params of the gradient (..., 2d, m + 1); of a family ``along`` of other terms those
        of its coefficients alone. NumPy."""
        growth, inner, others = self._inner(params, w, args)
        own = getattr(along, "family", along)
        columns = parameter_gradients(self.family, params[:-1], inner, others, own)
        columns = np.concatenate(
            [growth[..., None] * columns[..., : self.dim, :], columns[..., self.dim :, :]], axis=-2
        )
        if along is not None and own is along:
            return columns
        gradient, hessian = self.family.gradient_and_hessian(params[:-1], inner, others)
        # ∂/∂γ of (g ∂H/∂q, ∂H/∂p) at (q, p̃ / g): τ (g ∂H/∂q, 0) less τ times the p of H''.
        p = np.concatenate([np.zeros_like(inner[..., : self.dim]), inner[..., self.dim :]], axis=-1)
        turned = -np.einsum("...ij,...j->...i", hessian, p)
        turned[..., : self.dim] += gradient[..., : self.dim]
        column = args[..., -1:] * _grown(turned, growth)
        return np.concatenate([columns, column[..., None]], axis=-1)

    def _inner(self, params, w, args):
        """g (..., 1), the state (q, p) and the args of the family."""
        xp = namespace(params, w)
        growth = xp.exp(params[-1] * args[..., -1:])
        q, p = split(w)
        inner = xp.concatenate([q, p / growth], axis=-1)
        return growth, inner, args[..., :-1] if args.shape[-1] > 1 else None


def momenta(w):
    """(p, 0) of states (..., 2d): the field that friction adds, for γ = 1."""
    _, p = split(w)
    return namespace(w).concatenate([p, namespace(w).zeros_like(p)], axis=-1)


def _grown(field, growth):
    """(g θ_q, θ_p) of a field (..., 2d)."""
    along_q, along_p = split(field)
    return namespace(field).concatenate([growth * along_q, along_p], axis=-1)
