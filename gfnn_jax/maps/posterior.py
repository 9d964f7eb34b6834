"""Posterior of the coefficients of a map."""

from __future__ import annotations

import dataclasses
from typing import Any


@dataclasses.dataclass(frozen=True, eq=False)
class Posterior:
    """Normal distribution about the coefficients of one piece of a map.

    piece: index of the piece. root: (k, m) covariance root, NumPy: the covariance is rootᵀ root.
    Directions that the data do not determine are 0.
    """

    piece: int
    root: Any
