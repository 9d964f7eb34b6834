"""A prediction of several processes: each writes the file of its own lanes, one puts them together.

The parts, ``NAME.part0of2.npz`` and so on beside ``NAME.npz``, are predictions themselves.
"""

from __future__ import annotations

import contextlib
import re
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gfnn_jax.data.predictions import digest_of, member_of
from gfnn_jax.errors import InputError
from gfnn_jax.processes import Share
from gfnn_jax.storage.outputs import atomic_file, failures_as_work_errors

# The axis of the lanes, of the arrays that have one.
_LANES = {
    "trajectories": 0,
    "std": 0,
    "quantiles": 1,
    "status": 0,
    "left_at": 0,
    "params": 0,
    "t0": 0,
    "horizon": 0,
}
_COPIED_BYTES = 16 * 2**20  # at a time


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
    with failures_as_work_errors(out), contextlib.ExitStack() as stack:
        archives = [stack.enter_context(zipfile.ZipFile(path)) for path in parts]
        stream = stack.enter_context(atomic_file(out))
        whole = stack.enter_context(zipfile.ZipFile(stream, "w"))
        for name in (Path(n).stem for n in archives[0].namelist()):
            if name == "job":
                digest = np.asarray(digest_of(job))
                with member_of(whole, name, (), digest.dtype) as member:
                    member.write(digest.tobytes())
            else:
                axis = _LANES.get(name)
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
                    read = stream.read(min(left, _COPIED_BYTES))
                    if not read:
                        raise OSError(f"{name} of a part is shorter than its header says")
                    member.write(read)
                    left -= len(read)
