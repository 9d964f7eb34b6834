"""States estimated from a recording, and forecasts with bands, of a map that knows its sensors.

`estimates` does it for the map of a law, `position_estimates` for one of positions alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtri

from gfnn_jax.data.recording import Recording
from gfnn_jax.errors import InputError
from gfnn_jax.maps import estimates, position_estimates
from gfnn_jax.maps.sensors import TUBE
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
        values, std, band = (
            None if of is None else {name: x / factors.get(name, 1.0) for name, x in of.items()}
            for of in (self.values, self.std, self.band)
        )
        return self._replace(times=self.times / second, values=values, std=std, band=band)


def estimate(map_: Any, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """`SymplecticMap.estimate`."""
    with one_thread():
        return _kind(map_).estimate(map_, recording)


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


def _kind(map_: Any) -> Any:
    """The module that knows maps of this kind. Raises InputError where there is none."""
    if map_.sensors is None:
        raise InputError(
            "expected a map that was learned from a recording and knows its sensors, got one of "
            "pairs or of an older release"
        )
    return position_estimates if map_.of_positions else estimates
