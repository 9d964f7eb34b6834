"""S of two positions, as a function of one position and the displacement between them.

    S(q, Q) = F((1 − c) q + c Q, Q − q),        symmetric: ½ [S(q, Q) + S(Q, q)]

w = (q, Q) is the evaluation point of chart type 1. With c = 0 F has q itself, which may be an
angle: S is then unchanged where both positions turn once. c = ½ is the middle, of which an F that
is even in the displacement makes S(q, Q) = S(Q, q): the S of a reversible map, which goes the same
way back where momenta are turned.
"""

from typing import Any

import numpy as np

from gfnn_jax.arrays import namespace, pytree
from gfnn_jax.coordinates import whole_turns
from gfnn_jax.families.family import AroundAnother
from gfnn_jax.families.sums import matrix_free


@pytree("part", "both")
class OfDisplacement(AroundAnother):
    """The family of S(q, Q) that a family F of 2d variables makes.

    part: c, of the way from q to Q. both: whether S is the mean of F both ways, and symmetric.
    moves: (d,) of positions that are known modulo 2π, the centres of their moves Q − q; NaN of all
    other positions, and None where there are no such positions.
    """

    family: Any
    part: float = 0.0
    both: bool = False
    moves: Any = None

    @property
    def label(self) -> str:
        """Label in a table of candidates: name and size."""
        return f"{self.family.label} of q and Q − q"

    @property
    def operations(self) -> tuple[int, int]:
        """Floating-point operations of ∇S, and of ∇S with its Hessian."""
        gradient, with_hessian = self.family.operations
        ways = 1 + self.both
        return ways * gradient, ways * with_hessian

    @property
    def matrix_free(self) -> bool:
        """Return whether solvers are to use products with the Hessian instead of the Hessian."""
        return matrix_free(self.family)

    def unflatten(self, coefficients):
        """Coefficients (num_parameters,), NumPy -> the parameters of F."""
        return self.family.unflatten(coefficients)

    def value(self, params, w, args=None):
        """S, shape (...): w (..., 2d)."""
        return self._mean([self.family.value(params, self._inner(v), args) for v in self._ways(w)])

    def gradient(self, params, w, args=None):
        """∂S/∂w (..., 2d)."""
        return self._mean(
            [
                self._turned(self._outer(self.family.gradient(params, self._inner(v), args), -1), k)
                for k, v in enumerate(self._ways(w))
            ]
        )

    def gradient_and_hessian(self, params, w, args=None):
        """∂S/∂w (..., 2d) and ∂²S/∂w² (..., 2d, 2d)."""
        gradients, hessians = [], []
        for k, v in enumerate(self._ways(w)):
            g, h = self.family.gradient_and_hessian(params, self._inner(v), args)
            gradients.append(self._turned(self._outer(g, -1), k))
            h = self._outer(self._outer(h, -1), -2)
            hessians.append(self._turned(self._turned(h, k), k, -2))
        return self._mean(gradients), self._mean(hessians)

    def term_gradients(self, w, args=None):
        """Gradient of every term at w (..., 2d): (..., 2d, N). NumPy."""
        return self._mean(
            [
                self._turned(self._outer(self.family.term_gradients(self._inner(v)), -2), k, -2)
                for k, v in enumerate(self._ways(w))
            ]
        )

    def curvatures(self, params, w, args=None) -> list:
        """Curvatures that ``hessian_product`` takes: those of F, one way or both."""
        return [self.family.curvatures(params, self._inner(v), args) for v in self._ways(w)]

    def hessian_product(self, curvatures, v):
        """∂²S/∂w² v (..., 2d)."""
        found = []
        for k, bends in enumerate(curvatures):
            product = self.family.hessian_product(bends, self._inner(self._turned(v, k)))
            found.append(self._turned(self._outer(product, -1), k))
        return self._mean(found)

    def lifted(self, q, other):
        """Q (..., d) of two positions as they were measured: within half a turn of the centre of
        the moves where they are known modulo 2π. NumPy."""
        if self.moves is None:
            return other
        turns = whole_turns(other - q - self.moves)
        return other - np.where(np.isnan(self.moves), 0.0, turns)

    def _ways(self, w) -> list:
        """w = (q, Q), and (Q, q) where S is the mean of both."""
        return [w, self._turned(w, 1)] if self.both else [w]

    def _mean(self, ways: list):
        return 0.5 * (ways[0] + ways[1]) if self.both else ways[0]

    @staticmethod
    def _turned(x, often: int, axis: int = -1):
        """The halves of an axis exchanged so often."""
        xp = namespace(x)
        return xp.roll(x, x.shape[axis] // 2, axis=axis) if often % 2 else x

    def _inner(self, w):
        """(q + c (Q − q), Q − q) of w = (q, Q), (..., 2d): linear in w."""
        xp = namespace(w)
        q, other = xp.split(w, 2, axis=-1)
        moved = other - q
        return xp.concatenate([q + self.part * moved if self.part else q, moved], axis=-1)

    def _outer(self, g, axis: int):
        """The transpose of ``_inner`` along an axis of length 2d."""
        xp = namespace(g)
        at, along = xp.split(g, 2, axis=axis)
        ahead = along + self.part * at if self.part else along
        return xp.concatenate([at - ahead, ahead], axis=axis)
