"""The piece of a map that loses area: momenta shrink by a factor in every step."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.arrays import as_row, namespace
from gfnn_jax.phase_space import split
from gfnn_jax.solve.status import OK, Info


@partial(jax.tree_util.register_dataclass, data_fields=("factor", "shift"), meta_fields=())
@dataclasses.dataclass(frozen=True, eq=False)
class Damping:
    """D_b: (q, p) -> (q, b p + c). A piece.

    Behind a symplectic map Φ of Jacobian M it makes a conformally symplectic one: with A = D_b M,
    AᵀJA = b MᵀJM = b J (McLachlan & Perlmutter, J. Geom. Phys. 39 (2001) 276). c is a drift that
    no S has that is periodic in q: the mean force on an angle.

    factor: b, (), or (d,) where degrees of freedom lose area at different rates; no multiple of J
    is kept then. shift: c (d,).
    """

    factor: Any
    shift: Any

    @property
    def matrix(self) -> np.ndarray:
        """(2d, 2d), NumPy: diag(1, b)."""
        b = np.broadcast_to(self.factor, np.shape(self.shift))
        return np.diag(np.concatenate([np.ones_like(b), b]))

    def image(self, z):
        """The images of states z (..., 2d), NumPy or JAX."""
        q, p = split(z)
        return namespace(z).concatenate([q, self._shrunk(p) + as_row(self.shift, p)], axis=-1)

    def multiplier(self, args: Any = None):
        """b, by which the symplectic form is multiplied; None where it differs between degrees of
        freedom."""
        return self.factor if np.ndim(self.factor) == 0 else None

    def step(self, z, args=None, *, unrolled: bool | int = False):
        """(Z, Info) of the states z (B, 2d), by JAX."""
        lanes = jnp.zeros(z.shape[0], jnp.int32)
        return self.image(z), Info(lanes + OK, lanes, jnp.zeros(z.shape[0], z.dtype))

    def compensated_step(self, z, compensation, args=None):
        """(Z, compensation, Info) of z + compensation. What a product's rounding loses of p is
        lost: it dies out with b as all that p was."""
        image, info = self.step(z)
        q, p = split(compensation)
        return image, jnp.concatenate([q, self._shrunk(p)], axis=-1), info

    def action(self, z, image, origin, args=None):
        """NaN (B,): a map that loses area has no modified Hamiltonian."""
        return jnp.full(z.shape[0], jnp.nan, z.dtype)

    def inverse(self) -> Damping:
        """(Q, P) -> (Q, (P − c) / b)."""
        return Damping(1 / self.factor, -self.shift / self.factor)

    def _shrunk(self, p):
        return p * (self.factor if np.ndim(self.factor) == 0 else as_row(self.factor, p))
