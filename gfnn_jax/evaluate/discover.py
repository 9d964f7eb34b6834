"""``gfnn.discover``: from data to a report in one call."""

import dataclasses
import warnings
from pathlib import Path
from typing import Any

from gfnn_jax.data.recording import ReadOptions, Recording
from gfnn_jax.errors import FitError, FitWarning, InputError
from gfnn_jax.evaluate.forecasts import end_of_part
from gfnn_jax.evaluate.page import About, write_refusal, write_reports
from gfnn_jax.learn.fit import as_pairs_or_recording, fit, said_of
from gfnn_jax.learn.fitted import Fit


def discover(data: Any, out: str | Path | None = None, **options: Any) -> Fit:
    """Learn from the first two thirds of a recording, and with ``out`` forecast the rest and write
    the report. Pairs of states are learned from as a whole.

    data: as of `gfnn.fit`: a file, a table, arrays (t, x), a `Recording`, `Pairs`. Files and tables
    are read as `gfnn look` proposes, with a warning that says how. out: a folder for
    ``report.html``, one page, and ``report.json``; those of an earlier call are replaced. Without
    it nothing is written. options: keywords of `gfnn.read` and of `gfnn.fit`.

    Raises FitError where no law follows the recording, and InputError where the data cannot be
    used; the report is written all the same where the data could be read, and says why.

        fit = gfnn.discover("swing.csv", out="swing")   # and open swing/report.html
    """
    reading = {name: options.pop(name) for name in ReadOptions.__annotations__ if name in options}
    data, proposed = as_pairs_or_recording(data, reading=reading)
    about = About()
    if proposed is not None:
        options = {**proposed.asked, **options}
        about = About(notes=said_of(proposed))
        for line in about.notes:
            warnings.warn(line, FitWarning, stacklevel=2)
    if not isinstance(data, Recording):
        found = fit(data, **options)
    else:
        end = end_of_part(data)
        try:
            found = fit(data.slice(stop=end), **options)
        except (FitError, InputError) as error:
            if out is not None:
                write_refusal(data, error, Path(out), about)
            raise
        found = dataclasses.replace(found, data=data, learned_to=end)
    if out is not None:
        write_reports(found, Path(out), about)
    return found
