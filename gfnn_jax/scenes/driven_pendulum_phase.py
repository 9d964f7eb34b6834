"""A driven pendulum seen several times in each of the drive's periods, from any time of it on."""

from __future__ import annotations

import dataclasses

from gfnn_jax.coordinates import Coordinates
from gfnn_jax.scenes.driven_pendulum import driven_pendulum
from gfnn_jax.scenes.scene import Scene


def driven_pendulum_phase(
    steps: int = 16, amplitude: float = 0.15, frequency: float = 1.0
) -> Scene:
    """The pendulum of `driven_pendulum`, ``steps`` steps a period, from any time of the drive.

    H(z, t) is learned, whose flow steps from any time on over any dt.
    """
    stroboscopic = driven_pendulum(1, amplitude, frequency)
    return dataclasses.replace(
        stroboscopic,
        name="driven-pendulum-phase",
        purpose="driven pendulum at any phase of the drive: a law that depends on the time",
        dt=stroboscopic.dt / steps,
        any_phase=True,
        coordinates=Coordinates("cartesian", angles=(0,)),
        reversor=None,  # that of the stroboscopic map turns the drive's time too
        num_pairs=4_000,
        tolerance=1e-11,
    )


SCENES = {"driven-pendulum-phase": driven_pendulum_phase}
