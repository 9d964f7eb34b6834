"""S that depends on the time step: products of functions of w and of dt².

The step of an autonomous flow over −h is the inverse of that over h. In the midpoint chart both
have the same w, so that the displacement h J∇S is odd in h and S is even. dt² is therefore one more
variable beside the coordinates, in which S is not differentiated.
"""

from typing import Any

import numpy as np

from gfnn_jax.arrays import pytree
from gfnn_jax.families.family import AroundAnother
from gfnn_jax.families.products import Products


@pytree()
class OfTimeStep(AroundAnother):
    """Family S(C, w; dt²): args are the time step, (1,) or (..., 1), of either sign.

    products: the products of functions of w and of their only argument, dt².
    """

    products: Products

    @property
    def family(self) -> Products:  # type: ignore[override]
        return self.products

    @property
    def label(self) -> str:
        """Name and size, as the table of candidates shows them."""
        return f"{self.products.label} with dt²"

    @property
    def degree(self) -> int:
        """Total degree in w and dt²."""
        return self.products.degree

    def terms_of(self, degree: int) -> int:
        """Number of parameters of the same family of another degree."""
        return self.products.terms_of(degree)

    def unflatten(self, coefficients) -> np.ndarray:
        """Make the matrix C, the parameters of S, of coefficients (..., num_parameters), NumPy."""
        return self.products.unflatten(coefficients)

    def inside(self, params, args):
        """The same params, and dt²."""
        return params, args**2

    def term_gradients(self, w: Any, args: Any = None):
        """Gradients ∂/∂w of all terms, shape (..., 2d, num_parameters)."""
        return self.products.term_gradients(w, args**2)
