"""Output of ``gfnn run`` and ``gfnn fit``: a model with its record, and report.json."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.errors import InputError
from gfnn_jax.evaluate import report
from gfnn_jax.learn.fitted import Fit
from gfnn_jax.learn.saved import save
from gfnn_jax.maps import saved
from gfnn_jax.phase_space import Pairs
from gfnn_jax.storage.outputs import atomic_folder

REPORT, MODEL = "report.json", "model"


class Ran(NamedTuple):
    """Result of a job: the fit, the folder where it was written, and its report."""

    fit: Fit
    out: Path
    report: dict[str, Any]


def write(folder: Path, model: Path, fit: Fit, result: dict[str, Any], job: dict[str, Any]) -> None:
    """Write the fit into the folder ``model``, and its report into ``folder``."""
    save(fit, model, record={"job": job, **report.finite(result)})
    (folder / REPORT).write_text(report.to_json(result), encoding="utf-8")


def publish(best: Path, model: Path) -> str:
    """Copy the best map of an interrupted fit into the folder ``model``; return a message or "".

    An existing folder is left as it is, unless the same fit, interrupted before, wrote it.
    """
    if not best.is_dir():
        return ""
    if model.exists() and _unfinished(model) != _unfinished(best):
        return f"{model} is as it was before; the best map so far is in {best}"
    with atomic_folder(model) as folder:
        shutil.copytree(best, folder, dirs_exist_ok=True)
    return f"the best map so far is in {model} and can be used"


def _unfinished(model: Path) -> dict[str, Any] | None:
    """Job of the interrupted fit whose best map a folder holds; None for any other folder."""
    try:
        return saved.record(model).get("unfinished")
    except InputError:
        return None


def already_done(model: Path, job: dict[str, Any], resume: bool) -> bool:
    """Return whether a resumed job had already finished."""
    if not (resume and model.is_dir()):
        return False
    try:
        return saved.record(model).get("job") == job
    except InputError:
        return False


def pairs_digest(pairs: Pairs) -> str:
    """SHA-256 of the pairs' states, and of the parameters where there are any."""
    digest = hashlib.sha256(np.ascontiguousarray(pairs.z0).data)
    for array in (pairs.z1, *(pairs.args or {}).values()):
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
