"""How well the coefficients of a map are known."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True, eq=False, init=False)
class Posterior:
    """A normal distribution about a map's own coefficients, those of one of its pieces.

    piece: its index. root: (k, m), NumPy: the covariance is rootᵀ root. Directions that the data do
    not tell are 0.
    """

    piece: int
    root: Any

    def __init__(self, piece: int, root: Any):
        """root: the array, or a function that makes it, called when it is first asked for: of a
        thousand terms it takes as long as the fit."""
        object.__setattr__(self, "piece", piece)
        object.__setattr__(self, "_make" if callable(root) else "root", root)

    def __getattr__(self, name: str) -> Any:
        if name != "root":
            raise AttributeError(name)
        make: Callable[[], Any] = self.__dict__["_make"]
        object.__setattr__(self, "root", np.asarray(make()))
        return self.root

    @property
    def known(self) -> bool:
        """Whether root has been made."""
        return "root" in self.__dict__

    def of_piece(self, piece: int) -> Posterior:
        """The same of a piece that has another index."""
        return Posterior(piece, self.root if self.known else lambda: self.root)
