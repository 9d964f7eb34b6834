"""Job of ``gfnn look``: a recording read, summed up, drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gfnn_jax.data.columns import Undecided
from gfnn_jax.data.faults import Fault
from gfnn_jax.data.files import are_recordings, read_trajectories
from gfnn_jax.data.recording import Recording, read
from gfnn_jax.data.recording_summary import RecordingSummary, summarise
from gfnn_jax.errors import InputError


def look(
    paths: Sequence[Path], options: Mapping[str, Any], figure: Path | None = None
) -> RecordingSummary:
    """The summary of files, and their figure where a path for it is given.

    options: keywords of `gfnn_jax.read`, and ``mass``, which only goes into the command to type.
    """
    reading = {name: value for name, value in options.items() if name != "mass"}
    try:
        recording = _of_states(paths, reading) if _hold_states(paths) else read(paths, **reading)
        summary = summarise(recording, options)
    except Undecided as error:
        recording, summary = _proposed(paths, options, reading, error)
    if figure is not None:
        from gfnn_jax.evaluate.figures_of_recordings import recording_figure
        from gfnn_jax.evaluate.figures_style import save

        figure.parent.mkdir(parents=True, exist_ok=True)
        save(recording_figure(recording, summary), figure, dpi=110)
    return summary


def _proposed(
    paths: Sequence[Path], options: Mapping[str, Any], reading: dict[str, Any], error: Undecided
) -> tuple[Recording, RecordingSummary]:
    """A recording read by the roles that are proposed, and its summary with the proposal first."""
    told = error.options
    of_fit = {name: told[name] for name in ("structure", "states") if name in told}
    roles = {name: value for name, value in told.items() if name not in of_fit}
    recording = read(paths, **{**reading, **(roles or {"positions": told.get("states", ())})})
    message = str(error).removeprefix(f"{recording.source}: ")
    fault = Fault("roles", message, "", of_fit, wrong=False, proposed=True)
    return recording, summarise(recording, {**options, **roles}, [fault])


def _hold_states(paths: Sequence[Path]) -> bool:
    """Return whether the files are arrays of canonical states (q, p)."""
    is_array = all(path.suffix.lower() in (".npz", ".npy") for path in paths)
    return is_array and not are_recordings(paths)


def _of_states(paths: Sequence[Path], options: Mapping[str, Any]) -> Recording:
    """The recording of one array file of trajectories, a run each."""
    if len(paths) > 1 or set(options) - {"dt"}:
        raise InputError(
            f"{paths[0]}: holds states q, p in an array: look at one such file, without options "
            "about columns"
        )
    data = read_trajectories(paths[0], dt=options.get("dt"), fewest=1)
    if max(data.lengths) < 3 or np.ndim(data.dt):
        raise InputError(f"{paths[0]}: expected runs of states at one time step, got pairs")
    steps = np.concatenate([np.arange(length) for length in data.lengths])
    columns = {"run": np.repeat(np.arange(len(data.lengths)), data.lengths), "t": data.dt * steps}
    names = [f"{letter}{i + 1}" for letter in "qp" for i in range(data.dim)]
    return Recording(columns | dict(zip(names, data.states.T, strict=True)))
