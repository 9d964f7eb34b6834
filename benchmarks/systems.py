"""Systems that several benchmarks are measured on, beside the scenes of the package."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.coordinates import TWO_PI
from gfnn_jax.scenes import DrawnFrom, Scene, henon_heiles


def bounded_states(key, num):
    """Uniform over the well of Hénon and Heiles below E = 1/8."""
    energy = henon_heiles().invariants["energy"]
    box = np.array([0.7, 0.7, 0.5, 0.5])
    z = box * jax.random.uniform(key, (100 * num, 4), jnp.float64, -1, 1)
    inside = jnp.nonzero(jax.vmap(energy)(z) < 1 / 8, size=num)[0]
    return z[inside]


def pendulum(z, t=0.0):
    """H of a pendulum of unit frequency at rest."""
    return z[1] ** 2 / 2 - jnp.cos(z[0])


def disc(key, num, radius=1.0):
    """Uniform over a disc in the plane."""
    r, angle = jax.random.uniform(key, (2, num), jnp.float64)
    r, angle = radius * jnp.sqrt(r), TWO_PI * angle
    return jnp.stack([r * jnp.cos(angle), r * jnp.sin(angle)], axis=-1)


def pendulum_scene(dt: float, radius: float = 1.0) -> Scene:
    return Scene(
        name="pendulum",
        purpose="hard cases",
        dim=1,
        dt=dt,
        hamiltonian=pendulum,
        sampling=DrawnFrom(functools.partial(disc, radius=radius)),
        reversor=(1, -1),
    )


def oscillator_scene(dt: float) -> Scene:
    def flow(z, t):
        c, s = jnp.cos(t), jnp.sin(t)
        return jnp.stack([c * z[0] + s * z[1], c * z[1] - s * z[0]])

    return Scene(
        name="oscillator",
        purpose="hard cases",
        dim=1,
        dt=dt,
        flow=flow,
        sampling=DrawnFrom(disc),
        reversor=(1, -1),
    )


def well(dt: float) -> Scene:
    """Hénon and Heiles' well below E = 1/8, all of it."""
    return dataclasses.replace(henon_heiles(1 / 12, dt), sampling=DrawnFrom(bounded_states))
