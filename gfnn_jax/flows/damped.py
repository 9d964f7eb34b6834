"""Uniform friction of a bracket, and its flow, which multiplies the bracket by a number.

    ż = B(z) ∇H(z) − E z,      e^(Eτ) B(z) e^(Eτ)ᵀ = e^(λτ) B(e^(Eτ) z)

In y = e^(Eτ) z, τ the time since a step began, this is the motion ẏ = B(y) ∇K(y, τ) of
K = e^(λτ) H(e^(−Eτ) y), as of Caldirola and Kanai for (q, p) (`flows.uniform`). Its step is Poisson
to roundoff; back in z its derivative M obeys M B(z) Mᵀ = e^(−λh) B(Z).
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from gfnn_jax.arrays import as_row, matmul, namespace, pytree
from gfnn_jax.brackets import Bracket, Constant, LieAlgebra, null_space
from gfnn_jax.families.family import AroundAnother
from gfnn_jax.flows.uniform import CaldirolaKanai


@pytree()
class Dilations:
    """Linear motions that multiply a bracket by a number: E = Σ_k c_k L⁻¹ diag(patterns_k) L.

    patterns: (K, n). rates: (K,), λ = Σ c_k rates_k. basis, inverse: L and L⁻¹ (n, n).
    """

    patterns: Any
    rates: Any
    basis: Any
    inverse: Any

    @classmethod
    def of(cls, bracket: Bracket) -> Dilations:
        """Find all that are diagonal where L z has the bracket's standard constants; none of a
        bracket that is neither constant nor a Lie algebra."""
        n, rows, basis = bracket.size, [], _basis(bracket)
        eye = np.eye(n + 1)
        if isinstance(bracket, Constant):  # e_i + e_j = λ
            rows = [eye[i] + eye[j] - eye[n] for i, j in np.argwhere(bracket.form)]
        elif isinstance(bracket, LieAlgebra):  # e_i + e_j = λ + e_k
            c = np.einsum(
                "ia,jb,abc,ck->ijk", basis, basis, bracket.constants, np.linalg.inv(basis)
            )
            places = np.argwhere(np.abs(c) > 1e-9 * np.abs(c).max())
            rows = [eye[i] + eye[j] - eye[k] - eye[n] for i, j, k in places]
        found = null_space(np.array(rows)) if rows else np.zeros((0, n + 1))
        return cls(found[:, :n], found[:, n], basis, np.linalg.inv(basis))

    @property
    def matrices(self) -> np.ndarray:
        """(K, n, n): E for c = 1 of each."""
        return self.inverse @ (self.patterns[:, :, None] * self.basis)

    def take(self, rows) -> Dilations:
        """Keep these of the motions alone."""
        return dataclasses.replace(self, patterns=self.patterns[rows], rates=self.rates[rows])

    def about(self, bracket: Bracket) -> Dilations:
        """Motions of the same patterns in the basis of another bracket."""
        basis = _basis(bracket)
        return dataclasses.replace(self, basis=basis, inverse=np.linalg.inv(basis))

    def grown(self, c, z, time):
        """e^(Eτ) z (..., n) of coefficients c (1, K), states (..., n) and times (..., 1)."""
        factors = namespace(c, z, time).exp(as_row(matmul(c, self.patterns), time) * time)
        return matmul(matmul(z, self.basis.T) * factors, self.inverse.T)

    def growth(self, c, time):
        """e^(λτ) of times (..., 1)."""
        return namespace(c, time).exp(as_row(matmul(c, self.rates[:, None]), time) * time)

    def transposed(self, c, g, time):
        """e^(Eᵀτ) g of covectors (..., n)."""
        factors = namespace(c, g, time).exp(as_row(matmul(c, self.patterns), time) * time)
        return matmul(matmul(g, self.inverse) * factors, self.basis)


def _basis(bracket: Bracket) -> np.ndarray:
    """L (n, n) where L z has standard constants."""
    named = getattr(bracket, "blocks", ())
    return np.asarray(bracket.basis) if named else np.eye(bracket.size)  # pyright: ignore[reportAttributeAccessIssue]


@pytree()
class InRestingFrame(AroundAnother):
    """K(y, τ) = e^(λτ) H(e^(−Eτ) y) of ``family`` H; params are those of H and c of E behind them,
    τ is the last of the args."""

    family: Any
    dilations: Dilations

    at_time = CaldirolaKanai.at_time  # pyright: ignore[reportAssignmentType]

    @property
    def num_parameters(self) -> int:
        return self.family.num_parameters + len(self.dilations.rates)

    def split(self, params) -> tuple[Any, Any]:
        """Coefficients of H, and those of E (1, K)."""
        count = self.family.num_parameters
        return params[:count], params[None, count:]

    def value(self, params, w, args=None):
        """K (...) at y (..., n)."""
        own, z, _, growth, args = self._inner(params, w, args)
        return growth[..., 0] * self.family.value(own, z, args)

    def gradient(self, params, w, args=None):
        """∂K/∂y (..., n)."""
        own, z, time, growth, args = self._inner(params, w, args)
        return self._pulled(params, growth * self.family.gradient(own, z, args), time)

    def gradient_and_hessian(self, params, w, args=None):
        """∂K/∂y (..., n) and ∂²K/∂y² (..., n, n)."""
        own, z, time, growth, args = self._inner(params, w, args)
        g, hessian = self.family.gradient_and_hessian(own, z, args)
        xp, time_of = namespace(w), time[..., None]
        half = self._pulled(params, growth[..., None] * hessian, time_of)
        whole = self._pulled(params, xp.swapaxes(half, -1, -2), time_of)
        return self._pulled(params, growth * g, time), whole

    def _pulled(self, params, g, time):
        return self.dilations.transposed(self.split(params)[1], g, -time)

    def _inner(self, params, w, args):
        own, c = self.split(params)
        time = namespace(args, w).broadcast_to(args[..., -1:], (*w.shape[:-1], 1))
        growth = self.dilations.growth(c, time)
        z = self.dilations.grown(c, w, -time)
        return own, z, time, growth, args[..., :-1] if args.shape[-1] > 1 else None


@pytree()
class DampedFlow:
    """The flow of B∇H − E z over dt: ``flow`` is that of `InRestingFrame`'s K. A piece.

    frame: the K alone, as its family. Made by `flows.lie.law_flow`.
    """

    flow: Any
    frame: InRestingFrame

    @property
    def family(self):
        """H."""
        return self.frame.family

    @property
    def params(self):
        """Coefficients of H, and those of E behind them."""
        return self.flow.params

    @property
    def dt(self):
        """Time of a step."""
        return self.flow.dt

    @property
    def substeps(self) -> int:
        """Substeps of a step."""
        return self.flow.substeps

    def value(self, z, args=None):
        """H (...) at states z (..., n)."""
        return self.family.value(self.frame.split(self.params)[0], z, args)

    def over(self, dt) -> DampedFlow:
        """The flow over another dt."""
        return dataclasses.replace(self, flow=self.flow.over(dt))

    def inverse(self) -> DampedFlow:
        """The same flow backwards."""
        return self.over(-self.dt)

    def multiplier(self, args=None):
        """e^(−λ dt)."""
        growth = self.frame.dilations.growth(self.frame.split(self.params)[1], -self._span)
        return growth[:, 0] if jnp.ndim(self.dt) else growth[0, 0]

    def image(self, z, args=None):
        """Images (N, n) of states z, as an array of NumPy."""
        begun = self._begun(z, args)
        return np.asarray(self._ended(self.flow.image(z, np.repeat(begun, len(z), axis=0))))

    def step(self, z, args=None, *, unrolled: bool | int = False):
        """Step the states z (B, n): (Z, Info), by JAX."""
        y, info = self.flow.step(z, self._begun(z, args), unrolled=unrolled)
        return self._ended(y), info

    def compensated_step(self, z, compensation, args=None):
        """Step z + compensation (B, n): (Z, compensation, Info). What the last product's rounding
        loses is lost: it dies out as z does."""
        y, lost, info = self.flow.compensated_step(z, compensation, self._begun(z, args))
        return self._ended(y), self._ended(lost), info

    def _begun(self, z, args):
        """args with τ = 0 behind them."""
        xp = namespace(z)
        since = xp.zeros((1, 1), z.dtype)
        if args is None:
            return since
        args = args if args.ndim > 1 else args[None]
        return xp.concatenate([args, since * args[:, :1]], axis=-1)

    def _ended(self, y):
        """z of y as a step ends."""
        return self.frame.dilations.grown(self.frame.split(self.params)[1], y, -self._span)

    @property
    def _span(self):
        """dt as (1, 1) or (B, 1)."""
        return self.dt.reshape(-1, 1)
