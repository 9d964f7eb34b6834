"""Learn exactly symplectic maps from data, and predict with them for millions of steps.

    scene = gfnn.scenes.henon_heiles(energy=1 / 12)
    pairs = gfnn.sample_pairs(scene, num_pairs=4_096, key=jax.random.key(0))
    fit = gfnn.fit(pairs, scene, tolerance=1e-8)
    states, info = fit.map.rollout(z0, num_steps=1_000_000)

Names are loaded when first used, so that importing the package costs nothing.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gfnn_jax import records as records
    from gfnn_jax import scenes as scenes
    from gfnn_jax.brackets import Bracket as Bracket
    from gfnn_jax.compiling import enable_compile_cache as enable_compile_cache
    from gfnn_jax.data.recording import Recording as Recording
    from gfnn_jax.data.recording import read as read
    from gfnn_jax.errors import FitError as FitError
    from gfnn_jax.errors import FitWarning as FitWarning
    from gfnn_jax.errors import InputError as InputError
    from gfnn_jax.errors import WorkError as WorkError
    from gfnn_jax.evaluate import figures as figures
    from gfnn_jax.evaluate import metrics as metrics
    from gfnn_jax.evaluate.discover import discover as discover
    from gfnn_jax.exports.export import export as export
    from gfnn_jax.families import from_function as from_function
    from gfnn_jax.families.functions import register_function as register_function
    from gfnn_jax.generating.charts import CHARTS as CHARTS
    from gfnn_jax.generating.charts import Chart as Chart
    from gfnn_jax.learn.fit import fit as fit
    from gfnn_jax.learn.fitted import Fit as Fit
    from gfnn_jax.learn.monitors import Monitors as Monitors
    from gfnn_jax.learn.monitors import fit_monitors as fit_monitors
    from gfnn_jax.learn.options import FitOptions as FitOptions
    from gfnn_jax.learn.options import GeneratingFunction as GeneratingFunction
    from gfnn_jax.learn.options import Hamiltonian as Hamiltonian
    from gfnn_jax.learn.options import Lagrangian as Lagrangian
    from gfnn_jax.learn.options import between as between
    from gfnn_jax.learn.saved import load as load
    from gfnn_jax.maps.saved import register as register
    from gfnn_jax.maps.stroboscopic import stroboscopic as stroboscopic
    from gfnn_jax.maps.symplectic_map import SymplecticMap as SymplecticMap
    from gfnn_jax.models.arms.arm import Arm as Arm
    from gfnn_jax.models.model import Fitted as Fitted
    from gfnn_jax.models.model import TrainingData as TrainingData
    from gfnn_jax.phase_space import Pairs as Pairs
    from gfnn_jax.scenes import Scene as Scene
    from gfnn_jax.scenes.draws import sample_pairs as sample_pairs
    from gfnn_jax.scenes.draws import sample_states as sample_states
    from gfnn_jax.scenes.draws import sample_test_states as sample_test_states
    from gfnn_jax.scenes.trajectories import reference_trajectories as reference_trajectories

    __version__: str

_MODULES = {
    "figures": "evaluate.figures",
    "metrics": "evaluate.metrics",
    "records": "records",
    "scenes": "scenes",
}
_NAMES = {  # of what each module gives
    "brackets": "Bracket",
    "compiling": "enable_compile_cache",
    "data.recording": "Recording read",
    "errors": "FitError FitWarning InputError WorkError",
    "evaluate.discover": "discover",
    "exports.export": "export",
    "families": "from_function",
    "families.functions": "register_function",
    "generating.charts": "CHARTS Chart",
    "learn.fit": "fit",
    "learn.fitted": "Fit",
    "learn.monitors": "Monitors fit_monitors",
    "learn.options": "FitOptions GeneratingFunction Hamiltonian Lagrangian between",
    "learn.saved": "load",
    "maps.saved": "register",
    "maps.stroboscopic": "stroboscopic",
    "maps.symplectic_map": "SymplecticMap",
    "models.arms.arm": "Arm",
    "models.model": "Fitted TrainingData",
    "phase_space": "Pairs",
    "scenes": "Scene",
    "scenes.draws": "sample_pairs sample_states sample_test_states",
    "scenes.trajectories": "reference_trajectories",
}
_HOMES = {name: home for home, names in _NAMES.items() for name in names.split()}

__all__ = [*_MODULES, *_HOMES]  # pyright: ignore[reportUnsupportedDunderAll]


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
