"""Pieces of a map, one protocol: a step of a batch, its inverse and its multiplier.

The derivative A of a step has AᵀJA = μJ: μ = 1 of a symplectic piece, e^(−γ dt) of one with uniform
friction γ. Of a bracket it has A B(z) Aᵀ = μ B(Z).
"""

from __future__ import annotations

import dataclasses
from itertools import product
from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np

from gfnn_jax.arrays import as_row, matmul, namespace, pytree
from gfnn_jax.flows.damped import DampedFlow
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.lie import LieFlow
from gfnn_jax.generating.generated import Generated
from gfnn_jax.phase_space import apply_j, area, split
from gfnn_jax.solve.status import OK, Info

FLOWS = Flow, LieFlow, DampedFlow  # of a law: what serves any dt


@runtime_checkable
class Piece(Protocol):
    """Map in a row of such, batch first: z (B, 2d), by JAX.

    A piece is a pytree. ``unrolled`` makes derivatives those of the iterations that ran; a number
    also bounds the number of updates.
    """

    def step(self, z: Any, args: Any = None, *, unrolled: bool | int = False) -> tuple[Any, Info]:
        """Step z: (Z, Info)."""
        ...

    def compensated_step(self, z: Any, compensation: Any, args: Any = None) -> tuple:
        """Step z + compensation: (Z, compensation, Info). Rounding has lost the compensation."""
        ...

    def inverse(self) -> Any:
        """Make the inverse piece."""
        ...

    def multiplier(self, args: Any = None) -> Any:
        """μ of AᵀJA = μJ, which holds for the derivative A of every step: 1.0 of a symplectic
        piece; another number, or one of each lane (B,), of a conformally symplectic one; None where
        there is no such number."""
        ...


@runtime_checkable
class PieceWithAction(Piece, Protocol):
    """Piece that also knows its action: what the modified Hamiltonian is made of."""

    def action(self, z: Any, image: Any, origin: Any, args: Any = None) -> Any:
        """Action (B,) of the step from z to its image, about the origin (B, 2d).

        See `maps.modified_hamiltonian`.
        """
        ...


def with_params(piece: Any, params: Any) -> Any:
    """The piece with other coefficients: its own, or those of the piece that it is made of."""
    inside = next((n for n in ("flow", "short") if n in vars(piece)), None)
    if inside is None:
        return dataclasses.replace(piece, params=params)
    return dataclasses.replace(piece, **{inside: with_params(getattr(piece, inside), params)})


def serves_any_dt(piece: Any) -> bool:
    """Return whether a piece can be stepped over any dt."""
    return isinstance(piece, FLOWS) or (isinstance(piece, Generated) and piece.serves_any_dt)


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
