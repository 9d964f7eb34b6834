"""What ``gfnn fit`` does: a trajectory file in, a model folder with its report out."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gfnn_jax.data.files import iterate_pairs, read_sample, read_trajectories
from gfnn_jax.data.summary import summary
from gfnn_jax.evaluate import report
from gfnn_jax.jobs.progress import SILENT, Progress
from gfnn_jax.jobs.search import BEST, failures_of_arithmetic, scene_named, search
from gfnn_jax.jobs.written import Ran, already_done, publish, write
from gfnn_jax.learn.check import FEWEST
from gfnn_jax.learn.refit import refit
from gfnn_jax.storage.outputs import atomic_folder
from gfnn_jax.storage.partial import unfinished

# A larger file is never in memory whole: candidates are chosen on a sample of its pairs, and the
# chosen one is fitted to all of them chunk by chunk.
_LARGE_BYTES, _FIT_CHUNK, _HELD = 2**29, 50_000, 2_000


def fit(
    data: Path,
    *,
    out: Path,
    dt: float | None = None,
    tolerance: float = 1e-6,
    absolute_tolerance: float | None = None,
    max_seconds: float = 120.0,
    chart: str = "auto",
    learn: str = "auto",
    terms: tuple[str, ...] = (),
    base: str | None = None,
    structure: str | None = None,
    family: str = "auto",
    scene_name: str | None = None,
    angles: tuple[int, ...] = (),
    seed: int = 0,
    overwrite: bool = False,
    resume: bool = False,
    progress: Progress = SILENT,
) -> Ran | None:
    """Learn the map of a trajectory file, and write it with its report into the model folder out.

    scene_name: lends its coordinates and features. resume: None where ``out`` is this very job,
    done. The other options are those of ``gfnn.fit``.
    """
    scene = scene_named(scene_name) if scene_name is not None else None
    large = data.is_file() and data.stat().st_size > _LARGE_BYTES
    structured = structure is not None or (scene is not None and scene.structure is not None)
    fewest = FEWEST if structured else None
    trajectories = (
        read_sample(data, dt=dt) if large else read_trajectories(data, dt=dt, fewest=fewest)
    )
    for line in summary(trajectories):
        progress.tell(line)
    options = {
        "tolerance": tolerance, "absolute_tolerance": absolute_tolerance, "chart": chart,
        "learn": learn, "terms": list(terms), "base": base, "structure": structure,
        "family": family, "seed": seed,
    }  # fmt: skip
    job = {
        "command": "fit", "data": trajectories.digest,
        "dt": None if np.ndim(trajectories.dt) else trajectories.dt, "scene": scene_name,
        "angles": list(angles), **options,
    }  # fmt: skip
    if already_done(out, job, resume):
        return None
    with unfinished(out, job, what="fit", overwrite=overwrite, resume=resume) as kept_in:
        try:
            fitted = search(
                trajectories.pairs(), scene, angles=angles, max_seconds=max_seconds,
                progress=progress, kept_in=kept_in, job=job, **options,
            )  # fmt: skip
            linear = family != "mlp" and fitted.chosen.learns == "map"
            if large and linear and fitted.map.parameters is None:
                progress.say("all pairs of the file, for the chosen candidate")
                held = trajectories.pairs().take(slice(_HELD))
                with failures_of_arithmetic():
                    fitted = refit(fitted, iterate_pairs(data, _FIT_CHUNK, dt=dt), held)
            progress.say("the report: compiling the derivative of a step")
            result = report.assemble(
                fitted, scene=scene_name, dt=float(np.asarray(fitted.map.dt)), seed=seed,
                rollout=None,
                data={
                    "source": trajectories.source,
                    "digest": trajectories.digest,
                    "precision": trajectories.precision,
                    "units": trajectories.units,
                    "dt": _range(trajectories.dt),
                    "params": {n: _range(v) for n, v in (trajectories.args or {}).items()},
                },
            )  # fmt: skip
        except KeyboardInterrupt as stop:
            if told := publish(kept_in / BEST, out):
                stop.add_note(told)
            raise
        with atomic_folder(out) as folder:
            write(folder, folder, fitted, result, job)
    return Ran(fitted, out, result)


def _range(values) -> list[float]:
    """The smallest and the largest."""
    return [float(np.min(values)), float(np.max(values))]
