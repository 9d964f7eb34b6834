"""The search for a law: a linear start, arcs of growing length, terms dropped and added.

Half a period, one, two and four periods: short arcs find the law from afar, long ones tell small
forces. At each length terms that are not seen at four standard errors are dropped, and of those
that the law lacks the one with the largest score is tried; it stays where arcs that the fit has
not seen gain. Which friction there is, held-out arcs say in the end.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations

import numpy as np

from gfnn_jax.dataset.stretches import Nodes, Scales, arcs_of, with_states
from gfnn_jax.errors import FitError
from gfnn_jax.families.lagrangian import LINEAR
from gfnn_jax.maps.observation import Observation
from gfnn_jax.models import libraries
from gfnn_jax.models.law_fit import LawFit, Workbench
from gfnn_jax.models.structure import Key, Loss, Structure
from gfnn_jax.models.weak_start import protected, weak_start

FRICTIONS = ("linear", "quadratic", "dry")  # in the order of libraries.KINDS


@dataclasses.dataclass(frozen=True)
class SearchOptions:
    """Constants of the search, the same for all records (`python -m benchmarks measured`)."""

    periods: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0)  # lengths of arcs
    significant: float = 4.0  # standard errors, below which a term may be dropped
    nothing: float = 1.0  # standard errors, below which it is, without asking held-out arcs
    asked_for: float = 5.0  # standard errors, above which a term is tried
    tries: int = 3  # terms tried in a row
    plain_is_enough: float = (
        1.5  # times the residual of the larger library, the textbook's may have
    )
    gain: float = 0.05  # of the held-out cost, that a term has to bring
    friction_gain: float = 0.1  # of the held-out cost, that another kind of friction has to bring
    dry_width: float = 0.05  # ε of dry friction, in rms speeds
    frictions: tuple[str, ...] = FRICTIONS
    choose_friction: bool = True  # by held-out arcs; else all of these


def search(
    nodes: Sequence[Nodes],
    scales: Scales,
    angles: tuple[int, ...],
    num_inputs: int,
    inputs: Mapping[str, Callable],
    seen: Observation,
    told: Callable[[str], object] = lambda line: None,
    options: SearchOptions = SearchOptions(),
) -> tuple[LawFit, str, list[Nodes]]:
    """The law of these nodes: its fit to the longest arcs; of the rules between samples of the
    ``inputs`` (hold -> inputs of arcs) the best; and the nodes with the states found. ``seen`` says
    how states are observed."""
    d = seen.dim
    gauge = np.concatenate([n.x[:, :d] for n in nodes])
    benches = {hold: Workbench(gauge, u, scales.omega, seen) for hold, u in inputs.items()}
    sensors = tuple(zip(seen.parameters, map(float, seen.values), strict=True))
    shifted = seen.shifts()
    turned = tuple(i for i in angles if i in seen.direct and i not in shifted)  # with a zero

    def length(periods: float) -> int:
        return max(6, round(periods * scales.per_period))

    width = options.dry_width * float(np.mean(scales.speed))
    linear = libraries.losses(d, (LINEAR,), 0.0)
    starts = []
    plain = [libraries.textbook(d, angles)]
    if d > 1 and len(angles) == d:
        plain.append(libraries.relative(d, angles))
    plain_terms = []
    for rows in (*plain, libraries.first(d, angles)):
        terms = libraries.without_forces(rows, shifted)
        library = Structure(d, terms, tuple(linear), (), num_inputs, sensors)
        try:
            structure, known = weak_start(library, nodes, scales)
        except FitError:
            continue
        if rows in plain:
            plain_terms.append(structure.terms)
        zeros = tuple(i for i in turned if any(row[2][i] for row in structure.terms))
        structure = structure.plus(
            [("loss", row) for row in linear[:d]] + [("zero", i) for i in zeros]
        )
        if all(structure.terms != other.structure.terms for other in starts):
            arcs = arcs_of(nodes, length(options.periods[0]))
            fits = {
                hold: bench.fit(structure, known, arcs, scales.sigma)
                for hold, bench in benches.items()
            }
            hold = min(fits, key=lambda hold: float(np.max(fits[hold].rms() / scales.sigma)))
            benches = {hold: benches[hold]}  # inputs go on between samples as fits best
            starts.append(fits[hold])
            told(f"{options.periods[0]:g} periods: {describe(starts[-1])}")
    if not starts:
        raise FitError("no library of terms follows this recording: do its positions move freely?")
    (hold, bench), *_ = benches.items()
    misfit = [
        float(np.max(start.rms() / scales.sigma)) if np.isfinite(start.fitted.cost) else np.inf
        for start in starts
    ]
    best = min(range(len(starts)), key=lambda k: misfit[k])
    simple = [k for k, start in enumerate(starts) if start.structure.terms in plain_terms]
    simple = [k for k in simple if misfit[k] <= options.plain_is_enough * misfit[best]]
    fit = starts[min(simple, key=lambda k: misfit[k]) if simple else best]
    every = Structure(
        d, libraries.without_forces(
            (*libraries.first(d, angles), *libraries.more(d, angles)), shifted
        ),
        _with_opposites(libraries.losses(d, libraries.KINDS, width)), turned, num_inputs, sensors,
    )  # fmt: skip
    allowed = tuple(libraries.KINDS[FRICTIONS.index(k)] for k in options.frictions)
    every = dataclasses.replace(
        every, friction=tuple(row for row in every.friction if row[1] in allowed)
    )
    frictions = dataclasses.replace(every, terms=every.terms[:1])
    nodes = with_states(nodes, fit.arcs, fit.fitted.x)
    for periods in options.periods[1:]:
        arcs = arcs_of(nodes, length(periods))
        if arcs.t.shape == fit.arcs.t.shape:
            break  # no run is longer
        fit = bench.fit(fit.structure, fit.values, arcs, fit.sigma)
        if periods == 1:
            fit = grow(bench, nodes, fit, frictions, told, options)
            fit = prune(bench, nodes, fit, told, options)
            fit = grow(bench, nodes, fit, every, told, options)
        nodes = with_states(nodes, fit.arcs, fit.fitted.x)
        told(f"{periods:g} periods: {describe(fit)}")
    fit = choose_friction(bench, nodes, fit, width, told, options)
    fit = prune(bench, nodes, fit, told, options)
    fit = grow(bench, nodes, fit, every, told, options)
    fit = prune(bench, nodes, fit, told, options)
    return fit, hold, with_states(nodes, fit.arcs, fit.fitted.x)


def describe(fit: LawFit) -> str:
    rms = " ".join(f"{r:.3g}" for r in fit.rms())
    return (
        f"{len(fit.p)} coefficients, residual {rms}, correlated over {fit.correlation:.1f} nodes, "
        f"{fit.fitted.iterations} iterations" + ("" if fit.fitted.converged else ", not converged")
    )


def prune(
    bench: Workbench, nodes: Sequence[Nodes], fit: LawFit, told: Callable, options: SearchOptions
) -> LawFit:
    """The fit without terms that are not seen, the least seen first, as long as held-out arcs do
    not lose; and without friction that would drive."""
    refused: set[Key] = set()
    costs = None
    while True:
        z = significance(fit)
        always = {k for k in z if k[0] in ("gain", "sensor")}
        fixed = protected(fit.structure) | refused | always
        z = {k: size for k, size in z.items() if k not in fixed and size < options.significant}
        if not z:
            return fit
        key: Key = min(z.items(), key=lambda item: item[1])[0]
        smaller = fit.structure.without({key})
        if z[key] > options.nothing or (key[0] == "loss" and z[key] >= 0):
            if costs is None:
                costs = bench.cross_validate(nodes, fit, fit.structure, fit.values)
            without = bench.cross_validate(nodes, fit, smaller, fit.values)
            if gains(without, costs, options.gain):
                refused.add(key)
                continue
        told(f"  without {key}: {z[key]:.1f} standard errors")
        arcs = dataclasses.replace(fit.arcs, x=fit.fitted.x)
        fit, costs = bench.fit(smaller, fit.values, arcs, fit.sigma), None


def significance(fit: LawFit) -> dict[Key, float]:
    """Coefficients in units of their standard errors; friction that drives is below 0."""
    error = np.sqrt(np.diag(fit.covariance()))
    z = np.where(error > 0, np.abs(fit.p) / error, 0.0)
    keys = fit.structure.keys()
    drives = [k[0] == "loss" and p < 0 for k, p in zip(keys, fit.p, strict=True)]
    return dict(zip(keys, np.where(drives, -z, z).tolist(), strict=True))


def gains(costs: np.ndarray, others: np.ndarray, share: float) -> bool:
    """Return whether ``others`` are lower in all than these held-out costs (A,), by this share of
    them."""
    return bool(np.sum(others) < np.sum(costs) * (1 - share))


def grow(
    bench: Workbench, nodes: Sequence[Nodes], fit: LawFit, every: Structure, told: Callable,
    options: SearchOptions,
) -> LawFit:  # fmt: skip
    """The fit with terms that the residuals ask for, each kept where held-out arcs gain."""
    refused: set[Key] = set()
    costs = None
    for _ in range(options.tries):
        scores = bench.scores(fit, every)
        scores = {k: z for k, z in scores.items() if k not in refused and z > options.asked_for}
        if not scores:
            break
        key = max(scores, key=lambda k: scores[k])
        if costs is None:
            costs = bench.cross_validate(nodes, fit, fit.structure, fit.values)
        larger = fit.structure.plus([key])
        with_it = bench.cross_validate(nodes, fit, larger, fit.values)
        kept = gains(costs, with_it, options.gain)
        told(
            f"  {'with' if kept else 'not'} {key}: score {scores[key]:.1f}, held-out "
            f"{np.sum(costs):.5g} → {np.sum(with_it):.5g}"
        )
        if not kept:
            refused.add(key)
            continue
        arcs = dataclasses.replace(fit.arcs, x=fit.fitted.x)
        fit = bench.fit(larger, fit.values, arcs, fit.sigma)
        costs = None
    return fit


def choose_friction(
    bench: Workbench,
    nodes: Sequence[Nodes],
    fit: LawFit,
    width: float,
    told: Callable,
    options: SearchOptions,
) -> LawFit:
    """The fit with the friction that predicts held-out arcs best; the smaller where two tie."""
    d = fit.structure.dim
    bare = dataclasses.replace(fit.structure, friction=())
    kinds = [libraries.KINDS[FRICTIONS.index(k)] for k in options.frictions]
    best, lowest = bare, np.full(1, np.inf)
    counts = range(len(kinds) + 1) if options.choose_friction else [len(kinds)]
    for count in counts:
        for chosen in combinations(kinds, count):
            rows = libraries.losses(d, chosen, width)
            structure = dataclasses.replace(bare, friction=tuple(rows))
            structure = without_drives(bench, fit, structure)
            costs = bench.cross_validate(nodes, fit, structure, fit.values)
            told(f"  friction {structure.friction}: held-out {np.sum(costs):.5g}")
            if gains(lowest, costs, options.friction_gain):
                best, lowest = structure, costs
    arcs = dataclasses.replace(fit.arcs, x=fit.fitted.x)
    return bench.fit(best, fit.values, arcs, fit.sigma)


def without_drives(bench: Workbench, fit: LawFit, structure: Structure) -> Structure:
    """The structure without friction that a fit would make negative, the worst first; that of a
    relative speed gives way to that of the sum."""
    arcs = dataclasses.replace(fit.arcs, x=fit.fitted.x)
    known = fit.values
    while structure.friction:
        found = bench.fit(structure, known, arcs, fit.sigma, rescale=False)
        z = significance(found)
        worst = min((("loss", row) for row in structure.friction), key=lambda k: z[k])
        if z[worst] >= 0:
            break
        turned = libraries.opposite(worst[1])
        structure, known = structure.without({worst}), found.values
        if turned is not None:
            structure = structure.plus([("loss", turned)])
    return structure


def _with_opposites(rows: list[Loss]) -> tuple[Loss, ...]:
    turned = (libraries.opposite(row) for row in rows)
    return (*rows, *(row for row in turned if row is not None))
