"""Calibration of a law's forecasts by data that it was not learned from: bands and the horizon.

Each third of the record is forecast by the law that the other two thirds give. From many samples
the state is estimated, now from the window that does so best and now from a short one, and the
orbit followed. What has to be added to the variance that noise, state and coefficients explain so
that two standard deviations hold 95 % of the errors is the misfit, by the time ahead (conformal
prediction: Lei et al., J. Am. Stat. Assoc. 113 (2018) 1094). The colour of the noise is in it, and
what is wrong with the law. It is the same everywhere, or in proportion to how large the motion is,
as of friction of a wrong kind where motion dies down, or to the deviations that state and
coefficients explain (ibid., §5.2), which then may be too large too: the errors say which. The
time until which 95 % of the errors are below 1 %, 5 % and 20 % of the spread is the horizon.
"""

from __future__ import annotations

import dataclasses
import warnings
from bisect import bisect
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.dataset.stretches import Scales, Stretch
from gfnn_jax.fitting.evidence import Comparison
from gfnn_jax.maps.estimates import (
    Law,
    Orbits,
    Window,
    estimates_of,
    of_windows,
    propagate,
    thinned,
)
from gfnn_jax.maps.sensors import TUBE, Sensors


class Options:
    """Options of the calibration of forecasts (`benchmarks/measured.py`, `bands.py`).

    windows, tried: starts of forecasts, and those that choose the window. choices: periods from
    which a state may be estimated. first, last, leads: periods ahead, and how many times between
    these. near: leads to either side that share their errors. short: samples, at least, of the
    shortest window. widest: standard deviation of levels of friction, whose scatter is looked for.
    alike: share by which medians of some thirty errors differ by chance.
    fewest: errors that determine a quantile ``inside``, which are within two
    standard deviations. parts: of the record, in the jackknife of its errors. fractions: of the
    spread, that horizons are stated for.
    """

    windows: int = 96
    tried: int = 16
    choices: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0)
    first: float = 1 / 32
    last: float = 8.0
    leads: int = 24
    near: int = 2
    short: int = 20
    widest: float = 0.3
    alike: float = 0.25
    fewest: int = 20
    inside: float = 0.95
    parts: int = 8
    fractions: tuple[float, ...] = (0.01, 0.05, 0.20)


class Horizon(NamedTuple):
    """Seconds for which 95 % of forecasts, read by a sensor, stay within a fraction of the spread
    (rms position about its mean): measured on data that the law was not learned from, and as bands
    of two standard deviations say; 0 where the noise alone is larger, infinite where the fraction
    was not passed in eight periods."""

    fraction: float
    measured: float
    predicted: float


class Calibration(NamedTuple):
    """The law with the window of its estimates and its misfit, its horizons, and the median errors
    (n, k) of forecasts by the time ahead, in units of the spread; parts: (P, n, k) the same without
    one part of the record each, NaN where no other is long enough."""

    law: Law
    horizons: list[Horizon]
    median: np.ndarray
    parts: np.ndarray

    def against(self, other: Calibration, after: float = 0.0) -> Comparison:
        """Median errors as a multiple of another's, in the geometric mean over times ahead from
        ``after`` (s) on, and the standard error of this ratio, of the jackknife over parts of the
        record; 1 where they are of other times, or of none."""
        late = np.flatnonzero(self.law.sensors.leads[: len(self.median)] >= after)
        if self.median.shape != other.median.shape or not self.median[late].size:
            return Comparison(1.0, 1.0, 0.0, 0.0)
        ratio = float(np.exp(np.mean(np.log(self.median / other.median)[late])))
        logs = np.nanmean(np.log(self.parts / other.parts)[:, late], axis=(1, 2))
        error = np.sqrt((len(logs) - 1) * np.mean((logs - logs.mean()) ** 2))
        return Comparison(ratio, 1.0, ratio - 1.0, float(error))


class Thirds(NamedTuple):
    """The laws learned without each third of a record, and (stretch, time) where these begin."""

    laws: tuple[Law, ...]
    begins: tuple[tuple[int, float], ...]

    def of(self, stretch: int, t: float) -> int:
        """The third that a sample lies in."""
        return max(0, bisect(self.begins, (stretch, t)) - 1)

    def with_level(self, level: float) -> Thirds:
        """The same with the level of friction estimated, of this standard deviation."""
        laws = [
            law._replace(sensors=dataclasses.replace(law.sensors, level=level)) for law in self.laws
        ]
        return self._replace(laws=tuple(laws))


def calibrated(
    law: Law, thirds: Thirds, found: Sequence[Stretch], scales: Scales, spread: np.ndarray
) -> Calibration:
    """The law with the best window for its estimates and the misfit of its forecasts, and its
    horizons. ``spread`` (k,) of the channels."""
    starts = _starts(found, scales)
    if not starts or not np.all(spread > 0):  # of events
        return _unknown(law, spread)
    shortest = law.sensors.observation_model.shortest
    short = max((Options.short - 1) * scales.dt, shortest)
    period = max(scales.period, shortest)
    tried = np.unique(np.maximum(np.array(Options.choices) * period, short))
    some = starts[:: -(-len(starts) // Options.tried)]
    longest = max(s.t[-1] - s.t[0] for s in found)
    reach = scales.period if scales.period < longest else longest / 2
    leads = np.array([0.5, 1.0]) * reach
    windows = np.repeat(tried, len(some))
    errors = _forecasts(thirds, found, some * len(tried), windows, leads)[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # windows whose forecasts all diverge
        sizes = (np.abs(errors) / spread).reshape(len(tried), -1)
        middle = np.nan_to_num(np.nanmedian(sizes, axis=1), nan=np.inf)
    best = float(tried[np.argmin(middle)])
    if law.sensors.level:  # which a longer window determines better
        best = float(tried[middle <= (1 + Options.alike) * np.min(middle)][-1])
    leads = np.geomspace(
        max(Options.first * scales.period, scales.dt), Options.last * scales.period, Options.leads
    )
    leads = leads[leads <= 0.9 * longest]
    windows = np.where(np.arange(len(starts)) % 2, short, best)
    own, orbits, x, times = _forecasts(thirds, found, starts, windows, leads)
    errors, deviations = _shared(own), _shared(orbits.std)
    sensors, known, unit = _with_shape(law.sensors, x, errors, deviations)
    enough = np.isfinite(errors).all(axis=-1).sum(axis=0) >= Options.fewest
    leads, errors, known, unit = (
        leads[enough],
        *(values[:, enough] for values in (errors, known, unit)),
    )
    own, orbits = own[:, enough], orbits._replace(modes=orbits.modes[:, enough])
    if not len(leads):
        return _unknown(law, spread)
    part = np.arange(len(starts)) * Options.parts // len(starts)
    every = np.tile(part, len(errors) // len(part))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # times of one part alone
        missed = (errors**2 / 4 - known) / unit
        misfit, *others = (
            np.sqrt(np.maximum(np.nanquantile(missed[every != k], Options.inside, axis=0), 0.0))
            for k in range(-1, Options.parts)
        )
        sizes = np.abs(errors) / spread
        median, *parts = (np.nanmedian(sizes[every != k], axis=0) for k in range(-1, Options.parts))
    unseen = np.where(np.isfinite(others), others, misfit)[part]  # by a part's own scores
    sensors = dataclasses.replace(
        sensors,
        window=best,
        leads=leads,
        misfit=misfit,
        scores=_scores(
            own, orbits.with_misfit(sensors, unseen, sensors.size_of(x)), times[:, enough]
        ),
        observed=float(sum(s.t[-1] - s.t[0] for s in found)),
    )
    bands = np.where(np.isfinite(errors), 2 * np.sqrt(known + misfit**2 * unit), np.nan)
    measured = np.max(np.nanquantile(np.abs(errors), Options.inside, axis=0) / spread, axis=1)
    predicted = np.max(np.nanmedian(bands, axis=0) / spread, axis=1)
    horizons = [
        Horizon(f, _passed(measured, leads, f), _passed(predicted, leads, f))
        for f in Options.fractions
    ]
    return Calibration(law._replace(sensors=sensors), horizons, median, np.stack(parts))


def level_of_friction(thirds: Thirds, found: Sequence[Stretch], scales: Scales) -> float:
    """Relative standard deviation of the level of friction over a record, by laws that were not
    learned from it there: the scatter of levels about 0 beyond their standard errors, 0 of none."""
    starts = _starts(found, scales)
    if not starts or not thirds.laws[0].form.friction.count:
        return 0.0
    starts = starts[:: -(-len(starts) // Options.tried)]
    cut = [_window(found[i], k, scales.period) for i, k in starts]
    third = np.array([thirds.of(i, found[i].t[k]) for i, k in starts])
    x, covariance = estimates_of(thirds.with_level(Options.widest).laws, third, cut)
    d = 2 * thirds.laws[0].form.dim
    excess = x[:, d] ** 2 - covariance[:, d, d]
    return float(np.sqrt(max(0.0, np.median(excess))))


def _unknown(law: Law, spread: np.ndarray) -> Calibration:
    """The calibration of a record that is too short for one."""
    none = np.zeros((0, len(spread)))
    return Calibration(law, [], none, none[None])


def _with_shape(
    sensors: Sensors, x: np.ndarray, errors: np.ndarray, deviations: np.ndarray
) -> tuple[Sensors, np.ndarray, np.ndarray]:
    """The sensors with the kind of misfit that makes errors (N, n, k) likeliest, which have these
    deviations in a law that is right; the variances (N, n, k) without it, and those of a misfit of
    1. The N forecasts are from states x (B, 2d), which N repeats (`_shared`)."""
    best, chosen, repeated = np.inf, None, len(errors) // len(x)
    for relative, of_law in ((False, False), (True, False), (False, True)):
        one = dataclasses.replace(sensors, relative=relative, of_law=of_law)
        known, unit = deviations**2, np.tile(one.size_of(x), repeated)[:, None, None] ** 2
        unit = np.broadcast_to(unit, errors.shape)
        if of_law:
            noise = np.broadcast_to(sensors.sigma**2, errors.shape)
            known, unit = noise, np.maximum(known - noise, np.finfo(float).eps * known)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # leads without errors
            left = np.nanmean((errors**2 - known) / unit, axis=0)
        variance = known + np.maximum(left, 0.0) * unit
        unlikely = float(np.nansum(np.log(variance) + errors**2 / variance))
        if chosen is None or unlikely < best:
            best, chosen = unlikely, (one, known, unit)
    assert chosen is not None
    return chosen


def _scores(errors: np.ndarray, orbits: Orbits, times: np.ndarray) -> np.ndarray:
    """The largest errors (B, n) of any channel from the start of a forecast to each lead, in
    standard deviations, as multiples of the tube of Gaussian errors of this law at these times
    (B, n); NaN where the record ends before."""
    sizes = np.max(np.abs(errors) / orbits.std, axis=2)
    return np.maximum.accumulate(sizes, axis=1) / orbits.largest(TUBE, times)


def _shared(values: np.ndarray) -> np.ndarray:
    """Values (B, n, k) together with those of near leads (B (2 near + 1), n, k)."""
    far = np.pad(values, ((0, 0), (Options.near, Options.near), (0, 0)), constant_values=np.nan)
    return np.concatenate([far[:, k : k + values.shape[1]] for k in range(2 * Options.near + 1)])


def _passed(error: np.ndarray, leads: np.ndarray, fraction: float) -> float:
    """The first time at which the error passes the fraction, between leads by a straight line."""
    above = np.flatnonzero(error > fraction)
    if not len(above):
        return float("inf")
    k = int(above[0])
    return float(np.interp(fraction, error[k - 1 : k + 1], leads[k - 1 : k + 1])) if k else 0.0


def _window(s: Stretch, last: int, seconds: float) -> Window:
    """The samples of so many seconds up to the last, and of ``short`` at least."""
    first = min(int(np.searchsorted(s.t, s.t[last] - seconds)), max(0, last - Options.short + 1))
    own = slice(first, last + 1)
    return thinned(Window(s.t[own], s.y[own], s.t, s.u, s.noise[own], s.args))


def _starts(found: Sequence[Stretch], scales: Scales) -> list[tuple[int, int]]:
    """(stretch, sample) of the last samples of windows, evenly over the record."""
    fewest = max(Options.short, round(0.25 * scales.period / scales.dt))
    places = [(i, k) for i, s in enumerate(found) for k in range(fewest - 1, len(s.t) - 1)]
    every = max(1, len(places) // Options.windows)
    return places[::every] if places else []


def _forecasts(
    thirds: Thirds,
    found: Sequence[Stretch],
    starts: Sequence[tuple[int, int]],
    windows: np.ndarray,
    leads: np.ndarray,
) -> tuple[np.ndarray, Orbits, np.ndarray, np.ndarray]:
    """Errors (B, n, k) of forecasts by the law without the third in which they start, NaN where the
    record ends before, the forecasts, the states (B, 2d) they start from, and the times (B, n),
    those of the samples nearest to the leads. windows: (B,) seconds from which each state is
    estimated."""
    cut, times, measured = [], [], []
    for (i, k), window in zip(starts, windows.tolist(), strict=True):
        s = found[i]
        cut.append(_window(s, k, window))
        at = np.minimum(np.searchsorted(s.t, s.t[k] + leads), len(s.t) - 1)
        inside = s.t[k] + leads <= s.t[-1]
        times.append(np.where(inside, s.t[at], s.t[at[inside][-1]] if inside.any() else s.t[k]))
        measured.append(np.where(inside[:, None], s.y[at], np.nan))
    third = np.array([thirds.of(i, found[i].t[k]) for i, k in starts])
    laws, which = of_windows(thirds.laws, third, cut)
    last = np.array([w.t[-1] for w in cut])
    states: list[Any] = [None] * len(cut)
    for window in np.unique(windows):  # together they would all be the longest
        own = np.flatnonzero(windows == window).tolist()
        of_window = estimates_of(laws, which[own], [cut[n] for n in own])
        for n, *state in zip(own, *of_window, strict=True):
            states[n] = state
    x, covariance = (np.stack(part) for part in zip(*states, strict=True))
    orbits = propagate(laws, which, cut, x, covariance, last, np.array(times))
    d = thirds.laws[0].form.dim
    return orbits.values - np.array(measured), orbits, x[:, : 2 * d], np.array(times)
