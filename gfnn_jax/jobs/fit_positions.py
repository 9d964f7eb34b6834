"""Job of ``gfnn fit RECORDING --learn map``: positions in, a model folder with its report out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gfnn_jax.data.recording import read
from gfnn_jax.data.recording_summary import refuse_mistakes
from gfnn_jax.jobs.progress import SILENT, Progress
from gfnn_jax.jobs.search import failures_of_arithmetic, line, refusals
from gfnn_jax.jobs.units import units_of
from gfnn_jax.jobs.written import Ran, write
from gfnn_jax.learn.fit import fit as learn_fit
from gfnn_jax.learn.options import FitOptions
from gfnn_jax.storage.outputs import atomic_folder


def fit_positions(
    data: Sequence[Path],
    *,
    out: Path,
    columns: dict[str, Any],
    despite: Sequence[str] = (),
    progress: Progress = SILENT,
    **options: Any,
) -> Ran:
    """Learn the map of recordings of positions, and write it with its report into the folder out.

    columns: keywords of `gfnn_jax.read`. despite: kinds of mistakes that the files may show.
    options: `FitOptions`. Raises InputError where `gfnn look` finds a mistake.
    """
    with refusals():
        asked = FitOptions(**{**options, "learn": "map"})
    recording = read(list(data), **columns)
    refuse_mistakes(recording, despite)
    with refusals(), failures_of_arithmetic():
        fitted = learn_fit(
            recording,
            options=asked,
            on_progress=progress.status,
            on_candidate=lambda candidate: progress.line(line(candidate)),
        )
    progress.status("the report: the derivative of a step")
    fitted = fitted.settled()
    result = fitted.report(
        seed=asked.seed, data={"source": recording.source, "positions": list(recording.positions)}
    )
    job = {
        "command": "fit",
        "data": recording.source,
        "positions": list(recording.positions),
        **asked.deciding,
        "angles": list(recording.angles),
        **units_of(recording),
    }
    with atomic_folder(out) as folder:
        write(folder, folder, fitted, result, job)
    return Ran(fitted, out, result)
