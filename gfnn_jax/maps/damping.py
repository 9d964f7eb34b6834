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
class Damping:
    """D_b: (q, p) -> (q, b p + c). A piece.

    Behind a symplectic map Φ of Jacobian M it makes a conformally symplectic one: with A = D_b M,
    AᵀJA = b MᵀJM = b J (McLachlan & Perlmutter, J. Geom. Phys. 39 (2001) 276). c is a drift that
    no S has that is periodic in q: the mean force on an angle.

    factor: b, (), or (d,) where degrees of freedom lose area at different rates; no multiple of J
    is kept then. shift: c (d,). functions: f_j, of a b that depends on args: then b = Σ β_j f_j
    with ``factor`` β (t, 1) or (t, d), and c alike with ``shift`` (t, d). inverted: whether it is
    (Q, P) -> (Q, (P − c) / b).
    """

    factor: Any
    shift: Any
    functions: FunctionsOfArgs | None = None
    inverted: bool = False

    def of(self, args: Any = None) -> tuple[Any, Any]:
        """(b, c) of the args (..., a), each a number, (d,), (..., 1) or (..., d)."""
        b, c = self.factor, self.shift
        if self.functions is not None:
            values = self.functions(args)[..., None, :]
            b, c = (matmul(values, given)[..., 0, :] for given in (b, c))
        return (1 / b, -c / b) if self.inverted else (b, c)

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

    @property
    def matrix(self) -> np.ndarray:
        """(2d, 2d), NumPy: diag(1, b). Raises AttributeError where b depends on args."""
        if self.functions is not None:
            raise AttributeError("the factors depend on args")
        b = np.broadcast_to(self.of()[0], np.shape(self.shift))
        return np.diag(np.concatenate([np.ones_like(b), b]))

    def multiplier(self, args: Any = None):
        """b, by which the symplectic form is multiplied, () or (...) of the args (..., a); None
        where it differs between degrees of freedom, and where it depends on args and none are
        given."""
        if self.functions is None:
            b = self.of()[0]
            return b if np.ndim(b) == 0 else None
        return None if args is None or self.factor.shape[1] > 1 else self.of(args)[0][..., 0]

    def inverse(self) -> Damping:
        """(Q, P) -> (Q, (P − c) / b)."""
        return dataclasses.replace(self, inverted=not self.inverted)


def _beside(a, p):
    """A number, or as many axes as p has."""
    return a if np.ndim(a) == 0 else as_row(a, p)
