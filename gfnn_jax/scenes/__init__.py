"""The scenes that come with the package, each a `Scene`, by function and by name."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Callable

from gfnn_jax.scenes.driven_pendulum import driven_pendulum
from gfnn_jax.scenes.henon_heiles import henon_heiles
from gfnn_jax.scenes.henon_heiles_section import henon_heiles_section
from gfnn_jax.scenes.pcr3bp import pcr3bp
from gfnn_jax.scenes.scene import AroundOrbit, DrawnFrom, Scene, Section
from gfnn_jax.scenes.standard_map import standard_map
from gfnn_jax.scenes.two_body import two_body

SCENES: dict[str, Callable[[], Scene]] = {
    "two-body": two_body,
    "henon-heiles-regular": lambda: henon_heiles(energy=1 / 12),
    "henon-heiles-chaotic": lambda: henon_heiles(energy=1 / 6),
    "henon-heiles-printed": lambda: henon_heiles(energy=1 / 12, printed=True),
    "pcr3bp": pcr3bp,
    "standard-map-regular": lambda: standard_map(k=0.6),
    "standard-map-chaotic": lambda: standard_map(k=1.2),
    "driven-pendulum": driven_pendulum,
    "henon-heiles-section": henon_heiles_section,
}


def names() -> tuple[str, ...]:
    """The names that `make` knows."""
    return tuple(SCENES)


def make(name: str, dt: float | None = None) -> Scene:
    """The scene of this name, with its own time step or with another.

    Raises ValueError, in one line, on an unknown name (naming the nearest one and all there are),
    on a ``dt`` that is not finite and > 0, on any but its own for a scene that is a map without
    time, and on one that is not a whole number of periods where the scene has a period.
    """
    if name not in SCENES:
        close = difflib.get_close_matches(name, SCENES, n=1)
        hint = f", did you mean '{close[0]}'?" if close else ";"
        raise ValueError(f"unknown scene '{name}'{hint} scenes: {', '.join(SCENES)}")
    scene = SCENES[name]()
    if dt is None or dt == scene.dt:
        return scene
    if scene.timeless:
        raise ValueError(f"{name} is a map without time: it has dt = {scene.dt:g} only, not {dt:g}")
    return dataclasses.replace(scene, dt=dt)


__all__ = [
    "SCENES",
    "AroundOrbit",
    "DrawnFrom",
    "Scene",
    "Section",
    "driven_pendulum",
    "henon_heiles",
    "henon_heiles_section",
    "make",
    "names",
    "pcr3bp",
    "standard_map",
    "two_body",
]
