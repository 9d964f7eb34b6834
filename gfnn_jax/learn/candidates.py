"""Candidates: one chart, one family, one size, with its error and its cost.

An error is first estimated, from the held-out residual of the gradient of S, which a least-squares
factor answers for every size; a finalist's is measured, by its own steps on held-out pairs.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.coordinates import CARTESIAN, nearest_image, to_user
from gfnn_jax.dataset.bounds import bound_of_mean
from gfnn_jax.dataset.split import split_rows
from gfnn_jax.fitting import row_blocks
from gfnn_jax.generating.charts import AnyChart
from gfnn_jax.generating.generated import Generated
from gfnn_jax.learn.options import FitOptions
from gfnn_jax.learn.prepare import Prepared
from gfnn_jax.phase_space import Pairs, sizes

# A step in NumPy whose residual is larger, relative to its terms, has not been solved.
_SOLVED = 1e-10
_BLOCK = 500  # states that one of several devices steps at a time


@dataclasses.dataclass(frozen=True)
class Tolerance:
    """The error that is asked for.

    bound:    on the one-step error's upper 95 % bound.
    relative: whether errors are divided by each coordinate's spread first; else they are in the
              user's units, RMS per component.
    """

    bound: float
    relative: bool = True

    @classmethod
    def of(cls, options: FitOptions) -> Tolerance:
        """Tolerance that the options ask for."""
        if options.absolute_tolerance is None:
            return cls(options.tolerance)
        return cls(options.absolute_tolerance, relative=False)


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


class OneStepError(NamedTuple):
    """Z_predicted − Z on held-out pairs, in the user's coordinates, angles to the nearest image.

    rms, relative, deviations: as in Candidate. bound: the upper 95 % bound in the tolerance's
    measure (`dataset.bounds`). All infinite where a step fails.
    """

    rms: float
    relative: float
    bound: float
    deviations: np.ndarray


def one_step_error(error, spread, tolerance: Tolerance, block=None) -> OneStepError:
    """The statistics of errors (N, 2d) of states whose coordinates have this spread (2d,). block:
    (N,) which of them depend on each other; None: none do."""
    if not np.isfinite(error).all():
        width = error.shape[1]
        return OneStepError(np.inf, np.inf, np.inf, np.full(width, np.inf))
    squares = error**2
    deviations = np.sqrt(squares.mean(axis=0))
    measured = np.mean(squares / spread**2 if tolerance.relative else squares, axis=1)
    bound = bound_of_mean(measured, np.arange(len(measured)) if block is None else block)
    return OneStepError(
        float(np.sqrt(squares.mean())),
        float(np.sqrt(np.mean(squares / spread**2))),
        float(np.sqrt(bound)),
        deviations,
    )


@dataclasses.dataclass(frozen=True)
class Judges:
    """The pairs, which of them train, which choose (``held_out``) and which state the error
    (``test``, looked at once, at the end), and the error that is asked for. stretch: (N,) as that
    of `dataset.split.Split`."""

    pairs: Pairs
    training: np.ndarray
    held_out: np.ndarray
    tolerance: Tolerance
    test: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, int))
    stretch: np.ndarray | None = None

    @classmethod
    def of(cls, pairs: Pairs, seed: int, tolerance: Tolerance) -> Judges:
        """Of pairs with their runs and places, split by the seed."""
        split = split_rows(pairs, seed)
        return cls(pairs, split.training, split.validation, tolerance, split.test, split.stretch)

    @property
    def spread(self) -> np.ndarray:
        """(2d,) of the user's coordinates."""
        return sizes(self.pairs.z0)

    def met_by(self, candidate: Candidate) -> bool:
        """Whether the candidate's error is within the tolerance, at 95 %."""
        return candidate.validation_bound <= self.tolerance.bound

    def error_of(self, images: np.ndarray, coordinates, rows=None) -> OneStepError:
        """Of the held-out pairs' images (N, 2d) in the user's coordinates, or of these rows'.

        The bound by the held-out pairs is the one that the test pairs are likely to state: as far
        above their error again as that is above the held-out pairs'.
        """
        angles = coordinates.angles if coordinates.forward is CARTESIAN.forward else ()
        own = self.held_out if rows is None else rows
        error = nearest_image(images - np.asarray(self.pairs.z1)[own], angles)
        block = None if self.stretch is None else self.stretch[own]
        found = one_step_error(error, self.spread, self.tolerance, block)
        size = found.relative if self.tolerance.relative else found.rms
        if rows is not None or not len(self.test) or not 0 < size < np.inf:
            return found
        return found._replace(bound=found.bound**2 / size)

    def estimate(self, relative: float) -> OneStepError:
        """What a relative residual of the gradient lets expect of the step."""
        spread = self.spread
        rms = relative * float(np.sqrt(np.mean(spread**2)))
        bound = relative if self.tolerance.relative else rms
        return OneStepError(rms, relative, bound, relative * spread)


def refined_images(
    prepared: Prepared, chart: AnyChart, family, params, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Images of these rows by the map that S generates, as prepared (N, 2d), and which steps were
    solved (N,). In NumPy, from the data's own evaluation points: nothing is compiled."""

    def of(rows) -> tuple[np.ndarray, np.ndarray]:
        y0, y1 = prepared.y0[rows], prepared.y1[rows]
        dt, args = prepared.given(rows)
        piece = Generated(family, params, chart, dt, prepared.scale)
        images, error = piece.refined_step(y0, chart.evaluation_point(y0, y1), args)
        return images, (error < _SOLVED) & np.isfinite(images).all(axis=1)

    if not row_blocks.devices() or len(rows) <= _BLOCK:
        return of(rows)
    blocks = (rows[first : first + _BLOCK] for first in range(0, len(rows), _BLOCK))
    images, solved = zip(*row_blocks.each(lambda block, device: of(block), blocks), strict=True)
    return np.concatenate(images), np.concatenate(solved)


def validated(candidate: Candidate, prepared, chart, family, params, judges: Judges) -> Candidate:
    """The candidate with its error measured by steps on the held-out pairs."""
    images, solved = refined_images(prepared, chart, family, params, judges.held_out)
    images = np.where(solved[:, None], images, np.nan)
    images = prepared.whole_image(images)
    error = judges.error_of(to_user(prepared.coordinates, images), prepared.coordinates)
    return with_error(candidate, error)


def with_error(candidate: Candidate, error: OneStepError) -> Candidate:
    return dataclasses.replace(
        candidate, validation_rms=error.rms, validation_relative=error.relative,
        validation_bound=error.bound, deviations=error.deviations, validated=True,
    )  # fmt: skip
