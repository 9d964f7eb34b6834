"""Pendulums of different lengths: one law, with the length as its parameter."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from gfnn_jax.coordinates import Coordinates
from gfnn_jax.phase_space import Scalar, State
from gfnn_jax.scenes.scene import DrawnFrom, Scene

GRAVITY = 9.81  # m/s²


def hamiltonian(z: State, t=0.0, args=(1.0,)) -> Scalar:
    """p²/(2 l²) − g l cos q of a unit mass: q the angle, p the angular momentum, l in metres."""
    q, p = z
    length = args[0]
    return p**2 / (2 * length**2) - GRAVITY * length * jnp.cos(q)


@dataclasses.dataclass(frozen=True)
class Swinging:
    """Law ``draw(key, num)`` of (q, p, l): l uniform between two lengths, states that librate.

    most: the largest amplitude of the angle, in radians.
    """

    shortest: float
    longest: float
    most: float

    def __call__(self, key, num):
        of_length, of_state = jax.random.split(key)
        length = jax.random.uniform(of_length, (num,), jnp.float64, self.shortest, self.longest)
        area, turn = jax.random.uniform(of_state, (2, num), jnp.float64)
        half = jnp.sin(self.most / 2) * jnp.sqrt(area)
        # Small oscillations have frequency √(g/l): p is as large as l² √(g/l) times the angle.
        q = 2 * jnp.arcsin(half * jnp.cos(2 * jnp.pi * turn))
        p = 2 * length**1.5 * jnp.sqrt(GRAVITY) * half * jnp.sin(2 * jnp.pi * turn)
        return jnp.stack([q, p, length], axis=-1)


def pendulum_length(shortest: float = 0.5, longest: float = 2.0, dt: float = 0.05) -> Scene:
    """H = p²/(2 l²) − g l cos q, g = 9.81 m/s², lengths uniform in (0.5, 2) m.

    The pendulums swing by up to 2.6 radians; a step is 0.05 s, a 28th to a 56th of their periods.
    """
    return Scene(
        name="pendulum-length",
        purpose="pendulums of different lengths: one law with a parameter",
        dim=1,
        dt=dt,
        sampling=DrawnFrom(Swinging(shortest, longest, 2.6)),
        test_states=DrawnFrom(Swinging(shortest, longest, 2.2)),
        hamiltonian=hamiltonian,
        parameters=("l",),
        coordinates=Coordinates("cartesian", angles=(0,)),
        num_pairs=4_000,
        tolerance=1e-11,
    )


SCENES = {"pendulum-length": pendulum_length}
