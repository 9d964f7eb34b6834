"""What ``gfnn predict`` does: a saved map, initial states, and a prediction written as it grows."""

from __future__ import annotations

import hashlib
import time
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from gfnn_jax.data.files import read_initial
from gfnn_jax.data.predictions import PredictionWriter
from gfnn_jax.errors import InputError
from gfnn_jax.jobs.progress import SILENT, Progress
from gfnn_jax.maps import saved
from gfnn_jax.maps.symplectic_map import Lanes, SymplecticMap
from gfnn_jax.phase_space import TIME

# A chunk of a prediction: what is held in memory at once, and how much work a kill may lose.
_CHUNK_BYTES, _CHUNK_LANE_STEPS = 32 * 2**20, 400_000


class Predicted(NamedTuple):
    """How a prediction ended: status and left_at (B,), the map's dt, seconds of computing."""

    status: np.ndarray
    left_at: np.ndarray
    dt: float
    seconds: float


def predict(
    model: Path,
    initial: Path,
    *,
    num_steps: int,
    save_every: int = 1,
    out: Path,
    dt: float | None = None,
    stop_outside: bool = False,
    overwrite: bool = False,
    resume: bool = False,
    progress: Progress = SILENT,
) -> Predicted:
    """Predict from the initial states in a file, in chunks along the steps, into ``out``.

    dt: of a step, where it is not that of the data: of a map that is the flow of a Hamiltonian.
    Memory: one chunk of saved states, 32 MiB at most where a saved state of all lanes is no more
    than that, whatever ``num_steps``. A job that was killed goes on with ``resume`` where its last
    chunk ended, to the very bits that an uninterrupted one gives.
    """
    if save_every > num_steps:
        raise InputError(
            f"expected --save-every of at most --num-steps, {num_steps}; got {save_every}"
        )
    map_ = saved.load(model)
    if dt is not None:
        try:
            map_ = map_.over(dt)
        except ValueError as error:
            raise InputError(f"--dt: {error}") from error
    dt = float(map_.dt)
    names = () if map_.parameters is None else map_.parameters.names
    z0, params = read_initial(initial, map_.dim, names)
    digest = hashlib.sha256(np.ascontiguousarray(z0).data)
    if params is not None:
        digest.update(np.ascontiguousarray(params).data)
    identity = {
        "model": saved.digest(model),
        "initial": digest.hexdigest(),
        "outside": "stop" if stop_outside else "continue",
    }
    own, drive = None if params is None else (names, params), None
    if params is not None and map_.parameters is not None and TIME in names:
        drive = params[:, -1], float(np.asarray(map_.parameters.period))
        own = (names[:-1], params[:, :-1]) if len(names) > 1 else None
    writer = PredictionWriter(
        out, shape=z0.shape, num_steps=num_steps, save_every=save_every, dt=dt,
        identity=identity, params=own, drive=drive,
        overwrite=overwrite, resume=resume,
    )  # fmt: skip
    started = time.perf_counter()
    if writer.finished:
        with np.load(out, allow_pickle=False) as done:
            return Predicted(done["status"], done["left_at"], dt, 0.0)
    try:
        lanes = _go_on(map_, z0, params, writer, num_steps, save_every, stop_outside, progress)
        progress.say(f"writing {out}")
        status, left_at = np.asarray(lanes.status), np.asarray(lanes.left_at)
        writer.finish(status, left_at)
    except KeyboardInterrupt as stop:
        if not writer.finished:
            done = max(0, writer.saved - 1) * save_every
            stop.add_note(
                f"{writer.partial} keeps {done} of {num_steps} steps: --resume goes on with it"
            )
        raise
    return Predicted(status, left_at, dt, time.perf_counter() - started)


def _go_on(
    map_: SymplecticMap, z0, params, writer: PredictionWriter, num_steps, save_every, stop_outside,
    progress,
) -> Lanes:  # fmt: skip
    """All chunks that are not yet written; returns the lanes after the last step."""
    if writer.carry is None:
        lanes = map_.start(z0, params=params, stop_outside=stop_outside)
        writer.append(z0[:, None], lanes._asdict())
    else:
        lanes = Lanes(**{name: jax.device_put(value) for name, value in writer.carry.items()})
    chunk = _chunk_length(z0.shape[0], z0.shape[1], save_every)
    while writer.saved < writer.total:
        progress.say(f"step {(writer.saved - 1) * save_every} of {num_steps}")
        count = min(chunk, writer.total - writer.saved)
        lanes, states = map_.advance(
            lanes, count, params=params, save_every=save_every, stop_outside=stop_outside
        )
        writer.append(states, lanes._asdict())
    return lanes


def _chunk_length(num_lanes: int, width: int, save_every: int) -> int:
    """Saved states per chunk: a function of the job alone, so that a resumed one cuts alike."""
    by_memory = _CHUNK_BYTES // (8 * num_lanes * width)
    by_operations = _CHUNK_LANE_STEPS // (num_lanes * save_every)
    return max(1, min(by_memory, by_operations))
