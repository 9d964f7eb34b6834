"""Output of a job: where it goes, what may stand there, its progress; a model with its record, and
recordings in the units of the one that it was learned from."""

import contextlib
import dataclasses
import hashlib
import shutil
from collections.abc import Iterator
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from gfnn_jax import scenes
from gfnn_jax.candidates.assemble import Candidate
from gfnn_jax.data.recording import Recording, read
from gfnn_jax.errors import FitError, InputError, WorkError
from gfnn_jax.evaluate import report
from gfnn_jax.jobs.progress import SILENT, Progress
from gfnn_jax.learn.fit import fit
from gfnn_jax.learn.fitted import Fit
from gfnn_jax.learn.options import FitOptions
from gfnn_jax.learn.saved import save
from gfnn_jax.maps import saved
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import Pairs
from gfnn_jax.scenes import Scene
from gfnn_jax.storage.checkpoints import KeptFactors, TrainingCheckpoints
from gfnn_jax.storage.outputs import atomic_folder, unfinished

MODEL = "model"
_ANGLES = ("deg", "°", "rad")  # begins of the units that `gfnn_jax.read` turns into radians


@dataclasses.dataclass(frozen=True)
class Output:
    """Output of a job.

    out: the file or folder that it writes. overwrite: replace what is there. resume: go on with an
    unfinished job; one that is done is known again. progress: shows its messages.
    """

    out: Path
    overwrite: bool = False
    resume: bool = False
    progress: Progress = SILENT

    def unfinished(self, job: dict[str, Any]) -> AbstractContextManager[Path]:
        """Open the folder in which this job keeps its work (`storage.outputs.unfinished`)."""
        return unfinished(
            self.out, job, what=job["command"], overwrite=self.overwrite, resume=self.resume
        )

    def holds(self, job: dict[str, Any], model: str = ".") -> bool:
        """Return whether a resumed job had already finished, by the record of its model."""
        folder = self.out / model
        return self.resume and folder.is_dir() and _recorded(folder, "job") == job


class Ran(NamedTuple):
    """Result of a job: the fit, the folder where it was written, and its report."""

    fit: Fit
    out: Path
    report: dict[str, Any]


def write(folder: Path, model: Path, fit: Fit, result: dict[str, Any], job: dict[str, Any]) -> None:
    """Write the fit into the folder ``model``, and its report into ``folder``."""
    save(fit, model, record={"job": job, **report.finite(result)})
    (folder / report.REPORT).write_text(report.to_json(result), encoding="utf-8")


def publish(best: Path, model: Path) -> str:
    """Copy the best map of an interrupted fit into the folder ``model``; return a message or "".

    An existing folder is left as it is, unless the same fit, interrupted before, wrote it.
    """
    if not best.is_dir():
        return ""
    if model.exists() and _recorded(model, "unfinished") != _recorded(best, "unfinished"):
        return f"{model} is as it was before; the best map so far is in {best}"
    with atomic_folder(model) as folder:
        shutil.copytree(best, folder, dirs_exist_ok=True)
    return f"the best map so far is in {model} and can be used"


def _recorded(model: Path, what: str) -> Any:
    try:
        return saved.record(model).get(what)
    except InputError:
        return None


def pairs_digest(pairs: Pairs) -> str:
    """SHA-256 of the pairs' states, and of the parameters where there are any."""
    return digest_of(pairs.z0, pairs.z1, *(pairs.args or {}).values())


def digest_of(*arrays: Any) -> str:
    """SHA-256 of arrays, one after another; those that are None count nothing."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(b"" if array is None else np.ascontiguousarray(array).data)
    return digest.hexdigest()


def units_of(recording: Recording) -> dict[str, Any]:
    """Entries of a model's job by which `read_in_units` reads another recording in its units."""
    degrees = [name for name, factor in recording.factors.items() if factor != 1]
    units = {name: recording.unit(name) for name in recording.columns}
    return {"degrees": degrees, "time_unit": recording.time_unit, "units": units}


def read_in_units(path: Any, job: dict[str, Any], roles: dict[str, Any]) -> Recording:
    """Read a recording in the units of its header and, where that is silent about times or about
    degrees, in those of the recording that the model was learned from.

    roles: keywords of `gfnn_jax.read`; a unit among them goes before the model's. A file without
    names or times is read as that one was.
    """
    reading = job.get("reading", {})
    try:
        recording = read(path, **{**reading, **roles})
    except InputError:
        if "columns" not in reading:  # a file of inputs alone has not all of them
            raise
        reading = {name: value for name, value in reading.items() if name != "columns"}
        recording = read(path, **{**reading, **roles})
    roles = {**reading, **roles}
    known = (*recording.positions, *recording.velocities)
    silent = [n for n in job.get("degrees", ()) if n in known and n not in recording.units]
    told: dict[str, Any] = {"degrees": silent} if silent else {}
    if not recording.time_unit_given and job.get("time_unit", "s") != "s":
        told["time_unit"] = job["time_unit"]
    return read(path, **{**told, **roles}) if told else recording


def refuse_other_units(recording: Recording, job: dict[str, Any]) -> None:
    """Raises InputError where a column has another unit than in the recording that the model was
    learned from; degrees and radians are one, as both are read in radians."""
    for name, known in job.get("units", {}).items():
        own = recording.unit(name) if name in recording.columns else ""
        angles = all(unit.strip().lower().startswith(_ANGLES) for unit in (own, known))
        same = angles and own.partition("/")[2] == known.partition("/")[2]
        if own and known and own != known and not same:
            wanted = f"{name} in {known}, in which the model was learned"
            raise InputError(f"{recording.source}: expected {wanted}, got {own}")


BEST = "best"


def search(
    data: Pairs | Recording,
    scene: Scene | None,
    options: FitOptions,
    *,
    progress: Progress,
    spent: float = 0.0,
    kept: tuple[Path, dict[str, Any]] | None = None,
) -> Fit:
    """Fit pairs, or a recording.

    spent: seconds of the budget that are gone already. kept: folder for checkpoints of a training,
    factors, and the best map so far, and the job that they belong to. Raises InputError for data or
    a request that cannot give a map, WorkError where the arithmetic fails.
    """
    watch: dict[str, Any] = {"spent": spent, "on_progress": progress.status}
    watch["on_candidate"] = lambda candidate: progress.line(line(candidate))
    if kept is not None:
        kept_in, job = kept
        watch |= {"checkpoints": TrainingCheckpoints(kept_in, job), "factors": KeptFactors(kept_in)}
        watch["on_better"] = partial(_keep, kept_in / BEST, scene, job)
    with refusals(), failures_of_arithmetic():
        return fit(data, scene, options=options, **watch)


def _keep(
    folder: Path, scene: Scene | None, job: Any, map_: SymplecticMap, candidate: Candidate
) -> None:
    """Save the best map so far, unless a better one is there.

    A resumed fit goes through its small sizes again, which are worse than what it had kept."""
    with contextlib.suppress(InputError, KeyError):  # none can be read
        if float(saved.record(folder)["validation_relative"]) <= candidate.validation_relative:
            return
    record = {"unfinished": job, "validation_relative": candidate.validation_relative}
    saved.save(map_, folder, scene=scene, record=record, overwrite=True)


def line(candidate: Candidate) -> str:
    """Describe a finished candidate in one line: chart, family, one-step error ÷ spread.

    The error is estimated from the gradient's residual until steps have validated it.
    """
    first = "" if candidate.validated else "first estimated at "
    return (
        f"{candidate.chart} {candidate.label}: one-step error {first}"
        f"{candidate.validation_relative:.2e} of the spread, "
        f"{candidate.num_parameters} parameters"
    )


@contextlib.contextmanager
def refusals() -> Iterator[None]:
    """Turn a FitError, of options or data that can give no map, into an InputError; where the data
    were taken and the search found no law, into a WorkError."""
    try:
        yield
    except FitError as error:
        raise (WorkError if error.verdict else InputError)(str(error)) from error


@contextlib.contextmanager
def failures_of_arithmetic() -> Iterator[None]:
    """Turn a factorisation that fails, or JAX out of memory, into a WorkError of one line."""
    try:
        yield
    except (np.linalg.LinAlgError, jax.errors.JaxRuntimeError) as error:
        what = (str(error) or type(error).__name__).splitlines()[0]
        raise WorkError(f"the fit failed: {what}") from error


def scene_named(name: str, dt: float | None = None) -> Scene:
    """Make the scene of this name, with its own time step or another. Raises InputError."""
    try:
        return scenes.make(name, dt)
    except ValueError as error:
        raise InputError(str(error)) from error
