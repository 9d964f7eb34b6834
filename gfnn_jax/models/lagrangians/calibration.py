"""Calibration of a law's forecasts by the data that it was learned from: bands and the horizon.

From many samples of the record the state is estimated and the orbit followed. What the forecasts
miss, beyond what noise and the errors of state and coefficients explain, is the law's own misfit,
by the time ahead; the time when the median error passes 1 %, 5 % and 20 % of the spread is the
horizon.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gfnn_jax.dataset.stretches import Scales, Stretch
from gfnn_jax.maps.estimates import Law, Window, estimate_states, propagate, thinned

_WINDOWS, _TRIED = 48, 16  # starts of forecasts; of those that choose the window
_CHOICES = (0.25, 0.5, 1.0, 2.0)  # periods from which a state may be estimated
_PERIODS, _PER_PERIOD = 8, 8  # times ahead: how far, and how many to a period
_SHORT = 20  # samples, at least, of the shortest window
FRACTIONS = (0.01, 0.05, 0.20)  # of the spread, that horizons are told for


class Horizon(NamedTuple):
    """Seconds for which the median error stays within a fraction of the spread (rms position about
    its mean): measured on the record, and as the bands say; infinite where it was not passed."""

    fraction: float
    measured: float
    predicted: float


def calibrated(
    law: Law, found: Sequence[Stretch], scales: Scales, spread: np.ndarray
) -> tuple[Law, list[Horizon]]:
    """The law with the best window for its estimates and the misfit of its forecasts, and its
    horizons. ``spread`` (k,) of the channels."""
    starts = _starts(found, scales)
    if not starts:
        return law, []
    choices = []
    for periods in _CHOICES:
        window = max(periods * scales.period, (_SHORT - 1) * scales.dt)
        if choices and window <= choices[-1][0]:
            continue
        some = starts[:: -(-len(starts) // _TRIED)]
        errors = _forecasts(law, found, some, window, np.array([0.5, 1.0]) * scales.period)[0]
        with np.errstate(all="ignore"):
            choices.append((window, np.nanmedian(np.abs(errors) / spread)))
    best = min((c for c in choices if np.isfinite(c[1])), key=lambda c: c[1], default=choices[0])
    leads = np.arange(1, _PERIODS * _PER_PERIOD + 1) / _PER_PERIOD * scales.period
    longest = max(s.t[-1] - s.t[0] for s in found)
    leads = leads[leads <= 0.9 * longest]
    errors, deviations = _forecasts(law, found, starts, best[0], leads)
    misfit, kept = [], []
    for k in range(len(leads)):
        near = slice(max(0, k - 1), k + 2)  # neighbours in time ahead share their windows' scatter
        e, s = (a[:, near].reshape(-1, a.shape[-1]) for a in (errors, deviations))
        seen = np.isfinite(e).all(axis=1)
        if seen.sum() < 8:
            break
        excess = np.quantile(e[seen] ** 2 / 4 - s[seen] ** 2, 0.95, axis=0)
        misfit.append(np.sqrt(np.maximum(excess, 0.0)))
        kept.append(leads[k])
    if not kept:
        return law, []
    table = np.maximum.accumulate(np.array(misfit), axis=0)
    kept = np.array(kept)
    sensors = dataclasses.replace(law.sensors, window=best[0], leads=kept, misfit=table)
    errors, deviations = errors[:, : len(kept)], deviations[:, : len(kept)]
    total = np.sqrt(deviations**2 + table**2)
    with np.errstate(all="ignore"):
        measured = np.max(np.nanmedian(np.abs(errors), axis=0) / spread, axis=1)
        predicted = 0.6745 * np.max(np.nanmedian(total, axis=0) / spread, axis=1)
    horizons = [
        Horizon(f, _passed(measured, kept, f), _passed(predicted, kept, f)) for f in FRACTIONS
    ]
    return law._replace(sensors=sensors), horizons


def _window(s: Stretch, begin: int, end: int) -> Window:
    return Window(s.t[begin:end], s.y[begin:end], s.t, s.u, s.noise[begin:end])


def _passed(error: np.ndarray, leads: np.ndarray, fraction: float) -> float:
    above = np.flatnonzero(error > fraction)
    return float(leads[above[0]]) if len(above) else float("inf")


def _starts(found: Sequence[Stretch], scales: Scales) -> list[tuple[int, int]]:
    """(stretch, sample) of the last samples of windows, evenly over the record."""
    fewest = max(_SHORT, round(0.25 * scales.period / scales.dt))
    places = [(i, k) for i, s in enumerate(found) for k in range(fewest - 1, len(s.t) - 1)]
    every = max(1, len(places) // _WINDOWS)
    return places[::every] if places else []


def _forecasts(
    law: Law, found: Sequence[Stretch], starts: Sequence[tuple[int, int]], window: float,
    leads: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Errors (B, n, k) of forecasts, NaN where the record ends before, and their standard
    deviations without a misfit; times are those of the samples nearest to the leads."""
    windows, times, measured = [], [], []
    for i, k in starts:
        s = found[i]
        first = min(int(np.searchsorted(s.t, s.t[k] - window)), max(0, k - _SHORT + 1))
        windows.append(thinned(_window(s, first, k + 1)))
        at = np.minimum(np.searchsorted(s.t, s.t[k] + leads), len(s.t) - 1)
        inside = s.t[k] + leads <= s.t[-1]
        times.append(np.where(inside, s.t[at], s.t[at[inside][-1]] if inside.any() else s.t[k]))
        measured.append(np.where(inside[:, None], s.y[at], np.nan))
    bare = law._replace(
        sensors=dataclasses.replace(law.sensors, misfit=np.zeros_like(law.sensors.misfit))
    )
    x, covariance = estimate_states(bare, windows)
    last = np.array([w.t[-1] for w in windows])
    orbits = propagate(bare, windows, x, covariance, last, np.array(times))
    return orbits.values - np.array(measured), orbits.std
