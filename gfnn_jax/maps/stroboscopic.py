"""Stroboscopic map of a driven system: its steps at the phases of one period, composed.

Each step is symplectic, and so is their product. Observed once a period, the system is one map
that does not depend on time.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.arrays import pytree
from gfnn_jax.flows.lie import InARow
from gfnn_jax.maps.parameters import Parameters
from gfnn_jax.maps.symplectic_map import SymplecticMap

_WHOLE = 1e-9  # relative tolerance on the whole number of steps in a period


@pytree("steps", "backward")
class OverPhases(InARow):
    """Row of a driven piece at the times t0 + n dt, n from 0 to ``steps`` − 1, itself without args.

    parameters: those of the map; the time is the only one. backward: True for the inverse of the
    row, which is applied from its end.
    """

    piece: Any
    parameters: Parameters
    t0: Any
    dt: Any
    steps: int
    backward: bool = False

    def action(self, z, image, origin, args=None):
        """Action (B,) of the row from z (B, 2d), the sum of the actions of its steps."""

        def one(piece, both, at):
            z, total = both
            image, info = piece.step(z, at)
            return (image, total + piece.action(z, image, origin, at)), info

        return self._row(one, (z, jnp.zeros(z.shape[:1], z.dtype)), args)[0][1]

    def inverse(self) -> OverPhases:
        """Make the inverse row: the inverse steps from the last to the first."""
        return dataclasses.replace(self, piece=self.piece.inverse(), backward=not self.backward)

    def multiplier(self, args=None):
        """The product of those of the steps, which are alike; None where a step has none."""
        one = self.piece.multiplier(args)
        return None if one is None else one**self.steps

    def _row(self, one, carry, args):
        def following(carry, number):
            # Backward, a piece begins where its step forward ends.
            n = self.steps - number if self.backward else number
            at = self.parameters.after(jnp.reshape(self.t0, (1, 1)), n, self.dt)
            return one(self.piece, carry, at)

        carry, infos = jax.lax.scan(following, carry, jnp.arange(self.steps))
        return carry, jax.tree.map(lambda a: jnp.max(a, axis=0), infos)


def stroboscopic(map_: SymplecticMap, t0: float = 0.0) -> SymplecticMap:
    """Make the map over one period of the drive, from its time ``t0``.

    ``map_`` is one driven piece whose only parameter is the time, and the period is a whole number
    of its dt. Raises ValueError for any other map.
    """
    known = map_.parameters
    if known is None or known.period is None or len(known.names) > 1 or len(map_.pieces) != 1:
        raise ValueError("expected a driven map of a single piece, with no parameter but the time")
    dt, period = float(np.asarray(map_.dt)), float(np.asarray(known.period))
    steps = round(period / dt)
    if steps < 1 or abs(period / dt - steps) > _WHOLE * steps:
        raise ValueError(
            f"expected a dt that is a whole part of the period {period:g}, got {dt:g}: choose it "
            "by map.over(dt)"
        )
    dtype = np.dtype(map_.scale.dtype)
    piece = OverPhases(map_.pieces[0], known, np.asarray(t0, dtype), np.asarray(dt, dtype), steps)
    return dataclasses.replace(map_, pieces=(piece,), dt=np.asarray(period, dtype), parameters=None)
