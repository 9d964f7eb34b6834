"""Job of ``gfnn FILE`` and ``gfnn run RECORD``: the law of the first two thirds of a recording,
forecasts of its last third, which no fit sees, and the report of both as one page."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from gfnn_jax.data.proposed import as_proposed
from gfnn_jax.data.recording import SECONDS, Recording
from gfnn_jax.errors import InputError, WorkError, as_typed
from gfnn_jax.evaluate import report
from gfnn_jax.evaluate.forecasts import Forecasts, end_of_part, forecasts_of
from gfnn_jax.evaluate.report import About
from gfnn_jax.jobs.fit import fit_recording
from gfnn_jax.jobs.output import Output
from gfnn_jax.jobs.output import Ran as Learned
from gfnn_jax.storage.outputs import atomic_folder

FIGURE = "forecasts.png"


class Ran(NamedTuple):
    """A law, where it was written, and its forecasts of the rest, None where that is too short."""

    learned: Learned
    forecasts: Forecasts | None


def run_record(
    data: Path, output: Output, *, columns: Mapping[str, Any], command: str = "", **options: Any
) -> Ran:
    """Write the model, its report, as JSON and as a page, and the figures of law and forecasts into
    the output's folder.

    columns: keywords of `gfnn_jax.read`. command: that was typed. options: `FitOptions`. Raises
    InputError where the file is no recording or shows a mistake, WorkError where no law follows it;
    a page says why.
    """
    output.progress.line(f"reading {data}")
    proposed = as_proposed(data, columns)
    whole, columns, asked = proposed.recording, proposed.reading, proposed.asked
    taken = [f"taken as gfnn look proposes:{as_typed(proposed.new)}"] if proposed.new else []
    taken += proposed.why
    for line in taken:
        output.progress.line(line)
    end = end_of_part(whole)
    stop = end / SECONDS[whole.time_unit]
    about = About(command, tuple(taken))
    with atomic_folder(output.out) as folder:
        try:
            model = Output(folder / "model", progress=output.progress)
            asked |= options
            learned = fit_recording([data], model, columns={**columns, "stop": stop}, **asked)
        except (InputError, WorkError) as error:
            from gfnn_jax.evaluate.page import write_refusal

            refused: InputError | WorkError | None = error
            write_refusal(whole, error, folder, about)
        else:
            refused = None
            ran = _report(learned, whole, end, folder, output, about)
    if refused is not None:
        raise type(refused)(f"{refused} (report: {output.out / report.PAGE})")
    return ran


def _report(
    learned: Learned, whole: Recording, end: float, folder: Path, output: Output, about: About
) -> Ran:
    from gfnn_jax.evaluate.figures_of_recordings import forecasts_figure
    from gfnn_jax.evaluate.figures_style import save  # matplotlib, when the law is on screen
    from gfnn_jax.evaluate.page import write_reports

    fit = dataclasses.replace(learned.fit, data=whole, learned_to=end)
    held_out = fit.held_out
    assert held_out is not None
    output.progress.line("forecasting the last third, which no fit has seen")
    found = None
    try:
        found = forecasts_of(fit, held_out)
        save(forecasts_figure(found, held_out), folder / FIGURE, dpi=110)
    except InputError as error:
        output.progress.line(f"no forecasts: {error}")
    output.progress.line("writing the report")
    write_reports(fit, folder, about, result=learned.report, forecasts=found)
    return Ran(learned._replace(fit=fit), found)
