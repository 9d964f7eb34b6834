"""What ``gfnn predict MODEL --initial RECORDING`` does: forecasts from the end of each run.

The file written has times (R, n), values and std (R, n, d) by runs and columns; with .csv at its
end, columns run, t, each position and std_ of each. Angles are in radians.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.data.recording import Recording, read
from gfnn_jax.errors import InputError
from gfnn_jax.maps.estimates import Forecast, forecast
from gfnn_jax.maps.saved import load
from gfnn_jax.storage.outputs import atomic_write, ensure_new


class Judged(NamedTuple):
    """A forecast against what was measured: column -> (root mean square error, its median size,
    share of samples within two standard deviations), and the number of samples."""

    columns: dict[str, tuple[float, float, float]]
    num_samples: int


def forecast_recording(
    model: Path, initial: Path, *, out: Path, num_steps: int | None = None, save_every: int = 1,
    estimate_from: int | None = None, inputs: Path | None = None, compare: Path | None = None,
    columns: dict[str, Any] | None = None, overwrite: bool = False,
) -> tuple[dict[str, Forecast], Judged | None]:  # fmt: skip
    """Forecast from the states at the ends of a recording's runs; run -> its forecast.

    num_steps: of the model's dt; saved every so many. estimate_from: samples of each run that the
    state is estimated from; None: as many as the model found best. inputs: a recording of the
    inputs ahead. compare: one of what was measured, which gives the times. columns: keywords of
    `gfnn_jax.read` beside the roles, which the model knows.
    """
    ensure_new(out, overwrite)
    if num_steps is not None and num_steps < 0:
        raise InputError("expected --num-steps above 0: a forecast begins where a recording ends")
    map_ = load(model)
    if map_.sensors is None:
        raise InputError(f"{model}: was not learned from a recording: --initial needs states q, p")
    sensors = map_.sensors
    roles = {"positions": sensors.positions, "inputs": sensors.inputs, "angles": sensors.angles}
    roles = {**(columns or {}), **{k: v for k, v in roles.items() if v or k == "angles"}}
    if set(sensors.positions) & set(roles.get("degrees", ())):
        del roles["angles"]
    recording = read(initial, **roles)
    ahead = None if inputs is None else read(inputs, **{**roles, "positions": None})
    measured = None if compare is None else read(compare, **roles)
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
                raise InputError(f"{compare}: run {run}: holds no sample after {last:g} s")
        else:
            assert num_steps is not None
            steps = np.arange(save_every, num_steps + 1, save_every)
            times = last + float(np.asarray(map_.dt)) * steps
        found[run] = forecast(map_, part, times, ahead)
    _write(out, sensors.positions, found)
    return found, None if measured is None else _judged(sensors, found, measured)


def _last_samples(recording: Recording, run: str, count: int | None) -> Recording:
    if count is None:
        return recording
    times = recording.times(run)
    return recording.slice(start=float(np.sort(times)[-min(count, len(times)) :].min()))


def _judged(sensors: Any, found: dict[str, Forecast], measured: Recording) -> Judged:
    columns, count = {}, 0
    for name in sensors.positions:
        errors, stds = [], []
        for run, one in found.items():
            own = run if len(measured.runs) > 1 else next(iter(measured.runs))
            at = np.searchsorted(measured.times(own), one.times)
            error = one.values[name][0] - measured.values(name, own)[at]
            if name in sensors.angles:
                error = (error + np.pi) % (2 * np.pi) - np.pi
            seen = np.isfinite(error)
            errors.append(error[seen])
            stds.append(one.std[name][0][seen])
        error, std = np.concatenate(errors), np.concatenate(stds)
        rms, median = np.sqrt(np.mean(error**2)), np.median(np.abs(error))
        columns[name] = (float(rms), float(median), float(np.mean(np.abs(error) <= 2 * std)))
        count = len(error)
    return Judged(columns, count)


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
        values=np.stack([
            padded(np.stack([f.values[n][0] for n in names], axis=1)) for f in found.values()
        ]),
        std=np.stack([
            padded(np.stack([f.std[n][0] for n in names], axis=1)) for f in found.values()
        ]),
    )  # fmt: skip
    atomic_write(out, stream.getvalue())
