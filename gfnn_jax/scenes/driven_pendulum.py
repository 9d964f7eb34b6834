"""A pendulum whose weight is driven, seen once in a whole number of the drive's periods."""

from __future__ import annotations

import dataclasses
import math

import jax.numpy as jnp

from gfnn_jax.phase_space import Scalar, State
from gfnn_jax.scenes.scene import DrawnFrom, Scene, UniformInEllipse


@dataclasses.dataclass(frozen=True)
class DrivenPendulum:
    """``hamiltonian(z, t)``: p²/2 − cos q (1 + a cos νt), a the amplitude and ν the frequency."""

    amplitude: float
    frequency: float

    def __call__(self, z: State, t=0.0) -> Scalar:
        q, p = z
        return p**2 / 2 - jnp.cos(q) * (1 + self.amplitude * jnp.cos(self.frequency * t))


def driven_pendulum(periods: int = 1, amplitude: float = 0.15, frequency: float = 1.0) -> Scene:
    """H = p²/2 − cos q (1 + a cos νt), its stroboscopic map over ``periods`` periods 2π/ν.

    States are uniform in the disc of radius 0.8 around the hanging pendulum, those that rollouts
    start from in the disc of radius 0.6. With a = 0.15 and ν = 1 the origin lies in Mathieu's
    second tongue, a weak saddle (multipliers 0.987 and 1.013 per period) between two centres at
    p = ±0.128; orbits turn by up to 0.31 per period at the disc's rim, so that many periods twist.
    """
    period = 2 * math.pi / frequency
    return Scene(
        name="driven-pendulum",
        purpose="stroboscopic map of a driven pendulum: one or more whole periods per step",
        dim=1,
        dt=periods * period,
        period=period,
        sampling=DrawnFrom(UniformInEllipse((0.0, 0.0), (0.8, 0.8))),
        test_states=DrawnFrom(UniformInEllipse((0.0, 0.0), (0.6, 0.6))),
        hamiltonian=DrivenPendulum(amplitude, frequency),
        reversor=(1, -1),
        num_pairs=3_000,
        tolerance=2.5e-10,
    )


SCENES = {"driven-pendulum": driven_pendulum}
