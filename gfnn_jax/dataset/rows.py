"""The rows of the least-squares problem of S, from the rows of a data set."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.families.inputs import Inputs, box_inputs
from gfnn_jax.families.time_step import OfTimeStep
from gfnn_jax.generating.charts import AnyChart


def inputs_of(data: Dataset, w: np.ndarray, **more: Any) -> Inputs:
    """The variables of S at points w (N, 2d), as these coordinates have them; the angles among q
    alone enter by harmonics. more: as of `box_inputs`."""
    coordinates = data.coordinates
    angles = tuple(a for a in coordinates.angles if a < data.dim)
    return box_inputs(w, angles=angles, cyclic=coordinates.cyclic, **more)


def rows_of(data: Dataset, chart: AnyChart, rows) -> tuple[Any, np.ndarray]:
    """(w, target_gradient) of these rows, with their args where there are some, and the weight that
    makes a row of ∇S unit-free. Where each pair has its own dt: (w, h times that, dt), as `_Moves`
    has its terms."""
    (y0, y1), (_, args) = (data.y0[rows], data.y1[rows]), data.given(rows)
    dt = data.dt
    if data.own_dt is not None:
        dt, args = 1.0, data.own_dt[rows, None]
    found = chart.evaluation_point(y0, y1), chart.target_gradient(y0, y1, dt)
    found = found if args is None else (*found, args)
    return found, residual_weight(chart, data.scale, dt)


def weighted_rows_of(data: Dataset, chart: AnyChart, rows) -> tuple[Any, np.ndarray]:
    """`rows_of` these rows in units of their own noise, where it is known of each value: the target
    is multiplied by the weight of the coordinate that it changes, (n, 2d), which comes last."""
    found, weight = rows_of(data, chart, rows)
    if data.weight is None:
        return found, weight
    w, target, *args = found
    of_row = _changed(chart, data.weight[rows])
    return (w, of_row * target, *args, of_row), weight


def of_rows(family: Any, *, weighted: bool = False) -> Any:
    """The family whose terms make the rows: the moves h ∇φ where pairs have a dt of their own, and
    those of ``weighted_rows_of``."""
    family = _Moves(family) if isinstance(family, OfTimeStep) else family
    return _Weighted(family) if weighted else family


@dataclasses.dataclass(frozen=True)
class _Moves:
    """h ∇φ of the terms of an S of dt."""

    family: OfTimeStep

    @property
    def num_parameters(self) -> int:
        return self.family.num_parameters

    def term_gradients(self, w, dt):
        return dt[..., None] * self.family.term_gradients(w, dt)


@dataclasses.dataclass(frozen=True)
class _Weighted:
    """The terms of a family, each row times its weight."""

    family: Any

    @property
    def num_parameters(self) -> int:
        return self.family.num_parameters

    def term_gradients(self, w, *given):
        *args, of_row = given
        return of_row[..., None] * self.family.term_gradients(w, *args)


def residual_weight(chart: AnyChart, scale, dt: float) -> np.ndarray:
    """h over the scale of what each entry of ∇S changes, (2d,): ∂S/∂q changes p and conversely; in
    type 1 both entries are momenta."""
    return dt / _changed(chart, scale)


def _changed(chart: AnyChart, of_coordinates: np.ndarray) -> np.ndarray:
    """(..., 2d) of the coordinate that each entry of ∇S changes, from those of the coordinates."""
    dim = of_coordinates.shape[-1] // 2
    if chart.name == "type1":
        return np.concatenate(2 * [of_coordinates[..., dim:]], axis=-1)
    return np.roll(of_coordinates, dim, axis=-1)
