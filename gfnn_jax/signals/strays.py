"""Stray values: samples, single or in a row, far from where the samples around them lead.

Samples that cubics through four neighbours miss by far are suspected. A polynomial through the
samples on both sides then tells what the suspected ones should be, and how well it can: at a kink,
a step or with few samples a period the sides themselves do not lie on it, and nothing is said. A
stray begins and ends abruptly; a short swing of the motion rises and falls from sample to sample.
Nor is it a stray that is off by a whole turn: an angle that was not lifted.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.polynomial.legendre import legvander

from gfnn_jax.signals.roughness import misses

_SUSPECTED = 10.0  # times the median miss of the cubics nearby
_NEARBY = 64  # samples of a block whose median counts
_OF_MEDIAN = 0.94  # the median miss by white noise of unit size
_JOINED = 6  # samples from one suspected one to the next of the same stretch
_BESIDE = 2  # samples on either side whose cubics a stray spoils
_LONGEST = 40  # samples of a stretch
_SIDE = 8  # samples on either side of it, as many as it has if these are more
_DEGREE = 5
_WIDEST = 1.5  # of the duration of so many samples without a gap
_FAR = 10.0  # standard deviations of what the sides tell
_ROUGH = 3.0  # times the ordinary roughness of the column
_TURN, _OF_TURN = 2 * np.pi, 0.1  # a stray is not off by one, to this part of it
_ABRUPT = 3.0  # times as far off as the sample beside it, that a stray's first and last are


def strays(
    t: np.ndarray, x: np.ndarray, resolution: float, rough: float
) -> list[tuple[int, int, float]]:
    """(begin, end, how far off at most) of stretches of samples of a run (n,).

    t, x: without missing values. resolution: the smallest step between values, 0 if it is unknown.
    rough: of the column (`roughness`).
    """
    miss = misses(t, x)
    if len(x) < 2 * _SIDE + 1 or not miss.max() > _ROUGH * rough:
        return []
    usual = np.maximum(_nearby(miss), max(resolution, 1e-12 * np.ptp(x)))
    suspected = miss > _SUSPECTED * usual
    at = np.flatnonzero(suspected)
    if len(at) == 0:
        return []
    clean = ~suspected
    for k in range(1, _BESIDE + 1):
        clean[k:] &= ~suspected[:-k]
        clean[:-k] &= ~suspected[k:]
    right = np.flatnonzero(clean)
    parts, found = np.split(at, np.flatnonzero(np.diff(at) > _JOINED) + 1), []
    series = _Series(t, x, right, float(np.median(np.diff(t))), usual, _ROUGH * rough)
    while parts:
        first, *parts = parts
        stray = series.stray(first[0], first[-1])
        if stray is None and parts:  # all between a jump and the one that leads back
            stray = series.stray(first[0], parts[0][-1])
            parts = parts if stray is None else parts[1:]
        if stray is not None:
            found.append(stray)
    return found


class _Series(NamedTuple):
    """Samples (n,), those of them that are right (K,), the median step, how far cubics usually
    miss them (n,), and what is no stray yet."""

    t: np.ndarray
    x: np.ndarray
    right: np.ndarray
    step: float
    usual: np.ndarray
    least: float

    def stray(
        self, first: int | np.integer, last: int | np.integer
    ) -> tuple[int, int, float] | None:
        """(begin, end, how far off) of the stretch with the suspected samples from ``first`` to
        ``last``; None where it is none, or too few samples around it tell."""
        begin, end = first - _BESIDE, last + _BESIDE + 1
        count = max(_SIDE, end - begin)
        before = self.right[self.right < begin][-count:]
        behind = self.right[self.right >= end][:count]
        if end - begin > _LONGEST or min(len(before), len(behind)) < count:
            return None
        widest = _WIDEST * self.step * (2 * count + end - begin)
        if self.t[behind[-1]] - self.t[before[0]] > widest:
            return None
        sides = np.concatenate([before, behind])
        noise = float(self.usual[first]) / _OF_MEDIAN
        stray = _stray(self.t, self.x, np.arange(begin, end), sides, noise)
        return stray if stray is not None and stray[2] > self.least else None


def _nearby(miss: np.ndarray) -> np.ndarray:
    """The median of the block that a sample is in, or of the one before or behind if it is more."""
    blocks = np.array_split(miss, max(len(miss) // _NEARBY, 1))
    medians = np.pad([np.median(block) for block in blocks], 1, mode="edge")
    most = np.maximum(np.maximum(medians[:-2], medians[2:]), medians[1:-1])
    return np.repeat(most, [len(block) for block in blocks])


def _stray(
    t: np.ndarray, x: np.ndarray, rows: np.ndarray, sides: np.ndarray, sigma: float
) -> tuple[int, int, float] | None:
    """(begin, end, how far off) of the samples among ``rows`` that the polynomial of the ``sides``
    misses by far; None where it does not tell."""
    middle, half = t[rows].mean(), np.ptp(t[sides]) / 2
    q, r = np.linalg.qr(legvander((t[sides] - middle) / half, _DEGREE))
    coefficients = q.T @ x[sides]
    left = x[sides] - q @ coefficients
    sigma = max(sigma, float(np.sqrt(left @ left / (len(sides) - _DEGREE - 1))))
    reach = np.linalg.solve(r.T, legvander((t[rows] - middle) / half, _DEGREE).T)
    off = np.abs(x[rows] - coefficients @ reach)
    far = np.flatnonzero(off > _FAR * sigma * np.sqrt(1 + np.sum(reach**2, axis=0)))
    if len(far) == 0 or far[0] == 0 or far[-1] == len(rows) - 1:
        return None
    first, last = far[0], far[-1]
    if off[first] < _ABRUPT * off[first - 1] or off[last] < _ABRUPT * off[last + 1]:
        return None
    if abs(np.median(off[far]) - _TURN) < _OF_TURN * _TURN:
        return None
    return int(rows[first]), int(rows[last]) + 1, float(off[far].max())
