"""Tunes of orbits, by Laskar's frequency analysis: against amplitude, by map and by tracking."""

from __future__ import annotations

from typing import Any

import numpy as np
from harness import Numbers
from rings.lattice import AMPLITUDE, Ring, ellipsoid, ring
from rings.turn import NUM_PAIRS, learned
from scipy.optimize import minimize_scalar

TUNE_TURNS = 1_024


def tune(signal, near: float | None = None) -> float:
    """The frequency, in cycles per turn, of the largest line of a signal (N,): Laskar's frequency
    analysis with a Hann window. near: a frequency, from which the line is at most 0.02 away: the
    line of its own plane, where that of the other one may be larger."""
    n = np.arange(len(signal))
    window = np.hanning(len(signal)) * signal

    def power(frequency):
        return -abs(window @ np.exp(-2j * np.pi * frequency * n))

    lines, frequencies_ = np.abs(np.fft.fft(window)), np.arange(len(signal)) / len(signal)
    if near is not None:
        lines[np.abs(frequencies_ - near) > 0.02] = 0.0
    coarse = frequencies_[np.argmax(lines)]
    width = 1 / len(signal)
    found: Any = minimize_scalar(
        power, bounds=(coarse - width, coarse + width), method="bounded", options={"xatol": 1e-12}
    )
    return float(found.x % 1.0)


def followed(signals, linear) -> np.ndarray:
    """Tunes (N, 2) of orbits (turns, N, 2) of rising amplitude, each by the line of its own plane:
    the one next to where the tunes before lead, from the ``linear`` ones on."""
    found = np.empty(signals.shape[1:])
    for k, first in enumerate(linear):
        near = first
        for i in range(len(found)):
            found[i, k] = tune(signals[:, i, k], near)
            near = 2 * found[i, k] - found[i - 1, k] if i else found[i, k]
    return found


def tunes_of(machine: Ring, states) -> np.ndarray:
    """(N, 2) of orbits (turns, N, 4), about their own means: δ moves the closed orbit."""
    signals = machine.normalised(states - states.mean(axis=0))
    return np.array([[tune(signals[:, i, k]) for k in (0, 1)] for i in range(states.shape[1])])


def tunes(quick: bool) -> Numbers:
    """Tunes against amplitude, of the map in one piece and of the tracking code."""
    err = ring("err.mat")
    half = err.half_axes(AMPLITUDE, AMPLITUDE)
    z, points = ellipsoid(half, 600 if quick else NUM_PAIRS, 0), err.boundaries(4)
    ends = [z, *err.track(z, points)[0]]
    amplitudes = np.linspace(0.1, 0.9, 2 if quick else 9) * AMPLITUDE
    small = 0.05 * AMPLITUDE
    start = np.zeros((2 * len(amplitudes), 4))
    start[: len(amplitudes), 0], start[: len(amplitudes), 1] = amplitudes, small
    start[len(amplitudes) :, 1], start[len(amplitudes) :, 0] = amplitudes, small
    turns = 128 if quick else TUNE_TURNS
    orbits = np.concatenate([start[None], err.track(start, turns=turns)[:, 0]])

    def found(states) -> np.ndarray:
        signals = err.normalised(states)  # (turns + 1, N, 2)
        along_x, along_y = np.split(signals, 2, axis=1)
        linear = tune(along_x[:, 0, 0]), tune(along_y[:, 0, 1])
        return np.concatenate([followed(part, linear) for part in (along_x, along_y)])

    theirs, rows = found(orbits), {}
    for cuts in ((0, 4),) if quick else ((0, 4), (0, 2, 4)):
        map_, fits = learned([ends[i] for i in cuts], 1e-6 if quick else 1e-9)
        states = np.asarray(map_.rollout(start, num_steps=turns)[0]).transpose(1, 0, 2)
        rows[f"{len(fits)} generated"] = found(states)
    return {
        "amplitudes": amplitudes.tolist(),
        "tracked": theirs.tolist(),
        "turns": turns,
        "learned": {name: ours.tolist() for name, ours in rows.items()},
        "largest_difference": {
            name: float(np.abs(ours - theirs).max()) for name, ours in rows.items()
        },
    }
