"""Job of ``gfnn predict``: a saved map, initial states, and a prediction written in chunks."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from gfnn_jax.data import predictions
from gfnn_jax.data.blocks import damage
from gfnn_jax.data.files import are_recordings, read_initial, read_initial_noise
from gfnn_jax.data.recording import args_of
from gfnn_jax.errors import FitError, InputError
from gfnn_jax.jobs.output import Output, digest_of, read_in_units, refuse_other_units
from gfnn_jax.maps import saved
from gfnn_jax.maps.lanes import Lanes
from gfnn_jax.maps.posterior import bands, horizon
from gfnn_jax.maps.samples import Samples
from gfnn_jax.maps.sharded import Sharded
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import TIME
from gfnn_jax.processes import Share, wait_for_all
from gfnn_jax.storage.outputs import ensure_new

# A chunk of a prediction: bytes in memory at once, and steps that a kill may lose.
_CHUNK_BYTES, _CHUNK_LANE_STEPS = 32 * 2**20, 400_000
_OF_SAMPLES = "samples_"  # prefix of the samples' lanes in a carry


@dataclasses.dataclass(frozen=True)
class Steps:
    """Request of a prediction.

    num_steps:  backwards, by the inverse map, where negative, as the saved ``steps`` then are.
    save_every: of the steps that are saved. dt: time step, where it is not that of the data; for a
                map that can step any dt.
    samples:    number of maps drawn from the model's posterior, whose spread becomes ``std`` and
                ``quantiles``. Where the file of initial states has their noise ``z0_std``, the
                spread includes it, and ``band`` says so.
    horizon:    a length in position space, in the user's units; ``horizon`` (B,) of the file is the
                first saved step at which two standard deviations of the position exceed it, −1
                where none does.
    outside:    "stop" or "continue" where a trajectory leaves the domain; None: continue.
    devices:    number of devices of this process that share the lanes, or "all"; the bits are the
                same on any number, and after a resume on another number.
    """

    num_steps: int
    save_every: int = 1
    dt: float | None = None
    samples: int | None = None
    horizon: float | None = None
    outside: str | None = None
    devices: int | str | None = None

    def check(self) -> None:
        """Raises InputError where the options contradict each other."""
        if self.save_every > abs(self.num_steps):
            most, got = abs(self.num_steps), self.save_every
            raise InputError(f"expected --save-every of at most {most} (--num-steps), got {got}")
        if self.horizon is not None and self.samples is None:
            raise InputError("--horizon needs --samples: the band is the spread of samples")


class Predicted(NamedTuple):
    """Result of a prediction: status and left_at (B,), seconds of computing.

    horizon: (B,) where one was asked for. Among several processes the first has all lanes, the
    others have their own.
    """

    status: np.ndarray
    left_at: np.ndarray
    seconds: float
    horizon: np.ndarray | None = None


class _Begin(NamedTuple):
    """Initial states z0 (B, 2d), their parameters (B, k), and those of samples (n, B, 2d)."""

    z0: np.ndarray
    params: np.ndarray | None
    of_samples: np.ndarray | None

    def of(self, lanes: slice) -> _Begin:
        of_samples = None if self.of_samples is None else self.of_samples[:, lanes]
        params = None if self.params is None else self.params[lanes]
        return _Begin(self.z0[lanes], params, of_samples)


def predict(
    model: Path, initial: Path, output: Output, asked: Steps, share: Share | None = None
) -> Predicted:
    """Predict from the initial states in a file, in chunks along the steps, into the output.

    share: share of the lanes that this process predicts. It writes a part of its own, and the first
    process joins the parts when all are there. A resumed job keeps the parts that it began with,
    shared out anew.

    Memory is one chunk of saved states, at most 32 MiB where a saved state of all lanes is no more
    than that, for any number of steps. A killed job that is resumed continues where its last chunk
    ended, to the same bits as an uninterrupted one. Raises InputError for bad input.
    """
    asked.check()
    map_ = saved.load(model)
    if asked.dt is not None:
        with _refused_as("--dt"):
            map_ = map_.over(asked.dt)
    if map_.bracket is not None:
        if asked.horizon is not None:
            raise InputError("--horizon: is a length of positions, and these states have none")
        z0, params = _states_of(map_, model, initial)
    elif map_.of_positions and are_recordings(initial):
        z0, params = _last_states(map_, model, initial), None
    else:
        names = () if map_.parameters is None else map_.parameters.names
        z0, params = read_initial(initial, map_.dim, names)
    map_ = map_ if asked.num_steps > 0 else map_.reversed()
    drawn, begun, band = None, None, "model"
    if asked.samples is not None:
        with _refused_as("--samples"):
            drawn = map_.sample(jax.random.key(0), asked.samples)
        begun = np.broadcast_to(z0, (asked.samples, *z0.shape))
        std = read_initial_noise(initial, z0.shape)
        if std is not None:
            begun = begun + std * np.random.default_rng(1).normal(size=begun.shape)
            band = "model and initial state"
    begin = _Begin(z0, params, begun)
    stepped: SymplecticMap | Sharded = map_
    if asked.devices is not None or share is not None:
        with _refused_as("--devices"):
            stepped = map_.sharded(asked.devices or "all")
        if isinstance(drawn, Samples):
            drawn = Sharded(drawn, stepped.devices)
    identity: dict[str, Any] = {"model": saved.digest(model), "initial": digest_of(*begin)}
    identity["outside"] = asked.outside or "continue"
    identity |= {} if drawn is None else {"samples": asked.samples, "horizon_size": asked.horizon}
    identity |= {"block": stepped.block} if isinstance(stepped, Sharded) else {}
    job = _Prediction(map_, stepped, drawn, band, asked, output)
    if share is None or not isinstance(stepped, Sharded):
        return job.written(output.out, begin, identity)
    return _in_parts(job, begin, identity, share, stepped.block)


def _in_parts(
    job: _Prediction, begin: _Begin, identity: dict[str, Any], share: Share, block: int
) -> Predicted:
    """Predict the lanes of this process into a part, or several; the first process joins all."""
    output, whole = job.output, job.request(begin, identity).record
    if not output.overwrite and output.resume and predictions.is_done(output.out, whole):
        wait_for_all()
        return _finished(output.out)
    ensure_new(output.out, output.overwrite)
    resume = output.resume and not output.overwrite
    many = predictions.number_of_parts(output.out, share, resume=resume)
    shares = [Share(i, many) for i in range(many)]
    lanes = {predictions.part_of(output.out, one): one.of(len(begin.z0), block) for one in shares}
    predicted = [Predicted(np.zeros(0, int), np.zeros(0, int), 0.0)]
    for part, own in [*lanes.items()][share.index :: share.count]:
        if own.stop > own.start:
            of_part = identity | {"lanes": [own.start, own.stop]}
            predicted.append(job.written(part, begin.of(own), of_part))
    output.progress.status("waiting for the other processes")
    wait_for_all()
    seconds = sum(part.seconds for part in predicted)
    if share.index == 0:
        output.progress.status(f"writing {output.out}")
        there = [part for part, own in lanes.items() if own.stop > own.start]
        predictions.put_together(there, output.out, whole)
        return _finished(output.out)._replace(seconds=seconds)
    status = np.concatenate([part.status for part in predicted])
    return Predicted(status, np.concatenate([part.left_at for part in predicted]), seconds)


@contextlib.contextmanager
def _refused_as(option: str) -> Iterator[None]:
    """Turn the ValueError of what an option asks for into an InputError that names it."""
    try:
        yield
    except ValueError as error:
        raise InputError(f"{option}: {error}") from error


def _states_of(map_: SymplecticMap, model: Path, initial: Path) -> tuple[np.ndarray, Any]:
    """States (B, n) and their parameters (B, k) or None: the rows of an array, ``z0`` of an
    archive with its parameters by name, or the last state of every run of a file with the columns
    that the model was learned from."""
    bracket: Any = map_.bracket
    names, params = () if map_.parameters is None else map_.parameters.names, None
    if initial.suffix.lower() in (".npy", ".npz") and not are_recordings(initial):
        with damage(initial, "the array"):
            found: Any = np.load(initial, allow_pickle=False)
            if names and initial.suffix.lower() == ".npz" and set(names) <= set(found.files):
                params = np.stack([np.atleast_1d(found[name]) for name in names], axis=-1)
            if initial.suffix.lower() == ".npz":
                found = found["z0"] if "z0" in found.files else found["trajectories"][:, -1]
        z0 = np.atleast_2d(np.asarray(found, np.float64))
    else:
        job = saved.record(model).get("job", {})
        states = job.get("states", bracket.labels)
        own = job.get("parameters", ())
        recording = read_in_units(initial, job, {"positions": states, "parameters": own})
        refuse_other_units(recording, job)
        z0 = np.array([recording.array("positions", run)[-1] for run in recording.runs])
        params = np.array([args_of(recording, run, own) for run in recording.runs]) if own else None
    if names and params is None:
        raise InputError(
            f"{initial}: expected the parameters {', '.join(names)} of these states: a text file "
            "with their columns, or an .npz with z0 and an array of each name"
        )
    if z0.ndim != 2 or z0.shape[1] != bracket.size or not np.isfinite(z0).all():
        wanted = f"states {', '.join(bracket.labels)} that are finite"
        raise InputError(f"{initial}: expected {wanted}, got an array {z0.shape}")
    try:
        bracket.require_inside(z0)
    except FitError as error:
        raise InputError(f"{initial}: {error}") from error
    return z0, params


def _last_states(map_: SymplecticMap, model: Path, initial: Path) -> np.ndarray:
    """(B, 2d): the states at the end of every run, from its last two positions."""
    job = saved.record(model).get("job", {})
    names = job.get("positions")
    roles = {"positions": names, "angles": job.get("angles")}
    recording = read_in_units(initial, job, roles)
    refuse_other_units(recording, job)
    ends = np.array([recording.array("positions", run)[-2:] for run in recording.runs])
    if ends.shape[1:] != (2, map_.dim) or not np.isfinite(ends).all():
        raise InputError(f"{initial}: expected two positions ({map_.dim},) at the end of every run")
    return np.asarray(map_.step(map_.from_positions(ends[:, 0], ends[:, 1]))[0])


def _finished(out: Path) -> Predicted:
    with np.load(out, allow_pickle=False) as done:
        return Predicted(done["status"], done["left_at"], 0.0, done.get("horizon"))


@dataclasses.dataclass(frozen=True)
class _Prediction:
    """A prediction: the map, and ``stepped``, itself or the same over devices; the samples drawn,
    and what their band contains, as text."""

    map: SymplecticMap
    stepped: SymplecticMap | Sharded
    drawn: Samples | Sharded | None
    band: str
    asked: Steps
    output: Output

    def request(self, begin: _Begin, identity: dict[str, Any]) -> predictions.PredictionJob:
        """Request of these lanes, for their file."""
        parameters, params, own, drive = self.map.parameters, begin.params, None, None
        if parameters is not None and params is not None:
            names = parameters.names
            own = names, params
            if TIME in names:
                drive = params[:, -1], float(np.asarray(parameters.period))
                own = (names[:-1], params[:, :-1]) if len(names) > 1 else None
        steps = self.asked.num_steps, abs(float(self.map.dt)), self.asked.save_every
        has_bands = self.drawn is not None
        return predictions.PredictionJob(identity, begin.z0.shape, *steps, has_bands, own, drive)

    def written(self, out: Path, begin: _Begin, identity: dict[str, Any]) -> Predicted:
        """Predict these lanes into one file."""
        output, asked = self.output, self.asked
        job = self.request(begin, identity)
        writer = predictions.PredictionWriter(
            out, job, resume=output.resume, overwrite=output.overwrite
        )
        started = time.perf_counter()
        if writer.finished:
            return _finished(out)
        try:
            lanes = self._go_on(begin, writer)
            output.progress.status(f"writing {out}")
            status, left_at = np.asarray(lanes.status), np.asarray(lanes.left_at)
            more: dict[str, Any] = {} if self.drawn is None else {"band": self.band}
            passed = None
            if asked.horizon is not None:
                assert writer.carry is not None
                passed = writer.carry["horizon"]
                more |= {"horizon": passed, "horizon_size": asked.horizon}
            writer.finish(status, left_at, **more)
        except KeyboardInterrupt as stop:
            if not writer.finished:
                done = max(0, writer.saved - 1) * asked.save_every
                kept = f"{done} of {abs(asked.num_steps)} steps"
                stop.add_note(f"{writer.partial} keeps {kept}: --resume goes on with it")
            raise
        return Predicted(status, left_at, time.perf_counter() - started, passed)

    def _go_on(self, begin: _Begin, writer: predictions.PredictionWriter) -> Lanes:
        """Compute all chunks that are not yet written; return the lanes after the last step."""
        asked, drawn, z0 = self.asked, self.drawn, begin.z0
        options = {"params": begin.params, "stop_outside": asked.outside == "stop"}
        of_samples, passed = None, np.full(len(z0), -1)
        if writer.carry is None:
            lanes, states = self.stepped.start(z0, **options), z0[:, None]
            if drawn is not None and begin.of_samples is not None:
                of_samples = drawn.start(begin.of_samples, **options)
                others = begin.of_samples[:, :, None]
                states, passed = self._with_bands(states, others, [0], passed)
            writer.append(states, _carry(lanes, of_samples, passed))
        else:
            carry = {name: jax.device_put(value) for name, value in writer.carry.items()}
            lanes = Lanes(**{name: carry[name] for name in Lanes._fields})
            if drawn is not None:
                of_samples = Lanes(**{name: carry[_OF_SAMPLES + name] for name in Lanes._fields})
                passed = writer.carry["horizon"]
        # Saved states per chunk are a function of the job alone: a resumed job has the same.
        num_lanes, width = z0.shape[0] * (1 + (asked.samples or 0)), z0.shape[1]
        by_operations = _CHUNK_LANE_STEPS // (num_lanes * asked.save_every)
        chunk = max(1, min(_CHUNK_BYTES // (8 * num_lanes * width), by_operations))
        options["save_every"] = asked.save_every
        started, begun = time.perf_counter(), writer.saved
        while writer.saved < writer.total:
            done = writer.saved - begun
            left = (time.perf_counter() - started) * (writer.total - writer.saved) / max(done, 1)
            self.output.progress.status(
                f"step {(writer.saved - 1) * asked.save_every} of {abs(asked.num_steps)}"
                + (f", about {left:.0f} s left" if done else "")
            )
            count = min(chunk, writer.total - writer.saved)
            lanes, states = self.stepped.advance(lanes, count, **options)
            if drawn is not None and of_samples is not None:
                of_samples, others = drawn.advance(of_samples, count, **options)
                steps = np.abs(writer.steps[writer.saved : writer.saved + count])
                states, passed = self._with_bands(states, others, steps, passed)
            writer.append(states, _carry(lanes, of_samples, passed))
        return lanes

    def _with_bands(self, states, others, steps, passed) -> tuple[np.ndarray, np.ndarray]:
        """Join states with their std and quantiles (B, c, 5 · 2d); update the horizons (B,)."""
        found = bands(others, states, self.map.angles_of_z)
        if self.asked.horizon is not None:
            passed = np.where(passed < 0, horizon(found.std, steps, self.asked.horizon), passed)
        return np.concatenate([states, found.std, *found.quantiles], axis=-1), passed


def _carry(lanes: Lanes, of_samples: Lanes | None, passed) -> dict[str, Any]:
    if of_samples is None:
        return lanes._asdict()
    others = {_OF_SAMPLES + name: value for name, value in of_samples._asdict().items()}
    return {**lanes._asdict(), **others, "horizon": passed}
