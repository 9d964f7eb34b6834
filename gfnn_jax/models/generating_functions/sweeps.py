"""Size sweeps: the sizes of one family in one chart, estimated from a factor that they share.

S = Σ c_j φ_j(w) makes the map Z − z = h J ∇S(w), w between z and Z as the chart has it (paper,
eq. (4)). Its coefficients minimise the mean of ‖h ∇S(w) + J (Z − z)‖² over the training pairs
(eq. (3)): `dataset.rows` makes the rows of this linear problem, `fitting.least_squares` solves it
for every size. The residual of the validation pairs estimates the error of a size.

The noise of a state moves the rows of both pairs that it stands in, through w and through g: the
rows of S are r = φ(w)ᵀc − g (its gradient at the evaluation points, less the targets). What of the
residual is noise, a larger size tells: it leaves that too.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.budget import Budget
from gfnn_jax.candidates.assemble import Candidate, refined_images, validated, with_predictor
from gfnn_jax.coordinates import inner_slopes
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance, estimated_error
from gfnn_jax.dataset.rows import inputs_of, of_pairs, of_rows, rows_of, weighted_rows_of
from gfnn_jax.dataset.runs import looked_at
from gfnn_jax.dataset.split import outermost
from gfnn_jax.families.family import own_families
from gfnn_jax.families.inputs import Inputs, variable_signs
from gfnn_jax.families.products import Products
from gfnn_jax.families.sines import Sines
from gfnn_jax.families.time_step import OfTimeStep
from gfnn_jax.fitting import least_squares, uncertainty
from gfnn_jax.fitting.least_squares import ROWS_PER_TERM
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.generating.charts import MIDPOINT, AnyChart
from gfnn_jax.generating.generated import Generated
from gfnn_jax.maps.piece import Affine, Damping

# Operations of singular values, ÷ terms³; and of a step in NumPy, in units that take as long.
OF_SOLVE, OF_STEPS = 22.0, 20.0


FREE = Budget()  # of what a search has paid for


def quiet(message: str) -> None:
    """Say nothing of what is known already."""


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

    def solve(self, size: Size, budget: Budget = FREE, on_progress=quiet) -> tuple[Any, Any]:
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
        return self.solve(size)[1]


class Options:
    """Sizes of the sweeps, and what bounds them (benchmarks/constants.py)."""

    # Pairs of a block that goes to one of two halves: long beside the noise that neighbours
    # share.
    halves_block: int = 50
    noise_pairs: int = 4096  # that tell the noise of each coordinate
    # Degrees whose numbers of terms grow by about a half from one to the next; those of a group
    # are estimated from one factor of the rows of its largest.
    degrees: tuple[tuple[int, ...], ...] = (
        *((2, 3), (4, 5, 6), (7, 8), (9, 10), (12, 14)),
        *((16, 18, 20), (24, 28, 32)),
    )
    trial: tuple[int, ...] = (2, 3, 4, 5, 6)
    sines: tuple[int, ...] = (100, 200, 400, 800, 1_600)
    # Products of degree 14 in four variables: benchmarks/storage_ring.py.
    most_terms: int = 3_100
    # Rows × terms² of one factor: about half a minute on one core. 2,000 terms take 80,000 rows.
    most_operations: float = 320000000000.0
    worth_keeping: float = 1.0  # seconds


# Rows per term of a larger size, by which noise is told from misfit.
SAMPLE_ROWS = 6


class Factors(NamedTuple):
    """Factors of the training rows, of those held out, and of the training rows without the
    outermost twentieth and of that twentieth alone."""

    train: Triangle
    held: Triangle
    inner: Triangle
    outer: Triangle

    @classmethod
    def of(cls, inner: Triangle, outer: Triangle, held: Triangle) -> Factors:
        """The rows of the outermost twentieth are added to the others by their own triangle."""
        return cls(inner.merge(outer), held, inner, outer)


def part_of_noise(
    size: Size, larger: Size, left: tuple[float, float, int], rest: tuple[float, float, int]
) -> float:
    """The part of what a size leaves over that is noise, by what a larger one explains of it: the
    mean square that either leaves, the degrees of freedom that noise takes, and the rows."""
    (of_all, taken, _), (of_rest, more, rows) = left, rest
    noise = of_rest / max(1.0 - more / rows, 1.0 / rows)
    if not noise > 0:
        return 1.0 if not of_all > 0 else 0.0
    further = larger.family.num_parameters - size.family.num_parameters
    each = noise * max(more - taken, 0.0) / further  # of noise, in what a further term explains
    explained = rows * max(of_all - of_rest, 0.0)
    return noise / (noise + uncertainty.misfit(explained, further, each) / rows)


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
            own = Linear("own", own=lambda i: own_families(request, i))
            yield LinearSweep(data, tolerance, chart, own)
        return
    features = scene.features if scene is not None else None
    polynomials = request in ("auto", "polynomial")
    if data.own_dt is not None:  # S(w; dt²)
        charts, polynomials, features = [MIDPOINT], True, None
    for chart in charts:
        # Only the midpoint S inherits the reversor.
        reversor = scene.reversor if scene is not None and chart == MIDPOINT else None
        if polynomials:
            yield LinearSweep(data, tolerance, chart, Linear("polynomial", None, reversor), factors)
        if request in ("auto", "features") and features is not None:
            yield LinearSweep(
                data, tolerance, chart, Linear("features", features, reversor), factors
            )
        if request == "sines" or (request == "auto" and data.dim > 2 and data.own_dt is None):
            yield LinearSweep(data, tolerance, chart, Linear("sines"), factors)


@dataclasses.dataclass(frozen=True)
class Linear:
    """A kind of linear families. features, reversor: a scene's, as `box_inputs` takes them. own: a
    user's families, of the inputs, by rising number of terms."""

    kind: str
    features: Any = None
    reversor: Any = None
    own: Callable[[Inputs], Iterable[Any]] | None = None


class LinearSweep(Generates):
    """The sizes of one linear family in one chart.

    factors: a ``KeptFactors``, where factors that took long are kept for a fit that goes on.
    """

    linear = True

    def __init__(
        self,
        data: Dataset,
        tolerance: Tolerance,
        chart: AnyChart,
        of: Linear,
        factors: Any = None,
    ):
        kind, reversor, own = of.kind, of.reversor, of.own
        self._kept = factors
        self.data, self.tolerance, self.chart, self.kind = data, tolerance, chart, kind
        self._train, self._weight = weighted_rows_of(data, chart, data.training)
        self._held, _ = weighted_rows_of(data, chart, data.validation)
        free = (*data.coordinates.cyclic, *data.whole)
        self._outermost = outermost(data.y0[data.training], free)
        w, args = self._train[0], data.given(data.training)[1]
        if data.own_dt is not None:
            args = data.own_dt[data.training, None] ** 2
        inputs = inputs_of(data, w, features=of.features, reversor=reversor, args=args)
        signs = None
        if kind != "sines" and own is None and reversor is not None:
            signs = variable_signs(inputs, reversor, w)

        def groups() -> Iterator[Iterable[Any]]:
            if own is not None:
                return ([family] for family in own(inputs))
            if kind == "sines":
                return ([Sines(inputs, count)] for count in Options.sines)
            products = ((Products(inputs, n, signs) for n in g) for g in Options.degrees)
            return products if data.own_dt is None else (map(OfTimeStep, g) for g in products)

        counted = kind == "sines" or own is not None
        known = len(Options.sines) if counted else sum(map(len, Options.degrees))
        # Test rows determine a size too: once they have stated its error, it is fitted to them.
        rows = self._train[1].size + len(data.test) * self._width
        self._groups, self._determining = groups, rows
        self.sizes = [
            Size(family, group[-1], _extent(family))
            for group in _determined(groups(), rows, ROWS_PER_TERM)
            for family in group
        ]
        # Else the last size is the largest there is, or the most terms are reached.
        self.short_of_pairs = len(self.sizes) < known and rows < ROWS_PER_TERM * Options.most_terms
        self._factors: dict[Any, Factors] = {}
        self._solved: dict[int, least_squares.LeastSquaresFit] = {}  # by the number of terms

    def named(self, size: Size) -> str:
        """Name of the unit that estimates the size."""
        return f"{self.chart.name} {size.family.label}"

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
        return Candidate.of(
            estimated_error(self.data, self.tolerance, held_rms),
            label=f"{size.family.label}",
            family=self.kind,
            chart=self.chart.name,
            num_parameters=count,
            operations=size.operations,
            train_rms=train_rms,
            fit_seconds=time.perf_counter() - started,
        )

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
        told = {name: getattr(solved, name) for name in ("train_rms", "condition", "rank")}
        candidate = dataclasses.replace(estimated, outside=outside, **told)
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
            label = f"{family.name} {degree}"
            terms = family.terms_of(degree)
        fitted = len(self._train[0]) + len(self.data.test)
        share = fitted / (fitted + len(self.data.validation))
        pairs = int(np.ceil(ROWS_PER_TERM * terms / self._width / share))
        most = (
            f", more than the {Options.most_terms:,} that are tried"
            if terms > Options.most_terms
            else ""
        )
        return f"{label} ({terms:,} terms{most}; about {pairs:,} pairs)"

    def solve(
        self, size: Size, budget: Budget = FREE, on_progress=quiet
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
        train, held = self.factors(size.group)[:2]
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
        return data.users_image(images, known, rows)

    def residuals(self, size: Size) -> np.ndarray:
        """(N, 2d): what the size leaves of ∇S of every pair, unit-free as train_rms."""
        _, params = self.solve(size)
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
        return min(
            count, max(1, int(Options.most_operations / (group.num_parameters**2 * width)))
        ), width

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

    def factors(self, group, budget: Budget = FREE, on_progress=quiet) -> Factors:
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
        if self._kept is not None and time.perf_counter() - started > Options.worth_keeping:
            parts = {"inner": inner, "outer": outer, "held": held}
            rows = {f"{name}_rows": part.rows for name, part in parts.items()}
            factors = {name: part.factor for name, part in parts.items()}
            self._kept.save(self._named(group), **factors, **rows)
        return Factors.of(inner, outer, held)

    def posterior(self, size: Size) -> Callable[[], np.ndarray]:
        """Function that makes the covariance root of the size's coefficients."""
        return partial(self.root, size)

    def root(self, size: Size) -> np.ndarray:
        """(m, m): rootᵀ root is the covariance of the size's coefficients.

        What of the residual is noise, a larger size tells: it leaves that too. A radial momentum
        may have thirty times the noise of an angle, ÷ their spreads, and terms that move it then
        explain more noise than others; fewer pairs than coordinates do not tell theirs apart.
        """
        train = self.factors(size.group).train
        family, solved = size.family, self.solve(size)[0]
        larger = self._larger(size)
        most = family if larger is None else larger.family
        data, goes_on = self._sample(-(-SAMPLE_ROWS * most.num_parameters // self._width))
        w, target, *args = data
        params = family.unflatten(solved.coefficients)
        slopes = self._slopes(family, w, *args)
        residual = slopes @ solved.coefficients - target * self._weight
        states = None
        if self.moved_by_states and (goes_on.any() or len(residual) >= self._width):
            states = (residual, *self.by_states(family, params, w, *args), goes_on)
        scores = uncertainty.scores(slopes, *states) if states and goes_on.any() else None
        noise = self._noise(size, larger, data, states) if larger is not None else None
        count, ridge = family.num_parameters, solved.ridge
        parts = slopes.reshape(-1, count), residual.ravel()
        return uncertainty.root(train, count, parts, noise=noise, ridge=ridge, scores=scores)

    def error_by_noise(self, size: Size) -> float:
        """Error of the size's ∇S by noise, in the measure of train_rms: half of the
        difference between the fits to either half of the training pairs, blocks in time."""
        half = self.data.training // Options.halves_block % 2
        train, held = self.factors(size.group)[:2]
        count = size.family.num_parameters
        one, other = (
            least_squares.solve(
                least_squares.reduce(
                    self.in_rows(size.family),
                    [tuple(a[half == i] for a in self._train)],
                    self._weight,
                ),
                held,
                count,
            ).coefficients
            for i in (0, 1)
        )
        return train.image_norm(one - other) / (2 * np.sqrt(train.rows))

    def state_deviations(self, size: Size) -> np.ndarray:
        """(2d,) standard deviation of the noise of each of the user's coordinates, from what this
        size leaves of a sample of the training pairs."""
        data = self.data
        places, goes_on = looked_at(data.pairs, data.training, Options.noise_pairs)
        w, target, *args = (a[places] for a in self._train)
        solved, params = self.solve(size)
        slopes = self._slopes(size.family, w, *args)
        residual = slopes @ solved.coefficients - target * self._weight
        first, second = self.by_states(size.family, params, w, *args)
        unit = data.scale
        if not data.coordinates.plain:
            rows, unit = data.training[places], data.spread
            first, second = (
                by @ (inner_slopes(data.coordinates, z[rows]) * unit / data.scale[:, None])
                for by, z in ((first, data.pairs.z0), (second, data.pairs.z1))
            )
        step = np.linalg.solve(second, np.concatenate([residual[..., None], -first], axis=-1))
        return unit * of_pairs(step[..., 0], step[..., 1:], np.flatnonzero(goes_on))

    def degrees_of_freedom(self, near: Size, most: Size, counts: Sequence[int]) -> list[float]:
        """Degrees of freedom that noise takes of a fit of so many of the leading terms of a size:
        as many, where no state stands in two pairs. near: whose residuals tell the noise; it may
        be the larger one, whose terms begin with those of the other."""
        (w, target, *args), goes_on = self._sample(-(-SAMPLE_ROWS * max(counts) // self._width))
        if not goes_on.any() or not self.moved_by_states:
            return [float(count) for count in counts]
        solved, params = self.solve(near)
        larger = max(near, most, key=lambda size: size.family.num_parameters)
        slopes = self._slopes(larger.family, w, *args)
        residual = slopes[..., : len(solved.coefficients)] @ solved.coefficients
        residual = residual - target * self._weight
        states = residual, *self.by_states(near.family, params, w, *args), goes_on
        scores = uncertainty.scores(slopes, *states)
        return [
            uncertainty.degrees_of_freedom(slopes[..., :count], residual, scores[:, :count])
            for count in counts
        ]

    @property
    def alike(self) -> float:
        """The weight of misfit beside noise, where a size is chosen by its expected error."""
        return uncertainty.ALIKE

    def _noise(self, size: Size, larger: Size, data, states) -> float:
        """The part of the residual's mean square that is noise, by what a larger size explains of
        it: of all rows where that one was estimated from all of them, else of these. states:
        residual, its derivatives and which pairs go on, as `uncertainty.scores` takes them, or
        None."""

        def left(of: Size) -> tuple[float, float, int]:
            """Mean square, the degrees of freedom that noise takes, and the rows."""
            count = of.family.num_parameters
            reduced = (
                self._factors[of.group].train
                if larger.group in self._factors
                else least_squares.reduce(self.in_rows(of.family), [data], self._weight)
            )
            degrees = float(count)
            if states is not None:
                slopes = self._slopes(of.family, data[0], *data[2:])
                scores = uncertainty.scores(slopes, *states)
                degrees = uncertainty.degrees_of_freedom(slopes, states[0], scores)
            square = reduced.residual_norm(count) ** 2 / max(reduced.rows, 1)
            return square, degrees, reduced.rows

        return part_of_noise(size, larger, left(size), left(larger))

    def _slopes(self, family, w, *args) -> np.ndarray:
        return self.in_rows(family).term_gradients(w, *args) * self._weight[:, None]

    def in_rows(self, family: Any) -> Any:
        """The family whose terms make the rows of this sweep."""
        return of_rows(family, weighted=self.data.weight is not None)

    def by_states(self, family, params, w, *args) -> tuple[np.ndarray, np.ndarray]:
        """The residual's derivatives in z₀ and z₁ (n, 2d, 2d), those ÷ their scale."""
        of_row = 1.0
        if self.data.weight is not None:
            *args, of_row = (*args[:-1], args[-1][..., None])
        hessian = family.gradient_and_hessian(params, w, *args)[1]
        if self.data.own_dt is not None:
            hessian = args[0][..., None] * hessian
        of_point, of_target = self.of_states
        by = of_row * self._weight[:, None] * (hessian @ of_point - of_target)
        return by[..., : len(of_point)], by[..., len(of_point) :]

    @cached_property
    def of_states(self) -> tuple[np.ndarray, np.ndarray]:
        """(2d, 4d) each: what the numbers of z₀ and z₁, ÷ their scale, add to w and to the target.
        An affine base map is counted, the flow of a law is not."""
        data, chart = self.data, self.chart
        dt = 1.0 if data.own_dt is not None else data.dt
        eye = np.eye(2 * data.dim)
        first, second, none = eye, eye, np.zeros_like(eye)
        for piece in data.before:
            first = getattr(piece, "matrix", eye) @ first
        for piece in data.after:
            second = getattr(piece, "matrix", eye) @ second
        ends = ((first.T, none), (none, np.linalg.inv(second).T))
        of_point = [chart.evaluation_point(*of).T * data.scale for of in ends]
        of_target = [chart.target_gradient(*of, dt).T * data.scale for of in ends]
        return np.concatenate(of_point, axis=1), np.concatenate(of_target, axis=1)

    @property
    def moved_by_states(self) -> bool:
        """Return whether ``of_states`` is all that states' noise does: not behind the flow of a
        law."""
        around = (*self.data.before, *self.data.after)
        fixed = (getattr(p, "functions", None) is None for p in around)
        return all(isinstance(p, (Affine, Damping)) for p in around) and all(fixed)

    @property
    def _width(self) -> int:
        return self._train[0].shape[1]

    def _sample(self, pairs: int) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
        """Rows of about so many training pairs, and which of them go on with the next."""
        places, goes_on = looked_at(self.data.pairs, self.data.training, pairs)
        return tuple(a[places] for a in self._train), goes_on

    def _named(self, group) -> str:
        return f"{self.chart.name} {self.kind} {group.num_parameters}"


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
    inputs = inputs_of(data, w)
    trials = ([Products(inputs, degree)] for degree in Options.trial)
    groups = list(_determined(trials, w.size // 2, ROWS_PER_TERM))
    family = groups[-1][0] if groups else Products(inputs, 1)
    train, held = (
        least_squares.reduce(family, [(w[rows], target[rows])], weight)
        for rows in (slice(half), slice(half, None))
    )
    ((_, residual),) = least_squares.residuals(train, held, [family.num_parameters])
    return residual


def _determined(groups: Iterable[Iterable[Any]], rows: int, each: float) -> Iterator[list[Any]]:
    """The families, group by group, whose terms so many rows determine, ``each`` for a term.

    Sizes rise, so the first that is too large is the last that is looked at: in many dimensions the
    terms of a high degree could not even be counted.
    """
    most = min(Options.most_terms, int(rows / each))
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
