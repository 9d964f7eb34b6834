"""Candidates: one chart, one family, one size, fitted; its error measured and its cost counted.

A ladder holds the sizes of one family in one chart. The linear families of a stage are answered by
one factorisation: their terms are the leading columns of the largest.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.generating.charts import MIDPOINT, AnyChart
from gfnn_jax.coordinates import CARTESIAN, TWO_PI
from gfnn_jax.fitting import least_squares
from gfnn_jax.fitting.levenberg_marquardt import LMState, levenberg_marquardt
from gfnn_jax.solve.newton import LEFT_DOMAIN, NOT_CONVERGED, Info
from gfnn_jax.maps.symplectic_map import Generated, SymplecticMap
from gfnn_jax.phase_space import Pairs, sizes
from gfnn_jax.learn.prepare import Prepared
from gfnn_jax.families.inputs import box_inputs, variable_signs
from gfnn_jax.families.mlp import Mlp, amplitude_of
from gfnn_jax.families.products import Products
from gfnn_jax.families.sines import Sines
from gfnn_jax.generating.predictor import CLOSE, Starts, affordable, fit_starts

# Degrees whose numbers of terms grow by about a half from one to the next; a stage is fitted by one
# factorisation of the rows of its largest degree.
_STAGES = ((2, 3, 4, 5, 6), (7, 8, 9, 10), (12, 14, 16), (18, 20))
_SINES = (100, 200, 400, 800, 1_600)
_MOST_TERMS = 1_500
# Rows × terms² of one factorisation: about ten seconds on two cores.
_MOST_WORK = 1.2e11
# Where the starts of the data leave more updates than this on average, a map has its own.
_ONE_UPDATE, _START_PAIRS = 1.1, 2_000
# The network of the second-order fit: three small layers beat one wide, gelu beats tanh.
_MLP_HIDDEN, _MLP_ACTIVATION, _MLP_PAIRS = (16, 16, 16), "gelu", 4_000
# Of a refit: pairs at a time; a pair is wrong that is missed by so many deviations, which are no
# smaller than roundoff. A million pairs with one at this limit have no worse a fit for it.
_REFIT_PAIRS, _WRONG, _ROUNDING = 20_000, 100.0, 1e-14
_CHECKPOINT_SECONDS = 10.0
_NORMAL_95 = 1.645
_TIMED_LANES, _TIMED_FRONT = 1_000, 3


@dataclasses.dataclass(frozen=True)
class Candidate:
    """One rung of the ladder: what it is, how accurate, how fast.

    validation_rms: per-component RMS of the one-step state error on held-out pairs, in the user's
    coordinates; validation_bound: its upper 95 % bound. work: floating-point operations per
    predicted step. deviations: (2d,) the error's RMS in each coordinate. fit_seconds: of its
    least-squares solve or training, compilation apart.
    """

    label: str
    scalar: str
    chart: str
    num_parameters: int
    validation_rms: float
    validation_bound: float
    deviations: np.ndarray
    work: float
    microseconds_per_step: float | None
    fit_seconds: float
    compile_seconds: float
    train_rms: float
    newton_iterations_max: int
    condition: float | None
    rank: int | None
    map: SymplecticMap
    chosen: bool = False

    @property
    def relative_rms(self) -> float:
        """RMS of the error in units of the data's spread, whatever units they came in."""
        return float(np.sqrt(np.mean((self.deviations / np.asarray(self.map.scale)) ** 2)))


@dataclasses.dataclass(frozen=True)
class Rows:
    """The pairs, and which of them are for training and which are held out."""

    pairs: Pairs
    training: np.ndarray
    held_out: np.ndarray


@dataclasses.dataclass(frozen=True)
class Rung:
    """One size of a family; ``stage`` is the largest of those fitted by the same factorisation."""

    family: Any
    stage: Any
    work: float


def kinds(scalar, charts: Sequence[AnyChart], prepared: Prepared, scene) -> Iterator[tuple]:
    """(chart, (kind, features, reversor)) of each ladder that applies to what was asked for."""
    features = scene.features if scene is not None else None
    high_dimensional = prepared.y0.shape[1] > 4
    for chart in charts:
        # Only the midpoint S inherits the parity.
        reversor = scene.reversor if scene is not None and chart == MIDPOINT else None
        if scalar in ("auto", "polynomial"):
            yield chart, ("polynomial", None, reversor)
        if scalar in ("auto", "features") and features is not None:
            yield chart, ("features", features, reversor)
        if scalar == "sines" or (scalar == "auto" and high_dimensional):
            yield chart, ("sines", None, None)


class Ladder:
    """The sizes of one linear family in one chart, fitted on demand."""

    def __init__(self, prepared: Prepared, chart, rows: Rows, kind, features, reversor):
        self.prepared, self.chart, self.rows, self.kind = prepared, chart, rows, kind
        self.train, self.weight = _data(prepared, chart, rows.training)
        self.held, _ = _data(prepared, chart, rows.held_out)
        self.features, self.starts = features, fit_starts(chart, prepared, features)
        coordinates, dim = prepared.coordinates, prepared.y0.shape[1] // 2
        angles = tuple(a for a in coordinates.angles if a < dim)
        w = self.train[0]
        inputs = box_inputs(
            w, angles=angles, cyclic=coordinates.cyclic, features=features, reversor=reversor
        )
        if kind == "sines":
            stages: Iterable[Iterable[Any]] = ([Sines(inputs, count)] for count in _SINES)
        else:
            signs = variable_signs(inputs, reversor, w) if reversor is not None else None
            stages = ((Products(inputs, degree, signs) for degree in s) for s in _STAGES)
        self.rungs = [
            Rung(f, stage[-1], counted_work(f, 1))
            for stage in _determined(stages, w.size) for f in stage
        ]  # fmt: skip
        self._reduced: dict[Any, least_squares.Reduced] = {}

    def fit(self, rung: Rung, on_progress) -> Candidate:
        """Fit this rung; its stage's factorisation is made once."""
        top = rung.stage
        if top not in self._reduced:
            on_progress(f"{self.chart.name}: {top.num_parameters} terms of {top.label}")
            # Shuffled rows: the first of them are a sample, where all would take too long.
            most = int(_MOST_WORK / (top.num_parameters**2 * self.train[0].shape[1]))
            train = tuple(array[:most] for array in self.train)
            self._reduced = {top: least_squares.reduce(top, train, self.held, self.weight)}
        reduced, family = self._reduced[top], rung.family
        started = time.perf_counter()
        solved = least_squares.solve(reduced, family.num_parameters)
        seconds = reduced.seconds + time.perf_counter() - started
        # Judged through the stage's largest family, zeros added: one compilation for all its rungs.
        padding = top.num_parameters - family.num_parameters
        padded = top.unflatten(jnp.pad(solved.coefficients, (0, padding)))
        error = validation_error(
            self._composed(top, padded),
            self.rows.pairs, self.rows.held_out,
        )  # fmt: skip
        starts, updates = affordable(self.starts, family), error.iterations
        if updates.mean() > _ONE_UPDATE and np.isfinite(error.rms):
            own = self._own_starts(self._composed(top, padded))
            starts = affordable(own, family, spares=True)
            updates = 1 if starts.error <= CLOSE else updates
        params = family.unflatten(solved.coefficients)
        label = f"features {family.degree}" if self.kind == "features" else family.label
        return Candidate(
            label=label, scalar=self.kind, chart=self.chart.name,
            num_parameters=family.num_parameters, validation_rms=error.rms,
            validation_bound=error.bound, deviations=error.deviations,
            work=counted_work(family, updates) + starts.there.operations,
            microseconds_per_step=None, fit_seconds=seconds,
            compile_seconds=reduced.compile_seconds, train_rms=solved.train_rms,
            newton_iterations_max=int(error.iterations.max()), condition=solved.condition,
            rank=solved.rank,
            map=self._composed(family, params, starts),
        )  # fmt: skip

    def _composed(self, family, params, starts: Starts | None = None) -> SymplecticMap:
        starts = starts or affordable(self.starts, family)
        return compose(self.prepared, self.chart, family, params, starts, self.rows.pairs)

    def _own_starts(self, map_: SymplecticMap) -> list[Starts]:
        """Fitted to the map's own images of the training pairs: where S is coarse, those of the
        data are no closer to its roots than S is to the data."""
        prepared, rows = self.prepared, self.rows.training[:_START_PAIRS]
        size = len(self.rows.held_out)  # batches as validated: nothing is compiled
        z0 = np.asarray(self.rows.pairs.z0)[np.resize(rows, (-(-len(rows) // size), size))]
        images, infos = zip(*(map_.step(batch) for batch in z0), strict=True)
        solved = np.concatenate([info.status < NOT_CONVERGED for info in infos])[: len(rows)]
        y1 = np.array(self._as_prepared(jnp.concatenate(images)))[: len(rows)]
        angles = list(prepared.coordinates.angles)  # on the data's own turn
        y1[:, angles] += TWO_PI * np.round((prepared.y1[rows] - y1)[:, angles] / TWO_PI)
        own = dataclasses.replace(prepared, y0=prepared.y0[rows][solved], y1=y1[solved])
        return fit_starts(self.chart, own, self.features)

    @cached_property
    def _as_prepared(self) -> Callable:
        """Images (N, 2d) in the user's coordinates -> where S is learned."""
        forward, half = self.prepared.coordinates.forward, self.prepared.half
        back = (lambda y: y) if half is None else (lambda y: half.inverse()(y)[0])
        return jax.jit(jax.vmap(lambda z: back(forward(z))))


class Network:
    """The one rung of a network, trained by Levenberg–Marquardt."""

    def __init__(self, prepared, chart, rows, tolerance, max_iterations, seed, checkpoints):
        self.prepared, self.chart, self.rows = prepared, chart, rows
        self.tolerance, self.max_iterations = tolerance, max_iterations
        self.seed, self.checkpoints = seed, checkpoints
        (w, wanted), self.weight = _data(prepared, chart, rows.training[:_MLP_PAIRS])
        coordinates, dim = prepared.coordinates, prepared.y0.shape[1] // 2
        angles = tuple(a for a in coordinates.angles if a < dim)
        inputs = box_inputs(w, angles=angles, cyclic=coordinates.cyclic)
        family = Mlp(inputs, _MLP_HIDDEN, _MLP_ACTIVATION, amplitude_of(w, wanted))
        self.train, self.rungs = (w, wanted), [Rung(family, family, 0.0)]

    def fit(self, rung: Rung, on_progress) -> Candidate:
        """Train the network."""
        family = rung.family
        held, _ = _data(self.prepared, self.chart, self.rows.held_out)

        def report(state: LMState) -> None:
            on_progress(
                f"{self.chart.name} {family.label}: iteration {state.iteration}, "
                f"validation {state.validation_rms:.2e} of the data's spread"
            )

        theta = np.zeros(family.num_parameters)
        like = LMState(theta, theta, 0.0, 0, 0.0, 0.0, 0.0, 0.0, 0, 0.0)  # its structure counts
        resume = self.checkpoints.latest(like) if self.checkpoints else None
        result = levenberg_marquardt(
            family, family.init(jax.random.key(self.seed), jnp.float64), *self.train,
            validation=held, weight=self.weight, max_iterations=self.max_iterations,
            target_rms=0.5 * self.tolerance / float(np.max(self.prepared.scale)),
            on_progress=report, checkpoint=_every_few_seconds(self.checkpoints),
            resume=resume[1] if resume else None,
        )  # fmt: skip
        starts = affordable(fit_starts(self.chart, self.prepared), family)
        map_ = compose(self.prepared, self.chart, family, result.params, starts, self.rows.pairs)
        error = validation_error(map_, self.rows.pairs, self.rows.held_out)
        return Candidate(
            label=family.label, scalar=family.name, chart=self.chart.name,
            num_parameters=family.num_parameters, validation_rms=error.rms,
            validation_bound=error.bound, deviations=error.deviations,
            work=counted_work(family, error.iterations) + starts.there.operations,
            microseconds_per_step=None, fit_seconds=result.seconds,
            compile_seconds=result.compile_seconds, train_rms=result.train_rms,
            newton_iterations_max=int(error.iterations.max()), condition=None, rank=None,
            map=map_,
        )  # fmt: skip


def _every_few_seconds(checkpoints) -> Callable | None:
    """A checkpoint callback that saves when ten seconds have passed since it last did."""
    if checkpoints is None:
        return None
    last = time.monotonic()

    def save(state: LMState) -> None:
        nonlocal last
        if time.monotonic() - last > _CHECKPOINT_SECONDS:
            checkpoints.save(state.iteration, state)
            last = time.monotonic()

    return save


def _data(prepared: Prepared, chart: AnyChart, rows):
    """(w, wanted) of these rows, and the weight that makes a row of ∇S unit-free."""
    y0, y1 = jnp.asarray(prepared.y0[rows]), jnp.asarray(prepared.y1[rows])
    weight = _weight(chart, prepared.scale, prepared.dt)
    return (chart.point(y0, y1), chart.wanted(y0, y1, prepared.dt)), weight


def _weight(chart: AnyChart, scale, dt):
    """h over the scale of what each entry of ∇S changes, (2d,): ∂S/∂q changes p and conversely; in
    type 1 both entries are momenta."""
    dim = len(scale) // 2
    return dt / (np.tile(scale[dim:], 2) if chart.name == "type1" else np.roll(scale, dim))


def refitted(
    candidate: Candidate, chunks: Iterable[Pairs], held: Pairs
) -> tuple[Candidate | None, int, int, float]:
    """A candidate of a linear family fitted anew to all of these pairs: it (None where no pair is
    or judge is left), their number, how many were left out as wrong, and the error of the old one
    on the pairs held out.

    chunks: pairs that need never be in memory together. held: those that judge it, which are left
    out of the fit. A pair is wrong, and no judge, that the old candidate misses by many of its
    deviations.
    """
    map_ = candidate.map
    index = next(i for i, piece in enumerate(map_.pieces) if isinstance(piece, Generated))
    generated = map_.pieces[index]
    weight = _weight(generated.chart, np.asarray(generated.scale), map_.dt)
    as_seen = jax.jit(jax.vmap(map_.generated_pair))
    most = _WRONG * np.maximum(candidate.deviations, _ROUNDING * np.asarray(map_.scale))

    def right(z0, z1):
        return np.all(np.abs(_state_error(map_, z0, z1)[0]) <= most, axis=1)

    held = held.take(np.flatnonzero(right(held.z0, held.z1)))
    if len(held) == 0:
        return None, 0, 0, candidate.validation_rms
    judges, count, wrong = _as_keys(held.z0), 0, 0

    def rows(z0, z1):
        y0, y1 = as_seen(jnp.asarray(z0), jnp.asarray(z1))
        return generated.chart.point(y0, y1), generated.chart.wanted(y0, y1, map_.dt)

    def kept():
        nonlocal count, wrong
        for z0, z1 in _of_length(((p.z0, p.z1) for p in chunks), _REFIT_PAIRS):
            new = ~np.isin(_as_keys(z0), judges)
            good = right(z0, z1)
            count, wrong = count + int(np.sum(good)), wrong + int(np.sum(~good))
            yield tuple(np.asarray(a)[new & good] for a in rows(z0, z1))

    # Blocks of one length: each length is compiled for.
    length = min(_REFIT_PAIRS, least_squares.chunk_size(candidate.num_parameters, map_.dim))
    reduced = least_squares.reduce_chunks(
        generated.scalar, _of_length(kept(), length), [rows(held.z0, held.z1)], weight
    )
    if reduced.rows == 0:
        return None, count, wrong, candidate.validation_rms
    solved = least_squares.solve(reduced, candidate.num_parameters)
    generated = dataclasses.replace(
        generated, params=generated.scalar.unflatten(solved.coefficients)
    )
    pieces = (*map_.pieces[:index], generated, *map_.pieces[index + 1 :])
    all_held = np.arange(len(held))
    before = validation_error(map_, held, all_held).rms
    map_ = dataclasses.replace(map_, pieces=pieces)
    error = validation_error(map_, held, all_held)
    refit = dataclasses.replace(
        candidate, map=map_, validation_rms=error.rms, validation_bound=error.bound,
        deviations=error.deviations,
        train_rms=solved.train_rms, fit_seconds=candidate.fit_seconds + reduced.seconds,
    )  # fmt: skip
    return refit, count, wrong, before


def _of_length(blocks: Iterable[tuple], length: int) -> Iterator[tuple]:
    """Blocks of arrays cut and joined anew, each of so many rows, the last of what is left."""
    rest: tuple = ()
    for block in blocks:
        joined = [np.concatenate(parts) for parts in zip(rest, block)] if rest else block  # noqa: B905
        whole = len(joined[0]) - len(joined[0]) % length
        for first in range(0, whole, length):
            yield tuple(a[first : first + length] for a in joined)
        rest = tuple(a[whole:] for a in joined)
    if rest and len(rest[0]):
        yield rest


def _as_keys(z) -> np.ndarray:
    """The rows of z (N, 2d) as N things that can be compared."""
    z = np.ascontiguousarray(z)
    return z.view([("", z.dtype)] * z.shape[1]).ravel()


def _determined(stages: Iterable[Iterable[Any]], rows: int) -> Iterator[list[Any]]:
    """The families, stage by stage, whose terms so many rows determine.

    Sizes rise, so the first that is too large is the last that is looked at: in many dimensions the
    terms of a high degree could not even be counted.
    """
    most = min(_MOST_TERMS, rows // 3)
    for stage in stages:
        kept = []
        for family in stage:
            if family.num_parameters > most:
                break
            kept.append(family)
        else:
            yield kept
            continue
        if kept:
            yield kept
        return


def compose(
    prepared: Prepared, chart, family, params, starts: Starts, pairs: Pairs
) -> SymplecticMap:
    scale = jnp.asarray(prepared.scale)
    generated = Generated(family, params, chart, prepared.dt, scale, starts.there, starts.back)
    half = prepared.half
    return SymplecticMap(
        pieces=(generated,) if half is None else (half, generated, half),
        coordinates=prepared.coordinates,
        domain=prepared.domain,
        scale=jnp.asarray(sizes(pairs.z0)),
        cut=jnp.asarray(prepared.cut),
        dt=prepared.dt,
    )


class ValidationError(NamedTuple):
    """Z_predicted − Z on held-out pairs, in the user's coordinates, angles modulo 2π.

    rms: RMS per component. bound: its upper 95 % bound, that of the mean square by the central
    limit theorem. deviations: (2d,) RMS in each coordinate. iterations: of Newton, (N,). All but
    the iterations are infinite where a lane fails.
    """

    rms: float
    bound: float
    deviations: np.ndarray
    iterations: np.ndarray


def validation_error(map_: SymplecticMap, pairs: Pairs, rows) -> ValidationError:
    """How far the map is from the images of these rows of the pairs."""
    error, info = _state_error(map_, np.asarray(pairs.z0)[rows], np.asarray(pairs.z1)[rows])
    deviations, square = np.sqrt(np.mean(error**2, axis=0)), np.mean(error**2, axis=1)
    iterations = np.asarray(info.iterations)
    if not np.isfinite(square).all() or (np.asarray(info.status) > LEFT_DOMAIN).any():
        return ValidationError(np.inf, np.inf, np.full_like(deviations, np.inf), iterations)
    bound = square.mean() + _NORMAL_95 * square.std() / np.sqrt(len(square))
    rms = float(np.sqrt(square.mean()))
    return ValidationError(rms, float(np.sqrt(bound)), deviations, iterations)


def _state_error(map_: SymplecticMap, z0, z1) -> tuple[np.ndarray, Info]:
    """Z_predicted − Z (N, 2d), angles modulo 2π, and how the solves ended."""
    predicted, info = map_.step(z0)
    error = np.asarray(predicted) - z1
    if map_.coordinates.forward is CARTESIAN.forward:
        angles = list(map_.coordinates.angles)
        error[:, angles] -= TWO_PI * np.round(error[:, angles] / TWO_PI)
    return error, info


def counted_work(family, iterations) -> float:
    """Floating-point operations per predicted step: those of ∇S and of its Jacobian, counted.

    iterations: of some steps. One update takes a gradient beside the one that comes with the
    Jacobian; more take another Jacobian each, and one where the first has led.
    """
    gradient, jacobian = family.operations
    more = np.where(np.asarray(iterations) > 1, iterations, 0).mean()
    return float(jacobian + gradient + more * jacobian)


def timed(candidates: list[Candidate], chosen: Candidate, states) -> list[Candidate]:
    """Candidates with the measured time per trajectory-step, compilation apart.

    Of the chosen one and of a few along the front of those that no cheaper one beats: a compilation
    each is what it costs.
    """
    front, best = [], np.inf
    for candidate in sorted(candidates, key=lambda c: c.work):
        if candidate.validation_rms < best:
            front.append(candidate)
            best = candidate.validation_rms
    front = front or [chosen]  # where no candidate has an image of every state
    few = {id(front[i]) for i in np.linspace(0, len(front) - 1, _TIMED_FRONT).round().astype(int)}
    few.add(id(chosen))
    return [_measured(c, states) if id(c) in few else c for c in candidates]


def _measured(candidate: Candidate, states) -> Candidate:
    """With the time per step of a batch of 1,000 lanes, the best of five, and its most updates."""
    z = np.resize(states, (_TIMED_LANES, states.shape[1]))
    iterations = candidate.map.step(z)[1].iterations

    def run() -> float:
        started = time.perf_counter()
        jax.block_until_ready(candidate.map.step(z))
        return time.perf_counter() - started

    return dataclasses.replace(
        candidate,
        microseconds_per_step=1e6 * min(run() for _ in range(5)) / _TIMED_LANES,
        newton_iterations_max=int(iterations.max()),
    )
