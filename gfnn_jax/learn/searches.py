"""All that a fit searches for: H, S, and S with the help of H."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from gfnn_jax.candidates.assemble import Candidate, composed, with_error
from gfnn_jax.coordinates import to_user
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance, measured_error
from gfnn_jax.dataset.rows import residual_weight
from gfnn_jax.dataset.structures import Sites
from gfnn_jax.diagnosis.damping import Diagnosis, diagnosed
from gfnn_jax.diagnosis.local_jacobians import Charts
from gfnn_jax.errors import FitError
from gfnn_jax.fitting.linear_starts import fit_half_map
from gfnn_jax.generating.charts import MIDPOINT
from gfnn_jax.learn.request import Request
from gfnn_jax.maps.piece import Affine
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.models.generating_functions.map_of_terms import LearnedMap, SumOfTerms
from gfnn_jax.models.generating_functions.model_sweep import ModelSweep
from gfnn_jax.models.generating_functions.networks import EnsembleSweep, NetworkSweep
from gfnn_jax.models.generating_functions.sweeps import sweeps_for
from gfnn_jax.models.hamiltonians.learned_law import LearnedHamiltonian
from gfnn_jax.models.hamiltonians.networks import learn_network
from gfnn_jax.models.hamiltonians.problem import LawProblem
from gfnn_jax.models.hamiltonians.search import MAX_COST_RATIO, law_of, preferred
from gfnn_jax.models.maps_of_laws.law_maps import LawMaps, LawMapSearch
from gfnn_jax.phase_space import symplectic_form
from gfnn_jax.search.search import Entry, Found, Search

# Operations of a size of S that is estimated before H is looked for: a fifth of a second.
_SMALL = 2e9
_BETTER = 0.5  # of the error of an H, that S of a structure must have to be taken in its stead
OnBetter = Callable[[SymplecticMap, Candidate], Any]


class Searched(NamedTuple):
    """law: H, or None. of_terms: S with parameters or of a structure, or None. linear: the linear
    map, where the budget has left nothing that is as accurate. found: the generated maps. swept:
    whether any were looked for. charts: theirs. data: the user's, nothing of it factored out.
    tolerance: that was asked for. diagnosis: of the pairs."""

    law: LearnedHamiltonian | None
    of_terms: LearnedMap | None
    found: Found
    swept: bool
    charts: Charts
    data: Dataset
    tolerance: Tolerance
    diagnosis: Diagnosis
    linear: Candidate | None = None

    @property
    def met_by_law(self) -> bool:
        return self.law is not None and self.tolerance.met_by(self.law.candidate)


def searched(request: Request, data: Dataset, taken: Diagnosis) -> Searched:
    """Every candidate. Raises FitError where there is none."""
    diagnosis = taken
    tolerance, budget, watch = request.tolerance, request.budget, request.watch
    options, scene, charts = request.options, request.scene, diagnosis.charts
    better = None if watch.on_better is None else _Better(watch.on_better)
    given = tolerance.bound, budget, watch.on_progress, watch.on_candidate, better
    # Small sizes first: a map is then there, however long the search for H.
    # S is a sum of terms of pairs with parameters, and over sites.
    sites = isinstance(data.structure, Sites) and data.own_dt is None
    early = not (sites or data.args is not None) or options.model is not None
    climb = Search(_sweeps(request, data, diagnosis) if early else [], *given)
    climb.climb(most=_SMALL)
    # H with friction that depends on args is not learned.
    lossy_by_args = diagnosis.damping is not None and data.args is not None
    told: dict[str, Any] = {"on_progress": watch.on_progress, "partly": request.partly}
    problem = LawProblem(data, tolerance, budget, scene=scene, terms=options.terms, **told)
    law = None
    if not lossy_by_args:
        dearest = MAX_COST_RATIO * climb.cheapest  # of a law that is chosen beside the maps
        law = _law(request, dataclasses.replace(problem, dearest=dearest), better)
    of_terms, failed = None, None
    met_by_law = law is not None and tolerance.met_by(law.candidate)
    wanted = not early and options.learn != "hamiltonian" and not met_by_law
    if wanted and options.family == "auto":
        try:
            of_terms = SumOfTerms(
                diagnosis.data, tolerance, scene, options.chart, budget, watch.on_progress
            ).beside(law)
            if of_terms is not None and law is not None:  # which misses the tolerance
                own, others = of_terms.candidate, law.candidate
                no_better = own.validation_bound >= _BETTER * others.validation_bound
                if of_terms.data.structure is None:
                    no_better = preferred(others, own, tolerance)
                of_terms = None if no_better else of_terms
        except FitError as error:
            failed = error
    if wanted and data.args is not None and not _met(of_terms, tolerance):
        try:
            diagnosis = diagnosed(diagnosis.data, options.chart, request.reversor, options.seed)
        except FitError as error:
            failed = failed or error
        charts = diagnosis.charts
    if not early:
        climb = Search(_sweeps(request, data, diagnosis), *given)
    dearest = law.candidate.operations if law is not None and met_by_law else np.inf
    climb.climb(dearest)
    found = climb.found()
    dearest /= MAX_COST_RATIO  # of maps that would be chosen
    lossy = diagnosis.damping is not None or (law is not None and bool(law.friction))
    # Pairs of H's flow are drawn, and factored out, at one dt.
    if law is not None and not data.varied and not lossy:
        helper = LawMapSearch(law, problem, watch.on_candidate, better, options.seed)
        found, charts = helper.improved(LawMaps(found, charts), climb.sweeps, dearest)
    known = [f.candidate for f in (law, of_terms, *found.ranking[:1]) if f is not None]
    best = min((c.validation_bound for c in known), default=np.inf)
    linear = None
    if budget.over and best > tolerance.bound:
        linear = linear_map(diagnosis.plain, tolerance)
        if linear is not None and linear.validation_bound < best:
            watch.on_candidate(linear)
        elif known:
            linear = None
    if not known and linear is None:
        why = f"more pairs: {len(data)} are too few for the smallest model of this kind"
        larger = f"a larger budget, for {budget.ended}"
        raise failed or FitError(f"expected {larger if budget.over else why}")
    if of_terms is not None and found.ranking and not _met(of_terms, tolerance):
        best = found.ranking[0].candidate
        if best.validation_bound < of_terms.candidate.validation_bound:
            of_terms = None
    swept = bool(climb.sweeps)
    return Searched(law, of_terms, found, swept, charts, data, tolerance, taken, linear)


def _met(found: LearnedMap | None, tolerance: Tolerance) -> bool:
    return found is not None and tolerance.met_by(found.candidate)


def _law(
    request: Request, problem: LawProblem, better: _Better | None
) -> LearnedHamiltonian | None:
    """H, where one is looked for and found."""
    options = request.options
    if not request.seeks_law:
        return None
    if request.of_network:
        law = learn_network(problem, seed=options.seed, max_iterations=options.max_iterations)
    else:
        law = law_of(problem, options.learn)
    if law is not None:
        if better is not None:
            better.offer(law.candidate, lambda: composed(law.flow, problem.data))
        request.watch.on_candidate(law.candidate)
    return law


def _sweeps(request: Request, taken: Dataset, diagnosis: Diagnosis) -> list[Any]:
    """The sweeps of S over the charts that cover the data; none where H alone is learned, or the
    pairs are driven, or differ in dt and in parameters too."""
    charts, data, tolerance = diagnosis.charts.charts, diagnosis.data, request.tolerance
    options = request.options
    if options.model is not None:
        return [ModelSweep(options.model, taken, tolerance)]
    if options.learn == "hamiltonian" or data.period is not None:
        return []
    if data.own_dt is not None and not (data.structure is None and data.args is None):
        return []
    if options.family == "mlp":
        of_training = options.max_iterations, options.seed, request.watch.checkpoints
        given, count = (data, tolerance, charts[0], *of_training), options.ensemble
        return [NetworkSweep(*given) if count == 1 else EnsembleSweep(*given, count=count)]
    return list(
        sweeps_for(options.family, charts, data, tolerance, request.scene, request.watch.factors)
    )


class _Better:
    """Hands on the map of every entry that is more accurate than those before. Nothing is compiled:
    the map is measured by the steps that the search made."""

    def __init__(self, on_better: OnBetter):
        self._on_better, self._best = on_better, np.inf

    def __call__(self, entry: Entry) -> None:
        self.offer(entry.candidate, lambda: entry.map)

    def offer(self, candidate: Candidate, make: Callable[[], SymplecticMap]) -> None:
        """Hand on the map that ``make`` makes, if its candidate is better than those before."""
        if candidate.validation_bound < self._best:
            self._best = candidate.validation_bound
            self._on_better(make(), candidate)


_PAIRS = 20_000  # that a regression takes, at most


def linear_map(data: Dataset, tolerance: Tolerance) -> Candidate | None:
    """The affine symplectic map that is nearest to the pairs, with its error on those held out: of
    a quadratic S, or of a base map, whichever is nearer. Neither needs a solve.

    data: without a base map. None for pairs of several dt or parameters, or of a structure.
    """
    if data.varied or data.structure is not None:
        return None
    rows, held, coordinates = data.training[:_PAIRS], data.validation, data.coordinates
    y0, y1 = data.y0[rows], data.y1[rows]
    tried = [_of_quadratic(data, y0, y1)]
    half = fit_half_map(y0, y1, data.scale, angles=coordinates.angles)
    if half is not None:
        shift = half.matrix @ half.shift + half.shift
        tried.append(Affine(half.matrix @ half.matrix, half.centre, shift))
    images = [to_user(coordinates, piece.image(data.y0[held])) for piece in tried]
    errors = [measured_error(data, tolerance, image) for image in images]
    error, piece = min(zip(errors, tried, strict=True), key=lambda found: found[0].relative)
    width = len(data.scale)
    candidate = Candidate.of(
        error,
        label="linear",
        family="linear",
        chart="affine",
        num_parameters=width * (width + 3) // 2,
        operations=2.0 * width**2,
        train_rms=error.relative,
        fit_seconds=0.0,
    )
    map_ = composed(piece, data)
    return dataclasses.replace(with_error(candidate, error), map=map_)


def _of_quadratic(data: Dataset, y0, y1) -> Affine:
    """Z − z = h J (A (w − w̄) + b), w the midpoint: A by least squares among symmetric matrices.

    With rows x = w − w̄ and t of the target gradient, in units in which all residuals count alike,
    the normal equations are of Lyapunov's kind, G A + A G = xᵀt + tᵀx with G = xᵀx: they take (2d)³
    operations, where a basis of the quadratic terms takes (2d)⁶."""
    dt, width = data.dt, y0.shape[1]
    w, target = MIDPOINT.evaluation_point(y0, y1), MIDPOINT.target_gradient(y0, y1, dt)
    weight = residual_weight(MIDPOINT, data.scale, dt)
    free = [*data.coordinates.angles, *data.coordinates.cyclic]
    enters = np.setdiff1d(np.arange(width), free)  # a quadratic S of an angle has no period
    centre, mean = w.mean(axis=0), np.zeros(width)
    mean[enters] = target[:, enters].mean(axis=0)
    x = (w - centre)[:, enters] / weight[enters]
    t = (target - mean)[:, enters] * weight[enters]
    gram = x.T @ x
    ridge = np.finfo(np.float64).eps * np.trace(gram) * np.eye(len(gram))
    found = scipy.linalg.solve_continuous_lyapunov(gram + ridge, x.T @ t + t.T @ x)
    matrix = np.zeros((width, width))
    matrix[np.ix_(enters, enters)] = 0.5 * (found + found.T)
    matrix /= np.outer(weight, weight)
    form, eye = symplectic_form(width // 2), np.eye(width)
    half = 0.5 * dt * form @ matrix
    step = np.linalg.solve(eye - half, np.column_stack([eye + half, dt * form @ mean]))
    return Affine(step[:, :width], centre, step[:, width])
