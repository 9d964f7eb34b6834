"""Learn S as a sum of terms: of maps that differ in parameters, and of equal sites.

For kicked maps and return maps, which have no flow, and wherever no H is found. S = Σ c_jm φ_j(w)
f_m(parameters), or Σ_sites Σ_j c_j φ_j(w), is linear in its coefficients; its libraries are those
of an H, its data those of any S: target gradients at evaluation points.
"""

import dataclasses
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.budget import ROWS, Budget, within
from gfnn_jax.candidates.assemble import Candidate
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import OneStepError, Tolerance, measured_error
from gfnn_jax.dataset.rows import rows_of
from gfnn_jax.diagnosis.local_jacobians import SINGULAR
from gfnn_jax.errors import FitError, OutOfTime
from gfnn_jax.families.family import at_time
from gfnn_jax.families.sums import Sums, matrix_free
from gfnn_jax.families.terms import Terms, joined, multiplied
from gfnn_jax.fitting import least_squares, uncertainty
from gfnn_jax.fitting.evidence import EVIDENCE
from gfnn_jax.fitting.least_squares import ROWS_PER_TERM
from gfnn_jax.fitting.linear_starts import fitted_gradients
from gfnn_jax.fitting.significance import (
    ABOVE_NOISE,
    at_thresholds,
    null_terms,
    terms_above_noise,
)
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.generating.charts import CHARTS, AnyChart
from gfnn_jax.generating.generated import Generated
from gfnn_jax.models.parameters import states_and_functions, walked

_CHARTS = ("type2", "midpoint", "type3")  # that are tried, in this order


class Options:
    """Options of the search for S as a sum of terms (benchmarks/args.py)."""

    most_terms: int = 500
    # standard errors below which terms go, tried in turn
    thresholds: tuple[float, ...] = (10000.0, 1000.0, 100.0, 30.0, 10.0)
    # numbers of training pairs that sites are fitted to: no more are needed
    structured_rows: int = 50_000
    null_rows: int = 4000  # of them, which tell whose gradients are combinations of others
    flat: float = 1.2  # libraries whose errors differ by less have met the pairs' noise
    solved: float = 1e-10  # a step in NumPy whose residual is larger has not been solved


_FEWER_TERMS = "removing terms of S that are not significant"


class LearnedMap(NamedTuple):
    """The candidate, its error measured by steps in NumPy, the piece that S generates, and the data
    set that it was fitted to, of which a loss of area may be factored out.
    covariance: gives (m, m), rootᵀ root is that of the coefficients. stalled: whether another
    library of the chart was no less accurate, and the tolerance is missed."""

    candidate: Candidate
    piece: Generated
    data: Dataset
    covariance: Callable[[], np.ndarray]
    stalled: bool


class _Tried(NamedTuple):
    piece: Generated
    error: OneStepError
    train_rms: float


@dataclasses.dataclass(frozen=True)
class SumOfTerms:
    """The search for an S that is a sum of terms.

    data: pairs of one dt and several systems, or of many sites. chart: its name; "auto": each in
    turn.
    """

    data: Dataset
    tolerance: Tolerance
    scene: Any = None
    chart: str = "auto"
    budget: Budget = dataclasses.field(default_factory=Budget)
    on_progress: Callable[[str], Any] = lambda message: None

    def beside(self, law: Any) -> LearnedMap | None:
        """The map that is learned; None where there is none beside a law."""
        try:
            with np.errstate(all="ignore"):
                return self.learned(needed=law is None)
        except (FitError, OutOfTime):
            if law is None:
                raise
            return None

    def learned(self, needed: bool = True) -> LearnedMap:
        """The map of the first chart that meets the tolerance, else of the best. needed: whether
        the first library is fitted whatever the budget, because nothing else would be left.

        Raises FitError where no chart covers the data, or the pairs are too few.
        """
        started, data, tolerance, budget = (
            time.perf_counter(),
            self.data if self.data.structure is None else _fewer(self.data),
            self.tolerance,
            self.budget,
        )
        best: _Tried | None = None
        tried: list[_Tried] = []

        def attempt(chart: AnyChart, family: Any) -> _Tried:
            """A library fitted in a chart, a unit of the budget."""
            name = f"S in {chart.name}: {family.num_parameters} terms"
            work = _work(family, data)
            self.on_progress(name)
            first = needed and not tried
            with budget.free(ROWS, work) if first else budget.unit(name, ROWS, work):
                tried.append(_fitted(chart, family, data, tolerance))
            return tried[-1]

        try:
            for name in _CHARTS if self.chart == "auto" else (self.chart,):
                for found in self._of_chart(data, partial(attempt, CHARTS[name])):
                    if best is None or found.error.bound < best.error.bound:
                        best = found
                if best is not None and best.error.bound <= tolerance.bound:
                    break
        except OutOfTime:
            if best is None:
                raise
        if best is None or not np.isfinite(best.error.bound):
            raise FitError(
                "the pairs determine no S of such terms: they are too few, or no chart covers them"
                f"{' for all values of the parameters' if data.args is not None else ''}. Add "
                "pairs, or take a smaller dt"
            )
        chart, limit = best.piece.chart, Options.flat * best.error.relative
        rivals = [f for f in tried if f.piece.chart is chart and f.error.relative <= limit]
        stalled = len(rivals) > 1 and best.error.bound > tolerance.bound
        unit = budget.unit(
            _FEWER_TERMS, ROWS, len(Options.thresholds) * _work(best.piece.family, data)
        )
        full = best
        sparse = within(unit, lambda: _sparse(full, data, tolerance, noisy=stalled))
        if sparse is None:
            budget.leave_out(_FEWER_TERMS, budget.ended)
        best = sparse or full
        piece = best.piece
        gradient, with_hessian = piece.family.operations
        candidate = Candidate.of(
            best.error,
            label=f"S, {piece.family.num_parameters} terms",
            family=piece.family.name,
            chart=piece.chart.name,
            num_parameters=piece.family.num_parameters,
            operations=float(gradient + with_hessian),
            train_rms=best.train_rms,
            fit_seconds=time.perf_counter() - started,
            validated=True,
        )
        covariance = partial(_covariance_root, piece, data)
        return LearnedMap(candidate, piece, self.data, covariance, stalled)

    def _of_chart(self, data: Dataset, attempt: Callable[[Any], _Tried]) -> Iterator[_Tried]:
        """Iterate over what is tried in a chart."""
        tolerance, scene = self.tolerance, self.scene
        if data.structure is not None:
            yield from _of_sites(data, tolerance, attempt)
            return
        features = scene.features if scene is not None else None
        states, functions = states_and_functions(data, data.training, features=features)
        most = min(len(data.training) * 2 * data.dim / ROWS_PER_TERM, Options.most_terms)
        given, limits = (states, functions, attempt), {"bound": tolerance.bound, "most": most}
        yield from walked(*given, lambda tried: tried.error.bound, **limits)


def _work(family: Any, data: Dataset) -> float:
    """Operations of a least-squares fit of the family's terms."""
    rows = len(data.training) * data.spread.size
    return 2.0 * rows * family.num_parameters**2


def _fewer(data: Dataset) -> Dataset:
    """Take as many training pairs as the terms of a site need."""
    most = max(1, Options.structured_rows // data.y0.shape[1])
    return data.trained_on(data.training[:most])


def _of_sites(data: Dataset, tolerance: Tolerance, attempt) -> Iterator[_Tried]:
    """The libraries of a structure by rising size, until one meets the tolerance."""
    assert data.structure is not None
    width = data.y0.shape[1]
    rows = data.training[: max(1, Options.null_rows // width)]
    most = min(len(data.training) * width / ROWS_PER_TERM, Options.most_terms)
    for library in data.structure.libraries(data.dim):
        family = library.take(null_terms(library, data.y0[rows])[0])
        if family.num_parameters <= most:
            tried = attempt(family)
            yield tried
            if tried.error.bound <= tolerance.bound:
                return


def _data(chart: AnyChart, family: Terms | Sums, data: Dataset, rows):
    """(w, target gradient, args in the middle of the step, weight) of these rows."""
    (w, target, *_), weight = rows_of(data, chart, rows)
    return w, target, at_time(family, data.given(rows)[1], 0.5 * data.dt), weight


def _fitted(chart: AnyChart, family: Terms | Sums, data: Dataset, tolerance: Tolerance) -> _Tried:
    """The library's S by least squares, and the error of its steps on the held-out pairs."""
    w, target, args, _ = _data(chart, family, data, data.training)
    c = fitted_gradients(family, w, target, data.scale, args)
    return _validated(Generated(family, c, chart, data.dt, data.scale), data, tolerance)


def _validated(piece: Generated, data: Dataset, tolerance: Tolerance) -> _Tried:
    """Measure the errors of its steps; infinite where the chart folds over the held-out pairs."""
    rows, family, params = data.validation, piece.family, piece.params
    w = piece.chart.evaluation_point(data.y0[rows], data.y1[rows])
    args = data.given(rows)[1]
    images, off = piece.refined_step(data.y0[rows], w, args)
    folds = False  # a fixed point that contracts is none
    if not matrix_free(family):
        determinant = piece.determinant(data.y0[rows], data.y1[rows], args)
        folds = not (determinant > SINGULAR).all() and not (determinant < -SINGULAR).all()
    images = data.users_image(images, (off < Options.solved) & (not folds), rows)
    error = measured_error(data, tolerance, images)
    w, target, args, weight = _data(piece.chart, family, data, data.training)
    left = (family.gradient(params, w, args) - target) * weight
    return _Tried(piece, error, float(np.sqrt(np.mean(left**2))))


def _covariance_root(piece: Generated, data: Dataset) -> np.ndarray:
    """Root of the covariance. A larger library tells the noise in the residual, which it leaves."""
    family, count = piece.family, piece.family.num_parameters
    w, target, args, weight = _data(piece.chart, family, data, data.training)
    aim = (target * weight).ravel()
    slopes = (family.term_gradients(w, args) * weight[:, None]).reshape(target.size, -1)
    residual, noise = slopes @ np.asarray(piece.params) - aim, None
    found = _larger(family, data)
    if found is not None and ROWS_PER_TERM * found.num_parameters <= target.size:
        some = slice(max(1, Options.null_rows // w.shape[1]))
        given = () if args is None else (args,)
        few = null_terms(found, w[some], args=None if args is None else args[some])[0]
        known = found.take(few)
        both = least_squares.reduce(known, [(w, target, *given)], weight)
        part = uncertainty.variance(both, known.num_parameters)
        left = float(np.sum(residual**2)) / max(target.size - count, 1)
        noise = min(part / left, 1.0) if left > 0 else 1.0
    train = Triangle.of(np.column_stack([slopes, aim]))
    return uncertainty.root(train, count, (slopes, residual), noise=noise)


def _larger(family: Terms | Sums, data: Dataset) -> Terms | Sums | None:
    """The next library of a structure; of other terms they and their products with each variable of
    theirs, coordinates and parameters."""
    if data.structure is not None:
        count = family.num_parameters
        return next(
            (f for f in data.structure.libraries(data.dim) if f.num_parameters > count), None
        )
    assert isinstance(family, Terms)  # sums are of structures
    units = tuple(tuple(row) for row in np.eye(len(family.variables), dtype=int).tolist())
    variables = Terms(family.dim, family.variables, units, family.parameters)
    return joined(family, multiplied(family, variables))


def _sparse(full: _Tried, data: Dataset, tolerance: Tolerance, noisy: bool) -> _Tried:
    """Drop the terms that the pairs do not ask for, as far as the held-out error allows. noisy:
    whether what is left over is noise, so that only terms go that it explains."""
    piece = full.piece
    w, target, args, weight = _data(piece.chart, piece.family, data, data.training)
    terms = (piece.family.term_gradients(w, args) * weight[:, None]).reshape(target.size, -1)
    residual = terms @ piece.params - (target * weight).ravel()
    triangle = Triangle.of(np.column_stack([terms, residual]))
    c = np.asarray(piece.params)
    sets = at_thresholds(triangle, c, Options.thresholds)
    if noisy:
        few = terms_above_noise(triangle, c, ABOVE_NOISE)[0].tolist()
        sets = [few] if 0 < len(few) < len(c) else []
    for kept in sets:
        found = _fitted(piece.chart, piece.family.take(kept), data, tolerance)
        if EVIDENCE.is_no_worse(found.error.relative, full.error.relative):
            return found
    return full
