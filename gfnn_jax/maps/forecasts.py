"""States estimated from a recording, and forecasts with bands, of a map that knows its sensors.

`estimates` does it for the map of a law, `position_estimates` for one of positions alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.special import ndtri

from gfnn_jax.data.recording import Recording
from gfnn_jax.errors import InputError
from gfnn_jax.maps import estimates, position_estimates
from gfnn_jax.maps.sensors import TUBE, Sensors
from gfnn_jax.signals.filters import mixed, needed, turned
from gfnn_jax.threads import one_thread


class Forecast(NamedTuple):
    """Forecast of what sensors will show, and of coordinates that no column is named for: name ->
    (runs, n), and their standard deviations. times: in seconds. units: of the values, "" where it
    is not known. outside: lines about runs whose parameters, or whose motion, lie beyond those that
    the law was learned from, which the standard deviations leave out. band: half widths
    (runs, n) of the band that was asked for, None where none was; ``lower`` and ``upper`` are its
    edges. Where one was, the standard deviations hold the forecasts of the law's rivals too."""

    times: np.ndarray
    values: dict[str, np.ndarray]
    std: dict[str, np.ndarray]
    units: dict[str, str]
    outside: tuple[str, ...] = ()
    band: dict[str, np.ndarray] | None = None

    @property
    def lower(self) -> dict[str, np.ndarray] | None:
        """Lower edge (runs, n) of the band by name, None where no band was asked for."""
        return self._edge(-1.0)

    @property
    def upper(self) -> dict[str, np.ndarray] | None:
        """Upper edge (runs, n) of the band by name, None where no band was asked for."""
        return self._edge(1.0)

    def at(self, times: np.ndarray) -> Forecast:
        """The forecast at times (n,) between its own."""
        found = self._each(lambda _, x: CubicSpline(self.times, x, axis=1)(times))
        return found._replace(times=times)

    @classmethod
    def of_runs(cls, each: Sequence[Forecast]) -> Forecast:
        """Join forecasts of one run each, at the same times."""

        def joined(parts: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
            return {n: np.concatenate([one[n] for one in parts]) for n in parts[0]}

        values, std = joined([one.values for one in each]), joined([one.std for one in each])
        bands = [one.band for one in each if one.band is not None]
        outside = tuple(line for one in each for line in one.outside)
        band = joined(bands) if bands else None
        return cls(each[0].times, values, std, each[0].units, outside, band)

    def _each(self, change: Callable[[str, np.ndarray], np.ndarray]) -> Forecast:
        """Change values, standard deviations and bands, each (runs, n) of a name."""
        values, std = (
            {name: change(name, x) for name, x in of.items()} for of in (self.values, self.std)
        )
        band = self.band and {name: change(name, x) for name, x in self.band.items()}
        return self._replace(values=values, std=std, band=band)

    def _edge(self, side: float) -> dict[str, np.ndarray] | None:
        if self.band is None:
            return None
        return {name: self.values[name] + side * half for name, half in self.band.items()}

    def in_units_of(self, recording: Recording) -> Forecast:
        """Convert values and standard deviations to the units of a recording's file."""
        factors = recording.factors
        units = {n: recording.unit(n) if n in factors else unit for n, unit in self.units.items()}
        return self.divided(factors)._replace(units=units)

    def divided(self, factors: Mapping[str, float], second: float = 1.0) -> Forecast:
        """Divide values, standard deviations and bands by the factors of their columns, times by
        ``second``."""
        found = self._each(lambda name, x: x / factors.get(name, 1.0))
        return found._replace(times=self.times / second)


def estimate(map_: Any, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """`SymplecticMap.estimate`."""
    kind = _kind(map_)
    if map_.sensors.phase:
        recording = recording.behind_filter(-map_.sensors.phase)
    with one_thread():
        return kind.estimate(map_, recording)


class Asked(NamedTuple):
    """Band that is asked for: the probability with which it holds each reading, or the whole
    trajectory of all channels (``simultaneous``). Raises InputError where it is none of 0 to 1."""

    coverage: float | None = None
    simultaneous: bool = False

    @property
    def whole(self) -> float | None:
        """The probability of whole trajectories, None where it is not asked for."""
        if self.coverage is not None and not 0 < self.coverage < 1:
            raise InputError(f"expected a coverage between 0 and 1, got {self.coverage:g}")
        if not self.simultaneous:
            return None
        return TUBE if self.coverage is None else self.coverage


def forecast(
    map_: Any,
    recording: Recording,
    times: Any,
    inputs: Recording | None = None,
    asked: Asked | None = None,
) -> Forecast:
    """`SymplecticMap.forecast`, in radians and the units of the columns' numbers."""
    times = np.atleast_1d(np.asarray(times, float))
    if times.ndim != 1 or not np.all(np.diff(times) > 0):
        raise InputError("expected rising times (n,) of a forecast")
    asked = asked or Asked()
    kind, whole, given = _kind(map_), asked.whole, (map_, recording, times, inputs)
    if map_.sensors.phase:
        return _behind_filter(map_, recording, times, inputs, asked)
    if whole is not None and kind is position_estimates:
        raise InputError("expected a law: of a map of positions alone only bands of each reading")
    with one_thread():
        if kind is position_estimates:
            values, std, outside = kind.forecast(*given)
        else:
            values, std, outside, tubes = kind.forecast(*given, asked.coverage, whole)
    units = {name: "rad" if name in map_.sensors.angles else "" for name in values}
    found = Forecast(times, values, std, units, outside)
    if whole is not None:
        return found._replace(band={name: tubes[:, None] * of for name, of in std.items()})
    if asked.coverage is not None:
        # Two standard deviations are calibrated to hold 95 % of the readings.
        factor = 2 * ndtri((1 + asked.coverage) / 2) / ndtri((1 + TUBE) / 2)
        return found._replace(band={name: factor * of for name, of in std.items()})
    return found


def _behind_filter(
    map_: Any, recording: Recording, times: np.ndarray, inputs: Recording | None, asked: Asked
) -> Forecast:
    """The forecast of columns that went through one filter: what moved before it is forecast, from
    where the end of the recording smears nothing, and goes through the filter again."""
    sensors, found = map_.sensors, list[Forecast]()
    bare = dataclasses.replace(map_, sensors=dataclasses.replace(sensors, phase=0.0))
    for run in recording.runs:
        own, t = recording.slice(run=run), recording.times(run)
        step = float(np.mean(np.diff(t)))
        over = mixed(step, sensors.phase)
        known = own.behind_filter(-sensors.phase)
        known = known.slice(stop=max(t[-1] - over, t[min(estimates.FEWEST, len(t)) - 1]))
        inner, outside, enough = known, list[str](), needed(step, sensors.phase)
        if t[-1] - t[0] >= enough:
            inner = known.slice(start=t[0] + over)
        else:
            outside.append(
                f"run {run}: {t[-1] - t[0]:.2g} s of samples are few where a filter mixes those of "
                f"{over:.2g} s: errors are larger than the bands say; give {enough:.2g} s"
            )
        seen, end, driven = known.times(run), times[-1] + over, None
        if inputs is not None:
            ahead = _inputs_along(own, inputs, sensors)
            driven, last = ahead.behind_filter(-sensors.phase), float(ahead.times("0")[-1])
            if last < end:
                end = max(last, times[-1])
                outside.append(
                    f"run {run}: the inputs end at {last:g} s, and the filter mixes what follows "
                    f"into the last {over:.2g} s: give inputs for longer"
                )
        later = seen[-1] + step * np.arange(1, 1 + int(np.ceil((end - seen[-1]) / step - 1e-6)))
        one = forecast(bare, inner, later, driven, asked)
        values = dict(one.values)
        for name in set(values) & set(known.columns):
            whole = np.concatenate([known.values(name, run), values[name][0]])
            values[name] = turned(whole, step, sensors.phase)[None, len(seen) :]
        found.append(one._replace(values=values, outside=(*one.outside, *outside)).at(times))
    return Forecast.of_runs(found)


def _inputs_along(own: Recording, inputs: Recording, sensors: Sensors) -> Recording:
    """The inputs of one run, from its begin on to where those ahead end."""
    (run,) = own.runs
    there = run if len(inputs.runs) > 1 else next(iter(inputs.runs))
    t, begun = inputs.times(there), own.times(run)
    earlier = begun < t[0]
    columns = {
        name: np.concatenate([own.values(name, run)[earlier], inputs.values(name, there)])
        for name in sensors.inputs
    }
    names = tuple(sensors.inputs)
    return Recording({"t": np.concatenate([begun[earlier], t]), **columns}, inputs=names)


def _kind(map_: Any) -> Any:
    """The module that knows maps of this kind. Raises InputError where there is none."""
    if map_.sensors is None:
        raise InputError(
            "expected a map that was learned from a recording and knows its sensors, got one of "
            "pairs or of an older release"
        )
    return position_estimates if map_.of_positions else estimates
