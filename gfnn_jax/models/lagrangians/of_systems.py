"""The search for one law of several systems, which differ in parameters: a length, an added mass.

The runs of the value with most samples are searched for terms as any recording is. These terms are
then fitted to the runs of each value by themselves, and the coefficients tell on which functions of
the parameters they depend (`dependence`). That law is fitted to all runs at once, and from there on
terms are dropped and added, and friction is chosen, as ever. Where arcs that a fit has not seen do
not gain by the dependence, there is none.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from gfnn_jax.dataset.stretches import Nodes, Scales, arcs_of
from gfnn_jax.errors import FitError
from gfnn_jax.families.lagrangian import UNIFORM
from gfnn_jax.maps.observation import Observation
from gfnn_jax.models.lagrangians import libraries
from gfnn_jax.models.lagrangians.arc_inputs import ArcInputs
from gfnn_jax.models.lagrangians.dependence import (
    dependence,
    functions_in,
    seen,
    with_functions,
)
from gfnn_jax.models.lagrangians.fit import LawFit, Systems, Workbench, describe
from gfnn_jax.models.lagrangians.input_rules import Acting
from gfnn_jax.models.lagrangians.search import (
    Found,
    SearchOptions,
    arcs_by_length,
    everything,
    finished,
    gains,
    search,
)
from gfnn_jax.models.lagrangians.starts import no_law
from gfnn_jax.models.lagrangians.structure import Structure
from gfnn_jax.models.lagrangians.weak_start import weak_start
from gfnn_jax.models.lagrangians.zeros_of_runs import with_zeros_of_runs


def search_of_systems(
    nodes: Sequence[Nodes],
    scales: Scales,
    angles: tuple[int, ...],
    num_inputs: int,
    inputs: Mapping[str, ArcInputs],
    observation: Observation,
    on_progress: Callable[[str], object],
    options: SearchOptions,
    parameters: tuple[str, ...],
) -> Found | None:
    """The law of runs that differ in ``parameters``, with the result of `search.search`; None where
    no coefficient depends on them."""
    groups = _of_one_value(nodes)
    rule = _first_law(
        groups, nodes, scales, angles, num_inputs, tuple(inputs), observation, on_progress, options
    )
    structure = rule.fit.structure
    if len(structure.uncoupled) > 1:
        parts = "; ".join(
            ", ".join(observation.coordinates[i] for i in part) for part in structure.uncoupled
        )
        raise FitError(
            f"nothing couples {parts}: where runs differ in a parameter, expected the positions of "
            "one of these (--positions)"
        )
    gauge = np.concatenate([n.x[:, : observation.dim] for n in nodes])

    def bench_of(some: Sequence[Nodes], systems: Systems | None = None) -> Workbench:
        acting = ArcInputs(some, scales.substeps, rule.hold, rule.delay)
        return Workbench(gauge, acting, scales.omega, observation, systems=systems)

    values, fits, followed = [], [], list(nodes)
    for places in groups:
        some = [nodes[i] for i in places]
        fit, some = _fitted(bench_of(some), some, structure, scales, options)
        if fit is None:
            continue
        fits.append(fit)
        values.append(seen(fit, some[0].stretch.args))
        for i, node in zip(places, some, strict=True):
            followed[i] = node
    if len(fits) < 2:
        return None
    inertia = _inertia(structure, gauge)
    found = dependence(structure, inertia, values)
    if found.structure == structure:
        on_progress(f"no coefficient depends on {', '.join(parameters)}")
        return None
    bench = bench_of(nodes, Systems.of(parameters, nodes))
    arcs = arcs_of(followed, max(6, round(options.periods[-1] * scales.per_period)))
    sigma = np.median([fit.sigma for fit in fits], axis=0)
    fit = bench.fit(found.structure, found.known, arcs, sigma)
    on_progress(f"depending on {', '.join(parameters)}: {describe(fit)}")
    followed, fit = with_zeros_of_runs(bench, followed, fit, on_progress)
    mean = dict(
        zip(structure.keys(), np.mean([one.p for one in values], axis=0).tolist(), strict=True)
    )
    apart = bench.cross_validate(followed, fit, fit.structure, fit.values)
    alike = bench.cross_validate(followed, fit, structure, mean)
    on_progress(f"  cost of held-out arcs {np.sum(alike):.5g} → {np.sum(apart):.5g}")
    if not gains(alike, apart, options.gain):
        return None
    every = everything(angles, num_inputs, observation, options)
    every = _depending(every, fit.structure, (0,) * len(parameters))
    return finished(bench, followed, fit, every, scales, on_progress, options)


def _depending(every: Structure, found: Structure, none: tuple[int, ...]) -> Structure:
    """All terms and frictions, each with the functions of parameters that the law which was found
    has. Friction of a sum of speeds is among them where one system showed it."""
    shown = {row[:3] for row in found.friction}
    sums = {libraries.opposite(row) for row in every.friction} - shown
    directed = [row for row in every.friction if row[1] != UNIFORM and row not in sums]
    uniform = [row for row in every.friction if row[1] == UNIFORM]
    terms = with_functions(every.terms, functions_in(found.terms, none))
    return dataclasses.replace(
        every,
        terms=tuple(dict.fromkeys((found.terms[0], *terms))),
        friction=(*with_functions(directed, functions_in(found.friction, none)), *uniform),
    )


def _of_one_value(nodes: Sequence[Nodes]) -> list[list[int]]:
    """Places of the nodes of each value of the parameters, most samples first."""
    groups: dict[tuple[float, ...], list[int]] = {}
    for i, node in enumerate(nodes):
        groups.setdefault(tuple(node.stretch.args.tolist()), []).append(i)
    return sorted(groups.values(), key=lambda places: -sum(len(nodes[i].t) for i in places))


def _first_law(
    groups: Sequence[Sequence[int]],
    nodes: Sequence[Nodes],
    scales: Scales,
    angles: tuple[int, ...],
    num_inputs: int,
    holds: tuple[str, ...],
    observation: Observation,
    on_progress: Callable[[str], object],
    options: SearchOptions,
) -> Acting:
    """The law of the runs of one value, with the inputs as they act in it: of the value with most
    samples that has one."""
    for places in groups:
        some = [nodes[i] for i in places]
        inputs = {hold: ArcInputs(some, scales.substeps, hold) for hold in holds}
        try:
            found = search(
                some, scales, angles, num_inputs, inputs, observation, on_progress, options
            )
        except FitError:
            continue
        if np.isfinite(found.acting.fit.fitted.cost):
            return found.acting
    raise no_law(scales)


def _fitted(
    bench: Workbench,
    nodes: Sequence[Nodes],
    structure: Structure,
    scales: Scales,
    options: SearchOptions,
) -> tuple[LawFit | None, Sequence[Nodes]]:
    """A structure fitted to these nodes, and the nodes with its states; None where it cannot be."""
    try:
        without_zeros = dataclasses.replace(structure, zeros=())
        known = weak_start(without_zeros, nodes, scales, prune=False)[1]
    except FitError:
        return None, nodes
    fit, followed = arcs_by_length(bench, nodes, structure, known, scales, options)
    return (fit, followed) if np.isfinite(fit.fitted.cost) else (None, nodes)


def _inertia(structure: Structure, gauge: np.ndarray) -> np.ndarray:
    """(P,) each term's part in the mean of M₁₁, for a coefficient of 1."""
    form = structure.form(gauge)
    return np.concatenate([[1.0], -form.basis[0]]) / form.fixed[0]
