"""The planar circular restricted three-body problem (paper, section 4.3)."""

from __future__ import annotations

import math

import jax.numpy as jnp

from gfnn_jax.phase_space import Scalar, State, split
from gfnn_jax.scenes.scene import AroundOrbit, Scene

MU = 0.012150585  # Earth and Moon
START_RADIUS = 0.5


def _inverse_distances(q):
    """1/r₁ and 1/r₂: to the larger body at (−μ, 0) and to the smaller at (1 − μ, 0)."""
    y2 = q[1] ** 2
    return 1 / jnp.sqrt((q[0] + MU) ** 2 + y2), 1 / jnp.sqrt((q[0] + MU - 1) ** 2 + y2)


def hamiltonian(z: State, t=0.0) -> Scalar:
    """‖p‖²/2 + p₁q₂ − p₂q₁ − (1 − μ)/r₁ − μ/r₂; the Jacobi constant is −2H, up to μ(1 − μ)."""
    q, p = split(z)
    inverse_r1, inverse_r2 = _inverse_distances(q)
    return p @ p / 2 + p[0] * q[1] - p[1] * q[0] - (1 - MU) * inverse_r1 - MU * inverse_r2


def features(z: State):
    """(q₁, q₂, p₁, p₂, 1/r₁, 1/r₂): H is a polynomial of degree 2 in these."""
    return jnp.concatenate([z, jnp.stack(_inverse_distances(z[:2]))])


def pcr3bp(dt: float = 0.1) -> Scene:
    """Near-integrable orbits around the larger body, states within σ = 0.05 of one orbit."""
    circular_speed = math.sqrt((1 - MU) / START_RADIUS)
    start = (START_RADIUS - MU, 0.0, 0.0, circular_speed - MU)
    return Scene(
        name="pcr3bp",
        purpose="a satellite of the larger of two bodies, rotating frame: not separable",
        dim=2,
        dt=dt,
        sampling=AroundOrbit(start, num_steps=10_000, sigma=0.05),
        hamiltonian=hamiltonian,
        invariants={"Jacobi energy": hamiltonian},
        features=features,
        reversor=(1, -1, -1, 1),
        num_pairs=10_000,
        tolerance=7e-7,
    )


SCENES = {"pcr3bp": pcr3bp}
