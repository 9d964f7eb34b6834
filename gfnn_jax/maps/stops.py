"""Forecasts of bodies that dry friction stops.

A law's dry friction is smoothed over velocities ε, so that a body that it holds creeps at up to
about ε where it would rest. Orbits that come to rest are therefore followed anew by the same law
with ε so small that the creeping over the whole forecast stays below the noise
(`maps.laws.sticking`). That law is stiff: its steps are Gauss collocation, solved by Newton's
method.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gfnn_jax.families.lagrangian import DRY, Lagrangian
from gfnn_jax.flows.collocation import Steps, images
from gfnn_jax.flows.legendre import Legendre, family_of
from gfnn_jax.flows.motion import WEIGHTS
from gfnn_jax.maps.laws import STIFFEST, sticking, stiffness

_STAGES = 3
_NEAR = 4.0  # ε: speeds at which friction turns over, or will within a step
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


def stopped(
    law: Lagrangian, orbit: np.ndarray, ends: np.ndarray, noise: float, parts: int,
    inputs: Callable[[int, int], np.ndarray],
) -> np.ndarray:  # fmt: skip
    """Orbits (B, n, 2d) from the first states of ``orbit`` (B, n + 1, 2d), which are those of the
    smooth law at the times ``ends`` (B, n + 1), with dry friction that holds a body still to within
    ``noise``; NaN from where a step has no solution.

    parts: of a step, where nothing is near rest. inputs: (k, parts) -> those (B, parts, 6, m) at
    the stages of step k in so many parts.
    """
    duration = float(np.max(ends[:, -1] - ends[:, 0]))
    narrow = sticking(law, noise, duration)
    family, params = family_of(narrow)
    d, transform = law.dim, Legendre(law.terms)
    q = orbit[:, 0, :d]
    z = np.concatenate([q, law.momentum(q, orbit[:, 0, d:])], axis=1)
    stiff, slow = stiffness(narrow, q), _near_rest(law, orbit)
    found, moves = [orbit[:, 0]], np.ones(len(q), bool)
    for k, h in enumerate(np.diff(ends, axis=1).T):
        fine = max(parts, int(np.ceil(np.max(h) * stiff / STIFFEST)))
        for count, lanes in ((parts, moves & ~slow[:, k]), (fine, moves & slow[:, k])):
            if not lanes.any():
                continue
            u = np.tensordot(inputs(k, count), WEIGHTS, axes=(2, 0))[lanes]  # means over the parts
            for n in range(count):
                args = u[:, n] if law.num_inputs else None
                step = h[lanes] / count
                z[lanes] = images(
                    family, params, z[lanes], step, Steps(_STAGES, 1), args=args
                ).states
        found.append(np.concatenate([z[:, :d], transform.velocity(law.coefficients, z)], axis=1))
        if not law.num_inputs:  # else they may move a body again
            crept = np.abs(found[-1][:, :d] - found[-2][:, :d]) * duration
            creeps = np.abs(found[-1][:, d:]) * duration
            moves = moves & np.any((crept > noise * h[:, None]) | (creeps > noise), axis=1)
    return np.stack(found[1:], axis=1)


def _near_rest(law: Lagrangian, orbit: np.ndarray) -> np.ndarray:
    """Steps (B, n) of orbits (B, n + 1, 2d) in which a speed of dry friction turns or is small."""
    dry = law.friction.kinds == DRY
    speeds = orbit[..., law.dim :] @ law.friction.directions[dry].T / law.friction.widths[dry]
    before, after = speeds[:, :-1], speeds[:, 1:]
    small = np.minimum(np.abs(before), np.abs(after)) < _NEAR
    return np.any(small | (before * after < 0), axis=2)
