"""Standard maps coupled in a ring, without a flow (Froeschlé, Astron. Astrophys. 16 (1972))."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp

from gfnn_jax.coordinates import Coordinates
from gfnn_jax.phase_space import State, split
from gfnn_jax.scenes.scene import DrawnFrom, Scene


@dataclasses.dataclass(frozen=True)
class Kicks:
    """``step(z)``: p_i += k sin q_i + b (sin(q_{i+1} − q_i) + sin(q_{i−1} − q_i)), then q += p.

    In type 2 it is S = Σ_i P_i²/2 + k cos q_i − b cos(q_{i+1} − q_i), dt = 1.
    """

    k: float
    b: float

    def __call__(self, z: State) -> State:
        q, p = split(z)
        bond = self.b * jnp.sin(jnp.roll(q, -1) - q)
        p = p + self.k * jnp.sin(q) + bond - jnp.roll(bond, 1)
        return jnp.concatenate([q + p, p])


@dataclasses.dataclass(frozen=True)
class Torus:
    """``draw(key, num)``: all of the torus [−π, π)^(2·dim)."""

    dim: int

    def __call__(self, key, num):
        turns = jax.random.uniform(key, (num, 2 * self.dim), jnp.float64, -1.0, 1.0)
        return math.pi * turns


def froeschle(dim: int = 64, k: float = 0.5, b: float = 0.1) -> Scene:
    """Scene of ``dim`` coupled standard maps. q and p of every site are uniform angles. Chaotic."""
    return Scene(
        name="froeschle",
        purpose="a ring of coupled standard maps, a map without a flow: structure ring",
        dim=dim,
        dt=1.0,
        sampling=DrawnFrom(Torus(dim)),
        step=Kicks(k, b),
        coordinates=Coordinates("angles", angles=tuple(range(2 * dim))),
        structure="ring",
        regular=False,
        num_pairs=100,
        tolerance=1e-12,
    )


SCENES = {"froeschle": froeschle}
