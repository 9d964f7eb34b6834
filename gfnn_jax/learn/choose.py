"""The choice, and the error that it states.

The first of the ranking is taken whose own steps bear out what the search measured. Its error is
that of pairs that determined no coefficient: the test rows are looked at here for the first time,
after everything is chosen, and once. Where they are of few runs, or the pairs were too few to keep
some apart, the chosen model is fitted anew without each fifth of the runs in turn, and errs on that
fifth: one run knows nothing of the amplitudes of the others. Where rows are scarce a tenth of them
decides whether a size is determined at all: the final map is then fitted to the test rows too.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from gfnn_jax.budget import FLOW, ROWS, Budget, within
from gfnn_jax.candidates.assemble import Candidate, composed, measured, stepped, with_error
from gfnn_jax.coordinates import to_user
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import (
    FEW,
    FEWEST_RUNS,
    Tolerance,
    bound_of_mean,
    clusters,
    count_of_runs,
    error_of_each,
    measured_error,
)
from gfnn_jax.errors import FitError
from gfnn_jax.fitting.gauss_newton import Problem, without_each
from gfnn_jax.flows.collocation import Steps, truncation
from gfnn_jax.generating.generated import Generated
from gfnn_jax.learn.request import Request
from gfnn_jax.learn.searches import Searched
from gfnn_jax.maps.posterior import Posterior
from gfnn_jax.models.hamiltonians.learned_law import LearnedHamiltonian
from gfnn_jax.models.hamiltonians.learned_law import assembled as flow_assembled
from gfnn_jax.models.hamiltonians.problem import work_of_refit
from gfnn_jax.models.hamiltonians.search import preferred
from gfnn_jax.search.search import Entry, OnProgress


class Options:
    """Limits of the choice and of the error that it states (study: stated_errors)."""

    confirmed: float = 1.1  # of the error that the search measured
    smaller: int = 3  # sizes that are looked at below maps all of which have steps that fail
    folds: int = 5
    matters: float = 0.01  # of the tolerance: an error above it, that few states make, is told
    # quantile of the rows that bounds the one at 90 %, of some hundred rows
    nine_of_ten: float = 0.97
    # Numbers of the states at which a flow's own steps are measured, and times that the worst
    # counts.
    numbers: int = 8_192
    worst: int = 3
    # Operations of a root of m terms, ÷ m³: nearly all of them make the factor of a size two
    # further, of twice as many terms and twelve times as many rows, which tells noise from misfit.
    of_root: float = 200.0


FEWEST_RUNS_TESTED = 10  # runs that state the error for all others
_WHAT = "the stated error by cross-validation"


_TEST_ROWS = "the fit of the chosen size to the test pairs too"


class Chosen(NamedTuple):
    """The candidate with its map; the data set that it was fitted to and measured on; the seconds
    that compiling took; the entry that it comes from, None for H and for an S with parameters; law:
    H, where its flow is the map.
    by: what states its error: "test", pairs that chose nothing; "cross-validation"; or
    "validation", pairs that chose too, where the model is neither a linear S nor an H. stated_by:
    the same as text, with their number. few: a warning where few states make the error."""

    candidate: Candidate
    data: Dataset
    compile_seconds: float
    entry: Entry | None = None
    law: LearnedHamiltonian | None = None
    by: str = ""
    stated_by: str = ""
    few: str = ""


def choose(searched: Searched, request: Request) -> Chosen:
    """The candidate that is taken, its error and its time measured by the steps that users run."""
    law, data = searched.law, searched.data
    given = data, request.tolerance, request.budget
    if searched.linear is not None:
        return Chosen(searched.linear, data, 0.0)
    of_terms = searched.of_terms
    if of_terms is not None:
        map_, own = composed(of_terms.piece, of_terms.data), (of_terms.data, *given[1:])
        candidate, seconds, *_ = measured(of_terms.candidate, map_, *own)
        return Chosen(candidate, of_terms.data, seconds)
    ranking, bound = searched.found.ranking, request.tolerance.bound
    best = ranking[0].candidate if ranking else None
    if law is None or not (best is None or preferred(law.candidate, best, request.tolerance)):
        return _of_ranking(ranking, request)
    named = f"{law.candidate.label}{request.budget.compilation}"
    request.watch.on_progress(f"compiling the flow of {named}")
    candidate, seconds, *_ = flow_assembled(law, *given)
    expected = max(bound, Options.confirmed * law.candidate.validation_bound)
    if best is not None and not candidate.validation_bound <= expected:
        return _of_ranking(ranking, request)
    return Chosen(candidate, data, seconds, law=law)


def _of_ranking(ranking: list[Entry], request: Request) -> Chosen:
    """The first whose own steps bear out what the search measured, else the best.

    Where the steps of a map that was to meet the tolerance do not, larger ones of its sweep are
    looked at before others. Errors are infinite where a step fails: where some fail of every map,
    smaller ones of the best sweep follow, and of maps that all have such steps the one is taken of
    which the fewest do."""
    budget, on_progress, bound = request.budget, request.watch.on_progress, request.tolerance.bound
    compile_seconds, tried = 0.0, []
    first, larger = ranking[0], iter(())
    if first.candidate.validation_bound <= bound:
        sweep, sizes = first.sweep, first.sweep.sizes
        larger = _validated(sweep, sizes[sizes.index(first.size) + 1 :], budget, on_progress)
    smaller = _smaller(tried, budget, on_progress)
    for entry in itertools.chain([first], larger, ranking[1:], smaller):
        step = f"{entry.candidate.chart} {entry.candidate.label}"
        on_progress(f"compiling the step of {step}{budget.compilation}")
        data = entry.sweep.data
        assembled = measured(entry.candidate, entry.map, data, request.tolerance, budget)
        compile_seconds += assembled.compile_seconds
        tried.append((assembled.candidate, assembled.failed, entry))
        expected = max(bound, Options.confirmed * entry.candidate.validation_bound)
        if not assembled.compiled:
            break
        if np.isfinite(found := assembled.candidate.validation_bound) and found <= expected:
            break
    candidate, _, entry = min(
        tried, key=lambda t: (t[0].validation_bound > bound, t[0].validation_bound, t[1])
    )
    return Chosen(candidate, entry.sweep.data, compile_seconds, entry)


def _smaller(
    tried: list[tuple[Candidate, int, Entry]], budget: Budget, on_progress
) -> Iterator[Entry]:
    """A few sizes below those of these whose sweep has the fewest failed steps, as far as the
    budget goes, up to one without; none where one of them has none already."""
    if not all(failed for _, failed, _ in tried):
        return
    sweep = min(tried, key=lambda t: t[1])[2].sweep
    least = min(sweep.sizes.index(e.size) for _, _, e in tried if e.sweep is sweep)
    sizes = sweep.sizes[:least][: -Options.smaller - 1 : -1]
    for entry in _validated(sweep, sizes, budget, on_progress):
        yield entry
        if not tried[-1][1]:
            return


def _validated(sweep: Any, sizes: Sequence[Any], budget: Budget, on_progress) -> Iterator[Entry]:
    """Sizes of a sweep, validated by steps, as far as the budget goes."""
    for size in sizes:
        work = sweep.work(size) + sweep.work_of_steps(size)

        def made(size=size) -> Candidate:
            estimated = sweep.estimate(size, budget, on_progress)
            return sweep.validate(size, estimated, budget, on_progress)

        validated = within(budget.unit(sweep.named(size), ROWS, work), made)
        if validated is None:
            return
        yield Entry(validated, sweep, size)


def with_posterior(chosen: Chosen, searched: Searched) -> Chosen:
    """The choice with the posterior of its map, where that was fitted to the user's pairs and its
    model tells the covariance of its coefficients; as it is elsewhere. It is computed when it is
    first asked for."""
    map_, entry, law = chosen.candidate.map, chosen.entry, chosen.law
    if entry is not None:
        data = entry.sweep.data
        root = entry.sweep.posterior(entry.size) if data.pairs is searched.data.pairs else None
    elif searched.of_terms is not None:
        data, root = searched.of_terms.data, searched.of_terms.covariance
    elif law is not None and law.covariance is not None:
        data, root = searched.data, lambda: law.root
    else:
        return chosen
    if root is None:
        return chosen
    map_ = dataclasses.replace(map_, posterior=Posterior(len(data.before), root))
    return chosen._replace(candidate=dataclasses.replace(chosen.candidate, map=map_))


def work_of_posterior(num_parameters: int) -> float:
    """Operations of computing it."""
    return Options.of_root * float(num_parameters) ** 3


def stated(chosen: Chosen, found: Searched, budget: Budget, on_progress: OnProgress) -> Chosen:
    """The choice with its error on the test rows, or by cross-validation over runs where
    these are of few runs, or over blocks of time where all pairs are."""
    data = found.data
    everyone = np.concatenate([data.training, data.validation, data.test])
    by_runs = count_of_runs(data, everyone) >= FEWEST_RUNS
    enough = count_of_runs(data, data.test) >= FEWEST_RUNS_TESTED
    if not enough and (by_runs or not len(data.test)):
        cluster = data.run if by_runs else data.split.stretch
        known = _by_folds(chosen, found, everyone, cluster, budget, on_progress)
        # A fit without some runs may have no image of them; that says nothing of the whole one.
        if known and (np.isfinite(known.candidate.validation_bound) or not len(data.test)):
            return known
    if len(data.test):
        return _stated(chosen, found, "test", data.test, _images_of(chosen, found, data.test))
    words = _stated_by("validation", found, data.validation)
    return chosen._replace(by="validation", stated_by=words)


def _stated(chosen: Chosen, found: Searched, by: str, rows, images) -> Chosen:
    """The error of these rows' images (n, 2d) in the user's coordinates."""
    error = measured_error(found.data, found.tolerance, images, rows)
    error = error._replace(bound=float(np.hypot(error.bound, _of_steps(chosen, found))))
    few = of_few(error_of_each(found.data, found.tolerance, images, rows), found.tolerance)
    candidate, words = with_error(chosen.candidate, error), _stated_by(by, found, rows)
    return chosen._replace(candidate=candidate, by=by, stated_by=words, few=few)


def _stated_by(by: str, found: Searched, rows: np.ndarray) -> str:
    """Text about what an error was measured by."""
    cluster, runs = clusters(found.data, rows)
    count, independent = f"{len(rows):,} pairs", len(np.unique(cluster))
    if independent < len(rows):
        count += f" of {independent:,} {'runs' if runs else 'independent stretches'}"
    if by == "test":
        return f"{count} that took no part in the fit or its choices"
    if by == "cross-validation":
        return (
            f"{count}, each predicted by a fit without its fifth (cross-validation); some of them "
            "chose the model's size"
        )
    return f"{count} that also chose the model"


def _of_steps(chosen: Chosen, found: Searched) -> float:
    """Upper bound of the error of a flow's own steps, in the tolerance's measure; 0 of other maps.

    It is known without images, so all states tell it: the few that pass a centre closely have most
    of it, and hardly one may be among those that state the error."""
    law, data = chosen.law, found.data
    if law is None or not law.terms:
        return 0.0
    rows = np.arange(0, len(data), -(-len(data) * data.y0.shape[1] // Options.numbers))
    (dt, args), flow = data.given(rows), law.flow
    steps = Steps(flow.stages, flow.over(np.max(data.each_dt)).substeps)
    states, params = data.y0[rows], np.asarray(flow.params)
    off = truncation(flow.family, params, states, dt, steps, args=args, scale=data.scale)
    square = np.mean((off / data.scale) ** 2, axis=1)
    square = square[np.isfinite(square)]
    bound = bound_of_mean(square, np.arange(len(square)), Options.worst) if len(square) > 1 else 0.0
    unit = 1.0 if found.tolerance.relative else float(np.sqrt(np.mean(data.spread**2)))
    return unit * float(np.sqrt(bound))


def of_few(errors: np.ndarray, tolerance: Tolerance) -> str:
    """Warning where few of these errors (n,) make their RMS: then it has no bound that n of them
    tell (the variance of a heavy tail is infinite), and a quantile is stated beside it."""
    rms = float(np.sqrt(np.mean(errors**2)))
    if not FEW * np.median(errors) < rms < np.inf or rms < Options.matters * tolerance.bound:
        return ""
    unit = " of the spread" if tolerance.relative else ""
    return (
        "few states make most of the error: nine of ten err by less than "
        f"{np.quantile(errors, Options.nine_of_ten):.1e}{unit}. The 95 % bound of the RMS does not "
        "hold for other states: quote that of nine of ten"
    )


def _by_folds(
    chosen: Chosen, found: Searched, rows, cluster: np.ndarray, budget: Budget, on_progress
) -> Chosen | None:
    """The error of rows that are each predicted by a fit without their fold of clusters (N,); None
    where such fits are not known how to make, or do not fit into the budget."""
    model = _refits(chosen, found)
    if model is None:
        return None
    folds = np.array_split(np.unique(cluster[rows]), Options.folds)
    out = [rows[np.isin(cluster[rows], fold)] for fold in folds if len(fold)]
    try:
        work = len(out) * model.work
        took = budget.about(model.kind, work)
        on_progress(f"computing the error to state by {len(out)} more fits{took}")
        last = budget.last(_WHAT, model.kind, work)
        images = within(last, lambda: np.concatenate(model.predicts(out)))
    except (FitError, np.linalg.LinAlgError) as error:
        budget.leave_out(_WHAT, str(error))
        return None
    if images is None:  # told with what else was left out
        return None
    return _stated(chosen, found, "cross-validation", np.concatenate(out), images)


def _images_of(chosen: Chosen, found: Searched, rows: np.ndarray) -> np.ndarray:
    """Images by the steps that users run; in NumPy where the budget had no room for compiling
    them."""
    candidate, data, entry = chosen.candidate, chosen.data, chosen.entry
    pairs = found.data.pairs.take(rows)
    if candidate.microseconds_per_step is None and found.linear is not None:
        images = data.y0[rows]
        for piece in jax.tree.map(np.asarray, candidate.map.pieces):
            images = piece.image(images)
        return to_user(data.coordinates, images)
    sweep = None if entry is None else entry.sweep
    own = sweep is not None and sweep.data.pairs is found.data.pairs
    if candidate.microseconds_per_step is None and entry is not None and own:
        images, known = entry.sweep.images(entry.size, rows)
        return data.users_image(images, known, rows)
    steps = stepped(candidate.map, np.asarray(pairs.z0), pairs.dt, pairs.args, timed=False)
    return np.where(steps.failed[:, None], np.nan, steps.images)


class _Refits(NamedTuple):
    """The chosen model, to be fitted to other rows. predicts: parts of the rows -> images (n, 2d)
    of each in the user's coordinates, by a fit to all the others, NaN where a step fails.
    kind, work: of the operations that a fit takes at most."""

    predicts: Callable[[list[np.ndarray]], list[np.ndarray]]
    kind: str
    work: float


def _refits(chosen: Chosen, found: Searched) -> _Refits | None:
    """The chosen model; None where it is not known how to fit it anew in little time."""
    entry, law = chosen.entry, chosen.law
    if entry is not None:
        sweep, size = entry.sweep, entry.size
        work = sweep.work_of_refit(size)
        if not np.isfinite(work) or sweep.data.pairs is not found.data.pairs:
            return None

        def predicts(parts: list[np.ndarray]) -> list[np.ndarray]:
            rows = np.concatenate(parts)
            return [sweep.predicted(size, np.setdiff1d(rows, part), part) for part in parts]

        return _Refits(predicts, ROWS, work)
    return _of_law(law, found.data) if law is not None and law.terms else None


def _of_law(law: LearnedHamiltonian, data: Dataset) -> _Refits:
    flow = law.flow
    y0, y1 = data.y0, data.y1
    problem = Problem(y0, y1, data.each_dt, data.scale, args=data.args, weight=data.weight)
    steps = Steps(flow.stages, flow.over(np.max(data.each_dt)).substeps)
    family, coefficients = flow.family, np.asarray(flow.params)
    if law.constrained is not None:  # what is told of coefficients holds in each fit
        family = law.constrained
        coefficients = coefficients[list(family.free)]

    def predicts(parts: list[np.ndarray]) -> list[np.ndarray]:
        without = without_each(problem, family, coefficients, steps, parts)
        fits = zip(without, parts, strict=True)
        images = (problem.images(family, c, part, steps).states for c, part in fits)
        return [to_user(data.coordinates, states) for states in images]

    return _Refits(predicts, FLOW, work_of_refit(flow.family, len(data), data.dim, steps))


def with_test_rows(chosen: Chosen, found: Searched, budget: Budget) -> Chosen:
    """The choice with its coefficients from the test rows too, once they have stated its error. As
    it is where that were other rows, where rows are not scarce, or where the validation rows are
    then missed by more."""
    entry, candidate = chosen.entry, chosen.candidate
    if chosen.by != "test" or entry is None or not entry.sweep.linear:
        return chosen
    sweep, size = entry.sweep, entry.size
    work = sweep.work_of_test_rows(size)
    if not work or sweep.data.pairs is not found.data.pairs:
        return chosen
    last = budget.last(_TEST_ROWS, ROWS, work, decides=True)
    again = within(last, lambda: sweep.with_test_rows(size))
    if again is None:  # told with what else was left out
        return chosen
    if not again.validation_rms <= sweep.solve(size)[0].validation_rms:
        return chosen
    params = jax.tree.map(np.asarray, size.family.unflatten(again.coefficients))
    pieces = tuple(
        dataclasses.replace(piece, params=jax.device_put(params))
        if isinstance(piece, Generated)
        else piece
        for piece in candidate.map.pieces
    )
    map_ = dataclasses.replace(candidate.map, pieces=pieces)
    return chosen._replace(
        candidate=dataclasses.replace(candidate, map=map_),
        stated_by=f"{chosen.stated_by}; the map is fitted to them too",
    )
