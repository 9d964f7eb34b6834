"""Steps between samples: their median, gaps, whether they are even, whether a clock drifts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.polynomial import legendre

_GAP = 1.5  # of the 95th percentile of the steps; a longer step is a gap
_FEWEST = 100  # samples of a run whose drift is told
_NEARBY = 101  # steps whose median counts those in a gap
_PARABOLA = 0.97  # of the squares of times' deviations from even ones, that a drift explains
_EVEN = 0.05  # of a step, that times may be off


def median_step(times: Sequence[np.ndarray]) -> float:
    """The median time between samples, in s; NaN where no run has two."""
    steps = np.concatenate([np.diff(t) for t in times])
    return float(np.median(steps)) if len(steps) else np.nan


def longest_step(steps: np.ndarray) -> float:
    """The longest step that is no gap among these steps (n,)."""
    return float(_GAP * np.quantile(steps, 0.95)) if len(steps) else np.inf


def gaps(times: Sequence[np.ndarray]) -> list[tuple[int, float, float]]:
    """(number of the run, begin, end in s) of each gap."""
    longest = longest_step(np.concatenate([np.diff(t) for t in times]))
    return [
        (run, float(t[k]), float(t[k + 1]))
        for run, t in enumerate(times)
        for k in np.flatnonzero(np.diff(t) > longest)
    ]


def even_runs(times: Sequence[np.ndarray]) -> list[int]:
    """Numbers of the runs whose steps are all the median step, but for a twentieth."""
    step = median_step(times)
    return [r for r, t in enumerate(times) if np.all(np.abs(np.diff(t) - step) <= _EVEN * step)]


def drift(times: np.ndarray) -> float:
    """The relative change of the step along a run whose clock runs ever faster, or ever slower; 0
    where it does not.

    Times are a parabola in the number of steps then. Gaps count as so many steps; jitter does not
    make a parabola.
    """
    if len(times) < _FEWEST:
        return 0.0
    from scipy import ndimage  # loaded when first used

    steps = np.diff(times)
    usual = ndimage.median_filter(steps, _NEARBY, mode="nearest")
    number = np.concatenate([[0], np.cumsum(np.maximum(np.round(steps / usual), 1))])
    place = 2 * number / number[-1] - 1
    _, slope, bend = coefficients = legendre.legfit(place, times, 2)
    off = times - legendre.legval(place, coefficients[:2])
    parabola = legendre.legval(place, [0, 0, bend])
    if np.sum(parabola**2) < _PARABOLA * np.sum(off**2):
        return 0.0
    return float(6 * bend / slope)
