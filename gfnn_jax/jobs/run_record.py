"""Job of ``gfnn run RECORD``: the law of the first two thirds of a recording, and forecasts of its
last third, which no fit sees."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.data.recording import SECONDS, Recording, read
from gfnn_jax.evaluate import report
from gfnn_jax.evaluate.figures_of_recordings import forecasts_figure
from gfnn_jax.evaluate.forecasts import Forecasts, forecasts_along
from gfnn_jax.jobs.fit import fit_recording
from gfnn_jax.jobs.output import REPORT, Output
from gfnn_jax.jobs.output import Ran as Learned
from gfnn_jax.storage.outputs import atomic_folder

FIGURE = "forecasts.png"
_PART = 2 / 3  # of the record, in time, that is learned from
_PERIODS = (0.25, 1.0, 2.0)  # of the fastest motion, that is forecast ahead, if there are as many


class Ran(NamedTuple):
    """A law, where it was written, its forecasts of the rest, and that part of the recording."""

    learned: Learned
    forecasts: Forecasts
    held_out: Recording


def run_record(data: Path, output: Output, *, columns: Mapping[str, Any], **options: Any) -> Ran:
    """Write the model, its report and the figures of law and forecasts into the output's folder.

    columns: keywords of `gfnn_jax.read`. options: `FitOptions`. Raises InputError where the file is
    no recording, or its last third is too short to forecast.
    """
    whole = read(data, **columns)
    times = np.concatenate([whole.times(run) for run in whole.runs])
    end = float(times.min() + _PART * np.ptp(times))
    stop = end / SECONDS[whole.time_unit]
    with atomic_folder(output.out) as folder:
        learned = fit_recording(
            [data],
            Output(folder / "model", progress=output.progress),
            columns={**columns, "stop": stop},
            **options,
        )
        map_ = learned.fit.map
        assert map_.sensors is not None
        output.progress.line("forecasting the last third, which no fit has seen")
        held_out = whole.slice(start=np.nextafter(end, np.inf))
        half = max(np.ptp(held_out.times(run)) for run in held_out.runs) / 2
        ahead = [periods * 2 * np.pi / map_.sensors.omega for periods in _PERIODS]
        ahead = [seconds for seconds in ahead if seconds < half] or [half]
        found = forecasts_along(map_, held_out, ahead)
        forecasts_figure(found, held_out, folder / FIGURE)
        result = learned.report | {
            "forecasts": {
                "begin": end,
                "num": len(found.each),
                "ahead": list(found.ahead),
                "median": {name: list(of) for name, of in found.median.items()},
                "within_two_deviations": found.within,
            }
        }
        (folder / REPORT).write_text(report.to_json(result), encoding="utf-8")
    return Ran(learned, found, held_out)
