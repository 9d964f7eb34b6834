"""Triangular factors of an unfinished fit, kept so that they need not be computed twice."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from gfnn_jax.storage.outputs import atomic_file

FACTORS = "factors"


class KeptFactors:
    """Store of pairs of factors by name, in ``folder/factors``. A damaged one counts as missing."""

    def __init__(self, folder):
        self.folder = Path(folder) / FACTORS

    def load(self, name: str) -> dict[str, np.ndarray] | None:
        """Load the arrays that were saved under this name; None where there are none."""
        try:
            with np.load(self._path(name), allow_pickle=False) as stored:
                return dict(stored)
        except (OSError, ValueError, EOFError, zipfile.BadZipFile):
            return None

    def save(self, name: str, **arrays) -> None:
        """Save these arrays under this name. Raises WorkError."""
        with atomic_file(self._path(name)) as stream:
            np.savez(stream, **arrays)

    def _path(self, name: str) -> Path:
        return self.folder / f"{name.replace(' ', '-')}.npz"
