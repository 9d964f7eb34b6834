"""Folder ``OUT.partial``, in which an unfinished job keeps its work until its output is there.

The folder holds ``job.json``, the request, and whatever the job writes. Only the same job can
resume from it.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

from gfnn_jax.errors import InputError
from gfnn_jax.storage.outputs import atomic_write, ensure_new, failures_as_work_errors

JOB = "job.json"


@contextlib.contextmanager
def unfinished(
    out: Path, job: dict[str, Any], *, what: str, overwrite: bool, resume: bool
) -> Iterator[Path]:
    """Open the folder ``OUT.partial`` of a job that writes the folder ``out``.

    job: JSON-able, identifies the job. what: its name in messages, "fit" for example. The folder is
    removed when the block ends. When the block fails, the folder stays if the job has kept anything
    in it, and a KeyboardInterrupt gets a note that names what was kept.

    Raises InputError where ``out`` exists and may not be replaced, where an unfinished job is there
    and neither ``resume`` nor ``overwrite`` is set, and where ``resume`` meets another job.
    """
    folder = _beside(out)
    # What an interrupted job has left in ``out`` may be replaced by the same job.
    ensure_new(out, overwrite or (resume and (folder / JOB).is_file()), folder=True)
    with _claimed(out, what):
        # What another release has kept may mean something else to this one.
        job = {**json.loads(json.dumps(job)), "release": version("gfnn_jax")}
        _make_way(folder, job, what, overwrite=overwrite, resume=resume)
        atomic_write(folder / JOB, json.dumps(job))
        try:
            yield folder
        except BaseException as error:
            note = unfinished_note(out)
            if note is None:
                _discard(folder)
            if isinstance(error, KeyboardInterrupt):
                error.add_note(note or f"nothing of the {what} was kept")
            raise
        _discard(folder)


@contextlib.contextmanager
def _claimed(out: Path, what: str) -> Iterator[None]:
    """Hold ``OUT.lock`` by this process, where the system has file locks.

    A killed process releases it. Raises InputError where another process holds it.
    """
    try:
        import fcntl
    except ImportError:
        yield
        return
    path = out.with_name(out.name + ".lock")
    with failures_as_work_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        stream = open(path, "w")  # noqa: SIM115, closed below
    with stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Another process may have removed the file since it was opened: then the lock is void.
            if os.fstat(stream.fileno()).st_ino != path.stat().st_ino:
                raise BlockingIOError
        except OSError as error:
            raise InputError(f"{out}: another process is writing this {what}") from error
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def kept(folder: Path) -> list[str]:
    """Names, without suffix, of the files that a job has kept in its folder beside ``job.json``."""
    if not folder.exists():
        return []
    names = (path.name for path in folder.iterdir())
    return sorted({Path(n).stem for n in names if n != JOB and not n.startswith(".")})


def unfinished_note(out: Path) -> str | None:
    """Message about the unfinished job of ``out``; None where it has kept nothing."""
    folder = _beside(out)
    if not ((folder / JOB).is_file() and (found := kept(folder))):
        return None
    return f"{folder} keeps {', '.join(found)}: --resume goes on with it"


def _beside(out: Path) -> Path:
    return out.with_name(out.name + ".partial")


def _make_way(folder: Path, job, what: str, *, overwrite: bool, resume: bool) -> None:
    if not folder.exists():
        return
    if not (folder / JOB).is_file():
        raise InputError(f"{folder}: exists and is no unfinished {what}; move or delete it")
    if not kept(folder):  # killed before it had kept anything
        return
    if not resume:
        if not overwrite:
            raise InputError(
                f"{folder}: holds an unfinished {what} (--resume continues it, --overwrite "
                "discards it)"
            )
        return _discard(folder)
    try:
        found = json.loads((folder / JOB).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{folder}: {JOB} cannot be read ({error})") from error
    other = [key for key in {**found, **job} if found.get(key) != job.get(key)]
    if other:
        raise InputError(
            f"{folder}: belongs to another {what}: {', '.join(other)} differ (--overwrite discards "
            "it)"
        )


def _discard(folder: Path) -> None:
    with failures_as_work_errors(folder):
        if (folder / JOB).is_file():  # else it is not ours
            shutil.rmtree(folder)
