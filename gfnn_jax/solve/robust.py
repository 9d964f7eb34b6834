"""Loss functions ρ(r) of residuals in units of their noise, all ρ(r) → r² where r is small.

An iteration minimises Σ w r² with w = ρ'(r) ÷ 2r, the residuals' *weights* (iteratively reweighted
least squares; Huber, Robust Statistics, 1981).
"""

from __future__ import annotations

import dataclasses
from typing import Protocol

import numpy as np


class Loss(Protocol):
    """ρ and its weights, elementwise."""

    def of(self, residuals: np.ndarray) -> np.ndarray: ...

    def weights(self, residuals: np.ndarray) -> np.ndarray: ...


@dataclasses.dataclass(frozen=True)
class SoftL1:
    """2k²(√(1 + (r/k)²) − 1): grows as |r|, and has one minimum, wherever a fit starts.

    k: in standard deviations.
    """

    k: float = 2.5

    def of(self, residuals: np.ndarray) -> np.ndarray:
        return 2 * self.k**2 * (np.sqrt(1 + (residuals / self.k) ** 2) - 1)

    def weights(self, residuals: np.ndarray) -> np.ndarray:
        return (1 + (residuals / self.k) ** 2) ** -0.5


@dataclasses.dataclass(frozen=True)
class Biweight:
    """Tukey's (k²/3)(1 − (1 − (r/k)²)³), constant beyond k: gross errors have no weight, in a fit
    that starts from states that most of the others bear out.

    k: in standard deviations.
    """

    k: float = 7.0

    def of(self, residuals: np.ndarray) -> np.ndarray:
        return self.k**2 / 3 * (1 - (1 - self._size(residuals) ** 2) ** 3)

    def weights(self, residuals: np.ndarray) -> np.ndarray:
        return (1 - self._size(residuals) ** 2) ** 2

    def _size(self, residuals: np.ndarray) -> np.ndarray:
        return np.minimum(np.abs(residuals) / self.k, 1.0)
