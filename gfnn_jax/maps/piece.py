"""Pieces of a map, one protocol: a step of a batch, its inverse and its multiplier.

The derivative A of a step has AᵀJA = μJ: μ = 1 of a symplectic piece, e^(−γ dt) of one with uniform
friction γ. Of a bracket it has A B(z) Aᵀ = μ B(Z).
"""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.lie import LieFlow
from gfnn_jax.generating.generated import Generated
from gfnn_jax.solve.status import Info


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


def serves_any_dt(piece: Any) -> bool:
    """Return whether a piece can be stepped over any dt."""
    return isinstance(piece, (Flow, LieFlow)) or (
        isinstance(piece, Generated) and piece.serves_any_dt
    )
