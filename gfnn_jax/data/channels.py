"""Columns of a recording side by side, with their noise; parameters that its runs differ in."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gfnn_jax.data.recording import Recording
from gfnn_jax.errors import InputError


def channels_of(
    recording: Recording, names: Sequence[str], run: str
) -> tuple[np.ndarray, np.ndarray]:
    """(n, k) values of columns in a run, angles lifted, and their noise ÷ that of their column: 1
    where σ was not given for each value. A column that is not there is NaN."""
    y = np.full((len(recording.times(run)), len(names)), np.nan)
    noise = np.ones(y.shape)
    for k, name in enumerate(names):
        if name not in recording.columns:
            continue
        y[:, k] = recording.unwrapped(name, run)
        sigma, usual = recording.sigma(name, run), recording.std[name]
        if sigma is not None and usual:
            noise[:, k] = np.where(np.isfinite(sigma), sigma / usual, 1.0)
    return y, noise


def parameters_of(recording: Recording) -> tuple[str, ...]:
    """Parameters that differ between the runs. Raises InputError where one is no number of each
    run."""
    found = []
    for name in recording.parameters:
        columns = [recording.values(name, run) for run in recording.runs]
        for run, column in zip(recording.runs, columns, strict=True):
            if not (np.isfinite(column).all() and np.ptp(column) == 0):
                raise InputError(
                    f"{recording.source}: parameter {name} is not one number in run {run}. Name "
                    "what changes within a run an input: --inputs (inputs=)"
                )
        if len({float(column[0]) for column in columns}) > 1:
            found.append(name)
    return tuple(found)


def args_of(recording: Recording, run: str, names: Sequence[str]) -> np.ndarray:
    """(k,) these parameters of a run."""
    return np.array([recording.values(name, run)[0] for name in names])
