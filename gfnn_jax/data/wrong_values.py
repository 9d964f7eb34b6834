"""Stretches of a column in which its sensor was stuck, or which lie far from all beside them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from gfnn_jax.signals.roughness import misses, roughness
from gfnn_jax.signals.strays import strays
from gfnn_jax.signals.stuck import stuck


@dataclasses.dataclass(frozen=True)
class WrongValues:
    """A stretch of wrong values of one column.

    run: its number. rows: (k,) samples, the runs one after another. off: how far they are from
    where the samples around them lead; None of a sensor that was stuck.
    """

    run: int
    rows: np.ndarray
    off: float | None


def wrong_values(
    times: Sequence[np.ndarray], runs: Sequence[np.ndarray], resolution: float | None
) -> tuple[WrongValues, ...]:
    """The wrong values of a column (n_r,) of each run, NaN where missing, in the order of time."""
    begins = np.cumsum([0, *map(len, times)])
    known = [np.flatnonzero(np.isfinite(x)) for x in runs]
    series = [(t[k], x[k], b + k) for t, x, k, b in zip(times, runs, known, begins, strict=False)]
    rough, step = roughness([misses(t, x) for t, x, _ in series]), resolution or 0.0
    found = []
    for run, (t, x, rows) in enumerate(series):
        moving = np.ones(len(x), bool)
        for begin, end in stuck(t, x, step, rough):
            moving[begin:end] = False
            found.append(WrongValues(run, rows[begin:end], None))
        t, x, rows = t[moving], x[moving], rows[moving]
        for begin, end, off in strays(t, x, step, rough):
            found.append(WrongValues(run, rows[begin:end], off))
    return tuple(sorted(found, key=lambda stretch: stretch.rows[0]))
