"""Job of ``gfnn predict MODEL --initial RECORDING``: forecasts from the end of each run.

The file written has times (R, n), values and std (R, n, d) by runs and columns; with .csv at its
end, columns run, t, each position and std_ of each. Times are in the unit of the recording that is
gone on from, and so are values; of columns that it lacks in those of the law's.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.data.recording import SECONDS, Recording
from gfnn_jax.errors import InputError
from gfnn_jax.jobs.units import read_in_units, refuse_other_units
from gfnn_jax.maps.estimates import Forecast
from gfnn_jax.maps.saved import load, record
from gfnn_jax.maps.sensors import Sensors
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.storage.outputs import atomic_write, ensure_new


class Comparison(NamedTuple):
    """A forecast against what was measured: column -> (root mean square error, its median size,
    both in the column's unit, share of samples within two standard deviations), the units, and the
    number of samples."""

    columns: dict[str, tuple[float, float, float]]
    units: dict[str, str]
    num_samples: int


class Forecasts(NamedTuple):
    """Forecasts by run, the unit of their times, and how they compare with what was measured."""

    of_runs: dict[str, Forecast]
    time_unit: str
    compared: Comparison | None


def forecast_recording(
    model: Path,
    initial: Path,
    *,
    out: Path,
    num_steps: int | None = None,
    save_every: int = 1,
    stop: float | None = None,
    estimate_from: int | None = None,
    inputs: Path | None = None,
    compare: Path | None = None,
    columns: dict[str, Any] | None = None,
    overwrite: bool = False,
) -> Forecasts:
    """Forecast from the states at the ends of a recording's runs.

    num_steps: of the model's dt; saved every so many. stop: time, in the file's unit, at which the
    recording ends that lies in the file. estimate_from: samples of each run that the
    state is estimated from; None: as many as the model found best. inputs: a recording of the
    inputs ahead. compare: one of what was measured, which gives the times. columns: keywords of
    `gfnn_jax.read` beside the roles, which the model knows.
    """
    ensure_new(out, overwrite)
    if out.suffix not in (".csv", ".npz"):
        raise InputError(f"{out}: a forecast is written as .csv or .npz")
    if num_steps is not None and num_steps < 0:
        raise InputError("expected --num-steps above 0: a forecast begins where a recording ends")
    map_ = load(model)
    if map_.sensors is None:
        raise InputError(f"{model}: was not learned from a recording: --initial needs states q, p")
    sensors = map_.sensors
    job = record(model).get("job", {})
    columns = columns or {}
    recording, roles = _read(initial, map_, job, columns)
    if stop is not None:
        recording = recording.slice(stop=stop * SECONDS[recording.time_unit])
    ahead = None
    if inputs is not None:
        bare = ("positions", "velocities", "sensors", "coordinates", "angles", "parameters")
        ahead = read_in_units(inputs, job, {**roles, **dict.fromkeys(bare)})
        refuse_other_units(ahead, job)
    measured = None if compare is None else _read(compare, map_, job, columns)[0]
    if num_steps is None and measured is None:
        raise InputError("expected --num-steps, or --compare, whose times the forecast is for")
    if ahead is None and sensors.inputs and measured is not None:
        ahead = measured
    found: dict[str, Forecast] = {}
    for run in recording.runs:
        part = _last_samples(recording.slice(run=run), run, estimate_from)
        last = float(np.max(part.times(run)))
        if measured is not None:
            own = measured.times(run if len(measured.runs) > 1 else next(iter(measured.runs)))
            times = own[own > last]
            times = times[:num_steps] if num_steps else times
            if not len(times):
                raise InputError(
                    f"{compare}: holds no sample of run {run} after the end of {initial}, {last:g} "
                    "s. To forecast a part of one file: --to T ends --initial there"
                )
        else:
            assert num_steps is not None
            steps = np.arange(save_every, num_steps + 1, save_every)
            times = last + float(np.asarray(map_.dt)) * steps
        found[run] = map_.forecast(part, times, ahead)
    compared = None if measured is None else _compared(sensors, found, measured)
    second = SECONDS[recording.time_unit]
    factors = dict.fromkeys(job.get("degrees", ()), np.pi / 180) | recording.factors
    found = {run: _in_units(one, factors, second) for run, one in found.items()}
    _write(out, tuple(next(iter(found.values())).values), found)
    return Forecasts(found, recording.time_unit, compared)


def _read(
    path: Path, map_: SymplecticMap, job: dict[str, Any], columns: dict[str, Any]
) -> tuple[Recording, dict[str, Any]]:
    """Read a recording with the columns that the law was learned from, but for velocities that it
    may lack, and return the keywords of `read` too."""
    sensors = map_.sensors
    assert sensors is not None
    observation = sensors.observation_model
    varied = () if map_.parameters is None else map_.parameters.names
    columns = {"parameters": varied, **columns}
    roles = _roles(sensors, observation.channels) | columns
    try:
        recording = read_in_units(path, job, roles)
    except InputError:
        if observation.needed == observation.channels:
            raise
        roles = _roles(sensors, observation.needed) | columns
        recording = read_in_units(path, job, roles)
    # Outside of ``try``: a velocity in another unit is no velocity that is lacking.
    refuse_other_units(recording, job)
    return recording, roles


def _roles(sensors: Sensors, channels: tuple[str, ...]) -> dict[str, Any]:
    """Keywords of `read` for a recording with these columns."""
    speeds = sensors.observation_model.speeds
    return {
        "positions": tuple(n for n in channels if n in sensors.positions),
        "velocities": tuple(n for n in channels if n in speeds),
        "sensors": tuple(n for n in channels if n not in (*sensors.positions, *speeds)),
        "inputs": sensors.inputs,
        "coordinates": sensors.positions,
        "angles": sensors.angles,
    }


def _in_units(one: Forecast, factors: Mapping[str, float], second: float) -> Forecast:
    """Convert to the units of the file."""
    values, std = (
        {name: array / factors.get(name, 1.0) for name, array in of.items()}
        for of in (one.values, one.std)
    )
    return Forecast(one.times / second, values, std, one.outside)


def _last_samples(recording: Recording, run: str, count: int | None) -> Recording:
    if count is None:
        return recording
    times = recording.times(run)
    return recording.slice(start=float(np.sort(times)[-min(count, len(times)) :].min()))


def _compared(sensors: Sensors, found: dict[str, Forecast], measured: Recording) -> Comparison:
    """Forecasts, in seconds and radians, against what was measured, in the units of its file."""
    columns, count = {}, 0
    for name in (n for n in sensors.observation_model.channels if n in measured.columns):
        errors, stds = [], []
        for run, one in found.items():
            own = run if len(measured.runs) > 1 else next(iter(measured.runs))
            factor = measured.factors[name]
            times = measured.times(own)
            at = np.searchsorted(times, one.times - 0.5 * np.min(np.diff(times)))
            error = (one.values[name][0] - measured.values(name, own)[at]) / factor
            if name in sensors.angles:
                half = np.pi / factor
                error = (error + half) % (2 * half) - half
            finite = np.isfinite(error)
            errors.append(error[finite])
            stds.append(one.std[name][0][finite] / factor)
        error, std = np.concatenate(errors), np.concatenate(stds)
        rms, median = np.sqrt(np.mean(error**2)), np.median(np.abs(error))
        columns[name] = (float(rms), float(median), float(np.mean(np.abs(error) <= 2 * std)))
        count = len(error)
    return Comparison(columns, {name: measured.unit(name) for name in columns}, count)


def _write(out: Path, names: tuple[str, ...], found: dict[str, Forecast]) -> None:
    if out.suffix == ".csv":
        header = ",".join(["run", "t", *names, *(f"std_{n}" for n in names)])
        rows = [
            ",".join([run, *(f"{x:.10g}" for x in row)])
            for run, f in found.items()
            for row in np.stack(
                [f.times, *(f.values[n][0] for n in names), *(f.std[n][0] for n in names)], axis=1
            )
        ]
        atomic_write(out, "\n".join([header, *rows]) + "\n")
        return
    length = max(len(f.times) for f in found.values())

    def padded(a: np.ndarray) -> np.ndarray:
        return np.concatenate([a, np.full((length - len(a), *a.shape[1:]), np.nan)])

    stream = io.BytesIO()
    np.savez(
        stream,
        runs=np.array(list(found)),
        columns=np.array(names),
        times=np.stack([padded(f.times) for f in found.values()]),
        values=np.stack(
            [padded(np.stack([f.values[n][0] for n in names], axis=1)) for f in found.values()]
        ),
        std=np.stack(
            [padded(np.stack([f.std[n][0] for n in names], axis=1)) for f in found.values()]
        ),
    )
    atomic_write(out, stream.getvalue())
