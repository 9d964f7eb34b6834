"""Velocities and noise of sampled positions, by local cubics.

Around each sample a cubic in time is fitted to the samples of a window. Its value and slope at the
centre are q and v; what the sample itself differs by, corrected for its own pull on the cubic (the
leave-one-out error), measures the noise plus the bias of the window. The widest window whose
leave-one-out error is within 5 % of the best is taken: a wider one hardly distorts, and averages
more noise.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np


@dataclasses.dataclass(frozen=True)
class _Options:
    """halves: windows, samples on either side. samples: where the errors of a window are measured.
    tolerance: of the leave-one-out error, against the best window's."""

    halves: tuple[int, ...] = (2, 3, 4, 5, 6, 8, 10, 13, 16, 20, 25, 32, 40, 50, 64, 80)
    samples: int = 2_000
    tolerance: float = 1.05


_OPTIONS = _Options()


class Smooth(NamedTuple):
    """Positions, velocities and accelerations (n, d) at the samples of one stretch."""

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray


def smooth(
    t: np.ndarray, y: np.ndarray, half: int, at: np.ndarray | None = None
) -> tuple[Smooth, np.ndarray]:
    """Local cubics through y (n, d) at times t (n,), ``half`` samples to either side, and their
    leave-one-out errors, at the samples ``at`` (m,) or all: (m, d) each. At the ends windows keep
    their number of samples."""
    n = len(t)
    at = np.arange(n) if at is None else at
    width = min(2 * half + 1, n)
    first = np.clip(at - width // 2, 0, n - width)
    index = first[:, None] + np.arange(width)
    span = 0.5 * (t[index[:, -1]] - t[index[:, 0]])
    x = (t[index] - t[at, None]) / span[:, None]
    powers = x[:, :, None] ** np.arange(4.0)
    transposed = powers.swapaxes(1, 2)
    inverse = np.linalg.inv(transposed @ powers)
    c = inverse @ (transposed @ y[index])
    left_out = (y[at] - c[:, 0]) / (1 - inverse[:, 0, 0])[:, None]
    return Smooth(c[:, 0], c[:, 1] / span[:, None], 2 * c[:, 2] / span[:, None] ** 2), left_out


def choose_half(stretches: list[tuple[np.ndarray, np.ndarray]]) -> tuple[int, np.ndarray]:
    """The window (samples to either side) for these stretches (t (n,), y (n, d)) of a recording,
    and the noise σ (d,) of the channels: the smallest leave-one-out error, less the cubic's own
    part."""
    total = sum(len(t) for t, _ in stretches)
    every = max(1, total // _OPTIONS.samples)
    halves = [h for h in _OPTIONS.halves if any(len(t) >= 2 * h + 1 for t, _ in stretches)]
    errors, sigmas = [], []
    for half in halves:
        left_out = [
            smooth(t, y, half, np.arange(0, len(t), every))[1]
            for t, y in stretches
            if len(t) >= 2 * half + 1
        ]
        squares = np.concatenate(left_out) ** 2
        variance = np.median(squares, axis=0) / 0.4549  # the median of χ² with one degree is 0.4549
        errors.append(np.sqrt(variance))
        sigmas.append(np.sqrt(variance / (1 + 9 / (4 * (2 * half + 1)))))
    relative = np.array(errors) / np.maximum(np.min(errors, axis=0), 1e-300)
    score = relative.max(axis=1)
    good = np.flatnonzero(score <= _OPTIONS.tolerance * score.min())
    return halves[good[-1]], np.min(sigmas, axis=0)
