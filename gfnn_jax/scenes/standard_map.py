"""Chirikov's standard map: a symplectic map without an equation of motion (paper, section 4.4)."""

from __future__ import annotations

import dataclasses
import math
from functools import partial

import jax.numpy as jnp

from gfnn_jax.coordinates import Coordinates
from gfnn_jax.phase_space import State
from gfnn_jax.scenes.scene import AroundOrbit, Scene

GOLDEN_CURVE_BREAKS = 0.971635  # Greene (1979): above this K the chaos is connected in p


@dataclasses.dataclass(frozen=True)
class Kick:
    """``step(z)``: p += k sin θ, then θ += p (paper, eq. (standardMap))."""

    k: float

    def __call__(self, z: State) -> State:
        theta, p = z
        p = p + self.k * jnp.sin(theta)
        return jnp.stack([theta + p, p])


def standard_map(k: float = 0.6) -> Scene:
    """z = (θ, p), both of period 2π for the map; states within σ = 0.5 of one orbit, then reduced.

    Below K = 0.9716 the orbit starts at (0.3, π), in the two islands around θ = 0 and θ = π, p = π,
    between which it jumps at every step (K = 0.6: Lyapunov exponent over 10⁵ steps 1e-4, falling
    as 1/n). Above, it starts at (0.1, 0.1), beside the saddle and in the chaotic sea
    (K = 1.2: 0.19); there rollouts start on the orbit itself.

    Drawn states have θ and p in [0, 2π). Their images are not reduced, so that both are continuous.
    """

    regular = k < GOLDEN_CURVE_BREAKS
    orbit = AroundOrbit((0.3, math.pi) if regular else (0.1, 0.1), num_steps=10_000, sigma=0.5)
    return Scene(
        name=f"standard-map-{'regular' if regular else 'chaotic'}",
        purpose=(
            "a map with no equation of motion: two islands that the orbit jumps between"
            if regular
            else "a map with no equation of motion: the chaotic sea and its islands"
        ),
        dim=1,
        dt=1.0,
        sampling=orbit,
        test_states=None if regular else dataclasses.replace(orbit, sigma=0.0),
        step=Kick(k),
        coordinates=Coordinates("angles", angles=(0, 1)),
        regular=regular,
        num_pairs=1_000,
        tolerance=6e-13,
    )


SCENES = {
    "standard-map-regular": standard_map,
    "standard-map-chaotic": partial(standard_map, k=1.2),
}
