"""Random sine features: S linear in its parameters where polynomials have too many terms.

    S(c, w) = Σ c_j sin(k_j·x + b_j),   k_j normal of deviation ``bandwidth``, b_j uniform

(Rahimi & Recht, NIPS 2007). The frequencies are drawn once from ``seed`` and never trained, so the
fit is one least-squares solve; the number of features does not grow with the dimension.
"""

from __future__ import annotations

import dataclasses
from functools import cached_property, partial

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.families.inputs import Inputs


@partial(
    jax.tree_util.register_dataclass,
    data_fields=("inputs",),
    meta_fields=("num_parameters", "bandwidth", "seed"),
)
@dataclasses.dataclass(frozen=True)
class Sines:
    """``num_parameters`` random sines of the variables; whole wave numbers for angles."""

    inputs: Inputs
    num_parameters: int
    bandwidth: float = 1.0
    seed: int = 0

    name = "sines"

    @property
    def label(self) -> str:
        return f"{self.name} {self.num_parameters}"

    @property
    def operations(self) -> tuple[int, int]:
        """Floating-point operations of ∇S and of its Jacobian."""
        n = self.inputs.num_variables
        return 4 * self.num_parameters * n, 2 * self.num_parameters * n * (n + 1)

    @cached_property
    def _frequencies(self) -> tuple[np.ndarray, np.ndarray]:
        """k (num_parameters, variables) and b (num_parameters,); integer k for angles."""
        rng = np.random.default_rng(self.seed)
        k = self.bandwidth * rng.standard_normal((self.num_parameters, self.inputs.num_variables))
        angles = list(self.inputs.angles)
        k[:, angles] = np.round(k[:, angles])
        return k, rng.uniform(0, 2 * np.pi, self.num_parameters)

    def _phase(self, w):
        k, b = (jnp.asarray(a, w.dtype) for a in self._frequencies)
        return jnp.dot(k, self.inputs(w), precision="highest") + b

    def unflatten(self, coefficients):
        """The parameters of ``S`` are the coefficients (num_parameters,) themselves."""
        return coefficients

    def __call__(self, params, w):
        """S(params, w): params (num_parameters,), w (2d,) -> scalar."""
        return jnp.dot(params, jnp.sin(self._phase(w)), precision="highest")

    def gradient_features(self, w):
        """∇ of every sine at w: (2d, num_parameters)."""
        k, _ = self._frequencies
        slope = jax.jacfwd(self.inputs)(w)
        return slope.T @ (jnp.asarray(k.T, w.dtype) * jnp.cos(self._phase(w))[None, :])
