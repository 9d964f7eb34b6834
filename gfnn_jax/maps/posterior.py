"""Posterior of the coefficients of a map."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True, eq=False, init=False)
class Posterior:
    """Normal distribution about the coefficients of one piece of a map.

    piece: index of the piece. root: (k, m) covariance root, NumPy: the covariance is rootᵀ root.
    Directions that the data do not determine are 0.
    """

    piece: int
    root: Any

    def __init__(self, piece: int, root: Any):
        """Make a posterior. root: the array, or a function that makes it when it is first used.

        For a thousand terms it takes as long as the fit.
        """
        object.__setattr__(self, "piece", piece)
        object.__setattr__(self, "_make" if callable(root) else "root", root)

    def __getattr__(self, name: str) -> Any:
        if name != "root":
            raise AttributeError(name)
        make: Callable[[], Any] = self.__dict__["_make"]
        object.__setattr__(self, "root", np.asarray(make()))
        return self.root

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles hold the root, which is computed for them."""
        return Posterior, (self.piece, self.root)

    @property
    def known(self) -> bool:
        """True where root has been computed."""
        return "root" in self.__dict__

    def of_piece(self, piece: int) -> Posterior:
        """Make the posterior of a piece that has another index."""
        return Posterior(piece, self.root if self.known else lambda: self.root)
