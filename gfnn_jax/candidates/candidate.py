"""Candidates: one chart, one family, one size, with its error and its cost.

An error is first estimated, from the held-out residual of the gradient of S, which a least-squares
factor answers for every size; a finalist's is measured, by its own steps on held-out pairs.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from gfnn_jax.coordinates import to_user
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import OneStepError, Tolerance, measured_error
from gfnn_jax.fitting import row_blocks
from gfnn_jax.generating.charts import AnyChart
from gfnn_jax.generating.generated import Generated

# A step in NumPy whose residual is larger, relative to its terms, has not been solved.
_SOLVED = 1e-10
_BLOCK = 500  # states that one of several devices steps at a time


@dataclasses.dataclass(frozen=True)
class Candidate:
    """One size of one family in one chart: what it is, how accurate, what a step costs.

    validation_rms: RMS per component of the one-step error Z_predicted − Z on held-out pairs, in
    the user's units. validation_relative: the RMS over coordinates of error ÷ spread.
    validation_bound: upper 95 % bound of the one that the tolerance is for. validated: whether
    these were measured by steps; else they are estimates from the gradient's residual. deviations:
    (2d,) the error's RMS in each coordinate. train_rms: as validation_relative, of the training
    pairs' residual. outside: the relative error at the outermost twentieth of the training states,
    of a fit without them; of S estimated from the gradient's residual. operations: floating-point
    operations of a step with one update, the predictor's few not counted. fit_seconds: of its
    factorisation and solve, or its training. map: of the chosen one.
    """

    label: str
    family: str
    chart: str
    num_parameters: int
    operations: float
    validation_rms: float
    validation_relative: float
    validation_bound: float
    deviations: np.ndarray
    train_rms: float
    fit_seconds: float
    validated: bool = False
    microseconds_per_step: float | None = None
    newton_iterations_max: int | None = None
    condition: float | None = None
    rank: int | None = None
    map: Any = dataclasses.field(default=None, repr=False)
    chosen: bool = False
    learns: str = "map"
    outside: float | None = None

    @classmethod
    def of(cls, error: OneStepError, **what: Any) -> Candidate:
        """The candidate of this error."""
        return cls(**_fields_of(error), **what)


def _fields_of(error: OneStepError) -> dict[str, Any]:
    return {
        "validation_rms": error.rms,
        "validation_relative": error.relative,
        "validation_bound": error.bound,
        "deviations": error.deviations,
    }


def refined_images(
    data: Dataset, chart: AnyChart, family, params, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Images of these rows by the map that S generates, in inner coordinates (N, 2d), and which
    steps were solved (N,). In NumPy, from the data's own evaluation points: nothing is compiled."""

    def of(rows) -> tuple[np.ndarray, np.ndarray]:
        y0, y1 = data.y0[rows], data.y1[rows]
        dt, args = data.given(rows)
        piece = Generated(family, params, chart, dt, data.scale)
        images, error = piece.refined_step(y0, chart.evaluation_point(y0, y1), args)
        return images, (error < _SOLVED) & np.isfinite(images).all(axis=1)

    if not row_blocks.devices() or len(rows) <= _BLOCK:
        return of(rows)
    blocks = (rows[first : first + _BLOCK] for first in range(0, len(rows), _BLOCK))
    images, solved = zip(*row_blocks.each(lambda block, device: of(block), blocks), strict=True)
    return np.concatenate(images), np.concatenate(solved)


def validated(
    candidate: Candidate, data: Dataset, tolerance: Tolerance, chart, family, params
) -> Candidate:
    """The candidate with its error measured by steps on the validation rows."""
    images, solved = refined_images(data, chart, family, params, data.validation)
    images = np.where(solved[:, None], images, np.nan)
    images = data.whole_image(images, data.validation)
    error = measured_error(data, tolerance, to_user(data.coordinates, images))
    return with_error(candidate, error)


def with_error(candidate: Candidate, error: OneStepError) -> Candidate:
    return dataclasses.replace(candidate, **_fields_of(error), validated=True)
