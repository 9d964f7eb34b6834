"""Forecasts of a part of a recording that no fit has seen, from states along it."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.data.recording import Recording, args_of, parameters_of
from gfnn_jax.errors import InputError
from gfnn_jax.learn.fitted import Choice, Fit
from gfnn_jax.maps.sensors import TUBE
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.signals.filters import needed


class _Options:
    """Forecasts of a part that no fit has seen."""

    samples: int = 20  # that a state is estimated from
    starts: int = 24  # of forecasts
    drawn: int = 16  # states about a measured one, whose motions tell how far it is trusted
    # of the fastest motion, that are forecast ahead, if there are as many
    periods: tuple[float, ...] = (0.25, 1.0, 2.0)


PART = 2 / 3  # of a recording, in time, that is learned from where the rest is held out


class Ahead(NamedTuple):
    """One forecast: where it begins (s), its times (n,) in s, and by columns what was measured,
    what was forecast and its standard deviation (n,), in the file's units."""

    begin: float
    t: np.ndarray
    measured: dict[str, np.ndarray]
    values: dict[str, np.ndarray]
    std: dict[str, np.ndarray]

    def missed(self, name: str) -> np.ndarray:
        return np.abs(self.values[name] - self.measured[name])


class Forecasts(NamedTuple):
    """Forecasts from states along a recording. ahead: times (k,) in s; median: column -> median
    size of the error (k,) that far ahead, in the file's unit; within: share of all that was
    measured within two standard deviations."""

    each: tuple[Ahead, ...]
    ahead: tuple[float, ...]
    median: dict[str, tuple[float, ...]]
    within: float

    @property
    def report(self) -> dict[str, Any]:
        """Entry of ``report.json``."""
        return {
            "num": len(self.each),
            "ahead": self.ahead,
            "median": self.median,
            "within_two_deviations": self.within,
        }


def end_of_part(recording: Recording) -> float:
    """The time (s) up to which a law is learned from a recording whose rest is held out."""
    times = np.concatenate([recording.times(run) for run in recording.runs])
    return float(times.min() + PART * np.ptp(times))


def forecasts_of(fit: Fit, held_out: Recording) -> Forecasts:
    """Forecasts of a held-out part, for up to two periods of the fastest motion, as
    `forecasts_along`; of states with a bracket for up to half of it, each from one state."""
    map_ = fit.map
    half = max(np.ptp(held_out.times(run)) for run in held_out.runs) / 2
    if map_.sensors is None:
        noise = fit.noise if isinstance(fit.found, Choice) else None
        return _forecasts(partial(_of_state, map_, noise), held_out, [half / 4, half / 2, half])
    ahead = [periods * 2 * np.pi / map_.sensors.omega for periods in _Options.periods]
    ahead = [seconds for seconds in ahead if seconds < half] or [half]
    return forecasts_along(map_, held_out, ahead)


def forecasts_along(map_: SymplecticMap, recording: Recording, ahead: Sequence[float]) -> Forecasts:
    """Forecast from up to 24 states along a recording, each estimated from the 20 samples before,
    for as long as the last of the times ``ahead`` (s).

    Raises InputError where no run holds that many samples and as much time behind them.
    """
    return _forecasts(partial(_ahead, map_), recording, ahead)


def _forecasts(
    forecast: Callable[..., Ahead], recording: Recording, ahead: Sequence[float]
) -> Forecasts:
    """Forecasts along a recording. forecast: one, of (recording, run, its sample, seconds)."""
    times = {run: recording.times(run) for run in recording.runs}
    first = _Options.samples - 1
    places = ((run, t, k) for run, t in times.items() for k in range(first, len(t) - 1))
    starts = [(run, k) for run, t, k in places if t[k] + ahead[-1] <= t[-1]]
    if not starts:
        lacking = f"{_Options.samples} samples and {ahead[-1]:.3g} s behind them"
        raise InputError(f"{recording.source}: no run has {lacking} that no fit has seen")
    chosen = np.linspace(0, len(starts) - 1, min(_Options.starts, len(starts))).astype(int)
    begins = (starts[i] for i in chosen)
    each = tuple(forecast(recording, run, k, ahead[-1]) for run, k in begins)
    names = list(each[0].values)

    def median(name: str, s: float) -> float:
        found = (np.interp(one.begin + s, one.t, one.missed(name)) for one in each)
        return float(np.nanmedian(list(found)))

    medians = {name: tuple(median(name, s) for s in ahead) for name in names}
    inside = np.concatenate([one.missed(n) <= 2 * one.std[n] for one in each for n in names])
    known = np.concatenate([np.isfinite(one.measured[n]) for one in each for n in names])
    return Forecasts(each, tuple(ahead), medians, float(np.mean(inside[known])))


def _ahead(map_: SymplecticMap, recording: Recording, run: str, k: int, longest: float) -> Ahead:
    """The forecast of a run from its sample k on; angles as near what was measured as turns go."""
    t = recording.times(run)
    begin = float(t[k])
    later = recording.slice(np.nextafter(begin, np.inf), begin + longest, run=run)
    phase = 0.0 if map_.sensors is None else map_.sensors.phase
    over = 1.01 * needed(float(t[1] - t[0]), phase) if phase else 0.0
    start = recording.slice(float(t[k - _Options.samples + 1]) - over, begin, run=run)
    own = recording.slice(run=run) if recording.inputs else None
    found = map_.forecast(start, later.times(run), own, coverage=TUBE)
    measured, values, std = {}, {}, {}
    for name in recording.columns:  # a coordinate that none shows is forecast too, and not judged
        if name not in found.values:
            continue
        factor, values[name] = recording.factors[name], found.values[name][0]
        measured[name] = later.values(name, run) / factor
        if name in recording.angles:
            turn = 2 * np.pi / factor
            measured[name] += turn * np.round((values[name] - measured[name]) / turn)
        std[name] = found.std[name][0]
    return Ahead(begin, later.times(run), measured, values, std)


def _of_state(
    map_: SymplecticMap,
    noise: np.ndarray | None,
    recording: Recording,
    run: str,
    k: int,
    longest: float,
) -> Ahead:
    """The forecast of a run from its sample k as it was measured; its deviations are those of
    states that are drawn about it with the noise (d,)."""
    t, z, dt = recording.times(run), recording.array("positions", run), float(map_.dt)
    steps = int(longest / dt * (1 + 1e-9))
    sigma = np.zeros(z.shape[1]) if noise is None else noise
    starts = z[k] + sigma * np.random.default_rng(k).normal(size=(_Options.drawn, z.shape[1]))
    own = None if map_.parameters is None else args_of(recording, run, parameters_of(recording))
    states = np.concatenate([z[k : k + 1], starts])
    found = np.asarray(map_.rollout(states, steps, params=own)[0])[:, 1:]
    later = t[k] + dt * np.arange(1, steps + 1)
    spread = np.sqrt(np.nanmean((found[1:] - found[0]) ** 2, axis=0) + sigma**2)
    measured, values, std = {}, {}, {}
    for i, name in enumerate(recording.positions):
        factor = recording.factors[name]
        measured[name] = np.interp(later, t, z[:, i]) / factor
        values[name], std[name] = found[0, :, i] / factor, spread[:, i] / factor
    return Ahead(float(t[k]), later, measured, values, std)
