"""Job of ``gfnn run``: reference data of a scene, fit, rollouts, metrics, figures, report."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np

from gfnn_jax.candidates.candidate import Candidate
from gfnn_jax.dataset.structures import Bodies, structure_of
from gfnn_jax.errors import InputError
from gfnn_jax.evaluate import figures, figures_of_many, metrics
from gfnn_jax.jobs.measure import Measured, measure, plane_of
from gfnn_jax.jobs.progress import SILENT, Progress
from gfnn_jax.jobs.rollouts import NUM_STEPS, NUM_TRAJECTORIES, map_rollouts
from gfnn_jax.jobs.search import refusals, scene_named, search
from gfnn_jax.jobs.written import MODEL, Ran, already_done, pairs_digest, write
from gfnn_jax.learn.fitted import Fit
from gfnn_jax.learn.options import FitOptions
from gfnn_jax.maps.bands import bands
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import Pairs
from gfnn_jax.scenes import Scene
from gfnn_jax.scenes.draws import sample_pairs, sample_params, sample_t0, sample_test_states
from gfnn_jax.scenes.trajectories import reference_trajectories
from gfnn_jax.storage.outputs import atomic_folder
from gfnn_jax.storage.partial import unfinished

# Pairs and options of a network, and those with --quick.
_NETWORK = 6_000, {"tolerance": 1e-6, "max_iterations": 250}
_NETWORK_QUICK = 3_000, {"tolerance": 1e-5, "max_iterations": 60}
# Trajectories and samples of the band in the figure of errors: twice the work of all rollouts.
_BAND_TRAJECTORIES, _BAND_SAMPLES = 10, 20
QUICK_PAIRS, QUICK_TRAJECTORIES, QUICK_TOLERANCE = 4_000, 25, 1e-7


def run(
    name: str,
    *,
    out: Path,
    quick: bool = False,
    dt: float | None = None,
    overwrite: bool = False,
    resume: bool = False,
    progress: Progress = SILENT,
    **options: Any,
) -> Ran | None:
    """Run a scene: reference data, fit, rollouts, metrics, figures, report, into the folder out.

    quick: fewer pairs and rollouts, a tolerance of 1e-7 or larger, no band in the figure of errors.
    resume: returns None where ``out`` holds the result of this same job. options: `FitOptions`;
    without a tolerance the scene's own, close to the best attainable.
    """
    scene = scene_named(name, dt)
    num_pairs, usual = scene.num_pairs, {"tolerance": scene.tolerance}
    if options.get("family") == "mlp":
        num_pairs, usual = _NETWORK_QUICK if quick else _NETWORK
    elif quick:
        num_pairs = min(num_pairs, QUICK_PAIRS)
        usual = {"tolerance": max(scene.tolerance, QUICK_TOLERANCE)}
    with refusals():
        asked = FitOptions(**{**usual, **options})
    if asked.family == "features" and scene.features is None:
        raise InputError(
            f"family 'features' needs features, and the scene {name} declares none: choose another "
            "family"
        )
    num_trajectories = QUICK_TRAJECTORIES if quick else NUM_TRAJECTORIES
    job = {
        "command": "run",
        "scene": name,
        "dt": scene.dt,
        "num_pairs": num_pairs,
        "quick": quick,
        **asked.deciding,
    }
    if already_done(out / MODEL, job, resume):
        return None

    with unfinished(out, job, what="run", overwrite=overwrite, resume=resume) as kept_in:
        progress.status(f"reference data: {num_pairs} pairs, {num_trajectories} trajectories")
        key_pairs, key_test = _keys(asked.seed)
        pairs = _finite(sample_pairs(scene, num_pairs, key_pairs))
        z0 = np.asarray(sample_test_states(scene, num_trajectories, key_test))
        given: dict[str, Any] = {
            "params": sample_params(scene, num_trajectories, key_test, test=True),
            "t0": sample_t0(scene, num_trajectories, key_test),
        }
        fitted = search(pairs, scene, asked, progress=progress, kept_in=kept_in, job=job).settled()
        progress.status(f"reference trajectories of {NUM_STEPS} steps")
        reference = np.asarray(reference_trajectories(scene, z0, NUM_STEPS, **given))
        progress.status(f"rollouts of {NUM_STEPS} steps")
        rollouts = map_rollouts(fitted.map, z0, **given)
        measured = measure(rollouts, scene, reference, given["params"])
        result = fitted.report(
            seed=asked.seed,
            scene=name,
            rollout=measured.report,
            data={"source": "reference data of the scene", "digest": pairs_digest(pairs)},
        )
        progress.status("figures")
        with atomic_folder(out) as folder:
            write(folder, folder / MODEL, fitted, result, job)
            # Samples are stepped by a program of their own, which takes as long to compile.
            band = None if quick else _band(fitted.map, z0, measured.predicted, given)
            for file, figure in _figures(fitted, scene, measured, reference, band).items():
                figures.save(figure, folder / f"{file}.png")
    return Ran(fitted, out, result)


@jax.jit
def _keys(seed):
    """Keys of the pairs and of the test states."""
    of_pairs, of_test = jax.random.split(jax.random.key(seed))
    return of_pairs, of_test


def _finite(pairs: Pairs) -> Pairs:
    """Convert pairs to NumPy, without states that collide and have no image."""
    z0, z1 = np.asarray(pairs.z0), np.asarray(pairs.z1)
    known = np.isfinite(z1).all(axis=1)
    return dataclasses.replace(pairs, z0=z0, z1=z1).take(known)


def _band(map_: SymplecticMap, z0, predicted, given: dict[str, Any]) -> np.ndarray | None:
    """Two standard deviations (B, L) of the position of the first trajectories.

    None where the map has no posterior.
    """
    if map_.posterior is None:
        return None
    few = slice(_BAND_TRAJECTORIES)
    own: dict[str, Any] = {
        name: None if values is None else values[few] for name, values in given.items()
    }
    samples = map_.sample(jax.random.key(0), _BAND_SAMPLES)
    drawn, _ = samples.rollout(z0[few], predicted.shape[1] - 1, **own)
    std = bands(drawn, predicted[few], map_.angles_of_z).std
    return 2 * np.linalg.norm(std[..., : map_.dim], axis=-1)


def _figures(fit: Fit, scene: Scene, measured: Measured, reference, band=None) -> dict[str, Any]:
    """Draw the scene's figures, by file name. band: that of the error (B, L)."""
    steps, predicted = measured.steps, measured.predicted
    band = None if band is None else (steps, band)
    drawn = {"error": figures.error_growth({"GFNN": (steps, measured.error)}, band=band)}
    if measured.energy_error is not None:
        drawn["energy"] = figures.energy_error({"GFNN": (steps, measured.energy_error)})
    shown = [c for c in fit.candidates if np.isfinite(c.validation_relative)]
    if fit.chosen in shown:
        drawn["candidates"] = figures.speed_against_error(
            [c.operations / 1e3 for c in shown],
            [c.validation_relative for c in shown],
            [_labelled(c) for c in shown],
            shown.index(fit.chosen),
            fit.tolerance,
            estimated=[i for i, c in enumerate(shown) if not c.validated],
        )
    if scene.name == "two-body":
        errors = [
            metrics.absolute_error(element(predicted), element(reference))
            for element in metrics.ELEMENTS.values()
        ]
        drawn["elements"] = figures.element_errors({"GFNN": (steps, *errors)})[0]
    if scene.name.startswith("henon-heiles") and scene.dim == 2:
        sections = {
            name: np.concatenate([metrics.section_crossings(z, index=0) for z in trajectories])
            for name, trajectories in (("reference", reference), ("GFNN", predicted))
        }
        drawn["section"] = figures.sections({n: (z[:, 1], z[:, 3]) for n, z in sections.items()})[0]
    drawn_of_many = _figures_of_many(scene, steps, reference, predicted)
    if drawn_of_many:
        return {name: ax.figure for name, ax in drawn.items()} | drawn_of_many
    if scene.dim == 1:
        both = {"reference": reference, "GFNN": predicted}
        drawn["portrait"] = figures.sections(
            {n: (z[..., 0], z[..., 1]) for n, z in both.items()}, *plane_of(scene)
        )[0]
    else:
        lane = int(np.argmax(np.isfinite(reference).all(axis=(1, 2))))
        drawn["portrait"] = figures.phase_portrait(
            {
                n: (z[lane, :, 0], z[lane, :, 1])
                for n, z in (("reference", reference), ("GFNN", predicted))
            },
            ("$q_1$", "$q_2$"),
        )
    return {name: ax.figure for name, ax in drawn.items()}


def _figures_of_many(scene: Scene, steps, reference, predicted) -> dict[str, Any]:
    """Draw the figures of the scene's structure, of the first trajectory finite in both."""
    structure = structure_of(scene.structure, scene.dim, scene.coordinates)
    if structure is None:
        return {}
    whole = np.isfinite(reference).all(axis=(1, 2)) & np.isfinite(predicted).all(axis=(1, 2))
    lane = int(np.argmax(whole))
    drawn = scene.dt * np.asarray(steps), reference[lane], predicted[lane]
    if isinstance(structure, Bodies):
        return {"orbits": figures_of_many.orbits(*drawn, structure.count)}
    found = {"space-time": figures_of_many.space_time(*drawn, structure.angles)}
    if not structure.angles and structure.fields == 1:
        found["modes"] = figures_of_many.modes(*drawn, structure.kind)
    return found


def _labelled(candidate: Candidate) -> str:
    """Label of a candidate: chart, family and size, and the time of a step where measured."""
    microseconds = candidate.microseconds_per_step
    timed = f", {microseconds:.1f} µs" if microseconds is not None else ""
    return f"{candidate.chart} {candidate.label}{timed}"
