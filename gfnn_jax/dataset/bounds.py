"""Upper bounds of an error, from errors of pairs that are independent block by block."""

from __future__ import annotations

import numpy as np
from scipy.special import gammaincinv, stdtrit

_LEVEL = 0.95
_NORMAL = 1.6448536269514722  # the level's quantile of a normal number


def bound_of_mean(square: np.ndarray, block: np.ndarray, worst: int = 2) -> float:
    """Upper 95 % bound of the mean of squared errors (n,), those of one block depending on each
    other. block: (n,) integers.

    A sum of squares of errors is near Γ-distributed: the mean times ν / χ²_ν(5 %), with ν = 2
    mean² / variance of the mean (Satterthwaite, Biometrics Bull. 2 (1946) 110). That variance is
    of the blocks' sums; with few blocks it is uncertain itself, and taken as much larger as
    Student's quantile is than the normal one. Infinite from one block alone, which has no scatter.

    The block of the largest error counts ``worst`` times, for what is rarer than one block in n,
    and worse, may not be among them: an event of probability 3/n is missed by n blocks in 5 % of
    cases (e⁻³), which three times stand for.
    """
    _, block = np.unique(block, return_inverse=True)
    sums, counts = np.bincount(block, square), np.bincount(block)
    blocks, largest = len(sums), np.full(worst - 1, np.argmax(sums))
    if blocks < 2 or not np.isfinite(sums).all():
        return float("inf")
    sums, counts = np.append(sums, sums[largest]), np.append(counts, counts[largest])
    rows = counts.sum()
    mean = float(sums.sum() / rows)
    variance = blocks / (blocks - 1) * np.sum((sums - mean * counts) ** 2) / rows**2
    if not variance > 0:
        return mean
    variance *= (stdtrit(blocks - 1, _LEVEL) / _NORMAL) ** 2
    degrees = 2 * mean**2 / variance
    return float(mean * degrees / (2 * gammaincinv(0.5 * degrees, 1 - _LEVEL)))
