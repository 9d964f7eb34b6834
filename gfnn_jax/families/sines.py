"""Random sine features, linear in the parameters, for states where polynomials need many terms.

    S(c, w) = Σ c_j sin(k_j·x + b_j),   k_j normal of deviation ``bandwidth``, b_j uniform

(Rahimi & Recht, NIPS 2007). The frequencies are drawn once from ``seed`` and never trained, so the
fit is one least-squares solve; the number of features does not grow with the dimension.
"""

from functools import cached_property

import numpy as np

from gfnn_jax.arrays import as_row, matmul, namespace, pytree
from gfnn_jax.families.family import OfCoefficients
from gfnn_jax.families.inputs import Inputs


@pytree("num_parameters", "bandwidth", "seed")
class Sines(OfCoefficients):
    """Family of ``num_parameters`` random sines of the variables; whole wave numbers for angles."""

    inputs: Inputs
    num_parameters: int
    bandwidth: float = 1.0
    seed: int = 0

    name = "sines"

    @property
    def operations(self) -> tuple[int, int]:
        """Floating-point operations of ∇S, and of ∇S with its Hessian."""
        n = self.inputs.num_variables
        gradient = 4 * self.num_parameters * n
        return gradient, gradient + 2 * self.num_parameters * n * n

    @cached_property
    def _frequencies(self) -> tuple[np.ndarray, np.ndarray]:
        """Frequencies k (num_parameters, variables), integer for angles; b (num_parameters,)."""
        rng = np.random.default_rng(self.seed)
        k = self.bandwidth * rng.standard_normal((self.num_parameters, self.inputs.num_variables))
        angles = list(self.inputs.angles)
        k[:, angles] = np.round(k[:, angles])
        return k, rng.uniform(0, 2 * np.pi, self.num_parameters)

    def _phase(self, x):
        """Frequencies k (m, n), and phases k·x + b (..., m)."""
        xp = namespace(x)
        k, b = (xp.asarray(a, dtype=x.dtype) for a in self._frequencies)
        phase = matmul(x, k.T)
        return k, phase + as_row(b, phase)

    def value(self, params, w, args=None):
        """Value S(params, w), shape (...): params (num_parameters,), w (..., 2d)."""
        _, phase = self._phase(self.inputs(w))
        return matmul(namespace(w).sin(phase), params[:, None])[..., 0]

    def gradient(self, params, w, args=None):
        """Gradient ∇S(params, w), shape (..., 2d)."""
        x, slope, _ = self.inputs.tables(w, order=1)
        k, phase = self._phase(x)
        weighted = namespace(w).cos(phase) * as_row(params, phase)
        return self.inputs.pull_back_gradient(matmul(weighted, k), slope)

    def gradient_and_hessian(self, params, w, args=None):
        """Gradient ∇S (..., 2d) and Hessian S'' (..., 2d, 2d)."""
        x, slope, curvature = self.inputs.tables(w, order=2)
        (k, phase), xp = self._phase(x), namespace(w)
        gradient = matmul(xp.cos(phase) * as_row(params, phase), k)
        squares = (k[:, :, None] * k[:, None, :]).reshape(len(k), -1)
        hessian = -matmul(xp.sin(phase) * as_row(params, phase), squares)
        hessian = hessian.reshape(*x.shape, x.shape[-1])
        return (
            self.inputs.pull_back_gradient(gradient, slope),
            self.inputs.pull_back_hessian(hessian, gradient, slope, curvature),
        )

    def term_gradients(self, w, args=None):
        """Gradients of all sines at w (..., 2d): (..., 2d, num_parameters)."""
        x, slope, _ = self.inputs.tables(w, order=1)
        k, phase = self._phase(x)
        cos = namespace(w).cos(phase)[..., None, :]
        return self.inputs.pull_back_terms(as_row(k.T, cos) * cos, slope)
