"""Pieces of a map that loses area: momenta shrink by a factor in every step."""

from __future__ import annotations

import dataclasses
from itertools import product
from typing import Any

import jax.numpy as jnp
import numpy as np

from gfnn_jax.arrays import as_row, matmul, namespace, pytree
from gfnn_jax.phase_space import split
from gfnn_jax.solve.status import OK, Info


class _Shrinks:
    """Base of the pieces (q, p) -> (q, b p + c), b and c those of the args."""

    def of(self, args: Any) -> tuple[Any, Any]:
        """(b, c), each a number or as many axes as p has."""
        raise NotImplementedError

    def image(self, z, args: Any = None):
        """The images of states z (..., 2d), NumPy or JAX."""
        (q, p), (b, c) = split(z), self.of(args)
        return namespace(z).concatenate([q, _beside(b, p) * p + _beside(c, p)], axis=-1)

    def step(self, z, args=None, *, unrolled: bool | int = False):
        """(Z, Info) of the states z (B, 2d), by JAX."""
        lanes = jnp.zeros(z.shape[0], jnp.int32)
        return self.image(z, args), Info(lanes + OK, lanes, jnp.zeros(z.shape[0], z.dtype))

    def compensated_step(self, z, compensation, args=None):
        """(Z, compensation, Info) of z + compensation. What a product's rounding loses of p is
        lost: it dies out with b as all that p was."""
        image, info = self.step(z, args)
        q, p = split(compensation)
        shrunk = _beside(self.of(args)[0], p) * p
        return image, jnp.concatenate([q, shrunk], axis=-1), info


@pytree()
class Damping(_Shrinks):
    """D_b: (q, p) -> (q, b p + c). A piece.

    Behind a symplectic map Φ of Jacobian M it makes a conformally symplectic one: with A = D_b M,
    AᵀJA = b MᵀJM = b J (McLachlan & Perlmutter, J. Geom. Phys. 39 (2001) 276). c is a drift that
    no S has that is periodic in q: the mean force on an angle.

    factor: b, (), or (d,) where degrees of freedom lose area at different rates; no multiple of J
    is kept then. shift: c (d,).
    """

    factor: Any
    shift: Any

    def of(self, args: Any = None) -> tuple[Any, Any]:
        return self.factor, self.shift

    @property
    def matrix(self) -> np.ndarray:
        """(2d, 2d), NumPy: diag(1, b)."""
        b = np.broadcast_to(self.factor, np.shape(self.shift))
        return np.diag(np.concatenate([np.ones_like(b), b]))

    def multiplier(self, args: Any = None):
        """b, by which the symplectic form is multiplied; None where it differs between degrees of
        freedom."""
        return self.factor if np.ndim(self.factor) == 0 else None

    def inverse(self) -> Damping:
        """(Q, P) -> (Q, (P − c) / b)."""
        return Damping(1 / self.factor, -self.shift / self.factor)


@pytree("degrees")
class FunctionsOfArgs:
    """Products of Chebyshev polynomials of args, the constant first.

    centre, half: (a,) of the box that is scaled to [−1, 1]. degrees: (t, a) of each product in
    each arg, by rising total degree.
    """

    centre: Any
    half: Any
    degrees: tuple[tuple[int, ...], ...]

    @classmethod
    def within(cls, args: np.ndarray, degree: int) -> FunctionsOfArgs:
        """Products up to a total degree on the box of these args (N, a). NumPy."""
        low, high = args.min(axis=0), args.max(axis=0)
        powers = product(range(degree + 1), repeat=args.shape[1])
        degrees = sorted((n for n in powers if sum(n) <= degree), key=sum)
        return cls(0.5 * (low + high), 0.5 * (high - low), tuple(degrees))

    def __call__(self, args):
        """(..., t) of args (..., a), NumPy or JAX."""
        xp = namespace(args)
        x = (args - as_row(self.centre, args)) / as_row(self.half, args)
        tables = []
        for i in range(x.shape[-1]):
            one = [xp.ones_like(x[..., i]), x[..., i]]
            for _ in range(max(n[i] for n in self.degrees) - 1):
                one.append(2 * x[..., i] * one[-1] - one[-2])
            tables.append(one)
        columns = []
        for powers in self.degrees:
            column = tables[0][powers[0]]
            for table, n in zip(tables[1:], powers[1:], strict=True):
                column = column * table[n]
            columns.append(column)
        return xp.stack(columns, axis=-1)


@pytree("inverted")
class DampingOfArgs(_Shrinks):
    """D_b of b(args) = Σ β_j f_j(args) and of c(args) alike. A piece: for each value of the args
    the `Damping` of that b, AᵀJA = b(args) J.

    factor: β (t, 1), or (t, d) where degrees of freedom have their own. shift: (t, d). functions:
    f. inverted: whether it is (Q, P) -> (Q, (P − c) / b).
    """

    factor: Any
    shift: Any
    functions: FunctionsOfArgs
    inverted: bool = False

    def of(self, args: Any) -> tuple[Any, Any]:
        """(b, c) (..., 1) or (..., d) of the args (..., a)."""
        values = self.functions(args)[..., None, :]
        b, c = (matmul(values, given)[..., 0, :] for given in (self.factor, self.shift))
        return (1 / b, -c / b) if self.inverted else (b, c)

    def multiplier(self, args: Any = None):
        """b (...) of the args (..., a); None where it differs between degrees of freedom, and
        where no args are given."""
        return None if args is None or self.factor.shape[1] > 1 else self.of(args)[0][..., 0]

    def inverse(self) -> DampingOfArgs:
        return dataclasses.replace(self, inverted=not self.inverted)


def _beside(a, p):
    """A number, or as many axes as p has."""
    return a if np.ndim(a) == 0 else as_row(a, p)
