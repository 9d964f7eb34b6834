"""Kinds of files: canonical states, (q, p) at known steps, or a recording."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gfnn_jax.data.blocks import damage
from gfnn_jax.errors import InputError


def are_recordings(paths: str | Path | Sequence[str | Path], *, with_roles: bool = False) -> bool:
    """Return whether files are to be read by `gfnn_jax.read` (True) or as canonical trajectories
    (False).

    Canonical are an ``.npz`` with ``z0`` or ``trajectories``, a plain ``.npy``, and a ``.csv`` with
    columns q1 … and p1 … between commas. All else is a recording; so is every file but these two
    kinds of ``.npz`` where roles are given (``with_roles``).
    Raises InputError where files are of both kinds.
    """
    listed = [Path(p) for p in ([paths] if isinstance(paths, (str, Path)) else paths)]
    kinds = {path: _is_recording(path, with_roles) for path in listed}
    if len(set(kinds.values())) > 1:
        one = next(path for path, is_one in kinds.items() if is_one)
        other = next(path for path, is_one in kinds.items() if not is_one)
        raise InputError(
            f"expected files of one kind, got a recording ({one}) and states q, p ({other})"
        )
    return any(kinds.values())


def _is_recording(path: Path, with_roles: bool) -> bool:
    if not path.is_file():
        return False  # the reader of trajectories says what is the matter
    suffix = path.suffix.lower()
    if suffix == ".npz":
        with damage(path, "the archive"), zipfile.ZipFile(path) as archive:
            return not {"z0.npy", "trajectories.npy"} & set(archive.namelist())
    if suffix == ".npy":
        if with_roles:
            return True
        with damage(path, "the array"):
            return np.load(path, mmap_mode="r", allow_pickle=False).dtype.names is not None
    return with_roles or not _names_q_and_p(path)


def _names_q_and_p(path: Path) -> bool:
    """Return whether the header of a text file names columns q1 … and p1 … between commas."""
    with damage(path, "the header"), open(path, encoding="utf-8-sig") as stream:
        for line in stream:
            names = [cell.strip().strip('"').lower() for cell in line.lstrip("#").split(",")]
            found = {name[0] for name in names if re.match(r"[qp]\d+\s*([\[(].*)?$", name)}
            if found == {"q", "p"}:
                return True
            if line.strip() and not line.startswith("#"):
                return False
    return False
