"""Affine symplectic maps, of which base maps are made."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from gfnn_jax.arrays import as_row, matmul, pytree
from gfnn_jax.phase_space import apply_j, area
from gfnn_jax.solve.status import OK, Info


@pytree()
class Affine:
    """Map z -> centre + shift + E (z − centre), E a symplectic matrix: half a base map. A piece.

    matrix: (2d, 2d). centre, shift: (2d,).
    """

    matrix: Any
    centre: Any
    shift: Any

    def image(self, z, args=None):
        """Compute the images of states z (..., 2d), NumPy or JAX."""
        moved = matmul(z - as_row(self.centre, z), self.matrix.T)
        return as_row(self.centre + self.shift, z) + moved

    def step(self, z, args=None, *, unrolled: bool | int = False):
        """Step the states z (B, 2d): (Z, Info), by JAX."""
        lanes = jnp.zeros(z.shape[0], jnp.int32)
        return self.image(z), Info(lanes + OK, lanes, jnp.zeros(z.shape[0], z.dtype))

    def compensated_step(self, z, compensation, args=None):
        """Step z + compensation: (Z, compensation, Info). The product's rounding is not kept."""
        image, info = self.step(z)
        return image + matmul(compensation, self.matrix.T), jnp.zeros_like(z), info

    def action(self, z, image, origin, args=None):
        """Action (B,) of the step from z (B, 2d) to its image about the origin.

        The constant is such that the action about the centre vanishes at the centre.
        """
        centre = as_row(self.centre, z) - origin
        return area(centre + as_row(self.shift, z), image) - area(centre, z)

    def inverse(self) -> Affine:
        """Make the inverse map, by E⁻¹ = −J Eᵀ J of a symplectic E."""
        inverse = apply_j(apply_j(self.matrix).T)
        return Affine(inverse, self.centre + self.shift, -self.shift)

    def multiplier(self, args=None) -> float:
        """1.0: the piece is symplectic."""
        return 1.0
