"""Learn exactly symplectic maps from data, and predict with them for millions of steps.

    scene = gfnn.scenes.henon_heiles(energy=1 / 12)
    pairs = gfnn.sample_pairs(scene, num_pairs=4_096, key=jax.random.key(0))
    fit = gfnn.fit(pairs, scene, tolerance=1e-8)
    states, info = fit.map.rollout(z0, num_steps=1_000_000)

Names are loaded when first used, so that importing the package costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gfnn_jax import records, scenes
    from gfnn_jax.brackets import Bracket
    from gfnn_jax.compiling import enable_compile_cache
    from gfnn_jax.data.recording import Recording, read
    from gfnn_jax.errors import FitError, FitWarning, InputError, WorkError
    from gfnn_jax.evaluate import figures, metrics
    from gfnn_jax.evaluate.discover import discover
    from gfnn_jax.exports.export import export
    from gfnn_jax.families import from_function
    from gfnn_jax.families.functions import register_function
    from gfnn_jax.generating.charts import CHARTS, Chart
    from gfnn_jax.learn.fit import fit
    from gfnn_jax.learn.fitted import Fit
    from gfnn_jax.learn.monitors import Monitors, fit_monitors
    from gfnn_jax.learn.options import (
        FitOptions,
        GeneratingFunction,
        Hamiltonian,
        Lagrangian,
        between,
    )
    from gfnn_jax.learn.saved import load
    from gfnn_jax.maps.saved import register
    from gfnn_jax.maps.stroboscopic import stroboscopic
    from gfnn_jax.maps.symplectic_map import SymplecticMap
    from gfnn_jax.models.arms.arm import Arm
    from gfnn_jax.models.model import Fitted, TrainingData
    from gfnn_jax.phase_space import Pairs
    from gfnn_jax.scenes import Scene
    from gfnn_jax.scenes.draws import sample_pairs, sample_states, sample_test_states
    from gfnn_jax.scenes.trajectories import reference_trajectories

    __version__: str

_MODULES = {
    "figures": "evaluate.figures",
    "metrics": "evaluate.metrics",
    "records": "records",
    "scenes": "scenes",
}
_HOMES = {
    "Arm": "models.arms.arm",
    "Bracket": "brackets",
    "CHARTS": "generating.charts",
    "Chart": "generating.charts",
    "Fit": "learn.fitted",
    "FitError": "errors",
    "FitOptions": "learn.options",
    "FitWarning": "errors",
    "GeneratingFunction": "learn.options",
    "Hamiltonian": "learn.options",
    "Fitted": "models.model",
    "InputError": "errors",
    "Lagrangian": "learn.options",
    "Monitors": "learn.monitors",
    "Pairs": "phase_space",
    "Recording": "data.recording",
    "Scene": "scenes",
    "SymplecticMap": "maps.symplectic_map",
    "TrainingData": "models.model",
    "WorkError": "errors",
    "between": "learn.options",
    "discover": "evaluate.discover",
    "enable_compile_cache": "compiling",
    "export": "exports.export",
    "fit": "learn.fit",
    "fit_monitors": "learn.monitors",
    "from_function": "families",
    "load": "learn.saved",
    "read": "data.recording",
    "reference_trajectories": "scenes.trajectories",
    "register": "maps.saved",
    "register_function": "families.functions",
    "sample_pairs": "scenes.draws",
    "sample_states": "scenes.draws",
    "sample_test_states": "scenes.draws",
    "stroboscopic": "maps.stroboscopic",
}

__all__ = [
    "CHARTS",
    "Arm",
    "Bracket",
    "Chart",
    "Fit",
    "FitError",
    "FitOptions",
    "FitWarning",
    "Fitted",
    "GeneratingFunction",
    "Hamiltonian",
    "InputError",
    "Lagrangian",
    "Monitors",
    "Pairs",
    "Recording",
    "Scene",
    "SymplecticMap",
    "TrainingData",
    "WorkError",
    "between",
    "discover",
    "enable_compile_cache",
    "export",
    "figures",
    "fit",
    "fit_monitors",
    "from_function",
    "load",
    "metrics",
    "read",
    "records",
    "reference_trajectories",
    "register",
    "register_function",
    "sample_pairs",
    "sample_states",
    "sample_test_states",
    "scenes",
    "stroboscopic",
]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        value = importlib.import_module(f"gfnn_jax.{_MODULES[name]}")
    elif name in _HOMES:
        value = getattr(importlib.import_module(f"gfnn_jax.{_HOMES[name]}"), name)
    elif name == "__version__":
        from importlib.metadata import version

        value = version("gfnn_jax")
    else:
        raise AttributeError(f"module 'gfnn_jax' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
