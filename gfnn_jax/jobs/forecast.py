"""Job of ``gfnn predict MODEL --initial RECORDING``: forecasts from the end of each run.

The file written has times (R, n), values and std (R, n, d) by runs and columns; with .csv at its
end, columns run, t, each position and std_ of each. Times are in the unit of the recording that is
gone on from, and so are values; of columns that it lacks in those of the law's.
"""

import dataclasses
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.data.recording import SECONDS, Recording
from gfnn_jax.data.text_files import to_text
from gfnn_jax.errors import InputError
from gfnn_jax.jobs.output import Output, read_in_units, refuse_other_units
from gfnn_jax.maps.forecasts import Forecast, forecast
from gfnn_jax.maps.saved import load, record
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.storage.outputs import atomic_write, ensure_new


@dataclasses.dataclass(frozen=True)
class Ahead:
    """Request of a forecast.

    num_steps: of the model's dt; saved every so many. stop: time, in the file's unit, at which the
    recording ends that lies in the file. estimate_from: samples of each run that the state is
    estimated from; None: as many as the model found best. inputs: a recording of the inputs ahead.
    compare: one of what was measured, which gives the times. columns: keywords of `gfnn_jax.read`
    beside the roles, which the model knows.
    """

    num_steps: int | None = None
    save_every: int = 1
    stop: float | None = None
    estimate_from: int | None = None
    inputs: Path | None = None
    compare: Path | None = None
    columns: Mapping[str, Any] = dataclasses.field(default_factory=dict)


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


def forecast_recording(model: Path, initial: Path, output: Output, asked: Ahead) -> Forecasts:
    """Forecast from the states at the ends of a recording's runs."""
    out, num_steps = output.out, asked.num_steps
    ensure_new(out, output.overwrite)
    if out.suffix not in (".csv", ".npz"):
        raise InputError(f"{out}: a forecast is written as .csv or .npz")
    if num_steps is not None and num_steps < 0:
        raise InputError("expected --num-steps, above 0: a forecast begins where a recording ends")
    if num_steps is None and asked.compare is None:
        raise InputError("expected --num-steps, or --compare, whose times the forecast is for")
    known = _Model(model, asked.columns)
    recording, roles = known.read(initial)
    if asked.stop is not None:
        recording = recording.slice(stop=asked.stop * SECONDS[recording.time_unit])
    measured = None if asked.compare is None else known.read(asked.compare)[0]
    ahead = measured if known.sensors.inputs else None
    if asked.inputs is not None:
        bare = ("positions", "velocities", "sensors", "coordinates", "angles", "parameters")
        ahead = read_in_units(asked.inputs, known.job, {**roles, **dict.fromkeys(bare)})
        refuse_other_units(ahead, known.job)
    found: dict[str, Forecast] = {}
    for run in recording.runs:
        part, times = recording.slice(run=run), recording.times(run)
        if asked.estimate_from is not None:
            part = part.slice(start=float(times[-min(asked.estimate_from, len(times))]))
        last = float(times[-1])
        if measured is None:
            assert num_steps is not None
            steps = np.arange(asked.save_every, num_steps + 1, asked.save_every)
            times = last + float(np.asarray(known.map.dt)) * steps
        else:
            own = measured.times(_same_run(measured, run))
            times = own[own > last][:num_steps]
            if not len(times):
                raise InputError(
                    f"{asked.compare}: holds no sample of run {run} after the end of {initial}, "
                    f"{last:g} s. To forecast a part of one file, end it by --to"
                )
        found[run] = forecast(known.map, part, times, ahead)
    compared = None if measured is None else _compared(known, found, measured)
    second = SECONDS[recording.time_unit]
    factors = dict.fromkeys(known.job.get("degrees", ()), np.pi / 180) | recording.factors
    found = {run: one.divided(factors, second) for run, one in found.items()}
    _write(out, found)
    return Forecasts(found, recording.time_unit, compared)


class _Model:
    """A saved model of a recording: the map, its sensors, and the job that it was learned in."""

    def __init__(self, folder: Path, columns: Mapping[str, Any]):
        self.map: SymplecticMap = load(folder)
        if self.map.sensors is None:
            raise InputError(f"{folder}: not learned from a recording: --initial needs states q, p")
        self.sensors = self.map.sensors
        self.job = record(folder).get("job", {})
        varied = () if self.map.parameters is None else self.map.parameters.names
        self.columns = {"parameters": varied, **columns}

    def read(self, path: Path) -> tuple[Recording, dict[str, Any]]:
        """Read a recording with the columns that the law was learned from, but for velocities that
        it may lack, and return the keywords of `gfnn_jax.read` too."""
        observation = self.sensors.observation_model
        roles = self._roles(observation.channels)
        try:
            recording = read_in_units(path, self.job, roles)
        except InputError:
            if observation.needed == observation.channels:
                raise
            roles = self._roles(observation.needed)
            recording = read_in_units(path, self.job, roles)
        # Outside of ``try``: a velocity in another unit is no velocity that is lacking.
        refuse_other_units(recording, self.job)
        return recording, roles

    def _roles(self, channels: tuple[str, ...]) -> dict[str, Any]:
        positions, speeds = self.sensors.positions, self.sensors.observation_model.speeds
        return {
            "positions": tuple(n for n in channels if n in positions),
            "velocities": tuple(n for n in channels if n in speeds),
            "sensors": tuple(n for n in channels if n not in (*positions, *speeds)),
            "inputs": self.sensors.inputs,
            "coordinates": positions,
            "angles": self.sensors.angles,
            **self.columns,
        }


def _same_run(measured: Recording, run: str) -> str:
    """Name of the measured run that goes on with this one: its only one, or that of this name."""
    return run if len(measured.runs) > 1 else next(iter(measured.runs))


def _compared(known: _Model, found: dict[str, Forecast], measured: Recording) -> Comparison:
    """Forecasts, in seconds and radians, against what was measured, in the units of its file."""
    columns, count = {}, 0
    for name in (n for n in known.sensors.observation_model.channels if n in measured.columns):
        errors, stds = [], []
        for run, one in found.items():
            own, factor = _same_run(measured, run), measured.factors[name]
            times = measured.times(own)
            at = np.searchsorted(times, one.times - 0.5 * np.min(np.diff(times)))
            error = (one.values[name][0] - measured.values(name, own)[at]) / factor
            if name in known.sensors.angles:
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


def _write(out: Path, found: dict[str, Forecast]) -> None:
    names = tuple(next(iter(found.values())).values)
    values = {run: np.stack([f.values[n][0] for n in names], axis=1) for run, f in found.items()}
    std = {run: np.stack([f.std[n][0] for n in names], axis=1) for run, f in found.items()}
    times = {run: one.times for run, one in found.items()}
    if out.suffix == ".csv":
        table = [np.column_stack([times[r], values[r], std[r]]) for r in found]
        heads = ["t", *names, *(f"std_{name}" for name in names)]
        columns = dict(zip(heads, np.concatenate(table).T, strict=True))
        runs = np.repeat(list(found), [len(t) for t in times.values()])
        atomic_write(out, to_text({"run": runs, **columns}))
        return
    longest = max(map(len, times.values()))

    def padded(of_runs: Mapping[str, np.ndarray]) -> np.ndarray:
        rows = np.full((len(found), longest, *of_runs[next(iter(found))].shape[1:]), np.nan)
        for row, values in zip(rows, of_runs.values(), strict=True):
            row[: len(values)] = values
        return rows

    stream, of_runs = io.BytesIO(), {"times": times, "values": values, "std": std}
    arrays: dict[str, Any] = {name: padded(each) for name, each in of_runs.items()}
    np.savez(stream, runs=np.array(list(found)), columns=np.array(names), **arrays)
    atomic_write(out, stream.getvalue())
