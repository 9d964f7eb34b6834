"""The chosen candidate made a map: predictors for its solves, and a last look at its own steps."""

from __future__ import annotations

import dataclasses
import time
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from gfnn_jax.budget import COMPILE, Budget, within
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import OneStepError, Tolerance, measured_error
from gfnn_jax.dataset.rows import inputs_of
from gfnn_jax.fitting import row_blocks
from gfnn_jax.flows.collocation import of_lanes
from gfnn_jax.generating.charts import AnyChart
from gfnn_jax.generating.generated import Generated
from gfnn_jax.generating.predictor import affordable, fit_predictors
from gfnn_jax.maps.parameters import sampled
from gfnn_jax.maps.piece import Piece
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.solve.status import LEFT_DOMAIN

_TIMING = "the time of a step, and the error of compiled ones"


class Options:
    """Pairs and states of the last looks at a chosen map."""

    predictor_pairs: int = 2_000
    # States are stepped in blocks of one shape, whatever their number: compiled once for a kind of
    # map. A block of wide states is of so many numbers.
    block: int = 512
    block_numbers: int = 2**16
    repeats: int = 5  # of a timed block; the best counts


class Assembled(NamedTuple):
    """The candidate as its own steps show it, with its map, and the seconds that compiling took;
    compiled: whether there was room for that in the budget, else the error is the search's. failed:
    the number of steps that were not solved."""

    candidate: Candidate
    compile_seconds: float
    compiled: bool = True
    failed: int = 0


def measured(
    candidate: Candidate, map_: SymplecticMap, data: Dataset, tolerance: Tolerance, budget: Budget
) -> Assembled:
    """The candidate with this map, its error and its time per step measured by the steps that users
    run, as long as compiling them fits into the budget."""
    held, compiling = data.pairs.take(data.validation), budget.compiling
    unit = budget.last(_TIMING, COMPILE, compiling, decides=True)
    steps = within(unit, lambda: stepped(map_, np.asarray(held.z0), held.dt, held.args))
    if steps is None:
        return Assembled(dataclasses.replace(candidate, map=map_), 0.0, compiled=False)
    images = np.where(steps.failed[:, None], np.nan, steps.images)
    error = measured_error(data, tolerance, images)
    candidate = dataclasses.replace(
        with_error(candidate, error),
        map=map_,
        newton_iterations_max=int(steps.iterations.max()),
        microseconds_per_step=steps.microseconds_per_step,
    )
    return Assembled(candidate, steps.compile_seconds, failed=int(steps.failed.sum()))


def with_predictor(generated: Generated, data: Dataset, rows) -> Generated:
    """The piece with predictors fitted to its own images of the data's states: where S is coarse,
    the data are no closer to its roots than S is to the data."""
    rows = rows[: Options.predictor_pairs]
    images, solved = refined_images(data, generated.chart, generated.family, generated.params, rows)
    if solved.sum() < 2:  # nothing to learn from: the data's own images
        images, solved = data.y1[rows], np.ones(len(rows), bool)
    args, dt = data.given(rows[solved])[1], of_lanes(data.given(rows)[0], solved)
    features = getattr(getattr(generated.family, "inputs", None), "features", None)
    inputs, y0 = partial(inputs_of, data, features=features), data.y0[rows][solved]
    fitted = fit_predictors(generated.chart, y0, images[solved], dt, inputs, args)
    chosen = affordable(fitted, generated.family)
    return dataclasses.replace(generated, predictor=chosen.predictor)


def composed(piece: Piece, data: Dataset) -> SymplecticMap:
    """The piece between those that were factored out, in the scene's coordinates: leaves of JAX."""
    # Where the args that a map depends on were sampled, and the dt of an S of dt
    parameters = dt_range = None
    if data.args is not None:
        parameters = sampled(data.parameters, data.args, data.each_dt, data.period)
    if data.own_dt is not None and isinstance(piece, Generated):
        dt_range = np.array([data.own_dt.min(), data.own_dt.max()])
    pieces = (*data.before, piece, *data.after)
    where = data.coordinates, data.domain, data.spread, data.angle_centre, data.dt
    map_ = SymplecticMap(pieces, *where, parameters=parameters, dt_range=dt_range)
    # Not jnp.asarray, which compiles a copy for every new shape.
    return jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf)), map_)


def block_of(width: int) -> int:
    """The number of states (2d,) of this width that are stepped together."""
    return max(1, min(Options.block, Options.block_numbers // width))


class Stepped(NamedTuple):
    """Images (N, 2d) of states, Newton's iterations and whether a step failed (N,), the time of a
    step in a block, and the seconds that compiling took."""

    images: np.ndarray
    iterations: np.ndarray
    failed: np.ndarray
    microseconds_per_step: float
    compile_seconds: float


def stepped(
    map_: SymplecticMap, z: np.ndarray, dt: Any = None, args=None, *, timed: bool = True
) -> Stepped:
    """One step of the states z (N, 2d), in blocks of one shape; times are 0 unless ``timed``, and
    blocks are then shared out among the devices of the fit. dt: of each state (N,), or that of the
    map. args: name -> (N,), as those of `Pairs`."""
    size = block_of(z.shape[1])
    rows = np.resize(np.arange(len(z)), -(-len(z) // size) * size).reshape(-1, size)
    longest = map_.over(np.max(dt)) if np.ndim(dt) else map_  # as many substeps in every block

    placed: dict[Any, Any] = {}  # the map on each device, which one thread at a time has

    def run(block, device: Any = None) -> tuple[Any, float]:
        own, given = longest, args and {name: values[block] for name, values in args.items()}
        if device is not None:
            own = placed[device] = placed.get(device) or jax.device_put(longest, device)
        if np.ndim(dt):
            piece = dataclasses.replace(own.pieces[0], dt=dt[block])
            own = dataclasses.replace(own, pieces=(piece,), dt=dt[block])
        started = time.perf_counter()
        out = jax.block_until_ready(own.step(z[block], given))
        return jax.tree.map(np.asarray, out), time.perf_counter() - started

    if row_blocks.devices() and not timed:
        found, seconds, compiling = row_blocks.each(run, rows), 0.0, 0.0
    else:
        found, seconds = [run(rows[0])], 0.0
        if timed:
            seconds = min(run(rows[0])[1] for _ in range(Options.repeats))
        compiling = found[0][1] - seconds if timed else 0.0
        found += [run(block) for block in rows[1:]]
    blocks = [out for out, _ in found]
    images, status, iterations = (
        np.concatenate(parts)[: len(z)]
        for parts in zip(*((i, f.status, f.iterations) for i, f in blocks), strict=True)
    )
    return Stepped(images, iterations, status > LEFT_DOMAIN, 1e6 * seconds / size, compiling)


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
    images = data.users_image(images, solved, data.validation)
    return with_error(candidate, measured_error(data, tolerance, images))


def with_error(candidate: Candidate, error: OneStepError) -> Candidate:
    return dataclasses.replace(candidate, **_fields_of(error), validated=True)
