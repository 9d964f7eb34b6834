"""Job of ``gfnn compare``: the same data through all methods, with the same measures.

A finished method is kept in ``OUT.partial`` until all are done, so that an interrupted comparison
resumes with the next one.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.baselines import METHODS
from gfnn_jax.errors import InputError, WorkError
from gfnn_jax.evaluate import figures, metrics, report
from gfnn_jax.jobs.figures import BINS, divergences, figures_of_comparison
from gfnn_jax.jobs.measure import Rollouts, measure, without_runaways
from gfnn_jax.jobs.methods import OURS, PAPER_GFNN, TITLES, SharedData, learn_and_roll, separable
from gfnn_jax.jobs.output import Output, pairs_digest, scene_named
from gfnn_jax.maps.saved import versions
from gfnn_jax.scenes import Scene
from gfnn_jax.storage.outputs import atomic_folder, atomic_write, failures_as_work_errors
from gfnn_jax.storage.partial import unfinished

CAP, QUICK_CAP = 60.0, 2.0  # seconds, at the rate below
RATE = 4e10  # counted operations of a training that a quiet core makes in a second, about

__all__ = ["CAP", "OURS", "PAPER_GFNN", "RATE", "TITLES", "compare"]


class Compared(NamedTuple):
    """Folder of a comparison, and its report."""

    out: Path
    report: dict[str, Any]


def compare(
    name: str,
    output: Output,
    *,
    methods: Sequence[str] = (),
    quick: bool = False,
    seed: int = 0,
    cap: float | None = None,
) -> Compared | None:
    """Learn a scene by these methods (with none named, all that apply), into a folder.

    cap: most training of each, in seconds that stand for RATE counted operations, whatever the
    machine; 60 by default, 2 with quick. quick: fewer pairs and test states. A resumed comparison
    keeps the methods that are done, and returns None where the output has them all. Raises
    InputError for a scene or a method that cannot be compared, WorkError where a method fails.
    """
    progress = output.progress
    scene = scene_named(name)
    if scene.parameters:
        raise InputError(f"the scene {name} has parameters, which the other methods do not take")
    if scene.any_phase:
        raise InputError(f"the scene {name} is driven, and the other methods do not take the time")
    cap = (QUICK_CAP if quick else CAP) if cap is None else cap
    chosen = chosen_methods(methods, scene)
    job = {
        "command": "compare",
        "scene": name,
        "seed": seed,
        "quick": quick,
        "cap": cap,
        "version": versions()["gfnn_jax"],
    }
    if output.resume and _already_done(output.out, job, chosen):
        return None
    with unfinished(
        output.out,
        job,
        what="comparison",
        overwrite=output.overwrite,
        resume=output.resume,
    ) as kept_in:
        data = SharedData(scene, seed, quick)
        for method in chosen:
            if _is_finished(kept_in, method):
                continue
            progress.status(f"{TITLES[method]}: data")
            try:
                part, rollouts = learn_and_roll(method, data, cap * RATE, progress)
            except ValueError as error:  # the results of the other methods are kept
                raise WorkError(
                    f"{TITLES[method]}: {error} (leave it out with --methods; --resume keeps the "
                    "others)"
                ) from error
            _keep(kept_in, method, part, rollouts)
            progress.line(
                f"{TITLES[method]}: one-step error {part['fit']['validation_rms']:.2e}, "
                f"{part['fit']['seconds']:.1f} s"
            )
        progress.status("reference, measures and figures")
        reported, measured = {}, {}
        for method in chosen:
            part, rollouts = _kept(kept_in, method)
            rollouts = without_runaways(rollouts, data.reference)
            measured[TITLES[method]] = m = measure(rollouts, scene, data.reference)
            reported[method] = {
                "title": TITLES[method],
                **part,
                "rollout": m.report,
                "curve": _curve(m.error),
                "kl": divergences(scene, m.predicted, data.reference),
                "elements": _elements(scene, m.predicted, data.reference),
            }
        result = {
            "scene": name,
            "dt": scene.dt,
            "seed": seed,
            "dtype": "float64",
            "device": report.device(),
            "versions": versions(),
            "quick": quick,
            "cap": cap,
            "data": {
                "source": "reference data of the scene",
                "num_pairs": data.num_pairs,
                "digest": pairs_digest(data.fresh),
            },
            "kl_bins": BINS,
            "job": job,
            "methods": reported,
        }
        with atomic_folder(output.out) as folder:
            for file, figure in figures_of_comparison(scene, measured, data.reference).items():
                figures.save(figure, folder / f"{file}.png")
            (folder / report.REPORT).write_text(report.to_json(result), encoding="utf-8")
    return Compared(output.out, json.loads(report.to_json(result)))


def chosen_methods(methods: Sequence[str], scene: Scene) -> tuple[str, ...]:
    """Return the methods to compare. Raises InputError for one that is not known."""
    unknown = [m for m in methods if m not in TITLES]
    if unknown:
        raise InputError(f"unknown method '{unknown[0]}'; methods: {', '.join(TITLES)}")
    if methods:
        return tuple(m for m in TITLES if m in methods)
    coupled = not separable(scene)
    return tuple(m for m in TITLES if m not in METHODS or coupled or not METHODS[m].only_coupled)


def _elements(scene: Scene, predicted, reference) -> dict[str, Any] | None:
    """Curves of the errors of semi-major axis and eccentricity; None but for two bodies."""
    if scene.name != "two-body":
        return None
    return {
        name: _curve(metrics.absolute_error(element(predicted), element(reference)))
        for name, element in metrics.ELEMENTS.items()
    }


def _curve(error) -> dict[str, Any]:
    """Statistics of an error (B, L) at about 13 steps a decade."""
    steps = np.unique(np.round(np.geomspace(1, error.shape[1] - 1, 40)).astype(int))
    statistics = metrics.error_statistics(error)
    return {
        "steps": steps.tolist(),
        **{
            name: [float(f"{v:.4e}") for v in getattr(statistics, name)[steps]]
            for name in ("mean", "std", "median")
        },
    }


# Finished methods: a .json and a .npz for each, written whole or not at all.


def _already_done(out: Path, job: dict[str, Any], chosen: Sequence[str]) -> bool:
    """Return whether a resumed comparison had already finished."""
    try:
        found = json.loads((out / report.REPORT).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return found.get("job") == job and set(found.get("methods", ())) == set(chosen)


def _is_finished(folder: Path, method: str) -> bool:
    return (folder / f"{method}.json").exists()


def _keep(folder: Path, method: str, part: dict[str, Any], rollouts: Rollouts) -> None:
    """Keep a finished method. The .json is written last: where it exists, the .npz is whole."""
    with failures_as_work_errors(folder):
        np.savez(folder / f"{method}.npz", **rollouts._asdict())
    atomic_write(folder / f"{method}.json", report.to_json(part))


def _kept(folder: Path, method: str) -> tuple[dict[str, Any], Rollouts]:
    """Load what `_keep` has written."""
    part = json.loads((folder / f"{method}.json").read_text(encoding="utf-8"))
    with np.load(folder / f"{method}.npz", allow_pickle=False) as arrays:
        return part, Rollouts(arrays["states"], arrays["status"], float(arrays["seconds"]))
