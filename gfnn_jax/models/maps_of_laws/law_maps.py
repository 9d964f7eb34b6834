"""Generated maps that a law helps to: of pairs of its flow, or of what its flow leaves over."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from gfnn_jax.budget import FLOW, Budget
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.diagnosis.charts import Charts
from gfnn_jax.diagnosis.diagnosis import diagnosed
from gfnn_jax.errors import FitError, OutOfTime
from gfnn_jax.families.terms import Terms
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.legendre import Legendre
from gfnn_jax.models.generating_functions.sweeps import sweeps_for
from gfnn_jax.models.hamiltonians.cost_of_flow import flow_operations
from gfnn_jax.models.hamiltonians.learned_law import LearnedHamiltonian
from gfnn_jax.models.maps_of_laws.draw import NUM_PAIRS, drawn
from gfnn_jax.models.maps_of_laws.factor_out import TRIAL_PAIRS, factored_out, flow_of
from gfnn_jax.scenes.scene import Scene
from gfnn_jax.search.search import Entry, Found, Search

_FITTED, _MOST_STRONG = 200, 4  # pairs and terms of the simplest laws
_THERE_AND_BACK = 8.0  # steps of a law's flow, at each of the states
_EXPLAINED = 0.3  # of the spread: a law that errs by more explains too little to be factored out


class LawMaps(NamedTuple):
    """The maps that were found, and the charts in which they were looked for."""

    found: Found
    charts: Charts


def more_pairs_would_help(sweeps, found: Found, bound: Tolerance, dearest: float) -> bool:
    """Return whether none of the sizes that the pairs determine meets the tolerance, and larger
    ones would still be cheap enough."""
    if found.ranking and found.ranking[0].candidate.validation_bound <= bound.bound:
        return False
    return any(s.short_of_pairs and s.sizes and s.sizes[-1].operations < dearest for s in sweeps)


def search_of_law(
    law: LearnedHamiltonian,
    data: Dataset,
    tolerance: Tolerance,
    scene: Scene | None,
    dearest: float,
    budget: Budget,
    on_progress,
    on_candidate,
    seed: int,
) -> LawMaps | None:
    """Maps fitted to pairs that are drawn from the law's flow, and judged by the user's validation
    rows; None where none of them meets the tolerance, or no chart covers the drawn pairs."""
    try:
        with budget.unit("pairs drawn from the flow of H", FLOW, _work(law, NUM_PAIRS)):
            more = drawn(law.flow, data.coordinates, data.pairs.z0, data.dt, seed=seed)
    except OutOfTime:
        return None
    reversor = scene.reversor if scene else None
    try:
        diagnosis = diagnosed(data.validating(more), "auto", reversor, seed)
    except FitError:  # drawn ones go further than the user's; the law itself is left
        return None
    sweeps = list(sweeps_for("auto", diagnosis.charts.charts, diagnosis.data, tolerance, scene))
    climb = Search(sweeps, tolerance.bound, budget, on_progress, on_candidate)
    found = climb.to_its_end(dearest)
    if not found.ranking:
        return None
    if found.ranking[0].candidate.validation_bound > tolerance.bound:
        return None
    found = found._replace(ended="the tolerance is met, by a map of pairs drawn from H's flow")
    return LawMaps(found, diagnosis.charts)


def law_explains_most(
    law: LearnedHamiltonian, found: Found, bound: Tolerance, budget: Budget
) -> bool:
    """Return whether nothing meets the tolerance, but S might with most of the motion factored out.
    What stalls in noise would stall without it too."""
    if budget.over or not found.ranking or found.stalled:
        return False
    best = found.ranking[0].candidate
    error = law.candidate.validation_relative
    return best.validation_bound > bound.bound and error < _EXPLAINED


def search_around(
    law: LearnedHamiltonian,
    data: Dataset,
    tolerance: Tolerance,
    scene: Scene | None,
    budget: Budget,
    on_progress,
    on_candidate,
    better,
    seed: int,
) -> LawMaps | None:
    """Maps of a law's flow Φ and of S, which learns what Φ leaves over: of the whole law, then of
    its strongest terms, which leave more over but smoother. None where Φ has no image of some of
    the states, or no chart covers what is left."""
    best: LawMaps | None = None
    for laws in ([(law.flow.family, np.asarray(law.flow.params))], strongest(law, data)):
        if not laws:
            break
        try:
            with budget.unit("what the flow of H leaves over", FLOW, _work(law, len(data))):
                flows = [flow_of(family, c, data) for family, c in laws]
                flow, rest = factored_out(flows, data, seed)
                diagnosis = diagnosed(rest, "auto", scene.reversor if scene else None, seed)
        except OutOfTime:
            break
        except FitError:
            continue
        found = _around(
            flow, diagnosis, data, tolerance, scene, budget, on_progress, on_candidate, better
        )
        if found.found.ranking and (
            best is None
            or found.found.ranking[0].candidate.validation_bound
            < best.found.ranking[0].candidate.validation_bound
        ):
            best = found
        if best and best.found.ranking[0].candidate.validation_bound <= tolerance.bound:
            break
    return best


def _work(law: LearnedHamiltonian, states: int) -> float:
    """Operations of the law's flow, there and back, at so many states."""
    return _THERE_AND_BACK * states * law.candidate.operations


def _around(
    flow: Flow,
    diagnosis,
    data: Dataset,
    tolerance: Tolerance,
    scene: Scene | None,
    budget: Budget,
    on_progress,
    on_candidate,
    better,
) -> LawMaps:
    """The search for S around one flow, whose operations are added to every candidate's."""
    more = flow_operations(flow, data)
    sweeps = list(sweeps_for("auto", diagnosis.charts.charts, diagnosis.data, tolerance, scene))
    climb = Search(sweeps, tolerance.bound, budget, on_progress, on_candidate, better)
    found = climb.to_its_end()

    def dearer(entry: Entry) -> Entry:
        candidate = dataclasses.replace(
            entry.candidate,
            operations=entry.candidate.operations + more,
            label=f"{entry.candidate.label} around H",
        )
        return entry._replace(candidate=candidate)

    entries, ranking = ([dearer(e) for e in part] for part in (found.entries, found.ranking))
    return LawMaps(found._replace(entries=entries, ranking=ranking), diagnosis.charts)


def strongest(law: LearnedHamiltonian, data: Dataset) -> list[tuple[Terms, np.ndarray]]:
    """The law's one, two … strongest terms, with coefficients fitted anew, as far as their flow
    explains most of the motion."""
    family, c = law.flow.family, np.asarray(law.flow.params)
    if isinstance(family, Legendre):  # its terms are those of L
        return []
    rows = data.training[:TRIAL_PAIRS]
    slopes = family.term_gradients(data.y0[rows]) * data.scale[:, None]
    strength = np.abs(c) * np.sqrt(np.mean(np.sum(slopes**2, axis=1), axis=0))
    order = np.argsort(-strength)
    problem = Problem(data.y0, data.y1, data.dt, data.scale)
    laws = []
    for count in range(1, min(len(c), _MOST_STRONG + 1)):
        kept = np.sort(order[:count])
        part = family.take(kept.tolist())
        found = problem.fit(part, c[kept], rows[:_FITTED], rounds=False)
        if found.rms < _EXPLAINED:
            laws.append((part, found.coefficients))
    return laws


def better_than(around: Found, found: Found, law: LearnedHamiltonian) -> bool:
    """Return whether the maps around the law have a better one than the others and the law
    itself."""
    if not around.ranking:
        return False
    others = [found.ranking[0].candidate, law.candidate]
    best = around.ranking[0].candidate
    return all(best.validation_bound < other.validation_bound for other in others)
