"""The Poincaré return map of Hénon and Heiles, in the large island of regular orbits."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from gfnn_jax.phase_space import State
from gfnn_jax.scenes.henon_heiles import hamiltonian
from gfnn_jax.scenes.scene import DrawnFrom, Scene, Section, UniformInEllipse

ENERGY = 0.1
FIXED_POINT = (0.2755, 0.0)  # to four digits


def lift(z: State) -> Float[Array, "whole"]:  # noqa: F821
    """(0, y, p_x, p_y) of z = (y, p_y), with p_x > 0 such that the energy is ENERGY; NaN where the
    energy does not reach so far."""
    y, p_y = z
    p_x = jnp.sqrt(2 * ENERGY - p_y**2 - y**2 + 2 / 3 * y**3)
    return jnp.stack([jnp.zeros_like(y), y, p_x, p_y])


def henon_heiles_section() -> Scene:
    """(y, p_y) on x = 0, ẋ > 0 at E = 0.1, mapped to the next such crossing, about 6.1 later.

    Around the fixed point, a periodic orbit, lies the large island: closed curves from y = −0.1 to
    0.54, about twice as wide in y as in p_y. States are uniform in an ellipse of such a shape, from
    y = 0.085 to 0.445, those that rollouts start from in one a fifth smaller.
    """
    centre, axes = (0.265, 0.0), (0.18, 0.1)
    return Scene(
        name="henon-heiles-section",
        purpose="Poincaré return map of Hénon–Heiles, the large island of regular orbits",
        dim=1,
        dt=1.0,
        sampling=DrawnFrom(UniformInEllipse(centre, axes)),
        test_states=DrawnFrom(UniformInEllipse(centre, (0.8 * axes[0], 0.8 * axes[1]))),
        section=Section(hamiltonian, index=0, lift=lift),
        reversor=(1, -1),
        num_pairs=1_000,
        tolerance=1.5e-9,
    )


SCENES = {"henon-heiles-section": henon_heiles_section}
