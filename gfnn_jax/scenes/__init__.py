"""Scenes that come with the package, each a `Scene`, by function and by name.

Each scene is one module here. Its ``SCENES`` maps names on the command line to the functions that
make the scenes. Its function of the module's own name becomes a function of this package.
"""

from __future__ import annotations

import dataclasses
import difflib
import importlib
import pkgutil
from collections.abc import Callable
from typing import TYPE_CHECKING

from gfnn_jax.scenes.scene import (
    AroundOrbit,
    DrawnFrom,
    NormalSites,
    Scene,
    Section,
    UniformInEllipse,
)

if TYPE_CHECKING:  # what is collected below
    from gfnn_jax.scenes.driven_pendulum import driven_pendulum
    from gfnn_jax.scenes.driven_pendulum_phase import driven_pendulum_phase
    from gfnn_jax.scenes.fput import fput
    from gfnn_jax.scenes.froeschle import froeschle
    from gfnn_jax.scenes.henon_heiles import henon_heiles
    from gfnn_jax.scenes.henon_heiles_section import henon_heiles_section
    from gfnn_jax.scenes.n_body import n_body
    from gfnn_jax.scenes.pcr3bp import pcr3bp
    from gfnn_jax.scenes.pendulum_length import pendulum_length
    from gfnn_jax.scenes.standard_map import standard_map
    from gfnn_jax.scenes.toda import toda
    from gfnn_jax.scenes.two_body import two_body

_OTHER_MODULES = ("scene", "trajectories", "draws")
SCENES: dict[str, Callable[[], Scene]] = {}


def _collect() -> None:
    for found in pkgutil.iter_modules(__path__):
        if found.name not in _OTHER_MODULES:
            module = importlib.import_module(f"{__name__}.{found.name}")
            SCENES.update(module.SCENES)
            globals()[found.name] = getattr(module, found.name)


_collect()


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
