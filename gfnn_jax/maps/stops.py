"""Forecasts of bodies that dry friction stops.

A law's dry friction is smoothed over speeds ε, so that a body that it holds creeps at up to about ε
where it would rest. Orbits that come to rest are therefore followed anew with Coulomb's friction
(`flows.coulomb`), of which ε is 0.
"""

from __future__ import annotations

import numpy as np

from gfnn_jax.families.lagrangian import DRY, Lagrangian
from gfnn_jax.flows.coulomb import Coulomb

_RESTING = 2.0  # radians of the fastest motion: no turning point is as slow for as long


def resting(law: Lagrangian, states: np.ndarray, times: np.ndarray, omega: float) -> np.ndarray:
    """Lanes (B,) whose orbits (q, v) (B, n, 2d) at these times (B, n) come to rest in a direction
    of dry friction: its speed stays within ε for longer than any turning point takes."""
    dry = law.friction.kinds == DRY
    speeds = np.abs(states[..., law.dim :] @ law.friction.directions[dry].T)
    slow = speeds <= law.friction.widths[dry]  # (B, n, F)
    moved = np.where(slow, times[:, :1, None], times[..., None])
    slow_for = times[..., None] - np.maximum.accumulate(moved, axis=1)  # since the last motion
    return np.any(slow & (slow_for > _RESTING / omega), axis=(1, 2))


def stopped(law: Lagrangian, x: np.ndarray, ends: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Orbits (B, n, 2d) of the law with Coulomb's friction from states x = (q, v) (B, 2d) at the
    first of the times ``ends`` (B, n + 1) to the others; NaN from where a step has no solution.
    Inputs u (B, n, inputs) are constant in each step."""
    motion, found = Coulomb.of(law), []
    modes = motion.begin(x, u[:, 0])
    for k, h in enumerate(np.diff(ends, axis=1).T):
        x, modes = motion.advance(x, modes, h, u[:, k])
        found.append(x)
    return np.stack(found, axis=1)
