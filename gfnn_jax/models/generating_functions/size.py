"""A size of a sweep of S, and the piece that its S generates."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from gfnn_jax.budget import Budget
from gfnn_jax.candidates.assemble import with_predictor
from gfnn_jax.candidates.candidate import refined_images
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.generating.charts import AnyChart
from gfnn_jax.generating.generated import Generated

# Operations of singular values, ÷ terms³; and of a step in NumPy, in units that take as long.
OF_SOLVE, OF_STEPS = 22.0, 20.0


@dataclasses.dataclass(frozen=True)
class Size:
    """One size of a sweep: what a search needs to know before its error is estimated."""

    family: Any
    group: Any  # the largest family whose error is estimated from the same factor
    order: float  # the logarithm of the error falls in proportion: a degree, or log₂ of a number

    @property
    def operations(self) -> float:
        """Floating-point operations per predicted step: one update, which takes ∇S with its
        Hessian, and ∇S where it leads."""
        gradient, with_hessian = self.family.operations
        return float(gradient + with_hessian)


class Generates:
    """Base of the sweeps of S: a solved size makes a piece."""

    data: Dataset
    chart: AnyChart
    tolerance: Tolerance

    def solve(self, size: Size, budget: Budget, on_progress) -> tuple[Any, Any]:
        """Solve for the params of the size's family; with them what is known of the solution."""
        raise NotImplementedError

    def piece(self, size: Size) -> Generated:
        """The piece that the size's S generates, with its predictor."""
        data, params = self.data, self._params_of(size)
        piece = Generated(size.family, params, self.chart, data.dt, data.scale)
        return with_predictor(piece, data, data.training)

    def images(self, size: Size, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Images of these rows (n, 2d), inner ones, and which steps were solved (n,)."""
        params = self._params_of(size)
        return refined_images(self.data, self.chart, size.family, params, rows)

    def _params_of(self, size: Size) -> Any:
        return self.solve(size, Budget(), lambda message: None)[1]
