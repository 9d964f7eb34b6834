"""Roughness of a column: how far its samples are from cubics through their four neighbours.

It holds noise, a sensor's single counts, and what of the motion is not smooth.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

_BLOCK = 16  # samples, of which the roughest counts
_ORDINARY = 0.8  # of the blocks; what spoils fewer than the others is not the sensor's way


def misses(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Distances (n,) from the cubics; 0 for the first two and the last two samples."""
    found = np.zeros(len(x))
    n, places = len(x) - 4, (0, 1, 3, 4)
    if n < 1:
        return found
    cubic = np.zeros(n)
    for j in places:
        weight = np.ones(n)
        for m in places:
            if m != j:
                weight *= (t[2:-2] - t[m : m + n]) / (t[j : j + n] - t[m : m + n])
        cubic += weight * x[j : j + n]
    found[2:-2] = np.abs(x[2:-2] - cubic)
    return found


def roughness(runs: Sequence[np.ndarray]) -> float:
    """The largest miss that is ordinary in a column, of the `misses` (n_r,) of its runs: 3.4
    standard deviations of white noise. Infinite where no run has a block of samples."""
    whole = [miss[: len(miss) // _BLOCK * _BLOCK].reshape(-1, _BLOCK) for miss in runs]
    largest = np.concatenate([blocks.max(axis=1) for blocks in whole] or [np.empty(0)])
    return float(np.quantile(largest, _ORDINARY)) if len(largest) else np.inf
