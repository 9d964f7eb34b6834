"""S as a function of the time step too: products of functions of w and of dt².

A step of an autonomous flow over −h is the inverse of that over h. In the midpoint chart both have
the same w, so that the displacement h J∇S is odd in h and S even: dt² is one more variable beside
the coordinates, by which S is not differentiated.
"""

from __future__ import annotations

import dataclasses
from functools import cache, partial
from typing import Any

import jax
import numpy as np

from gfnn_jax.arrays import namespace
from gfnn_jax.families.inputs import Inputs
from gfnn_jax.families.products import Basis, Products


@partial(jax.tree_util.register_dataclass, data_fields=("products",), meta_fields=())
@dataclasses.dataclass(frozen=True, eq=False)
class OfTimeStep:
    """S(C, w; dt²): args are the time step, (1,) or (..., 1), of either sign.

    products: of the variables (w, dt²), (..., 2d + 1).
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
        """Those of (w, dt²)."""
        return self.products.inputs

    @property
    def num_parameters(self) -> int:
        return len(_of_state(self.products.basis))

    @property
    def operations(self) -> tuple[int, int]:
        """Floating-point operations of ∇S, and of ∇S with its Hessian."""
        return self.products.operations

    def unflatten(self, coefficients) -> np.ndarray:
        """Coefficients (..., num_parameters), NumPy -> the matrix C, the parameters of S."""
        every = np.zeros((*np.shape(coefficients)[:-1], self.products.num_parameters))
        every[..., _of_state(self.products.basis)] = coefficients
        return self.products.unflatten(every)

    def __call__(self, params, w, args=None):
        return self.value(params, w, args)

    def value(self, params: Any, w: Any, args: Any = None):
        """S, shape (...)."""
        return self.products.value(params, _beside(w, args))

    def gradient(self, params: Any, w: Any, args: Any = None):
        """∂S/∂w, shape (..., 2d)."""
        return self.products.gradient(params, _beside(w, args))[..., :-1]

    def gradient_and_hessian(self, params: Any, w: Any, args: Any = None):
        """∂S/∂w (..., 2d) and ∂²S/∂w² (..., 2d, 2d)."""
        gradient, hessian = self.products.gradient_and_hessian(params, _beside(w, args))
        return gradient[..., :-1], hessian[..., :-1, :-1]

    def term_gradients(self, w: Any, args: Any = None):
        """∂/∂w of every term, shape (..., 2d, num_parameters)."""
        every = self.products.term_gradients(_beside(w, args))
        return every[..., :-1, _of_state(self.products.basis)]


def _beside(w, dt):
    """(w, dt²), (..., 2d + 1)."""
    xp = namespace(w, dt)
    square = xp.broadcast_to(xp.asarray(dt, dtype=w.dtype) ** 2, (*w.shape[:-1], 1))
    return xp.concatenate([w, square], axis=-1)


@cache
def _of_state(basis: Basis) -> np.ndarray:
    """The terms that w enters: a function of dt alone generates nothing."""
    first, second = (half.orders for half in basis.halves)
    row, column = basis.terms.T
    in_dt = basis.halves[1].indices[:, -1]  # dt² is the last variable, and no angle
    return np.flatnonzero(first[row] + (second - in_dt)[column] > 0)
