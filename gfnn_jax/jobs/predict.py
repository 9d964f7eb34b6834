"""Job of ``gfnn predict``: a saved map, initial states, and a prediction written in chunks."""

from __future__ import annotations

import hashlib
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from gfnn_jax.data.files import are_recordings, read_initial, read_initial_noise
from gfnn_jax.data.parts import number_of_parts, part_of, put_together
from gfnn_jax.data.predictions import PredictionWriter, is_done, job_of
from gfnn_jax.errors import InputError
from gfnn_jax.jobs.progress import SILENT, Progress
from gfnn_jax.jobs.units import read_in_units, refuse_other_units
from gfnn_jax.maps import saved
from gfnn_jax.maps.bands import bands, horizon
from gfnn_jax.maps.lanes import Lanes
from gfnn_jax.maps.positions import starts_from_positions
from gfnn_jax.maps.samples import Samples
from gfnn_jax.maps.sharded import Sharded
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import TIME
from gfnn_jax.processes import Share, wait_for_all
from gfnn_jax.storage.outputs import ensure_new

# A chunk of a prediction: bytes in memory at once, and steps that a kill may lose.
_CHUNK_BYTES, _CHUNK_LANE_STEPS = 32 * 2**20, 400_000


class Predicted(NamedTuple):
    """Result of a prediction: status and left_at (B,), size of the map's dt, seconds of computing.

    horizon: (B,) where one was asked for. Among several processes the first has all lanes, the
    others have their own.
    """

    status: np.ndarray
    left_at: np.ndarray
    dt: float
    seconds: float
    horizon: np.ndarray | None = None


class _Drawn(NamedTuple):
    """Samples of a prediction, and their initial states z0 (n, B, 2d).

    angles: indices of the angles of a state. size: that of the horizon, or None. of: uncertainties
    that the band contains, as text.
    """

    samples: Samples | Sharded
    z0: np.ndarray
    angles: tuple[int, ...]
    size: float | None
    of: str


class _Request(NamedTuple):
    """Request of a prediction: the map, and ``stepped``, itself or the same over devices."""

    map: SymplecticMap
    stepped: SymplecticMap | Sharded
    num_steps: int
    save_every: int
    stop_outside: bool
    overwrite: bool
    resume: bool


def predict(
    model: Path,
    initial: Path,
    *,
    num_steps: int,
    save_every: int = 1,
    out: Path,
    dt: float | None = None,
    samples: int | None = None,
    horizon_size: float | None = None,
    stop_outside: bool = False,
    devices: int | str | None = None,
    share: Share | None = None,
    overwrite: bool = False,
    resume: bool = False,
    progress: Progress = SILENT,
) -> Predicted:
    """Predict from the initial states in a file, in chunks along the steps, into ``out``.

    num_steps: backwards, by the inverse map, where it is negative, as the saved ``steps`` then are.
    dt: time step, where it is not that of the data; for a map that can step any dt. samples: number
    of maps drawn from the model's posterior, whose spread becomes ``std`` and ``quantiles``. Where
    the file of initial states has their noise ``z0_std``, the spread includes it, and ``band`` says
    so. horizon_size: a length in position space, in the user's units; ``horizon`` (B,) is the first
    saved step at which two standard deviations of the position exceed it, −1 where none does.
    devices: number of devices of this process that share the lanes, or "all"; the bits are the same
    on any number, and after a resume on another number. share: share of the lanes that this process
    predicts. It writes a part of its own, and the first process joins the parts when all are there.
    A resumed job keeps the parts that it began with, shared out anew.

    Memory is one chunk of saved states, at most 32 MiB where a saved state of all lanes is no more
    than that, for any ``num_steps``. With ``resume`` a killed job continues where its last chunk
    ended, to the same bits as an uninterrupted one. Raises InputError for bad input.
    """
    if save_every > abs(num_steps):
        raise InputError(
            f"expected --save-every of at most --num-steps = {abs(num_steps)}, got {save_every}"
        )
    if horizon_size is not None and samples is None:
        raise InputError("--horizon needs --samples: the band is the spread of samples")
    map_ = saved.load(model)
    if dt is not None:
        try:
            map_ = map_.over(dt)
        except ValueError as error:
            raise InputError(f"--dt: {error}") from error
    dt = abs(float(map_.dt))
    names = () if map_.parameters is None else map_.parameters.names
    if starts_from_positions(map_) and are_recordings(initial):
        z0, params = _last_states(map_, model, initial), None
    else:
        z0, params = read_initial(initial, map_.dim, names)
    map_ = map_ if num_steps > 0 else map_.reversed()
    digest = hashlib.sha256(np.ascontiguousarray(z0).data)
    if params is not None:
        digest.update(np.ascontiguousarray(params).data)
    drawn = None
    if samples is not None:
        drawn = _drawn(map_, samples, z0, read_initial_noise(initial, z0.shape), horizon_size)
        digest.update(np.ascontiguousarray(drawn.z0).data)
    stepped: SymplecticMap | Sharded = map_
    if devices is not None or share is not None:
        try:
            stepped = map_.sharded(devices or "all")
        except ValueError as error:
            raise InputError(f"--devices: {error}") from error
        if drawn is not None and isinstance(drawn.samples, Samples):
            drawn = drawn._replace(samples=Sharded(drawn.samples, stepped.devices))
    identity = {
        "model": saved.digest(model),
        "initial": digest.hexdigest(),
        "outside": "stop" if stop_outside else "continue",
        **({} if drawn is None else {"samples": samples, "horizon_size": horizon_size}),
        **({"block": stepped.block} if isinstance(stepped, Sharded) else {}),
    }
    request = _Request(map_, stepped, num_steps, save_every, stop_outside, overwrite, resume)
    if share is None or not isinstance(stepped, Sharded):
        return _written(request, out, z0, params, identity, drawn, progress)
    job = job_of(
        identity,
        z0.shape,
        num_steps=num_steps,
        save_every=save_every,
        dt=dt,
        bands=drawn is not None,
    )
    if not overwrite and resume and is_done(out, job):
        wait_for_all()
        return _finished(out, dt)
    ensure_new(out, overwrite)
    many = number_of_parts(out, share, resume=resume and not overwrite)
    lanes = [Share(i, many).of(len(z0), stepped.block) for i in range(many)]
    parts = [part_of(out, Share(i, many)) for i in range(many)]
    predicted = [Predicted(np.zeros(0, int), np.zeros(0, int), dt, 0.0)]
    for own, part in [*zip(lanes, parts, strict=True)][share.index :: share.count]:
        if own.stop > own.start:
            own_params = None if params is None else params[own]
            own_drawn = None if drawn is None else drawn._replace(z0=drawn.z0[:, own])
            of_part = identity | {"lanes": [own.start, own.stop]}
            predicted.append(
                _written(request, part, z0[own], own_params, of_part, own_drawn, progress)
            )
    progress.status("waiting for the other processes")
    wait_for_all()
    if share.index == 0:
        there = [part for part, own in zip(parts, lanes, strict=True) if own.stop > own.start]
        progress.status(f"writing {out}")
        put_together(there, out, job)
        return _finished(out, dt)._replace(seconds=sum(part.seconds for part in predicted))
    status, left_at = (
        np.concatenate([getattr(part, name) for part in predicted])
        for name in ("status", "left_at")
    )
    return Predicted(status, left_at, dt, sum(part.seconds for part in predicted))


def _last_states(map_: SymplecticMap, model: Path, initial: Path) -> np.ndarray:
    """(B, 2d): the states at the end of every run, from its last two positions."""
    job = saved.record(model).get("job", {})
    names = job.get("positions")
    roles = {"positions": names, "angles": job.get("angles")}
    recording = read_in_units(initial, job, roles)
    refuse_other_units(recording, job)
    ends = np.array([recording.array("positions", run)[-2:] for run in recording.runs])
    if ends.shape[1:] != (2, map_.dim) or not np.isfinite(ends).all():
        raise InputError(
            f"{initial}: expected two positions of {map_.dim} coordinates at the end of every run"
        )
    return np.asarray(map_.step(map_.from_positions(ends[:, 0], ends[:, 1]))[0])


def _written(
    request: _Request, out: Path, z0, params, identity, drawn: _Drawn | None, progress
) -> Predicted:
    """Predict these lanes into one file."""
    map_ = request.map
    dt, parameters = abs(float(map_.dt)), map_.parameters
    own, drive = None, None
    if parameters is not None and params is not None:
        names = parameters.names
        own = names, params
        if TIME in names:
            drive = params[:, -1], float(np.asarray(parameters.period))
            own = (names[:-1], params[:, :-1]) if len(names) > 1 else None
    writer = PredictionWriter(
        out,
        shape=z0.shape,
        num_steps=request.num_steps,
        save_every=request.save_every,
        dt=dt,
        identity=identity,
        params=own,
        drive=drive,
        bands=drawn is not None,
        overwrite=request.overwrite,
        resume=request.resume,
    )
    started = time.perf_counter()
    if writer.finished:
        return _finished(out, dt)
    try:
        lanes = _go_on(request, z0, params, writer, drawn, progress)
        progress.status(f"writing {out}")
        status, left_at = np.asarray(lanes.status), np.asarray(lanes.left_at)
        more: dict[str, Any] = {} if drawn is None else {"band": drawn.of}
        passed = None
        if drawn is not None and drawn.size is not None:
            assert writer.carry is not None
            passed = writer.carry["horizon"]
            more |= {"horizon": passed, "horizon_size": drawn.size}
        writer.finish(status, left_at, **more)
    except KeyboardInterrupt as stop:
        if not writer.finished:
            done = max(0, writer.saved - 1) * request.save_every
            stop.add_note(
                f"{writer.partial} keeps {done} of {abs(request.num_steps)} steps: --resume goes "
                "on with it"
            )
        raise
    return Predicted(status, left_at, dt, time.perf_counter() - started, passed)


def _finished(out: Path, dt: float) -> Predicted:
    """Read the result of a prediction that is already there."""
    with np.load(out, allow_pickle=False) as done:
        return Predicted(done["status"], done["left_at"], dt, 0.0, done.get("horizon"))


def _drawn(map_: SymplecticMap, count: int, z0, std, size: float | None) -> _Drawn:
    """Draw the samples of a prediction, the same for the same model and initial states."""
    try:
        samples = map_.sample(jax.random.key(0), count)
    except ValueError as error:
        raise InputError(f"--samples: {error}") from error
    begun = np.broadcast_to(z0, (count, *z0.shape))
    of = "model"
    if std is not None:
        begun = begun + std * np.random.default_rng(1).normal(size=begun.shape)
        of = "model and initial state"
    return _Drawn(samples, begun, map_.angles_of_z, size, of)


def _go_on(
    request: _Request, z0, params, writer: PredictionWriter, drawn: _Drawn | None, progress
) -> Lanes:
    """Compute all chunks that are not yet written; return the lanes after the last step."""
    map_, save_every, stop_outside = request.stepped, request.save_every, request.stop_outside
    of_samples = None
    passed = np.full(len(z0), -1)
    if writer.carry is None:
        lanes = map_.start(z0, params=params, stop_outside=stop_outside)
        states = z0[:, None]
        if drawn is not None:
            of_samples = drawn.samples.start(drawn.z0, params=params, stop_outside=stop_outside)
            states, passed = _with_bands(drawn, states, drawn.z0[:, :, None], [0], passed)
        writer.append(states, _carry(lanes, of_samples, passed))
    else:
        carry = {name: jax.device_put(value) for name, value in writer.carry.items()}
        lanes = Lanes(**{name: carry[name] for name in Lanes._fields})
        if drawn is not None:
            of_samples = Lanes(**{name: carry[_OF_SAMPLES + name] for name in Lanes._fields})
            passed = writer.carry["horizon"]
    many = 1 if drawn is None else 1 + len(drawn.z0)
    chunk = _chunk_length(z0.shape[0] * many, z0.shape[1], save_every)
    options = {"params": params, "save_every": save_every, "stop_outside": stop_outside}
    started, begun = time.perf_counter(), writer.saved
    while writer.saved < writer.total:
        progress.status(
            f"step {(writer.saved - 1) * save_every} of {abs(request.num_steps)}"
            + _time_left(time.perf_counter() - started, writer.saved - begun, writer)
        )
        count = min(chunk, writer.total - writer.saved)
        lanes, states = map_.advance(lanes, count, **options)
        if drawn is not None and of_samples is not None:
            of_samples, others = drawn.samples.advance(of_samples, count, **options)
            steps = np.abs(writer.steps[writer.saved : writer.saved + count])
            states, passed = _with_bands(drawn, states, others, steps, passed)
        writer.append(states, _carry(lanes, of_samples, passed))
    return lanes


def _time_left(seconds: float, done: int, writer: PredictionWriter) -> str:
    """Message about the time left, at the rate of ``done`` saved states in these seconds."""
    if not done:
        return ""
    return f", about {seconds * (writer.total - writer.saved) / done:.0f} s left"


_OF_SAMPLES = "samples_"  # prefix of the samples' lanes in a carry


def _carry(lanes: Lanes, of_samples: Lanes | None, passed) -> dict[str, Any]:
    """Arrays from which a prediction can be continued."""
    if of_samples is None:
        return lanes._asdict()
    others = {_OF_SAMPLES + name: value for name, value in of_samples._asdict().items()}
    return {**lanes._asdict(), **others, "horizon": passed}


def _with_bands(drawn: _Drawn, states, others, steps, passed) -> tuple[np.ndarray, np.ndarray]:
    """Join states with their std and quantiles (B, c, 5 · 2d); update the horizons (B,)."""
    found = bands(others, states, drawn.angles)
    if drawn.size is not None:
        passed = np.where(passed < 0, horizon(found.std, steps, drawn.size), passed)
    return np.concatenate([states, found.std, *found.quantiles], axis=-1), passed


def _chunk_length(num_lanes: int, width: int, save_every: int) -> int:
    """Number of saved states per chunk, a function of the job alone: a resumed job has the same."""
    by_memory = _CHUNK_BYTES // (8 * num_lanes * width)
    by_operations = _CHUNK_LANE_STEPS // (num_lanes * save_every)
    return max(1, min(by_memory, by_operations))
