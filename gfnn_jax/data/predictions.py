"""Predictions out: written in chunks as they come, resumable, and finished in one stroke.

A prediction is an array (B, S, 2d): B lanes, S saved states each. It is computed along the steps,
all lanes at once, so the chunks are (B, c, 2d). Each goes, with what is needed to go on from it
(the *carry*), into the folder ``OUT.partial`` beside the output, is made durable, and only then is
entered in a journal with its SHA-256. A process killed at any moment thus loses the chunk it was
at, and a chunk that is damaged or half written is found out and computed again.
"""

import contextlib
import dataclasses
import hashlib
import json
import os
import re
import warnings
import zipfile
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from gfnn_jax.errors import InputError
from gfnn_jax.processes import Share
from gfnn_jax.storage import outputs


class Options:
    """Format of a prediction, and bytes in memory."""

    format: int = 2
    assembly: int = 64 * 2**20  # bytes in memory while the output is assembled
    copied: int = 16 * 2**20  # while parts are copied
    band_parts: int = 4  # beside a state: its std and three quantiles


# Axis of the lanes, of the arrays of a file that have one.
_OF_LANES = ("trajectories", "std", "status", "left_at", "params", "t0", "horizon")
_AXIS_OF_LANES = {"quantiles": 1} | dict.fromkeys(_OF_LANES, 0)


@dataclasses.dataclass(frozen=True)
class PredictionJob:
    """Request of a prediction: all that its file depends on.

    identity:  a JSON-able dict that says which job this is (digests of the model and of the initial
               states, say): a job is resumed only if all of it agrees.
    shape:     (B, 2d).
    num_steps, save_every: N and K; saved are the S = 1 + |N| // K states of steps 0, ±K, ±2K, ...,
               backwards where N < 0.
    dt:        the time step of the map.
    bands:     whether states come with their std and three quantiles: (B, c, 5 · 2d).
    params:    the names (k,) and values (B, k) of the map's parameters.
    drive:     the time t0 (B,) of the drive at the initial states, and its period.
    """

    identity: dict[str, Any]
    shape: tuple[int, int]
    num_steps: int
    dt: float
    save_every: int = 1
    bands: bool = False
    params: tuple[tuple[str, ...], np.ndarray] | None = None
    drive: tuple[np.ndarray, float] | None = None

    @property
    def steps(self) -> range:
        """The numbers of the saved steps."""
        sign = 1 if self.num_steps > 0 else -1
        return range(0, self.num_steps + sign, sign * self.save_every)

    @property
    def record(self) -> dict[str, Any]:
        """The request as a file can hold it."""
        job = {
            **self.identity,
            "format": Options.format,
            "shape": [self.shape[0], len(self.steps), self.shape[1]],
            **({"bands": True} if self.bands else {}),
            "num_steps": self.num_steps,
            "save_every": self.save_every,
            "dt": float(self.dt),
        }
        return json.loads(json.dumps(job))  # as it will be read back


def digest_of(job: dict[str, Any]) -> str:
    """Digest by which a finished prediction is known as that of its job."""
    return hashlib.sha256(json.dumps(job, sort_keys=True).encode()).hexdigest()


def is_done(out: Path, job: dict[str, Any]) -> bool:
    """Return whether ``out`` is the finished prediction of this job."""
    try:
        with np.load(out, allow_pickle=False) as file:
            return str(file["job"]) == digest_of(job)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return False


class PredictionWriter:
    """Writes one prediction file: ``trajectories`` (B, S, 2d), ``status`` (B,), ``left_at`` (B,),
    ``steps`` (S,) and ``dt``, all float64 or int64, ``params`` (B, k) and ``param_names`` (k,)
    where the map has parameters, ``t0`` (B,) and ``period`` where it is driven, with ``bands`` also
    ``std`` (B, S, 2d) and ``quantiles`` (3, B, S, 2d), and ``job``, a digest of what was asked for.

    out:       the ``.npz`` to write; ``OUT.partial`` holds the chunks until `finish`.
    resume:    go on with ``OUT.partial`` where there is one; else start. Where ``out`` is this very
               job, done, ``finished`` is set and there is nothing left to do.
    overwrite: replace an existing output, and discard an unfinished one.

    After construction ``saved`` is the number of states per lane already on disk, and ``carry``
    what was saved with the last of them (None at the start).

    Memory: one chunk while appending, about 64 MiB while finishing. Disk: the output twice while
    finishing. Raises InputError where something is in the way, WorkError where writing fails;
    what was there before then stays, and so do the finished chunks.
    """

    def __init__(self, out, asked: PredictionJob, *, resume: bool = False, overwrite: bool = False):
        self.out, self.asked = Path(out), asked
        self.partial = self.out.with_name(self.out.name + ".partial")
        self.steps = asked.steps
        self.lanes, self._state = asked.shape
        self.width = self._state * (1 + Options.band_parts if asked.bands else 1)
        self.saved = 0
        self.carry: dict[str, np.ndarray] | None = None
        self._chunks: list[dict[str, Any]] = []  # the journal's entries: file, start, stop, sha256
        self._job = asked.record
        if self.out.suffix != ".npz":
            raise InputError(f"{out}: a prediction is written as .npz")
        self.finished = False
        self._overwrite = overwrite
        if resume and self._journal.exists() and self._read_journal():
            if not is_done(self.out, self._job):  # what stands there is another's
                outputs.ensure_new(self.out, self._overwrite)
            return
        if resume and not overwrite and is_done(self.out, self._job):
            self.finished, self.saved = True, self.total
            with outputs.failures_as_work_errors(self.out):
                self._discard()  # what a kill at the very end may have left
            return
        outputs.ensure_new(self.out, overwrite)
        if self.partial.exists() and not (overwrite or resume):
            ways = "--resume goes on with it, --overwrite discards it"
            raise InputError(f"{self.partial}: an unfinished prediction ({ways})")
        with outputs.failures_as_work_errors(self.out):
            self._discard()
            self.partial.mkdir(parents=True)
        self._write_journal()

    @property
    def total(self) -> int:
        """States per lane in the finished output."""
        return len(self.steps)

    def append(self, states: Any, carry: dict[str, Any]) -> None:
        """The next saved states (B, c, 2d), and the arrays needed to go on after them."""
        states = np.ascontiguousarray(states, dtype=np.float64)
        stop = self.saved + (states.shape[1] if states.ndim == 3 else 0)
        expected = (self.lanes, stop - self.saved, self.width)
        if states.shape != expected or not self.saved < stop <= self.total:
            wanted = f"({self.lanes}, at most {self.total - self.saved}, {self.width})"
            raise ValueError(f"expected states {wanted}, got {states.shape}")
        carry = {name: np.asarray(value) for name, value in carry.items()}
        if any(value.dtype.hasobject for value in carry.values()):
            raise TypeError("the carry must be arrays of numbers")
        rest = BytesIO()
        np.savez(rest, **carry)  # pyright: ignore[reportArgumentType]
        name = f"{self.saved:012d}-{stop:012d}.chunk"
        digest = hashlib.sha256(states.data)
        digest.update(rest.getbuffer())
        with outputs.failures_as_work_errors(self.out):
            with open(self.partial / name, "wb") as stream:
                stream.write(states.data)
                stream.write(rest.getbuffer())
                stream.flush()
                os.fsync(stream.fileno())
            outputs.sync_folder(self.partial)
            entry = {"file": name, "start": self.saved, "stop": stop, "sha256": digest.hexdigest()}
            with open(self._journal, "ab") as stream:
                stream.write(json.dumps(entry).encode() + b"\n")
                stream.flush()
                os.fsync(stream.fileno())
        self._chunks.append(entry)
        self.saved, self.carry = stop, carry

    def finish(self, status: Any, left_at: Any, **more: Any) -> None:
        """Assemble the output from the chunks, put it in place at once, and remove the chunks.

        status:  (B,) integers, 0 = ok.
        left_at: (B,) the first step at which a lane was outside the domain, or −1.
        more:    further arrays of the file, by their names.
        """
        if self.saved != self.total:
            raise ValueError(f"{self.saved} of {self.total} states are there")
        status = np.asarray(status).astype(np.int64).reshape(self.lanes)
        left_at = np.asarray(left_at).astype(np.int64).reshape(self.lanes)
        arrays = {
            **{name: np.asarray(value) for name, value in more.items()},
            "status": status,
            "left_at": left_at,
            "dt": np.asarray(float(self.asked.dt)),
            "job": np.asarray(digest_of(self._job)),
        }
        if self.asked.params is not None:
            names, values = self.asked.params
            arrays |= {"params": values, "param_names": np.array(names)}
        if self.asked.drive is not None:
            t0, period = self.asked.drive
            arrays |= {"t0": t0, "period": np.asarray(period)}
        with outputs.atomic_file(self.out) as stream, zipfile.ZipFile(stream, "w") as archive:
            shape = (self.lanes, self.total, self._state)
            with member_of(archive, "trajectories", shape, np.float64) as member:
                self._assemble(member, 0)
            if self.width > self._state:
                with member_of(archive, "std", shape, np.float64) as member:
                    self._assemble(member, 1)
                with member_of(archive, "quantiles", (3, *shape), np.float64) as member:
                    for part in (2, 3, 4):
                        self._assemble(member, part)
            for name, array in arrays.items():
                with member_of(archive, name, array.shape, array.dtype) as member:
                    member.write(np.ascontiguousarray(array).tobytes())
            with member_of(archive, "steps", (self.total,), np.int64) as member:
                for first in range(0, self.total, 2**20):
                    part = self.steps[first : first + 2**20]
                    member.write(np.arange(part.start, part.stop, part.step, dtype=np.int64).data)
        self.finished = True
        self._discard()

    def _discard(self) -> None:
        """Remove the folder of chunks, the journal first, and nothing in it that is not ours."""
        for path in [self._journal, *self.partial.glob("*.chunk")]:
            path.unlink(missing_ok=True)
        if self.partial.exists():
            self.partial.rmdir()

    def _assemble(self, member, part: int) -> None:
        """One part (B, S, 2d) of the chunks (B, c, parts · 2d), a few lanes at a time."""
        columns = slice(part * self._state, (part + 1) * self._state)
        lane = self.total * self.width * 8
        together = max(1, Options.assembly // (2 * max(lane, 1)))
        for first in range(0, self.lanes, together):
            lanes = min(together, self.lanes - first)
            chunks = (self._read_chunk(entry, first, lanes) for entry in self._chunks)
            pieces = (np.ascontiguousarray(chunk[..., columns]) for chunk in chunks)
            if lanes == 1:  # a lane may be larger than memory: piece after piece
                for piece in pieces:
                    member.write(piece.data)
            else:
                member.write(np.concatenate([*pieces], axis=1).data)

    def _read_chunk(self, entry: dict[str, Any], first: int, lanes: int) -> np.ndarray:
        saved = entry["stop"] - entry["start"]
        row = saved * self.width
        path = self.partial / entry["file"]
        data = np.fromfile(path, np.float64, count=lanes * row, offset=8 * first * row)
        return data.reshape(lanes, saved, self.width)

    @property
    def _journal(self) -> Path:
        return self.partial / "journal.jsonl"

    def _write_journal(self) -> None:
        lines = [{"job": self._job, "overwrite": self._overwrite}, *self._chunks]
        outputs.atomic_write(self._journal, "".join(json.dumps(line) + "\n" for line in lines))

    def _read_journal(self) -> bool:
        """Take up the chunks that are whole; False if the job's first line was never written."""
        lines = self._journal.read_bytes().splitlines()
        try:
            began = json.loads(lines[0])
            job = began["job"]
        except (IndexError, KeyError, TypeError, ValueError):
            warnings.warn(f"{self.partial}: no readable journal: starting again", stacklevel=3)
            return False
        # Who began with --overwrite need not say it again.
        self._overwrite = self._overwrite or began.get("overwrite") is True
        for key in {**job, **self._job}:
            if job.get(key) != self._job.get(key):
                differs = f"{key} is {job.get(key)} there and {self._job.get(key)} here"
                whose = f"{self.partial}: belongs to another prediction"
                raise InputError(f"{whose}: {differs}. --overwrite discards it")
        for line in lines[1:]:
            carry = self._verified_carry(line)
            if carry is None:
                again = f"going on from saved state {self.saved} instead"
                what = f"{self.partial}: a chunk is damaged or half written: {again}"
                warnings.warn(what, stacklevel=3)
                break
            entry = json.loads(line)
            self._chunks.append(entry)
            self.saved, self.carry = entry["stop"], carry
        self._write_journal()  # without what is not used again
        used = {entry["file"] for entry in self._chunks}
        for path in self.partial.glob("*.chunk"):
            if path.name not in used:
                path.unlink()
        return True

    def _verified_carry(self, line: bytes) -> dict[str, np.ndarray] | None:
        """The carry of the chunk in this line of the journal; None if anything of it is damaged."""
        try:
            entry = json.loads(line)
            start, stop = int(entry["start"]), int(entry["stop"])
            name = f"{start:012d}-{stop:012d}.chunk"
            if start != self.saved or not start < stop <= self.total or entry["file"] != name:
                return None
            with open(self.partial / name, "rb") as stream:
                if hashlib.file_digest(stream, "sha256").hexdigest() != entry["sha256"]:
                    return None
                stream.seek(self.lanes * (stop - start) * self.width * 8)
                with np.load(BytesIO(stream.read()), allow_pickle=False) as carry:
                    return dict(carry)
        except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile):
            return None


def member_of(archive: zipfile.ZipFile, name: str, shape: tuple[int, ...], dtype: Any):
    """An open ``.npy`` member, its header written; ZipInfo's fixed date makes it repeatable."""
    member = archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True)
    descr = np.lib.format.dtype_to_descr(np.dtype(dtype))
    header = {"descr": descr, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(member, header)
    return member


# A prediction of several processes: each writes the file of its own lanes, one puts them together.
# The parts, NAME.part0of2.npz and so on beside NAME.npz, are predictions themselves.


def part_of(out: Path, share: Share) -> Path:
    """The file that this process writes."""
    return out.with_name(f"{out.stem}.part{share.index}of{share.count}{out.suffix}")


def number_of_parts(out: Path, share: Share, *, resume: bool) -> int:
    """Number of parts that the prediction is in: one of each process, or as many as an interrupted
    job has begun, whatever its number of processes.

    Raises InputError where parts of another number are there and are not to be gone on with.
    """
    names = [path.name for path in out.parent.glob(f"{out.stem}.part*of*{out.suffix}*")]
    pattern = re.compile(re.escape(out.stem) + r"\.part\d+of(\d+)" + re.escape(out.suffix))
    there = {int(found[1]) for found in map(pattern.match, names) if found}
    if not there or (resume and len(there) == 1):
        return there.pop() if there else share.count
    if there == {share.count}:
        return share.count
    found = " and of ".join(map(str, sorted(there)))
    raise InputError(
        f"{out}: unfinished parts by {found} processes are there, and this job has {share.count}: "
        + ("delete those of one kind" if resume else "--resume goes on with them, or delete them")
    )


def put_together(parts: Sequence[Path], out: Path, job: dict[str, Any]) -> None:
    """One prediction, ``out``, of the parts in the order of their lanes; they are then deleted.

    Memory: 16 MiB, whatever the sizes. Raises WorkError where writing fails; the parts then stay.
    """
    with outputs.failures_as_work_errors(out), contextlib.ExitStack() as stack:
        archives = [stack.enter_context(zipfile.ZipFile(path)) for path in parts]
        stream = stack.enter_context(outputs.atomic_file(out))
        whole = stack.enter_context(zipfile.ZipFile(stream, "w"))
        for name in (Path(n).stem for n in archives[0].namelist()):
            if name == "job":
                digest = np.asarray(digest_of(job))
                with member_of(whole, name, (), digest.dtype) as member:
                    member.write(digest.tobytes())
            else:
                axis = _AXIS_OF_LANES.get(name)
                _copy(name, archives if axis is not None else archives[:1], whole, axis or 0)
    for path in parts:
        path.unlink()


def _copy(name: str, archives: Sequence[zipfile.ZipFile], whole: zipfile.ZipFile, axis: int):
    """One array, those of the parts put together along an axis."""
    with contextlib.ExitStack() as stack:
        streams = [stack.enter_context(archive.open(f"{name}.npy")) for archive in archives]
        headers = []
        for stream in streams:
            np.lib.format.read_magic(stream)
            headers.append(np.lib.format.read_array_header_1_0(stream))
        shapes = [header[0] for header in headers]
        dtype, shape = headers[0][2], shapes[0]
        if shape:
            shape = (*shape[:axis], sum(s[axis] for s in shapes), *shape[axis + 1 :])
        member = stack.enter_context(member_of(whole, name, shape, dtype))
        # Row after row of the axes before that of the lanes.
        for _ in range(int(np.prod(shape[:axis]))):
            for stream, own in zip(streams, shapes, strict=True):
                left = int(np.prod(own[axis:])) * dtype.itemsize
                while left:
                    read = stream.read(min(left, Options.copied))
                    if not read:
                        raise OSError(f"{name} of a part is shorter than its header says")
                    member.write(read)
                    left -= len(read)
