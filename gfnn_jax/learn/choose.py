"""The choice: the first of the ranking whose own steps bear out what the search measured."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.budget import ROWS, Budget
from gfnn_jax.candidates.assemble import composed, measured
from gfnn_jax.candidates.candidate import Candidate
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.errors import OutOfTime
from gfnn_jax.learn.request import Request
from gfnn_jax.learn.searches import Searched
from gfnn_jax.models.generating_functions.map_of_terms import assembled as map_assembled
from gfnn_jax.models.hamiltonians.choose_law import preferred
from gfnn_jax.models.hamiltonians.learned_law import assembled as flow_assembled
from gfnn_jax.search.search import Entry

_CONFIRMED = 1.1  # of the error that the search measured
_SMALLER = 3  # sizes that are looked at below maps all of which have steps that fail


class Chosen(NamedTuple):
    """The candidate with its map; the data set that it was fitted to and measured on; the seconds
    that compiling took; the entry that it comes from, None for H and for an S with parameters."""

    candidate: Candidate
    data: Dataset
    compile_seconds: float
    entry: Entry | None = None


def choose(searched: Searched, request: Request) -> Chosen:
    """The candidate that is taken, its error and its time measured by the steps that users run."""
    law, data = searched.law, searched.data
    given = data, request.tolerance, request.budget
    if searched.linear is not None:
        return Chosen(searched.linear, data, 0.0)
    of_terms = searched.of_terms
    if of_terms is not None:
        candidate, seconds, *_ = map_assembled(of_terms, request.tolerance, request.budget)
        return Chosen(candidate, of_terms.data, seconds)
    ranking, bound = searched.found.ranking, request.tolerance.bound
    best = ranking[0].candidate if ranking else None
    if law is None or not (best is None or preferred(law.candidate, best, request.tolerance)):
        return _of_ranking(ranking, request)
    request.on_progress(f"compiling the flow of {law.candidate.label}")
    candidate, seconds, *_ = flow_assembled(law, *given)
    expected = max(bound, _CONFIRMED * law.candidate.validation_bound)
    if best is not None and not candidate.validation_bound <= expected:
        return _of_ranking(ranking, request)
    return Chosen(candidate, data, seconds)


def _of_ranking(ranking: list[Entry], request: Request) -> Chosen:
    """The first whose own steps bear out what the search measured, else the best.

    Where the steps of a map that was to meet the tolerance do not, larger ones of its sweep are
    looked at before others. Errors are infinite where a step fails: where some fail of every map,
    smaller ones of the best sweep follow, and of maps that all have such steps the one is taken of
    which the fewest do.
    """
    budget, on_progress, bound = request.budget, request.on_progress, request.tolerance.bound
    compile_seconds, tried = 0.0, []
    first = ranking[0]
    larger = (
        _larger(first, budget, on_progress) if first.candidate.validation_bound <= bound else ()
    )
    smaller = _smaller(tried, budget, on_progress)
    for entry in itertools.chain([first], larger, ranking[1:], smaller):
        on_progress(f"compiling the step of {entry.candidate.chart} {entry.candidate.label}")
        sweep = entry.sweep
        map_ = composed(sweep.piece(entry.size), sweep.data)
        assembled = measured(entry.candidate, map_, sweep.data, request.tolerance, budget)
        compile_seconds += assembled.compile_seconds
        tried.append((assembled.candidate, assembled.failed, entry))
        expected = max(bound, _CONFIRMED * entry.candidate.validation_bound)
        if not assembled.compiled:
            break
        if np.isfinite(found := assembled.candidate.validation_bound) and found <= expected:
            break
    candidate, _, entry = min(
        tried, key=lambda t: (t[0].validation_bound > bound, t[0].validation_bound, t[1])
    )
    return Chosen(candidate, entry.sweep.data, compile_seconds, entry)


def _larger(entry: Entry, budget: Budget, on_progress) -> Iterator[Entry]:
    """The larger sizes of an entry's sweep, validated by steps, as far as the budget goes."""
    sizes = entry.sweep.sizes
    return _validated(entry.sweep, sizes[sizes.index(entry.size) + 1 :], budget, on_progress)


def _smaller(
    tried: list[tuple[Candidate, int, Entry]], budget: Budget, on_progress
) -> Iterator[Entry]:
    """A few sizes below those of these whose sweep has the fewest failed steps, as far as the
    budget goes, up to one without; none where one of them has none already."""
    if not all(failed for _, failed, _ in tried):
        return
    sweep = min(tried, key=lambda t: t[1])[2].sweep
    least = min(sweep.sizes.index(e.size) for _, _, e in tried if e.sweep is sweep)
    for entry in _validated(sweep, sweep.sizes[:least][: -_SMALLER - 1 : -1], budget, on_progress):
        yield entry
        if not tried[-1][1]:
            return


def _validated(sweep: Any, sizes: Sequence[Any], budget: Budget, on_progress) -> Iterator[Entry]:
    """Sizes of a sweep, validated by steps, as far as the budget goes."""
    for size in sizes:
        work = sweep.work(size) + sweep.work_of_steps(size)
        try:
            with budget.unit(sweep.named(size), ROWS, work):
                estimated = sweep.estimate(size, budget, on_progress)
                estimated = sweep.validate(size, estimated, budget, on_progress)
        except OutOfTime:
            return
        yield Entry(estimated, sweep, size)
