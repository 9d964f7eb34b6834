"""Job of ``gfnn fit RECORDING``: a recording in, a model folder with its report out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from gfnn_jax.data.recording import read
from gfnn_jax.data.recording_summary import refuse_mistakes
from gfnn_jax.evaluate import report
from gfnn_jax.evaluate.figures_of_laws import law_figure
from gfnn_jax.jobs.progress import SILENT, Progress
from gfnn_jax.jobs.search import failures_of_arithmetic, refusals
from gfnn_jax.jobs.units import units_of
from gfnn_jax.jobs.written import REPORT
from gfnn_jax.learn.fit import fit as learn_fit
from gfnn_jax.learn.fitted import Fit
from gfnn_jax.learn.options import FitOptions
from gfnn_jax.learn.saved import save
from gfnn_jax.storage.outputs import atomic_folder

FIGURE = "law.png"


class Learned(NamedTuple):
    """A law, where it was written, and its report."""

    fit: Fit
    out: Path
    report: dict[str, Any]


def fit_recording(
    data: Sequence[Path],
    *,
    out: Path,
    columns: dict[str, Any],
    despite: Sequence[str] = (),
    progress: Progress = SILENT,
    **options: Any,
) -> Learned:
    """Learn the law of recordings (files), and write it with its report into the folder ``out``.

    columns: keywords of `gfnn_jax.read`. despite: kinds of mistakes that the files may show.
    options: `FitOptions`. Raises InputError where `gfnn look` finds a mistake, or no law follows
    the recording; WorkError where the arithmetic fails.
    """
    with refusals():
        asked = FitOptions(**options)
    recording = read(list(data), **columns)
    refuse_mistakes(recording, despite)
    with refusals(), failures_of_arithmetic():
        fitted = learn_fit(recording, options=asked, on_progress=progress.line)
    result = fitted.report(source=recording.source, seed=asked.seed)
    job = {
        "command": "fit",
        "data": recording.source,
        **asked.deciding,
        **units_of(recording),
    }
    with atomic_folder(out) as folder:
        save(fitted, folder, record={"job": job, **result})
        law_figure(fitted, recording, folder / FIGURE)
        (folder / REPORT).write_text(report.to_json(result), encoding="utf-8")
    return Learned(fitted, out, result)
