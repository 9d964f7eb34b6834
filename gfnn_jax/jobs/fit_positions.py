"""Job of ``gfnn fit RECORDING --learn map``: positions in, a model folder with its report out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gfnn_jax.data.recording import read
from gfnn_jax.data.recording_summary import refuse_mistakes
from gfnn_jax.errors import FitError, InputError
from gfnn_jax.evaluate import report
from gfnn_jax.jobs.progress import SILENT, Progress
from gfnn_jax.jobs.search import failures_of_arithmetic, line
from gfnn_jax.jobs.written import Ran, write
from gfnn_jax.learn.fit import fit_positions as learn_positions
from gfnn_jax.storage.outputs import atomic_folder


def fit_positions(
    data: Sequence[Path], *, out: Path, columns: dict[str, Any], seed: int = 0,
    despite: Sequence[str] = (), progress: Progress = SILENT, **options: Any,
) -> Ran:  # fmt: skip
    """Learn the map of recordings of positions, and write it with its report into the folder out.

    columns: keywords of `gfnn_jax.read`. despite: kinds of mistakes that the files may show.
    options: those of `learn.fit.fit_positions`. Raises InputError where `gfnn look` finds a
    mistake.
    """
    recording = read(list(data), **columns)
    refuse_mistakes(recording, despite)
    try:
        with failures_of_arithmetic():
            fitted = learn_positions(
                recording, seed=seed, on_progress=progress.say,
                on_candidate=lambda candidate: progress.tell(line(candidate)), **options,
            )  # fmt: skip
    except FitError as error:
        raise InputError(str(error)) from error
    progress.say("the report: the derivative of a step")
    fitted = fitted.settled()
    result = report.assemble(
        fitted, scene=None, dt=float(np.asarray(fitted.map.dt)), seed=seed, rollout=None,
        data={"source": recording.source, "positions": list(recording.positions)},
    )  # fmt: skip
    job = {
        "command": "fit", "data": recording.source, "positions": list(recording.positions),
        "angles": list(recording.angles), "seed": seed,
    }  # fmt: skip
    with atomic_folder(out) as folder:
        write(folder, folder, fitted, result, job)
    return Ran(fitted, out, result)
