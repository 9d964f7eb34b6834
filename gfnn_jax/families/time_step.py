"""S as a function of the time step too: products of functions of w and of dt².

A step of an autonomous flow over −h is the inverse of that over h. In the midpoint chart both have
the same w, so that the displacement h J∇S is odd in h and S even: dt² is one more variable beside
the coordinates, by which S is not differentiated.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import numpy as np

from gfnn_jax.families.inputs import Inputs
from gfnn_jax.families.products import Products


@partial(jax.tree_util.register_dataclass, data_fields=("products",), meta_fields=())
@dataclasses.dataclass(frozen=True, eq=False)
class OfTimeStep:
    """S(C, w; dt²): args are the time step, (1,) or (..., 1), of either sign.

    products: those of w whose only argument is dt².
    """

    products: Products

    @property
    def name(self) -> str:
        return self.products.name

    @property
    def label(self) -> str:
        """As candidates tables show it: what, and how large."""
        return f"{self.products.label} with dt²"

    @property
    def degree(self) -> int:
        """The total degree in w and dt²."""
        return self.products.degree

    @property
    def signs(self) -> tuple[int, ...] | None:
        return self.products.signs

    @property
    def inputs(self) -> Inputs:
        """Those of w and dt²."""
        return self.products.inputs

    @property
    def num_parameters(self) -> int:
        return self.products.num_parameters

    def terms_of(self, degree: int) -> int:
        """How many parameters it would have of another degree."""
        return self.products.terms_of(degree)

    @property
    def operations(self) -> tuple[int, int]:
        """Floating-point operations of ∇S, and of ∇S with its Hessian."""
        return self.products.operations

    def unflatten(self, coefficients) -> np.ndarray:
        """Coefficients (..., num_parameters), NumPy -> the matrix C, the parameters of S."""
        return self.products.unflatten(coefficients)

    def __call__(self, params, w, args=None):
        return self.value(params, w, args)

    def value(self, params: Any, w: Any, args: Any = None):
        """S, shape (...)."""
        return self.products.value(params, w, args**2)

    def gradient(self, params: Any, w: Any, args: Any = None):
        """∂S/∂w, shape (..., 2d)."""
        return self.products.gradient(params, w, args**2)

    def gradient_and_hessian(self, params: Any, w: Any, args: Any = None):
        """∂S/∂w (..., 2d) and ∂²S/∂w² (..., 2d, 2d)."""
        return self.products.gradient_and_hessian(params, w, args**2)

    def term_gradients(self, w: Any, args: Any = None):
        """∂/∂w of every term, shape (..., 2d, num_parameters)."""
        return self.products.term_gradients(w, args**2)
