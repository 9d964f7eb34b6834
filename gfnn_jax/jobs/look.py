"""Job of ``gfnn look``: a recording read, summed up, drawn."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gfnn_jax.data.files import are_recordings, read_trajectories
from gfnn_jax.data.proposed import summarised
from gfnn_jax.data.recording import Recording
from gfnn_jax.data.recording_summary import RecordingSummary, summarise
from gfnn_jax.errors import InputError
from gfnn_jax.families.expressions import coordinate_names


def look(
    paths: Sequence[Path], options: Mapping[str, Any], figure: Path | None = None
) -> RecordingSummary:
    """The summary of files, and their figure where a path for it is given.

    options: keywords of `gfnn_jax.read`, and ``mass``, which only goes into the command to type.
    """
    is_array = all(path.suffix.lower() in (".npz", ".npy") for path in paths)
    if is_array and not are_recordings(paths):  # of canonical states
        recording = _of_states(paths, {n: value for n, value in options.items() if n != "mass"})
        summary = summarise(recording, options)
    else:
        recording, summary = summarised(list(paths), options)
    if figure is not None:
        from gfnn_jax.evaluate.figures_of_recordings import recording_figure
        from gfnn_jax.evaluate.figures_style import save

        figure.parent.mkdir(parents=True, exist_ok=True)
        save(recording_figure(recording, summary), figure, dpi=110)
    return summary


def _of_states(paths: Sequence[Path], options: Mapping[str, Any]) -> Recording:
    """The recording of one array file of trajectories, a run each."""
    if len(paths) > 1 or set(options) - {"dt"}:
        raise InputError(
            f"{paths[0]}: holds states q, p in an array: look at one such file, without column "
            "options"
        )
    data = read_trajectories(paths[0], dt=options.get("dt"), fewest=1)
    if max(data.lengths) < 3 or np.ndim(data.dt):
        raise InputError(f"{paths[0]}: expected runs of states at one time step, got pairs")
    steps = np.concatenate([np.arange(length) for length in data.lengths])
    columns = {"run": np.repeat(np.arange(len(data.lengths)), data.lengths), "t": data.dt * steps}
    names = coordinate_names(data.dim)
    return Recording(columns | dict(zip(names, data.states.T, strict=True)))
