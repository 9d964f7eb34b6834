"""S as a weighted sum of networks of one shape, each trained by itself.

    S(a, w) = Σ a_k S_k(w)

It is linear in the weights a: with a_k = 1/E it is the members' mean, and other weights move it
within what the members say differently. It generates a symplectic map for any weights.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from gfnn_jax.arrays import pytree
from gfnn_jax.families.family import DifferentiatedByJax
from gfnn_jax.families.mlp import Mlp


@pytree()
class Ensemble(DifferentiatedByJax):
    """Ensemble of E networks of one shape; the params of the family are their weights (E,).

    network: the common shape. members: their params, every leaf with a leading axis E.
    """

    network: Mlp
    members: Any

    name = "mlp"

    @property
    def inputs(self):
        return self.network.inputs

    @property
    def size(self) -> int:
        """Number E of members."""
        return jax.tree.leaves(self.members)[0].shape[0]

    @property
    def label(self) -> str:
        return f"{self.size} × {self.network.label}"

    @property
    def num_parameters(self) -> int:
        """Number of parameters of all members; the weights are not learned."""
        return self.size * self.network.num_parameters

    @property
    def operations(self) -> tuple[int, int]:
        """Floating-point operations of ∇S, and of ∇S with its Hessian, for all members."""
        gradient, with_hessian = self.network.operations
        return self.size * gradient, self.size * with_hessian

    def unflatten(self, coefficients):
        """Return the weights (..., E) themselves."""
        return coefficients

    def value(self, params, w, args=None):
        """S(params, w), shape (...): params (E,), w (..., 2d)."""
        each = jax.vmap(lambda member: self.network.value(member, w))(self.members)
        return jnp.tensordot(params, each, 1)
