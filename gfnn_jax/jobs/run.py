"""Job of ``gfnn run``: reference data of a scene, fit, rollouts, metrics, figures, report."""

import dataclasses
from typing import Any

import jax
import numpy as np

from gfnn_jax.errors import InputError
from gfnn_jax.evaluate import figures
from gfnn_jax.evaluate.page import About, write_page
from gfnn_jax.evaluate.report import PAGE
from gfnn_jax.jobs.figures import figures_of_run
from gfnn_jax.jobs.measure import (
    NUM_STEPS,
    NUM_TRAJECTORIES,
    affine_errors,
    finite_pairs,
    map_rollouts,
    measure,
)
from gfnn_jax.jobs.output import (
    MODEL,
    Output,
    Ran,
    pairs_digest,
    refusals,
    scene_named,
    search,
    write,
)
from gfnn_jax.learn.options import FitOptions
from gfnn_jax.maps.posterior import bands
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.scenes import Scene
from gfnn_jax.scenes.draws import sample_params, sample_t0, sample_test_states
from gfnn_jax.scenes.trajectories import reference_trajectories
from gfnn_jax.storage.outputs import atomic_folder


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Sizes of a run: pairs, options of a network, trajectories of the rollouts; None: the scene's.

    tolerance: the least one. band_trajectories, band_samples: of the band in the figure of errors,
    twice the work of all rollouts; 0 for no band.
    """

    pairs: int | None = None
    tolerance: float = 0.0
    trajectories: int = NUM_TRAJECTORIES
    network_pairs: int = 6_000
    network_tolerance: float = 1e-6
    network_iterations: int = 250
    band_trajectories: int = 10
    band_samples: int = 20

    def of(self, scene: Scene) -> tuple[int, float]:
        """(pairs, tolerance) of a scene."""
        few = scene.num_pairs if self.pairs is None else min(scene.num_pairs, self.pairs)
        return few, max(scene.tolerance, self.tolerance)


WHOLE = Sizes()
QUICK = Sizes(4_000, 1e-6, 25, 3_000, 1e-5, 60, 0, 0)


def run(
    name: str, output: Output, *, quick: bool = False, dt: float | None = None, **options: Any
) -> Ran | None:
    """Run a scene: reference data, fit, rollouts, metrics, figures, report, into a folder.

    quick: fewer pairs and rollouts, a tolerance of 1e-6 or larger, no band in the figure of errors.
    options: `FitOptions`; without a tolerance the scene's own, close to the best attainable.
    Returns None where the output holds the result of this same job.
    """
    progress = output.progress
    scene = scene_named(name, dt)
    sizes, usual = QUICK if quick else WHOLE, {}
    num_pairs, usual["tolerance"] = sizes.of(scene)
    if options.get("family") == "mlp":
        num_pairs, usual["tolerance"] = sizes.network_pairs, sizes.network_tolerance
        usual["max_iterations"] = sizes.network_iterations
    with refusals():
        asked = FitOptions(**{**usual, **options})
    if asked.family == "features" and scene.features is None:
        raise InputError(f"family 'features': the scene {name} declares none, take another family")
    num_trajectories = sizes.trajectories
    job = {"command": "run", "scene": name, "dt": scene.dt, "num_pairs": num_pairs, "quick": quick}
    job |= asked.deciding
    if output.holds(job, MODEL):
        return None
    with output.unfinished(job) as kept_in:
        progress.status(f"reference data: {num_pairs} pairs, {num_trajectories} trajectories")
        key_pairs, key_test = _keys(asked.seed)
        pairs = finite_pairs(scene, num_pairs, key_pairs)
        z0 = np.asarray(sample_test_states(scene, num_trajectories, key_test))
        given: dict[str, Any] = {"t0": sample_t0(scene, num_trajectories, key_test)}
        given["params"] = sample_params(scene, num_trajectories, key_test, test=True)
        fitted = search(pairs, scene, asked, progress=progress, kept=(kept_in, job)).settled()
        progress.status(f"reference trajectories of {NUM_STEPS} steps")
        reference = np.asarray(reference_trajectories(scene, z0, NUM_STEPS, **given))
        progress.status(f"rollouts of {NUM_STEPS} steps")
        rollouts = map_rollouts(fitted.map, z0, **given)
        measured = measure(rollouts, scene, reference, given["params"])
        origin = {"source": "reference data of the scene", "digest": pairs_digest(pairs)}
        result = fitted.report(rollout=measured.report, data=origin)
        progress.status("figures")
        with atomic_folder(output.out) as folder:
            write(folder, folder / MODEL, fitted, result, job)
            about = About(f"gfnn run {name}{' --quick' * quick}")
            write_page(fitted, folder / PAGE, about=about)
            # Samples are stepped by a program of their own, which takes as long to compile.
            band = None if quick else _band(fitted.map, z0, measured.predicted, given)
            varied = scene.parameters or scene.any_phase
            affine = None if varied else affine_errors(pairs, scene, reference)
            drawn = figures_of_run(fitted, scene, measured, reference, band, affine)
            for file, figure in drawn.items():
                figures.save(figure, folder / f"{file}.png")
    return Ran(fitted, output.out, result)


@jax.jit
def _keys(seed):
    of_pairs, of_test = jax.random.split(jax.random.key(seed))
    return of_pairs, of_test


def _band(map_: SymplecticMap, z0, predicted, given: dict[str, Any]) -> np.ndarray | None:
    """Two standard deviations (B, L) of the position of the first trajectories.

    None where the map has no posterior."""
    if map_.posterior is None:
        return None
    few = slice(WHOLE.band_trajectories)
    own: dict[str, Any] = {n: None if x is None else x[few] for n, x in given.items()}
    samples = map_.sample(jax.random.key(0), WHOLE.band_samples)
    drawn, _ = samples.rollout(z0[few], predicted.shape[1] - 1, **own)
    std = bands(drawn, predicted[few], map_.angles_of_z).std
    return 2 * np.linalg.norm(std[..., : map_.dim], axis=-1)
