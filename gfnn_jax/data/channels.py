"""Columns of a recording side by side, with their noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gfnn_jax.data.recording import Recording


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
