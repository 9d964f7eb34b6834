"""Size sweeps: the sizes of one family in one chart, estimated from a factor that they share.

S = Σ c_j φ_j(w) makes the map Z − z = h J ∇S(w), w between z and Z as the chart has it (paper,
eq. (4)). Its coefficients minimise the mean of ‖h ∇S(w) + J (Z − z)‖² over the training pairs
(eq. (3)): `dataset.rows` makes the rows of this linear problem, `fitting.least_squares` solves it
for every size. The residual of the validation pairs estimates the error of a size.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from gfnn_jax.budget import Budget
from gfnn_jax.candidates.candidate import Candidate, refined_images, validated
from gfnn_jax.coordinates import to_user
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance, estimated_error
from gfnn_jax.dataset.rows import rows_of, weighted_rows_of
from gfnn_jax.dataset.split import outermost
from gfnn_jax.families.inputs import Inputs, box_inputs, variable_signs
from gfnn_jax.families.own import own_families
from gfnn_jax.families.products import Products
from gfnn_jax.families.sines import Sines
from gfnn_jax.families.time_step import OfTimeStep
from gfnn_jax.fitting import least_squares
from gfnn_jax.fitting.least_squares import ROWS_PER_TERM
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.generating.charts import MIDPOINT, AnyChart
from gfnn_jax.models.generating_functions.coefficient_noise import CoefficientNoise, Factors
from gfnn_jax.models.generating_functions.parity import is_even
from gfnn_jax.models.generating_functions.size import OF_SOLVE, OF_STEPS, Size

# Degrees whose numbers of terms grow by about a half from one to the next; those of a group are
# estimated from one factor of the rows of its largest.
_DEGREES = ((2, 3), (4, 5, 6), (7, 8), (9, 10), (12, 14), (16, 18, 20), (24, 28, 32))
_TRIAL = (2, 3, 4, 5, 6)
_EVEN_DEGREES = tuple((degree,) for degree in (2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 24, 28, 32))
_SINES = (100, 200, 400, 800, 1_600)
# Products of degree 14 in four variables: benchmarks/storage_ring.py.
_MOST_TERMS = 3_100
# Rows × terms² of one factor: about half a minute on one core. 2,000 terms take 80,000 rows.
_MOST_OPERATIONS = 3.2e11
_WORTH_KEEPING = 1.0  # seconds


def sweeps_for(
    request: Any,
    charts: Sequence[AnyChart],
    data: Dataset,
    tolerance: Tolerance,
    scene,
    factors=None,
) -> Iterator:
    """The sweeps of the families that apply, chart by chart.

    request: "auto", "polynomial", "features" (the scene's), "sines", or a user's own; with "auto"
    random sines are tried where polynomials have too many terms. factors: as ``LinearSweep`` takes
    them.
    """
    if not isinstance(request, str):
        for chart in charts:
            yield LinearSweep(
                data, tolerance, chart, "own", None, None, own=lambda i: own_families(request, i)
            )
        return
    features = scene.features if scene is not None else None
    polynomials = request in ("auto", "polynomial")
    free = polynomials and (scene is None or scene.reversor is None)
    degrees = [degree for (degree,) in _EVEN_DEGREES]
    even = free and is_even(data, degrees, _MOST_TERMS, ROWS_PER_TERM)
    for chart in charts:
        # Only the midpoint S inherits the parity.
        reversor = scene.reversor if scene is not None and chart == MIDPOINT else None
        if polynomials:
            yield LinearSweep(data, tolerance, chart, "polynomial", None, reversor, factors, even)
        if request in ("auto", "features") and features is not None:
            yield LinearSweep(data, tolerance, chart, "features", features, reversor, factors)
        if request == "sines" or (request == "auto" and data.dim > 2):
            yield LinearSweep(data, tolerance, chart, "sines", None, None, factors)


def sweep_of_dt(data: Dataset, tolerance: Tolerance, scene, factors=None) -> LinearSweep:
    """The sweep of S(w; dt²), where each pair has its own dt."""
    reversor = scene.reversor if scene is not None else None
    return LinearSweep(data, tolerance, MIDPOINT, "polynomial", None, reversor, factors)


class LinearSweep(CoefficientNoise):
    """The sizes of one linear family in one chart.

    factors: a ``KeptFactors``, where factors that took long are kept for a fit that goes on. even:
    whether S(−w) = S(w), and has even terms only. own: a user's families, of the inputs, by rising
    number of terms.
    """

    linear = True

    def __init__(
        self,
        data: Dataset,
        tolerance: Tolerance,
        chart: AnyChart,
        kind: str,
        features,
        reversor,
        factors=None,
        even=False,
        own: Callable[[Inputs], Iterable[Any]] | None = None,
    ):
        reversor = (-1,) * 2 * data.dim if even else reversor
        self._kept, self._prefix = factors, "even " if even else ""
        self.data, self.tolerance, self.chart, self.kind = data, tolerance, chart, kind
        self._train, self._weight = weighted_rows_of(data, chart, data.training)
        self._held, _ = weighted_rows_of(data, chart, data.validation)
        free = (*data.coordinates.cyclic, *data.whole)
        self._outermost = outermost(data.y0[data.training], free)
        coordinates = data.coordinates
        w, of, args = self._train[0], Products, data.given(data.training)[1]
        if data.own_dt is not None:
            of, args = _of_time_step, data.own_dt[data.training, None] ** 2
        inputs = box_inputs(
            w,
            angles=tuple(a for a in coordinates.angles if a < data.dim),
            cyclic=coordinates.cyclic,
            features=features,
            reversor=reversor,
            args=args,
        )
        degrees = _EVEN_DEGREES if even else _DEGREES
        signs = None
        if kind != "sines" and own is None and reversor is not None:
            signs = variable_signs(inputs, reversor, w)

        def groups() -> Iterator[Iterable[Any]]:
            if own is not None:
                return ([family] for family in own(inputs))
            if kind == "sines":
                return ([Sines(inputs, count)] for count in _SINES)
            return ((of(inputs, degree, signs) for degree in g) for g in degrees)

        known = len(_SINES) if kind == "sines" or own is not None else sum(map(len, degrees))
        # Test rows determine a size too: once they have stated its error, it is fitted to them.
        rows = self._train[1].size + len(data.test) * self._width
        self._groups, self._determining = groups, rows
        self.sizes = [
            Size(family, group[-1], _extent(family))
            for group in _determined(groups(), rows, ROWS_PER_TERM)
            for family in group
        ]
        # Else the last size is the largest there is, or the most terms are reached.
        self.short_of_pairs = len(self.sizes) < known and rows < ROWS_PER_TERM * _MOST_TERMS
        self._factors: dict[Any, Factors] = {}
        self._solved: dict[int, least_squares.LeastSquaresFit] = {}  # by the number of terms

    def named(self, size: Size) -> str:
        """Name of the unit that estimates the size."""
        return f"{self.chart.name} {self._prefix}{size.family.label}"

    def work(self, size: Size) -> float:
        """Operations that estimating the size takes: its group's factor, if it is not there yet."""
        solved = size.family.num_parameters**2
        return solved if size.group in self._factors else solved + self.work_of_factor(size)

    def work_of_factor(self, size: Size) -> float:
        """Operations of the factor that the size is estimated from."""
        count, width = self._rows_of(size.group)
        return 2 * (count + len(self._held[1])) * width * (size.group.num_parameters + 1) ** 2

    def work_of_steps(self, size: Size) -> float:
        """Operations that validating the estimated size takes, those of the steps as those that the
        solution makes in their time."""
        steps = len(self.data.validation) * size.operations
        return OF_SOLVE * size.family.num_parameters**3 + OF_STEPS * steps

    def work_of_refit(self, size: Size) -> float:
        """Operations that a fit of the size to other rows takes."""
        count, width = size.family.num_parameters, self._train[1].shape[1]
        return 2.0 * len(self.data) * width * (count + 1) ** 2 + OF_SOLVE * count**3

    def estimate(self, size: Size, budget: Budget, on_progress: Callable[[str], Any]) -> Candidate:
        """The size with its error estimated from the held-out residual of the gradient."""
        started = time.perf_counter()
        train, held = self.factors(size.group, budget, on_progress)[:2]
        count = size.family.num_parameters
        ((train_rms, held_rms),) = least_squares.residuals(train, held, [count])
        return self._candidate(size, train_rms, held_rms, time.perf_counter() - started)

    def validate(self, size: Size, estimated: Candidate, budget: Budget, on_progress) -> Candidate:
        """The estimated size solved, and its error measured by steps."""
        budget.check()
        on_progress(f"{estimated.chart} {estimated.label}: steps of the held-out pairs")
        started = time.perf_counter()
        solved, params = self.solve(size, budget, on_progress)
        factors = self.factors(size.group, budget, on_progress)
        outside = None
        if factors.outer.rows:  # none where every coordinate covers its circle
            ((_, outside),) = least_squares.residuals(
                factors.inner, factors.outer, [size.family.num_parameters]
            )
        candidate = dataclasses.replace(
            estimated,
            train_rms=solved.train_rms,
            condition=solved.condition,
            rank=solved.rank,
            outside=outside,
        )
        candidate = validated(candidate, self.data, self.tolerance, self.chart, size.family, params)
        seconds = estimated.fit_seconds + time.perf_counter() - started
        return dataclasses.replace(candidate, fit_seconds=seconds)

    def at(self, order: float) -> str:
        """Describe the size of this order: its terms, and how many pairs they take."""
        family = self.sizes[0].family
        if not hasattr(family, "degree"):
            label = f"{family.name} {(terms := round(2**order))}"
        else:
            degree = round(order)
            label = f"{self._prefix}{family.name} {degree}"
            terms = family.terms_of(degree)
        fitted = len(self._train[0]) + len(self.data.test)
        share = fitted / (fitted + len(self.data.validation))
        pairs = int(np.ceil(ROWS_PER_TERM * terms / self._width / share))
        most = f", more than the {_MOST_TERMS:,} that are tried" if terms > _MOST_TERMS else ""
        return f"{label} ({terms:,} terms{most}; about {pairs:,} pairs)"

    def solve(
        self, size: Size, budget: Budget, on_progress
    ) -> tuple[least_squares.LeastSquaresFit, Any]:
        """The coefficients of this size, and the params of its family: solved for once."""
        count = size.family.num_parameters
        if count not in self._solved:
            train, held = self.factors(size.group, budget, on_progress)[:2]
            self._solved[count] = least_squares.solve(train, held, count)
        solved = self._solved[count]
        return solved, size.family.unflatten(solved.coefficients)

    def work_of_test_rows(self, size: Size) -> float:
        """Operations that `with_test_rows` takes. 0 above twice the rows that a size needs: the
        test rows, an eighth as many, make its coefficients little better then."""
        rows, count = self._train[1].size, size.family.num_parameters
        if not len(self.data.test) or rows > 2 * ROWS_PER_TERM * count:
            return 0.0
        more = len(self.data.test) * self._width
        return 2.0 * more * (size.group.num_parameters + 1) ** 2 + OF_SOLVE * count**3

    def with_test_rows(self, size: Size) -> least_squares.LeastSquaresFit:
        """Solution of this size with the test rows among those that train. The validation rows
        choose the ridge, as before."""
        quiet = Budget(), lambda message: None
        train, held = self.factors(size.group, *quiet)[:2]
        test, _ = weighted_rows_of(self.data, self.chart, self.data.test)
        more = least_squares.reduce(self.in_rows(size.group), [test], self._weight)
        return least_squares.solve(train.merge(more), held, size.family.num_parameters)

    def predicted(self, size: Size, others: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Images (n, 2d) of these rows, in the user's coordinates, by a fit to other rows; NaN
        where a step is not solved."""
        family = self.in_rows(size.family)
        given, _ = weighted_rows_of(self.data, self.chart, others)
        train, held = (
            least_squares.reduce(family, [of], self._weight) for of in (given, self._held)
        )
        return self._predicted(size, train, held, rows)

    def _predicted(
        self, size: Size, train: Triangle, held: Triangle, rows: np.ndarray
    ) -> np.ndarray:
        data = self.data
        solved = least_squares.solve(train, held, size.family.num_parameters)
        params = size.family.unflatten(solved.coefficients)
        images, known = refined_images(data, self.chart, size.family, params, rows)
        images = data.whole_image(np.where(known[:, None], images, np.nan), rows)
        return to_user(data.coordinates, images)

    def residuals(self, size: Size) -> np.ndarray:
        """(N, 2d): what the size leaves of ∇S of every pair, unit-free as train_rms."""
        _, params = self.solve(size, Budget(), lambda message: None)
        (w, target, *args), weight = rows_of(self.data, self.chart, slice(None))
        gradient = np.asarray(size.family.gradient(params, w, *args))
        if self.data.own_dt is not None:
            gradient = args[0] * gradient
        return weight * (gradient - target)

    @property
    def largest_known(self) -> Size:
        """The largest size that a factor answers for."""
        return [size for size in self.sizes if size.group in self._factors][-1]

    def _rows_of(self, group) -> tuple[int, int]:
        """Pairs that a group's factor is made of, and rows of each. They are shuffled: the first of
        them are a sample, where all would take too long."""
        count, width = self._train[1].shape
        return min(count, max(1, int(_MOST_OPERATIONS / (group.num_parameters**2 * width)))), width

    def _larger(self, size: Size) -> Size | None:
        """The size two further, as a symmetric map gains nothing from the odd degrees; the next, or
        None, where there is none. Few pairs need half the rows here that a size needs which may be
        chosen: enough to distinguish misfit from noise."""
        place = self.sizes.index(size)
        further = self.sizes[place + 1 : place + 3]
        if len(further) < 2:
            rows = self._determining
            families = (f for g in _determined(self._groups(), rows, ROWS_PER_TERM / 2) for f in g)
            beyond = (f for f in families if f.num_parameters > rows // ROWS_PER_TERM)
            further += [Size(f, f, _extent(f)) for f in itertools.islice(beyond, 2 - len(further))]
        return further[-1] if further else None

    def factors(self, group, budget: Budget, on_progress) -> Factors:
        """Factors of a group's largest family, which answer for all of its sizes."""
        if group not in self._factors:
            self._factors[group] = self._known(group) or self._computed(group, budget, on_progress)
        return self._factors[group]

    def _known(self, group) -> Factors | None:
        """The factors that an interrupted fit of the same pairs has kept."""
        stored = self._kept.load(self._named(group)) if self._kept is not None else None
        if stored is None:
            return None
        inner, outer, held = (
            Triangle(stored[part], int(stored[f"{part}_rows"]))
            for part in ("inner", "outer", "held")
        )
        return Factors.of(inner, outer, held)

    def _computed(self, group, budget: Budget, on_progress) -> Factors:
        taken, _ = self._rows_of(group)
        on_progress(
            f"{self.chart.name}: {group.num_parameters} terms of {group.label}, {taken} pairs"
        )
        started = time.perf_counter()
        train, outermost = tuple(a[:taken] for a in self._train), self._outermost[:taken]
        inner, outer, held = (
            least_squares.reduce(self.in_rows(group), [rows], self._weight, on_block=budget.check)
            for rows in (
                tuple(a[~outermost] for a in train),
                tuple(a[outermost] for a in train),
                self._held,
            )
        )
        if self._kept is not None and time.perf_counter() - started > _WORTH_KEEPING:
            self._kept.save(
                self._named(group),
                inner=inner.factor,
                inner_rows=inner.rows,
                outer=outer.factor,
                outer_rows=outer.rows,
                held=held.factor,
                held_rows=held.rows,
            )
        return Factors.of(inner, outer, held)

    def _named(self, group) -> str:
        return f"{self.chart.name} {self.kind} {group.num_parameters}"

    def _candidate(self, size: Size, train_rms, held_rms, seconds) -> Candidate:
        error = estimated_error(self.data, self.tolerance, held_rms)
        return Candidate.of(
            error,
            label=f"{self._prefix}{size.family.label}",
            family=self.kind,
            chart=self.chart.name,
            num_parameters=size.family.num_parameters,
            operations=size.operations,
            train_rms=train_rms,
            fit_seconds=seconds,
        )


def _extent(family) -> float:
    """The degree of products, or log₂ of the number of terms."""
    degree = getattr(family, "degree", None)
    return float(np.log2(family.num_parameters) if degree is None else degree)


def trial_residual(data: Dataset) -> float:
    """The held-out residual of ∇S, ÷ scale, of polynomials of a low degree in the midpoint chart:
    how near these pairs are to a map that a small S generates. Infinite where some are missing."""
    half = len(data.y0) // 2
    (w, target), weight = rows_of(data, MIDPOINT, slice(None))
    if not np.isfinite(w + target).all():
        return float("inf")
    coordinates = data.coordinates
    inputs = box_inputs(
        w,
        angles=tuple(a for a in coordinates.angles if a < data.dim),
        cyclic=coordinates.cyclic,
    )
    trials = ([Products(inputs, degree)] for degree in _TRIAL)
    groups = list(_determined(trials, w.size // 2, ROWS_PER_TERM))
    family = groups[-1][0] if groups else Products(inputs, 1)
    train, held = (
        least_squares.reduce(family, [(w[rows], target[rows])], weight)
        for rows in (slice(half), slice(half, None))
    )
    ((_, residual),) = least_squares.residuals(train, held, [family.num_parameters])
    return residual


def _of_time_step(inputs, degree: int, signs=None) -> OfTimeStep:
    return OfTimeStep(Products(inputs, degree, signs))


def _determined(groups: Iterable[Iterable[Any]], rows: int, each: float) -> Iterator[list[Any]]:
    """The families, group by group, whose terms so many rows determine, ``each`` for a term.

    Sizes rise, so the first that is too large is the last that is looked at: in many dimensions the
    terms of a high degree could not even be counted.
    """
    most = min(_MOST_TERMS, int(rows / each))
    for group in groups:
        kept = []
        for family in group:
            if family.num_parameters > most:
                break
            kept.append(family)
        else:
            yield kept
            continue
        if kept:
            yield kept
        return
