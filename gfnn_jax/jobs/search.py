"""Call of ``gfnn.fit`` by the jobs: candidates are shown, and a failure is one line."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from gfnn_jax import scenes
from gfnn_jax.candidates.assemble import Candidate
from gfnn_jax.errors import FitError, InputError, WorkError
from gfnn_jax.jobs.progress import Progress
from gfnn_jax.learn.fit import fit
from gfnn_jax.learn.fitted import Fit
from gfnn_jax.learn.options import FitOptions
from gfnn_jax.maps import saved
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import Pairs
from gfnn_jax.scenes import Scene
from gfnn_jax.storage.checkpoints import KeptFactors, TrainingCheckpoints

BEST = "best"


def search(
    pairs: Pairs,
    scene: Scene | None,
    options: FitOptions,
    *,
    progress: Progress,
    spent: float = 0.0,
    kept: tuple[Path, dict[str, Any]] | None = None,
) -> Fit:
    """Fit these pairs.

    spent: seconds of the budget that are gone already. kept: folder for checkpoints of a training,
    factors, and the best map so far, and the job that they belong to. Raises InputError for data or
    a request that cannot give a map, WorkError where the arithmetic fails.
    """
    checkpoints = factors = on_better = None
    if kept is not None:
        kept_in, job = kept
        checkpoints, factors = TrainingCheckpoints(kept_in, job), KeptFactors(kept_in)
        on_better = partial(_keep, kept_in / BEST, scene, job)
    with refusals(), failures_of_arithmetic():
        return fit(
            pairs,
            scene,
            options=options,
            spent=spent,
            checkpoints=checkpoints,
            factors=factors,
            on_progress=progress.status,
            on_candidate=lambda candidate: progress.line(line(candidate)),
            on_better=on_better,
        )


def _keep(
    folder: Path, scene: Scene | None, job: Any, map_: SymplecticMap, candidate: Candidate
) -> None:
    """Save the best map so far, unless a better one is there.

    A resumed fit goes through its small sizes again, which are worse than what it had kept.
    """
    if _error_of(folder) <= candidate.validation_relative:
        return
    record = {"unfinished": job, "validation_relative": candidate.validation_relative}
    saved.save(map_, folder, scene=scene, record=record, overwrite=True)


def _error_of(folder: Path) -> float:
    """Error of the map that was kept in the folder; infinite where none can be read."""
    try:
        return float(saved.record(folder)["validation_relative"])
    except (InputError, KeyError):
        return float("inf")


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
