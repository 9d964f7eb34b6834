"""Bodies in space that attract each other: a star of mass 1 and three light companions."""

from __future__ import annotations

import dataclasses
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.phase_space import Scalar, State, split
from gfnn_jax.scenes.scene import DrawnFrom, Scene

_MASSES = (1.0, 0.01, 0.02, 0.005)
_RADII = (1.0, 1.9, 3.2)  # of the companions' orbits
_TILT = 0.1  # standard deviation of a direction out of the plane
# (relative spread of a radius, relative standard deviation of a speed) of initial states of
# rollouts, and of the states of pairs, which are spread wider so that such orbits stay among them.
_TEST, _TRAINING = (0.05, 0.02), (0.25, 0.15)


@dataclasses.dataclass(frozen=True)
class Gravity:
    """``energy(z)``: Σ_i |p_i|²/(2 m_i) − Σ_{i<j} m_i m_j/|q_i − q_j|."""

    masses: tuple[float, ...]

    def __call__(self, z: State, t=0.0) -> Scalar:
        q, p = (x.reshape(len(self.masses), -1) for x in split(z))
        masses = np.array(self.masses)
        kinetic = jnp.sum(jnp.sum(p**2, axis=1) / (2 * masses))
        a, b = np.array(list(combinations(range(len(masses)), 2))).T
        return kinetic - jnp.sum(masses[a] * masses[b] / jnp.linalg.norm(q[a] - q[b], axis=1))


@dataclasses.dataclass(frozen=True)
class Companions:
    """Law ``draw(key, num)`` of near-circular orbits of any phase about the star, slightly tilted.

    The frame is that of the centre of mass. spread: largest deviation of a radius, relative to it.
    faster: standard deviation of a speed, relative to that on a circle.
    """

    masses: tuple[float, ...]
    radii: tuple[float, ...]
    spread: float
    faster: float

    def __call__(self, key, num):
        keys, count = jax.random.split(key, 4), len(self.radii)
        shape = (num, count)
        spread = 1 + self.spread * jax.random.uniform(keys[0], shape, jnp.float64, -1, 1)
        r = jnp.asarray(self.radii)[None] * spread
        phase = jax.random.uniform(keys[1], shape, jnp.float64, 0, 2 * jnp.pi)
        tilt = _TILT * jax.random.normal(keys[2], shape, jnp.float64)
        speed = (1 + self.faster * jax.random.normal(keys[3], shape, jnp.float64)) / jnp.sqrt(r)
        cos, sin, none = jnp.cos(phase), jnp.sin(phase), jnp.zeros(shape)
        q = r[..., None] * jnp.stack([cos, sin, none], axis=-1)
        along = jnp.stack([-sin * jnp.cos(tilt), cos * jnp.cos(tilt), jnp.sin(tilt)], axis=-1)
        p = jnp.asarray(self.masses[1:])[None, :, None] * along * speed[..., None]
        star = jnp.zeros((num, 1, 3))
        q = jnp.concatenate([star, q], axis=1)
        p = jnp.concatenate([star - jnp.sum(p, axis=1, keepdims=True), p], axis=1)
        return jnp.concatenate([q.reshape(num, -1), p.reshape(num, -1)], axis=1)


@dataclasses.dataclass(frozen=True)
class Component:
    """``value(z)``: one component of the momentum Σ p_i, or of the angular momentum Σ q_i × p_i."""

    bodies: int
    angular: bool

    def __call__(self, z: State) -> Scalar:
        q, p = (x.reshape(self.bodies, 3) for x in split(z))
        return jnp.sum(jnp.cross(q, p) if self.angular else p, axis=0)[2]


def n_body(dt: float = 0.05) -> Scene:
    """Four bodies of unequal masses in space, q body by body; the innermost orbit takes 2π."""
    energy, bodies = Gravity(_MASSES), len(_MASSES)
    return Scene(
        name="n-body",
        purpose="a star and three companions in space: structure bodies:4",
        dim=3 * bodies,
        dt=dt,
        sampling=DrawnFrom(Companions(_MASSES, _RADII, *_TRAINING)),
        test_states=DrawnFrom(Companions(_MASSES, _RADII, *_TEST)),
        hamiltonian=energy,
        invariants={
            "energy": energy,
            "momentum": Component(bodies, angular=False),
            "angular momentum": Component(bodies, angular=True),
        },
        structure=f"bodies:{bodies}",
        num_pairs=1_000,
        tolerance=1e-12,
    )


SCENES = {"n-body": n_body}
