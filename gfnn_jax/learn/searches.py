"""All that a fit searches for: H, S, and S with the help of H."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.errors import FitError
from gfnn_jax.learn.assemble import composed
from gfnn_jax.learn.candidates import Candidate, Judges
from gfnn_jax.learn.choose_charts import Charts
from gfnn_jax.learn.choose_law import DEARER, law_of
from gfnn_jax.learn.clock import Budget
from gfnn_jax.learn.diagnosed import Diagnosis, diagnosed
from gfnn_jax.learn.ensembles import EnsembleSweep
from gfnn_jax.learn.law_maps import (
    better_than,
    law_explains_most,
    more_pairs_would_help,
    search_around,
    search_of_law,
)
from gfnn_jax.learn.learned_law import LearnedHamiltonian
from gfnn_jax.learn.linear_map import linear_map
from gfnn_jax.learn.map_of_terms import LearnedMap, map_of
from gfnn_jax.learn.model_sweep import ModelSweep
from gfnn_jax.learn.network_sweep import NetworkSweep
from gfnn_jax.learn.networks import learn_network
from gfnn_jax.learn.prepare import Prepared
from gfnn_jax.learn.request import Request
from gfnn_jax.learn.search import Entry, Found, Search
from gfnn_jax.learn.sweeps import sweep_of_dt, sweeps_for
from gfnn_jax.maps.symplectic_map import SymplecticMap

# Operations of a size of S that is judged before H is looked for: a fifth of a second.
_SMALL = 2e9
OnBetter = Callable[[SymplecticMap, Candidate], Any]


class Searched(NamedTuple):
    """law: H, or None. of_terms: S with parameters or of a structure, or None. linear: the linear
    map, where the budget has left nothing that is as accurate. found: the generated maps. swept:
    whether any were looked for. charts: theirs. plain: the pairs as prepared, without a base map or
    law factored out. judges: of the user's pairs."""

    law: LearnedHamiltonian | None
    of_terms: LearnedMap | None
    found: Found
    swept: bool
    charts: Charts
    plain: Prepared
    judges: Judges
    linear: Candidate | None = None

    @property
    def met_by_law(self) -> bool:
        return self.law is not None and self.judges.met_by(self.law.candidate)


def searched(
    request: Request, plain: Prepared, seen: Diagnosis, judges: Judges,
    on_better: OnBetter | None,
) -> Searched:  # fmt: skip
    """Every candidate. Raises FitError where there is none."""
    bound, budget, say, tell = request.tolerance, request.budget, request.say, request.tell
    options = request.options
    scene, prepared, charts = request.scene, seen.prepared, seen.charts
    better = _Better(on_better) if on_better is not None else None
    given = bound.bound, budget, say, tell, better
    # Small sizes first: a map is then there, however long the search for H.
    early = not prepared.of_terms or options.model is not None
    climb = Search(_sweeps(request, plain, seen, judges) if early else [], *given)
    climb.climb(most=_SMALL)
    law = _law(request, plain, judges, better, DEARER * climb.cheapest)
    of_terms, failed = None, None
    met_by_law = law is not None and judges.met_by(law.candidate)
    wanted = not early and options.learn != "hamiltonian" and not met_by_law
    if wanted and options.family == "auto":
        try:
            of_terms = map_of(prepared, judges, scene, options.chart, law, budget, say)
        except FitError as error:
            failed = error
    if wanted and plain.args is not None and not _met(of_terms, judges):
        try:
            seen = diagnosed(plain, options.chart, request.reversor, options.seed)
        except FitError as error:
            failed = failed or error
        prepared, charts = seen.prepared, seen.charts
    if not early:
        climb = Search(_sweeps(request, plain, seen, judges), *given)
    dearest = law.candidate.operations if law is not None and met_by_law else np.inf
    climb.climb(dearest)
    found = climb.found()
    dearest /= DEARER  # of maps that would be chosen
    lossy = seen.damping is not None or (law is not None and bool(law.friction))
    if plain.varied or lossy:  # pairs of H's flow are drawn, and factored out, at one dt
        pass
    elif (
        law is not None
        and met_by_law
        and more_pairs_would_help(climb.sweeps, found, bound, dearest)
    ):
        say("drawing pairs from the flow of H")
        drawn = search_of_law(
            law, judges.pairs, judges, scene, request.coordinates, dearest, budget, say, tell,
            options.seed,
        )  # fmt: skip
        if drawn is not None:
            found, charts = drawn
    elif (
        law is not None and not met_by_law and plain.args is None
        and law_explains_most(law, found, bound, budget)
    ):  # fmt: skip
        say(f"learning what the flow of {law.candidate.label} leaves over")
        around = search_around(law, plain, judges, scene, budget, say, tell, better, options.seed)
        if around is not None and better_than(around.found, found, law):
            found, charts = around
    known = [f.candidate for f in (law, of_terms, *found.ranking[:1]) if f is not None]
    best = min((c.validation_bound for c in known), default=np.inf)
    linear = None
    if budget.over and best > bound.bound:
        linear = linear_map(seen.plain, judges)
        if linear is not None and linear.validation_bound < best:
            tell(linear)
        elif known:
            linear = None
    if not known and linear is None:
        raise failed or FitError(_nothing_found(len(judges.pairs), budget))
    if of_terms is not None and found.ranking and not _met(of_terms, judges):
        best = found.ranking[0].candidate
        if best.validation_bound < of_terms.candidate.validation_bound:
            of_terms = None
    return Searched(law, of_terms, found, bool(climb.sweeps), charts, plain, judges, linear)


def _met(found: LearnedMap | None, judges: Judges) -> bool:
    return found is not None and judges.met_by(found.candidate)


def _law(
    request: Request, plain: Prepared, judges: Judges, better: _Better | None, dearest: float
) -> LearnedHamiltonian | None:
    """H, where one is looked for and found. dearest: operations of a step of a law that is chosen
    beside the maps at hand."""
    options = request.options
    if not request.seeks_law:
        return None
    if request.of_network:
        law = learn_network(
            plain, judges, request.scene, seed=options.seed, budget=request.budget,
            say=request.say, max_iterations=options.max_iterations,
        )  # fmt: skip
    else:
        law = law_of(
            plain, judges, request.scene, options.learn, options.terms, request.budget, request.say,
            dearest,
        )  # fmt: skip
    if law is not None:
        if better is not None:
            better.offer(law.candidate, lambda: composed(law.flow, plain, judges))
        request.tell(law.candidate)
    return law


def _sweeps(request: Request, plain: Prepared, seen: Diagnosis, judges: Judges) -> list[Any]:
    """The sweeps of S over the charts that cover the data; none where H alone is learned, or the
    pairs are driven, or differ in dt and in parameters too."""
    options = request.options
    if options.model is not None:
        return [ModelSweep(options.model, plain, judges)]
    charts, prepared = seen.charts.charts, seen.prepared
    if options.learn == "hamiltonian" or prepared.period is not None:
        return []
    if prepared.own_dt is not None:
        alone = prepared.structure is None and prepared.args is None
        return [sweep_of_dt(prepared, request.scene, judges, request.factors)] if alone else []
    if options.family == "mlp":
        given = (prepared, charts[0], judges, options.max_iterations, options.seed,
                 request.checkpoints)  # fmt: skip
        count = options.ensemble
        return [NetworkSweep(*given) if count == 1 else EnsembleSweep(*given, count=count)]
    return list(
        sweeps_for(options.family, charts, prepared, request.scene, judges, request.factors)
    )


def _nothing_found(num_pairs: int, budget: Budget) -> str:
    if budget.over:
        return f"expected a larger budget: no candidate was finished; {budget.ended}"
    return f"expected more pairs: {num_pairs} are too few for the smallest model of this kind"


class _Better:
    """Hands on the map of every entry that is more accurate than those before. Nothing is compiled:
    the map is judged by the steps that the search made."""

    def __init__(self, on_better: OnBetter):
        self._on_better, self._best = on_better, np.inf

    def __call__(self, entry: Entry) -> None:
        self.offer(entry.candidate, lambda: _map_of(entry))

    def offer(self, candidate: Candidate, make: Callable[[], SymplecticMap]) -> None:
        """Hand on the map that ``make`` makes, if its candidate is better than those before."""
        if candidate.validation_bound < self._best:
            self._best = candidate.validation_bound
            self._on_better(make(), candidate)


def _map_of(entry: Entry) -> SymplecticMap:
    sweep = entry.sweep
    return composed(sweep.piece(entry.size), sweep.prepared, sweep.judges)
