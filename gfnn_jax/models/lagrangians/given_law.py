"""The fit of a law whose terms are given: no search, but for the friction where none was named."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from gfnn_jax.dataset.stretches import Nodes, Scales, arcs_of, with_states
from gfnn_jax.families.lagrangian import LINEAR
from gfnn_jax.maps.observation import Observation
from gfnn_jax.models.lagrangians import libraries
from gfnn_jax.models.lagrangians.arc_inputs import ArcInputs
from gfnn_jax.models.lagrangians.fit import LawFit, Systems, Workbench, describe
from gfnn_jax.models.lagrangians.friction_choice import FrictionChoice
from gfnn_jax.models.lagrangians.given_terms import Given
from gfnn_jax.models.lagrangians.input_rules import choose_rule
from gfnn_jax.models.lagrangians.search import (
    Found,
    SearchOptions,
    as_found,
    by_arcs_that_tell,
    choose_friction,
    frictions_tried,
    to_longer_arcs,
)
from gfnn_jax.models.lagrangians.structure import Structure
from gfnn_jax.models.lagrangians.weak_start import weak_start
from gfnn_jax.models.lagrangians.zeros_of_runs import with_zeros_of_runs


def fit_given(
    given: Given,
    nodes: Sequence[Nodes],
    scales: Scales,
    angles: tuple[int, ...],
    num_inputs: int,
    inputs: Mapping[str, ArcInputs],
    observation: Observation,
    on_progress: Callable[[str], object],
    options: SearchOptions,
    parameters: tuple[str, ...] = (),
) -> Found:
    """Fit exactly the terms that are given, with the result of `search.search`. parameters: in
    which the systems of the runs differ, and by which terms may be multiplied."""
    d = observation.dim
    gauge = np.concatenate([n.x[:, :d] for n in nodes])
    systems = Systems.of(parameters, nodes)
    benches = {
        hold: Workbench(gauge, u, scales.omega, observation, systems=systems)
        for hold, u in inputs.items()
    }
    sensors = tuple(zip(observation.parameters, map(float, observation.values), strict=True))
    linear = tuple(libraries.losses(d, (LINEAR,), 0.0)[:d])
    friction = linear if given.friction is None else given.friction
    structure = Structure(d, given.terms, friction, (), num_inputs, sensors)
    structure, known = weak_start(structure, nodes, scales, prune=False)
    plain = all(row[3] == 0 for row in given.terms)  # a sine or a phase says where zero is
    turned = [i for i in angles if i in observation.direct and i not in observation.shifts()]
    zeros = [i for i in turned if plain and any(row[2][i] for row in given.terms)]
    structure = structure.plus([("zero", i) for i in zeros])
    arcs = arcs_of(nodes, max(6, round(options.periods[0] * scales.per_period)))
    rule = choose_rule(benches, nodes, structure, known, arcs, scales.sigma, scales.dt)
    fit, bench = rule.fit, rule.bench
    on_progress(f"{options.periods[0]:g} periods: {describe(fit)}")
    nodes = with_states(nodes, fit.arcs, fit.fitted.x)
    for periods in options.periods[1:]:
        length = max(6, round(periods * scales.per_period))
        longer = to_longer_arcs(bench, nodes, fit, length)
        if longer is None:
            break
        nodes, fit = with_zeros_of_runs(bench, nodes, longer, on_progress)
        on_progress(f"{periods:g} periods: {describe(fit)}")
        nodes = with_states(nodes, fit.arcs, fit.fitted.x)

    def choose(
        bench: Workbench, nodes: Sequence[Nodes], fit: LawFit
    ) -> tuple[LawFit, FrictionChoice]:
        if given.friction is not None:
            return fit, FrictionChoice(given.friction, {}, {}, gains=False)
        tried = frictions_tried(d, options)
        return choose_friction(bench, nodes, fit, tried, on_progress, options)

    settled = partial(as_found, scales.dt)
    return by_arcs_that_tell(bench, nodes, fit, choose, settled, scales, on_progress, options)
