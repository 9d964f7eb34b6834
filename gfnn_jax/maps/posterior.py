"""How well the coefficients of a map are known."""

from __future__ import annotations

import dataclasses
from typing import Any


@dataclasses.dataclass(frozen=True, eq=False)
class Posterior:
    """A normal distribution about a map's own coefficients, those of one of its pieces.

    piece: its index. root: (k, m), NumPy: the covariance is rootᵀ root. Directions that the data do
    not tell are 0.
    """

    piece: int
    root: Any
