"""States estimated from a recording, and forecasts with bands, of a map that knows its sensors.

`estimates` does it for the map of a law, `position_estimates` for one of positions alone.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.data.recording import Recording
from gfnn_jax.errors import InputError
from gfnn_jax.maps import estimates, position_estimates
from gfnn_jax.threads import one_thread


class Forecast(NamedTuple):
    """Forecast of what sensors will show, and of coordinates that no column is named for: name ->
    (runs, n), and their standard deviations. times: in seconds. units: of the values, "" where it
    is not known. outside: lines about runs whose parameters, or whose motion, lie beyond those that
    the law was learned from, which the standard deviations leave out."""

    times: np.ndarray
    values: dict[str, np.ndarray]
    std: dict[str, np.ndarray]
    units: dict[str, str]
    outside: tuple[str, ...] = ()

    def in_units_of(self, recording: Recording) -> Forecast:
        """Convert values and standard deviations to the units of a recording's file."""
        factors = recording.factors
        values, std = (
            {name: array / factors.get(name, 1.0) for name, array in of.items()}
            for of in (self.values, self.std)
        )
        units = {n: recording.unit(n) if n in factors else unit for n, unit in self.units.items()}
        return self._replace(values=values, std=std, units=units)


def estimate(map_: Any, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """`SymplecticMap.estimate`."""
    with one_thread():
        return _kind(map_).estimate(map_, recording)


def forecast(
    map_: Any, recording: Recording, times: Any, inputs: Recording | None = None
) -> Forecast:
    """`SymplecticMap.forecast`, in radians and the units of the columns' numbers."""
    times = np.atleast_1d(np.asarray(times, float))
    if times.ndim != 1 or not np.all(np.diff(times) > 0):
        raise InputError("expected rising times (n,) of a forecast")
    with one_thread():
        values, std, outside = _kind(map_).forecast(map_, recording, times, inputs)
    units = {name: "rad" if name in map_.sensors.angles else "" for name in values}
    return Forecast(times, values, std, units, outside)


def _kind(map_: Any) -> Any:
    """The module that knows maps of this kind. Raises InputError where there is none."""
    if map_.sensors is None:
        raise InputError(
            "expected a map that was learned from a recording and knows its sensors, got one of "
            "pairs or of an older release"
        )
    return position_estimates if map_.of_positions else estimates
