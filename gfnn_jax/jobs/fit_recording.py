"""What ``gfnn fit RECORDING`` does: a recording in, a model folder with its report out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from gfnn_jax.data.recording import read
from gfnn_jax.data.recording_summary import refuse_mistakes
from gfnn_jax.evaluate import law_report, report
from gfnn_jax.jobs.progress import SILENT, Progress
from gfnn_jax.jobs.written import REPORT
from gfnn_jax.learn.fit import fit as learn_fit
from gfnn_jax.maps import saved
from gfnn_jax.models.learned_law import LearnedLaw
from gfnn_jax.storage.outputs import atomic_folder


class Learned(NamedTuple):
    """A law, where it was written, and its report."""

    fit: LearnedLaw
    out: Path
    report: dict[str, Any]


def fit_recording(
    data: Sequence[Path], *, out: Path, columns: dict[str, Any], learn: str = "auto",
    friction: str = "auto", input_hold: str = "auto", mass: dict[str, float] | None = None,
    despite: Sequence[str] = (), seed: int = 0, progress: Progress = SILENT,
) -> Learned:  # fmt: skip
    """Learn the law of recordings (files), and write it with its report into the folder ``out``.

    columns: keywords of `gfnn_jax.read`. despite: kinds of mistakes that the files may show. The
    other options are those of ``gfnn.fit``. Raises InputError where `gfnn look` finds a mistake.
    """
    recording = read(list(data), **columns)
    refuse_mistakes(recording, despite)
    fitted = learn_fit(
        recording, learn=learn, friction=friction, input_hold=input_hold, mass=mass, seed=seed,
        on_progress=progress.tell,
    )  # fmt: skip
    result = law_report.assemble(fitted, source=recording.source, seed=seed)
    kept = ("seed", "device", "data", "fit", "map", "lagrangian", "friction", "gauge")
    job = {
        "command": "fit", "data": recording.source, "friction": friction,
        "degrees": [name for name, factor in recording.factors.items() if factor != 1],
        "time_unit": recording.time_unit,
    }  # fmt: skip
    record = {"job": job, **report.finite({key: result[key] for key in kept})}
    with atomic_folder(out) as folder:
        saved.save(fitted.map, folder, record=record)
        (folder / REPORT).write_text(report.to_json(result), encoding="utf-8")
    return Learned(fitted, out, result)
