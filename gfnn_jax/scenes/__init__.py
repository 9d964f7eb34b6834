"""Scenes that come with the package, each a `Scene`, by function and by name."""

import dataclasses
import difflib
from collections.abc import Callable
from functools import partial

from gfnn_jax.scenes.scene import (
    AroundOrbit,
    DrawnFrom,
    NormalSites,
    Scene,
    Section,
    UniformInEllipse,
)
from gfnn_jax.scenes.systems import (
    ESCAPE_ENERGY,
    driven_pendulum,
    driven_pendulum_phase,
    fput,
    froeschle,
    henon_heiles,
    henon_heiles_section,
    n_body,
    pcr3bp,
    pendulum_length,
    standard_map,
    toda,
    two_body,
)

SCENES: dict[str, Callable[[], Scene]] = {  # by their names on the command line
    "driven-pendulum": driven_pendulum,
    "driven-pendulum-phase": driven_pendulum_phase,
    "fput": fput,
    "froeschle": froeschle,
    "henon-heiles-regular": henon_heiles,
    "henon-heiles-chaotic": partial(henon_heiles, energy=ESCAPE_ENERGY),
    "henon-heiles-printed": partial(henon_heiles, printed=True),
    "henon-heiles-section": henon_heiles_section,
    "n-body": n_body,
    "pcr3bp": pcr3bp,
    "pendulum-length": pendulum_length,
    "standard-map-regular": standard_map,
    "standard-map-chaotic": partial(standard_map, k=1.2),
    "toda": toda,
    "two-body": two_body,
}


def names() -> tuple[str, ...]:
    """Names that `make` knows."""
    return tuple(SCENES)


def make(name: str, dt: float | None = None) -> Scene:
    """Make the scene of this name, with its own time step or with another.

    Raises ValueError, in one line, on an unknown name (naming the nearest one and all there are),
    on a ``dt`` that is not finite and > 0, on another ``dt`` than its own for a scene that is a map
    without time, and on one that is not a whole number of periods where the scene has a period.
    """
    if name not in SCENES:
        close = difflib.get_close_matches(name, SCENES, n=1)
        hint = f", did you mean '{close[0]}'?" if close else ";"
        raise ValueError(f"unknown scene '{name}'{hint} scenes: {', '.join(SCENES)}")
    scene = SCENES[name]()
    if dt is None or dt == scene.dt:
        return scene
    if scene.timeless:
        raise ValueError(f"{name} is a map without time: its dt is {scene.dt:g}, got {dt:g}")
    return dataclasses.replace(scene, dt=dt)


__all__ = [
    "SCENES",
    "AroundOrbit",
    "DrawnFrom",
    "NormalSites",
    "Scene",
    "Section",
    "UniformInEllipse",
    "driven_pendulum",
    "driven_pendulum_phase",
    "fput",
    "froeschle",
    "henon_heiles",
    "henon_heiles_section",
    "make",
    "n_body",
    "names",
    "pcr3bp",
    "pendulum_length",
    "standard_map",
    "toda",
    "two_body",
]
