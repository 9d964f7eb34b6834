"""Files and folders written whole or not at all; nothing is overwritten unasked.

An unfinished job keeps its work in the folder ``OUT.partial`` until its output is there:
``job.json``, the request, and whatever the job writes. Only the same job can resume from it.
Nothing here needs JAX, so that a refusal comes at once.
"""

import contextlib
import dataclasses
import json
import math
import os
import shutil
import signal
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from gfnn_jax.errors import InputError, WorkError

# Files that mark a folder as written by this package, and the other contents of such a folder.
# --overwrite deletes no other folder, and none that holds something else, such as data.
FOLDER_MARKS = ("model.json", "report.json", "report.html")
_OURS = (*FOLDER_MARKS, "SHA256SUMS", "arrays", "arrays.npz", "model", "*.png")


def ensure_new(path, overwrite: bool = False, *, folder: bool = False) -> Path:
    """Check, before any work, that the file or folder ``path`` can be written. Writes nothing.

    Raises InputError where ``path`` exists and ``overwrite`` is off, where it is a folder instead
    of a file or the reverse, where it is a folder that this package did not write or that holds
    anything else, where it is the current folder or one above it, or where its parent cannot be
    written.
    """
    path = Path(path)
    try:
        if path.is_dir() and not folder:
            raise InputError(f"{path}: is a folder, expected a file to write")
        if path.exists() and folder and not path.is_dir():
            raise InputError(f"{path}: is a file, expected a folder to write")
        if folder and path.resolve() in (here := Path.cwd(), *here.parents):
            raise InputError(f"{path}: is the current folder or one above it; name another")
        if path.exists() and not (folder and not any(path.iterdir())):
            if not overwrite:
                raise InputError(f"{path}: exists already (--overwrite replaces it)")
            if folder and not any((path / mark).is_file() for mark in FOLDER_MARKS):
                marks = " or ".join(FOLDER_MARKS)
                raise InputError(f"{path}: is a folder without {marks}; not overwritten")
            inside = [*path.iterdir(), *path.glob("model/*")] if folder else []
            others = [file for file in inside if not any(map(file.match, _OURS))]
            if others:
                raise InputError(
                    f"{path}: holds {others[0].name}, which is no part of a model or a run; not "
                    "overwritten"
                )
        parent = path.absolute().parent
        while not parent.exists():
            parent = parent.parent
        if not parent.is_dir():
            raise InputError(f"{path}: cannot be written: {parent} is not a folder")
        if not os.access(parent, os.W_OK | os.X_OK):
            raise InputError(f"{path}: cannot be written: no permission for {parent}")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error
    return path


@contextlib.contextmanager
def failures_as_work_errors(path) -> Iterator[None]:
    """Turn an OSError while writing ``path``, such as a full disk, into a WorkError of one line."""
    try:
        yield
    except OSError as error:
        raise WorkError(f"{path}: writing failed: {error.strerror or error}") from error


@contextlib.contextmanager
def signals_handled(
    numbers: Iterable[int], handler: Callable[[int, Any], object]
) -> Iterator[None]:
    """Call ``handler(number, frame)`` at these signals until the block ends.

    Nothing is done outside the main thread, where no signal arrives.
    """
    try:
        before = {number: signal.signal(number, handler) for number in numbers}
    except ValueError:
        yield
        return
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Delay SIGINT and SIGTERM until the block ends."""
    waiting: list[int] = []
    try:
        with signals_handled((signal.SIGINT, signal.SIGTERM), lambda n, _: waiting.append(n)):
            yield
    finally:
        if waiting:
            signal.raise_signal(waiting[0])


@contextlib.contextmanager
def atomic_file(path) -> Iterator[Any]:
    """Open a binary stream. ``path`` appears whole when the block ends, not at all if it fails."""
    path = Path(path)
    beside = path.with_name(f".{path.name}.part")
    with failures_as_work_errors(path):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with open(beside, "wb") as stream:
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(beside, path)
            sync_folder(path.parent)
        finally:
            beside.unlink(missing_ok=True)


def atomic_write(path, content: str | bytes) -> None:
    """Write a whole file, or leave what was there before. Raises WorkError."""
    with atomic_file(path) as stream:
        stream.write(content.encode() if isinstance(content, str) else content)


@contextlib.contextmanager
def atomic_folder(path) -> Iterator[Path]:
    """Open a new folder to fill; it replaces ``path`` when the block ends without failing.

    A folder cannot be exchanged for another in one step. The old one is ``.NAME.old`` for an
    instant; `restore_interrupted` brings it back if the process was killed in that instant.
    """
    path = Path(path)
    beside = path.absolute().with_name(f".{path.name}.part")
    old = _old(path)
    with failures_as_work_errors(path):
        restore_interrupted(path)
        try:
            shutil.rmtree(beside, ignore_errors=True)
            beside.mkdir(parents=True)
            yield beside
            for file in sorted(beside.rglob("*")):
                if file.is_file():
                    with open(file, "rb") as stream:
                        os.fsync(stream.fileno())
            with uninterrupted():  # between the two renames there is neither folder
                if path.exists():
                    os.rename(path, old)
                os.rename(beside, path)
            sync_folder(path.absolute().parent)
            shutil.rmtree(old, ignore_errors=True)
        finally:
            shutil.rmtree(beside, ignore_errors=True)


def restore_interrupted(path) -> None:
    """Undo an exchange of folders that was killed half way; see `atomic_folder`."""
    path = Path(path)
    if _old(path).exists():
        if path.exists():
            shutil.rmtree(_old(path), ignore_errors=True)
        else:
            os.rename(_old(path), path)


def _old(path: Path) -> Path:
    return path.absolute().with_name(f".{path.name}.old")


def sync_folder(folder) -> None:
    """Make a rename in this folder outlast a crash, where the system can."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


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

    A killed process releases it. Raises InputError where another process holds it."""
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
            ways = "--resume continues it, --overwrite discards it"
            raise InputError(f"{folder}: holds an unfinished {what} ({ways})")
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


def finite(value: Any) -> Any:
    """Copy a tree as dicts, of named tuples and dataclasses too, and lists, also of arrays, with
    None for numbers that are not finite."""
    if hasattr(value, "_asdict"):
        value = value._asdict()
    elif dataclasses.is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    if hasattr(value, "__array__"):  # of NumPy or JAX
        return finite(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value
