"""The error that a fit states: that of the chosen map, on pairs that determined no coefficient.

The test rows are looked at here for the first time, after everything is chosen, and once. Where
they are of few runs, or the pairs were too few to keep some apart, the chosen model is fitted anew
without each fifth of the runs in turn, and errs on that fifth: one run knows nothing of the
amplitudes of the others. Some of these pairs have chosen the size, and `Stated.words` adds that.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from gfnn_jax.budget import FLOW, ROWS, Budget
from gfnn_jax.candidates.assemble import stepped
from gfnn_jax.candidates.candidate import Candidate, with_error
from gfnn_jax.coordinates import to_user
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
from gfnn_jax.errors import FitError, OutOfTime
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.fitting.left_out import without_each
from gfnn_jax.flows.collocation import Steps, truncation
from gfnn_jax.learn.choose import Chosen
from gfnn_jax.learn.searches import Searched
from gfnn_jax.models.hamiltonians.problem import work_of_refit

_FOLDS = 5
FEWEST_RUNS_TESTED = 10  # runs that state the error for all others
_MATTERS = 0.01  # of the tolerance: an error above it, that few states make, is told
_NINE_OF_TEN = 0.97  # quantile of the rows that bounds the one at 90 %, of some hundred rows
# Numbers of the states at which a flow's own steps are measured, and times that the worst counts.
_NUMBERS, _WORST = 8_192, 3
_WHAT = "the stated error by cross-validation"


class Stated(NamedTuple):
    """The candidate with the error that is stated. by: "test", pairs that chose nothing;
    "cross-validation"; or "validation", pairs that chose too, where the model is neither a linear
    S nor an H. pairs, clusters: how many it is measured by; runs: whether the clusters are runs.
    few: a warning where few states make the error."""

    candidate: Candidate
    by: str
    pairs: int
    clusters: int
    runs: bool
    few: str = ""

    @property
    def words(self) -> str:
        """Text about what the error was measured by."""
        count = f"{self.pairs:,} pairs"
        if self.clusters < self.pairs:
            count += f" of {self.clusters:,} {'runs' if self.runs else 'independent stretches'}"
        if self.by == "test":
            return f"{count} that took no part in the fit or its choices"
        if self.by == "cross-validation":
            return (
                f"{count}, each predicted by a fit without its fifth (cross-validation); some of "
                "them chose the model's size"
            )
        return f"{count} that also chose the model"


def stated(chosen: Chosen, found: Searched, budget: Budget) -> Stated:
    """The chosen candidate with its error on the test rows, or by cross-validation over runs where
    these are of few runs, or over blocks of time where all pairs are."""
    data = found.data
    if count_of_runs(data, data.test) >= FEWEST_RUNS_TESTED:
        return _stated(chosen, found, "test", data.test, _images_of(chosen, found, data.test))
    everyone = np.concatenate([data.training, data.validation, data.test])
    by_runs = count_of_runs(data, everyone) >= FEWEST_RUNS
    if by_runs or not len(data.test):
        cluster = data.run if by_runs else data.split.stretch
        known = _by_folds(chosen, found, everyone, cluster, budget)
        # A fit without some runs may have no image of them; that says nothing of the whole one.
        if known and (np.isfinite(known.candidate.validation_bound) or not len(data.test)):
            return known
    if len(data.test):
        return _stated(chosen, found, "test", data.test, _images_of(chosen, found, data.test))
    cluster, runs = clusters(data, data.validation)
    return Stated(
        chosen.candidate, "validation", len(data.validation), len(np.unique(cluster)), runs
    )


def _stated(chosen: Chosen, found: Searched, by: str, rows, images) -> Stated:
    """The error of these rows' images (n, 2d) in the user's coordinates."""
    error = measured_error(found.data, found.tolerance, images, rows)
    error = error._replace(bound=float(np.hypot(error.bound, _of_steps(chosen, found))))
    cluster, runs = clusters(found.data, rows)
    candidate = with_error(chosen.candidate, error)
    few = of_few(error_of_each(found.data, found.tolerance, images, rows), found.tolerance)
    return Stated(candidate, by, len(rows), len(np.unique(cluster)), runs, few)


def _of_steps(chosen: Chosen, found: Searched) -> float:
    """Upper bound of the error of a flow's own steps, in the tolerance's measure; 0 of other maps.

    It is known without images, so all states tell it: the few that pass a centre closely have most
    of it, and hardly one may be among those that state the error.
    """
    law, data = found.law, found.data
    if law is None or chosen.candidate.learns != "hamiltonian" or not law.terms:
        return 0.0
    rows = np.arange(0, len(data), -(-len(data) * data.y0.shape[1] // _NUMBERS))
    (dt, args), flow = data.given(rows), law.flow
    steps = Steps(flow.stages, flow.over(np.max(data.each_dt)).substeps)
    off = truncation(
        flow.family, np.asarray(flow.params), data.y0[rows], dt, steps, args=args, scale=data.scale
    )
    square = np.mean((off / data.scale) ** 2, axis=1)
    square = square[np.isfinite(square)]
    bound = bound_of_mean(square, np.arange(len(square)), _WORST) if len(square) > 1 else 0.0
    unit = 1.0 if found.tolerance.relative else float(np.sqrt(np.mean(data.spread**2)))
    return unit * float(np.sqrt(bound))


def of_few(errors: np.ndarray, tolerance: Tolerance) -> str:
    """Warning where few of these errors (n,) make their RMS: then it has no bound that n of them
    tell (the variance of a heavy tail is infinite), and a quantile is stated beside it."""
    rms = float(np.sqrt(np.mean(errors**2)))
    if not FEW * np.median(errors) < rms < np.inf or rms < _MATTERS * tolerance.bound:
        return ""
    return (
        f"few states make most of the error: nine of ten err by less than "
        f"{np.quantile(errors, _NINE_OF_TEN):.1e}{' of the spread' if tolerance.relative else ''}. "
        "The 95 % bound of the RMS does not hold for other states: quote the error of nine of ten"
    )


def _by_folds(
    chosen: Chosen, found: Searched, rows, cluster: np.ndarray, budget: Budget
) -> Stated | None:
    """The error of rows that are each predicted by a fit without their fold of clusters (N,); None
    where such fits are not known how to make, or do not fit into the budget."""
    model = _refits(chosen, found)
    if model is None:
        return None
    folds = np.array_split(np.unique(cluster[rows]), _FOLDS)
    out = [rows[np.isin(cluster[rows], fold)] for fold in folds if len(fold)]
    try:
        with budget.last(_WHAT, model.kind, len(out) * model.work):
            images = np.concatenate(model.predicts(out))
    except OutOfTime:  # told with what else was left out
        return None
    except (FitError, np.linalg.LinAlgError) as error:
        budget.leave_out(_WHAT, str(error))
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
        images, solved = entry.sweep.images(entry.size, rows)
        images = data.whole_image(np.where(solved[:, None], images, np.nan), rows)
        return to_user(data.coordinates, images)
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
    entry, law = chosen.entry, found.law
    if entry is not None:
        sweep, size = entry.sweep, entry.size
        work = sweep.work_of_refit(size)
        if not np.isfinite(work) or sweep.data.pairs is not found.data.pairs:
            return None

        def predicts(parts: list[np.ndarray]) -> list[np.ndarray]:
            rows = np.concatenate(parts)
            return [sweep.predicted(size, np.setdiff1d(rows, part), part) for part in parts]

        return _Refits(predicts, ROWS, work)
    flow = law is not None and chosen.candidate.learns == "hamiltonian" and law.terms
    return _of_law(found) if flow else None


def _of_law(found: Searched) -> _Refits:
    data, law = found.data, found.law
    assert law is not None
    flow = law.flow
    problem = Problem(
        data.y0, data.y1, data.each_dt, data.scale, args=data.args, weight=data.weight
    )
    steps = Steps(flow.stages, flow.over(np.max(data.each_dt)).substeps)
    coefficients = np.asarray(flow.params)

    def predicts(parts: list[np.ndarray]) -> list[np.ndarray]:
        without = without_each(problem, flow.family, coefficients, steps, parts)
        images = (
            problem.images(flow.family, c, part, steps).states
            for c, part in zip(without, parts, strict=True)
        )
        return [to_user(data.coordinates, states) for states in images]

    return _Refits(predicts, FLOW, work_of_refit(flow.family, len(data), data.dim, steps))
