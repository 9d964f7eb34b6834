"""The search for a law: a linear start, arcs of growing length, terms dropped and added.

Half a period, one, two and four periods: short arcs find the law from afar, long ones tell small
forces. At each length terms that are not seen at four standard errors are dropped, and of those
that the law lacks the one with the largest score is tried; it stays where arcs that the fit has
not seen gain. Which friction there is, held-out arcs say in the end.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from gfnn_jax.dataset.stretches import Nodes, Scales, arcs_of, with_states
from gfnn_jax.families.lagrangian import LINEAR, UNIFORM
from gfnn_jax.maps.observation import Observation
from gfnn_jax.models.lagrangians import libraries
from gfnn_jax.models.lagrangians.arc_inputs import ArcInputs
from gfnn_jax.models.lagrangians.fine_steps import with_fine_steps
from gfnn_jax.models.lagrangians.fit import LawFit, Workbench, a_third, describe
from gfnn_jax.models.lagrangians.friction_choice import FrictionChoice, which_friction
from gfnn_jax.models.lagrangians.input_rules import Acting, with_delay
from gfnn_jax.models.lagrangians.libraries import FRICTIONS
from gfnn_jax.models.lagrangians.starts import best_start
from gfnn_jax.models.lagrangians.structure import Key, Loss, Structure
from gfnn_jax.models.lagrangians.text import word_of
from gfnn_jax.models.lagrangians.weak_start import protected
from gfnn_jax.models.lagrangians.zeros_of_runs import with_zeros_of_runs

_AS_WELL = 1.01  # times the cost, with which a law follows the record as well


@dataclasses.dataclass(frozen=True)
class SearchOptions:
    """Constants of the search, the same for all records (`python benchmarks/measured.py DIR`)."""

    periods: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0)  # lengths of arcs
    significant: float = 4.0  # standard errors, below which a term may be dropped
    nothing: float = 1.0  # standard errors, below which it is, without asking held-out arcs
    asked_for: float = 5.0  # standard errors, above which a term is tried
    tries: int = 3  # terms tried in a row
    gain: float = 0.05  # of the held-out cost, that a term has to bring
    choices: int = 3  # of the friction, each close to the fit with the one before
    sharper: float = 1.5  # times smaller standard errors, at which shorter arcs are tried
    frictions: tuple[str, ...] = FRICTIONS
    choose_friction: bool = True  # by held-out arcs; else all of these


class Found(NamedTuple):
    """Findings of a search: the fit to the longest arcs with the inputs as they act, which friction
    and how sure that is, and the nodes with their states; and the same of shorter arcs, where
    these tell the coefficients better."""

    acting: Acting
    choice: FrictionChoice
    nodes: list[Nodes]
    shorter: Found | None = None

    @property
    def follows(self) -> bool:
        """Return whether orbits of the law follow all arcs."""
        fit = self.acting.fit
        return bool(np.all(np.isfinite(fit.p)) and np.isfinite(fit.fitted.cost))


def search(
    nodes: Sequence[Nodes],
    scales: Scales,
    angles: tuple[int, ...],
    num_inputs: int,
    inputs: Mapping[str, ArcInputs],
    observation: Observation,
    on_progress: Callable[[str], object] = lambda line: None,
    options: SearchOptions = SearchOptions(),
) -> Found:
    """The law of these nodes, by the best of the rules between samples of the ``inputs`` (hold ->
    inputs of arcs). ``observation`` says how states are observed."""
    d = observation.dim
    gauge = np.concatenate([n.x[:, :d] for n in nodes])
    benches = {hold: Workbench(gauge, u, scales.omega, observation) for hold, u in inputs.items()}
    bench, fit = best_start(
        nodes, scales, angles, num_inputs, benches, observation, options.periods[0], on_progress
    )
    every = everything(angles, num_inputs, observation, options)
    nodes = with_states(nodes, fit.arcs, fit.fitted.x)
    if len(fit.structure.uncoupled) > 1:  # what couples them is seen best along short arcs
        fit = grow(bench, nodes, fit, every, on_progress, options)
        nodes = with_states(nodes, fit.arcs, fit.fitted.x)
    periods = options.periods[1:]
    return _along_longer_arcs(bench, nodes, fit, periods, every, scales, on_progress, options)


def search_on(
    acting: Acting,
    nodes: Sequence[Nodes],
    scales: Scales,
    angles: tuple[int, ...],
    num_inputs: int,
    on_progress: Callable[[str], object] = lambda line: None,
    options: SearchOptions = SearchOptions(),
) -> Found:
    """The law that a search comes to from one that was found, with its inputs as they are found to
    act and arcs of a period."""
    fit, bench = acting.fit, acting.bench
    every = everything(angles, num_inputs, bench.observation, options)
    nodes = with_states(nodes, fit.arcs, fit.fitted.x)
    on_progress(f"1 periods: {describe(fit)}")
    longer = tuple(periods for periods in options.periods if periods > 1)
    return _along_longer_arcs(bench, nodes, fit, longer, every, scales, on_progress, options)


def _along_longer_arcs(
    bench: Workbench,
    nodes: Sequence[Nodes],
    fit: LawFit,
    lengths: Sequence[float],
    every: Structure,
    scales: Scales,
    on_progress: Callable[[str], object],
    options: SearchOptions,
) -> Found:
    """The law that a fit comes to by arcs of these lengths, in periods."""
    frictions = dataclasses.replace(every, terms=every.terms[:1])
    reached = [(nodes, fit)]
    for periods in lengths:
        longer = to_longer_arcs(bench, nodes, fit, max(6, round(periods * scales.per_period)))
        if longer is None:
            break
        nodes, fit = with_zeros_of_runs(bench, nodes, longer, on_progress)
        if periods == 1:
            bench, fit = with_fine_steps(bench, fit, on_progress)
            fit = grow(bench, nodes, fit, frictions, on_progress, options)
            fit = prune(bench, nodes, fit, on_progress, options)
            fit = grow(bench, nodes, fit, every, on_progress, options)
        nodes = with_states(nodes, fit.arcs, fit.fitted.x)
        on_progress(f"{periods:g} periods: {describe(fit)}")
        reached.append((nodes, fit))
    for nodes, fit in reversed(reached):
        found = finished(bench, nodes, fit, every, scales, on_progress, options)
        if found.follows:
            break  # else its friction leaves it without an orbit along these arcs
    return found


def everything(
    angles: tuple[int, ...], num_inputs: int, observation: Observation, options: SearchOptions
) -> Structure:
    """All terms and frictions that a search may come to."""
    d, shifted = observation.dim, observation.shifts()
    rows = (*libraries.first(d, angles), *libraries.more(d, angles))
    turned = tuple(i for i in angles if i in observation.direct and i not in shifted)
    sensors = tuple(zip(observation.parameters, map(float, observation.values), strict=True))
    return Structure(
        d,
        libraries.without_forces(rows, shifted),
        frictions_tried(d, options),
        turned,
        num_inputs,
        sensors,
    )


def finished(
    bench: Workbench,
    nodes: Sequence[Nodes],
    fit: LawFit,
    every: Structure,
    scales: Scales,
    on_progress: Callable,
    options: SearchOptions,
) -> Found:
    """The law that a fit to the longest arcs comes to: its friction chosen, terms dropped and
    added."""

    def choose(
        bench: Workbench, nodes: Sequence[Nodes], fit: LawFit
    ) -> tuple[LawFit, FrictionChoice]:
        return choose_friction(bench, nodes, fit, every.friction, on_progress, options)

    settled = partial(_settled, every, scales.dt, on_progress, options)
    return by_arcs_that_tell(bench, nodes, fit, choose, settled, scales, on_progress, options)


def by_arcs_that_tell(
    bench: Workbench,
    nodes: Sequence[Nodes],
    fit: LawFit,
    choose: Callable[[Workbench, Sequence[Nodes], LawFit], tuple[LawFit, FrictionChoice]],
    settled: Callable[[Workbench, Sequence[Nodes], LawFit, FrictionChoice], Found],
    scales: Scales,
    on_progress: Callable,
    options: SearchOptions,
) -> Found:
    """The law of a fit to the longest arcs, by steps that are short enough, with the friction that
    is to ``choose``, as it is ``settled``; and, where shorter arcs tell its coefficients better,
    that of these."""
    bench, fit = with_fine_steps(bench, fit, on_progress)
    fit, choice = choose(bench, nodes, fit)
    nodes, fit = with_zeros_of_runs(bench, nodes, fit, on_progress)
    lengths = [max(6, round(p * scales.per_period)) for p in options.periods]
    shorter = telling_more(bench, nodes, fit, lengths, options)
    found = settled(bench, nodes, fit, choice)
    if shorter is None:
        return found
    periods = shorter.arcs.t.shape[1] / scales.per_period
    on_progress(f"arcs of {periods:.2g} periods tell more than longer ones: {describe(shorter)}")
    nodes = with_states(nodes, shorter.arcs, shorter.fitted.x)
    return found._replace(shorter=settled(bench, nodes, *choose(bench, nodes, shorter)))


def _settled(
    every: Structure,
    dt: float,
    on_progress: Callable[[str], object],
    options: SearchOptions,
    bench: Workbench,
    nodes: Sequence[Nodes],
    fit: LawFit,
    choice: FrictionChoice,
) -> Found:
    """The law by arcs as long as those of the fit: terms that they do not tell are dropped, and
    others of ``every`` tried."""
    terms = dataclasses.replace(every, friction=())
    before = fit.structure
    fit = prune(bench, nodes, fit, on_progress, options, friction=False)
    fit = grow(bench, nodes, fit, terms, on_progress, options)
    fit = prune(bench, nodes, fit, on_progress, options, friction=False)
    if fit.structure != before:
        fit, choice = choose_friction(bench, nodes, fit, every.friction, on_progress, options)
    return as_found(dt, bench, nodes, fit, choice)


def as_found(
    dt: float, bench: Workbench, nodes: Sequence[Nodes], fit: LawFit, choice: FrictionChoice
) -> Found:
    """The fit as it is, with the delay of its inputs, and the nodes with its states."""
    nodes = with_states(nodes, fit.arcs, fit.fitted.x)
    return Found(with_delay(bench, nodes, fit, dt), choice, nodes)


def telling_more(
    bench: Workbench,
    nodes: Sequence[Nodes],
    fit: LawFit,
    lengths: Sequence[int],
    options: SearchOptions,
) -> LawFit | None:
    """The fit to arcs of the one of these ``lengths`` (nodes) that tells the coefficients best,
    longer ones first as long as shorter ones tell more. None where the standard errors, in the
    geometric mean, are not much smaller than those of ``fit``: longer arcs are a longer lever, but
    where motion is chaotic, or forces unknown, their residuals grow faster."""
    if not len(fit.p):
        return None  # a driven mass: nothing of its law is free
    best = fit
    for size in sorted(lengths, reverse=True):
        arcs = arcs_of(with_states(nodes, best.arcs, best.fitted.x), size)
        if arcs.t.shape[1] >= best.arcs.t.shape[1]:
            continue
        other = bench.fit(fit.structure, best.values, arcs, best.sigma)
        if not _errors(other) < _errors(best):
            break
        best = other
    return best if options.sharper * _errors(best) < _errors(fit) else None


def _errors(fit: LawFit) -> float:
    """Geometric mean of the standard errors."""
    return fit.linearised.sharpness


def arcs_by_length(
    bench: Workbench,
    nodes: Sequence[Nodes],
    structure: Structure,
    known: Mapping[Key, float],
    scales: Scales,
    options: SearchOptions,
) -> tuple[LawFit, list[Nodes]]:
    """A structure fitted to arcs of growing length, and the nodes with its states."""
    fit, sigma, nodes = None, scales.sigma, list(nodes)
    for periods in options.periods:
        arcs = arcs_of(nodes, max(6, round(periods * scales.per_period)))
        if fit is not None and arcs.t.shape == fit.arcs.t.shape:
            break  # no run is longer
        fit = bench.fit(structure, known, arcs, sigma)
        known, sigma, nodes = fit.values, fit.sigma, with_states(nodes, arcs, fit.fitted.x)
    assert fit is not None  # there is a length
    return fit, nodes


def to_longer_arcs(
    bench: Workbench, nodes: Sequence[Nodes], fit: LawFit, length: int
) -> LawFit | None:
    """The same structure fitted to arcs of this length (nodes); None where no run is longer, or
    where no orbit of the law follows one of them."""
    arcs = arcs_of(nodes, length)
    if arcs.t.shape == fit.arcs.t.shape:
        return None
    longer = bench.fit(fit.structure, fit.values, arcs, fit.sigma)
    return longer if np.isfinite(longer.fitted.cost) else None


def _word(bench: Workbench, key: Key) -> str:
    names = () if bench.systems is None else bench.systems.names
    return word_of(key, bench.observation.coordinates, bench.observation.speeds, names)


def prune(
    bench: Workbench,
    nodes: Sequence[Nodes],
    fit: LawFit,
    on_progress: Callable,
    options: SearchOptions,
    friction: bool = True,
) -> LawFit:
    """The fit without terms that are not seen, the least seen first, as long as held-out arcs do
    not lose; and, unless ``friction`` has been chosen, without that which would drive. First, of
    terms that the record tells only together, without one."""
    refused: set[Key] = set()
    fit = without_degeneracies(bench, fit, on_progress)
    costs = None
    while True:
        z = significance(fit)
        stays = {k for k in z if k[0] in ("gain", "sensor")}
        stays |= set() if friction else {k for k in z if k[0] == "loss"}
        fixed = protected(fit.structure) | refused | stays
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
        on_progress(f"  dropped {_word(bench, key)}: {z[key]:.1f} standard errors")
        arcs = dataclasses.replace(fit.arcs, x=fit.fitted.x)
        fit, costs = bench.fit(smaller, fit.values, arcs, fit.sigma), None


def without_degeneracies(bench: Workbench, fit: LawFit, on_progress: Callable) -> LawFit:
    """The fit without the first term, kinetic ones before others, of each combination that moves
    nothing; which costs nothing. Masses that couple two coordinates give way to a spring that
    does as well."""
    fixed = protected(fit.structure)
    for row in fit.structure.terms:
        spring = ((0,) * len(row[0]), row[0], *row[2:])
        if (
            max(row[0]) == 1
            and not any(row[1])
            and not any(row[2])
            and (spring not in fit.structure.terms)
        ):
            arcs = dataclasses.replace(fit.arcs, x=fit.fitted.x)
            larger = fit.structure.plus([("term", spring)])
            with_it = bench.fit(larger, fit.values, arcs, fit.sigma, rescale=False)
            fit = with_it if with_it.degenerate() else fit
    while True:
        step = fit.degenerate()
        open_ = [key for key in step if key[0] == "term" and key not in fixed]
        if not open_:
            return fit
        values, gone = fit.values, open_[0]
        along = values[gone] / step[gone]
        moved = {key: value - along * step.get(key, 0.0) for key, value in values.items()}
        smaller = fit.structure.without({gone})
        arcs = dataclasses.replace(fit.arcs, x=fit.fitted.x)
        without = bench.fit(smaller, moved, arcs, fit.sigma, rescale=False)
        if without.fitted.cost > _AS_WELL * fit.fitted.cost:  # its zero is out of reach
            fixed = fixed | {gone}
            continue
        others = ", ".join(_word(bench, key) for key in open_[1:])
        on_progress(f"  dropped {_word(bench, gone)}: determined only together with {others}")
        fit = without


def significance(fit: LawFit) -> dict[Key, float]:
    """Coefficients in units of their standard errors; friction that drives is below 0."""
    z, keys = fit.linearised.significance, fit.structure.keys()
    drives = [k[0] == "loss" and p < 0 for k, p in zip(keys, fit.p, strict=True)]
    return dict(zip(keys, np.where(drives, -z, z).tolist(), strict=True))


def gains(costs: np.ndarray, others: np.ndarray, share: float) -> bool:
    """Return whether ``others`` are lower in all than these held-out costs (A,), by this share of
    them."""
    return bool(np.sum(others) < np.sum(costs) * (1 - share))


def grow(
    bench: Workbench,
    nodes: Sequence[Nodes],
    fit: LawFit,
    every: Structure,
    on_progress: Callable,
    options: SearchOptions,
) -> LawFit:
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
        on_progress(
            f"  {'added' if kept else 'refused'} {_word(bench, key)}: "
            f"{scores[key]:.1f} standard errors, cost of held-out arcs {np.sum(costs):.5g} → "
            f"{np.sum(with_it):.5g}"
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
    candidates: Sequence[Loss],
    on_progress: Callable,
    options: SearchOptions,
) -> tuple[LawFit, FrictionChoice]:
    """The fit with the friction that held-out arcs choose, and how sure that is. Arcs are as long
    as those of the fit, or as long as three of them can be. A choice holds close to its fit, so
    that it is made again until it stands; where none has stood when the third is looked at, the
    likeliest of these fits is taken."""
    whole, sigma = dataclasses.replace(fit.arcs, x=fit.fitted.x), fit.sigma
    length = max(6, min(whole.t.shape[1], a_third(nodes, bench.systems)))
    arcs = arcs_of(with_states(nodes, whole, whole.x), length)
    if arcs.t.shape != whole.t.shape:
        fit = bench.fit(fit.structure, fit.values, arcs, sigma)
    choice = which_friction(bench, fit, candidates, options.choose_friction)
    tried = [(fit, choice)]
    for _ in range(options.choices):
        rows = [_word(bench, ("loss", row)) for row in choice.rows]
        on_progress(f"  friction: {', '.join(rows) or 'none'}")
        if set(choice.rows) == set(fit.structure.friction):
            break
        structure = dataclasses.replace(fit.structure, friction=choice.rows)
        arcs = dataclasses.replace(fit.arcs, x=fit.fitted.x)
        fit = bench.fit(structure, fit.values, arcs, fit.sigma)
        choice = which_friction(bench, fit, candidates, options.choose_friction, choice)
        tried.append((fit, choice))
    else:
        if options.choose_friction:
            fit, choice = _likeliest(bench, tried)
    if set(choice.rows) != set(fit.structure.friction):
        choice = which_friction(
            bench, fit, candidates, options.choose_friction, rows=fit.structure.friction
        )
    fit = _without_drives(bench, bench.fit(fit.structure, fit.values, whole, sigma), on_progress)
    return fit, choice._replace(rows=fit.structure.friction)


def _without_drives(bench: Workbench, fit: LawFit, on_progress: Callable[[str], object]) -> LawFit:
    """The fit without friction whose coefficient has fallen below zero by other arcs than those
    that chose it, the farthest below first: friction does not drive."""
    while np.isfinite(fit.fitted.cost):
        z = {key: size for key, size in significance(fit).items() if fit.values[key] < 0}
        z = {key: size for key, size in z.items() if key[0] == "loss"}
        if not z:
            break
        key: Key = min(z, key=lambda key: z[key])
        on_progress(f"  dropped {_word(bench, key)}: {z[key]:.1f} standard errors")
        arcs = dataclasses.replace(fit.arcs, x=fit.fitted.x)
        fit = bench.fit(fit.structure.without({key}), fit.values, arcs, fit.sigma)
    return fit


def _likeliest(
    bench: Workbench, tried: Sequence[tuple[LawFit, FrictionChoice]]
) -> tuple[LawFit, FrictionChoice]:
    """The likeliest of these fits whose friction does not drive, by Schwarz's criterion: what their
    residuals add up to, of which those that are correlated count once."""
    fits = [one for one in tried if _can_be_chosen(one[0])] or tried[-1:]
    last, loss = tried[-1][0], bench.observation.loss
    count = np.count_nonzero(np.isfinite(last.arcs.y)) / last.correlation

    def criterion(fit: LawFit) -> float:
        unit = last.fitted.sigma / fit.fitted.sigma
        cost = np.nansum(loss.of(fit.fitted.residuals / unit))
        return float(count * np.log(cost) + len(fit.p) * np.log(count))

    return min(fits, key=lambda one: criterion(one[0]))


def _can_be_chosen(fit: LawFit) -> bool:
    """Return whether the friction does not drive, and is not both linear and uniform."""
    losses = [value for key, value in fit.values.items() if key[0] == "loss"]
    kinds = {row[1] for row in fit.structure.friction}
    followed = np.isfinite(fit.fitted.cost)
    return bool(followed and min(losses, default=0.0) >= 0 and not {LINEAR, UNIFORM} <= kinds)


def frictions_tried(dim: int, options: SearchOptions) -> tuple[Loss, ...]:
    """Friction of all the kinds that are asked for, in every direction."""
    kinds = tuple(libraries.KINDS[FRICTIONS.index(k)] for k in options.frictions)
    if dim == 1 and len(kinds) > 1:  # linear friction is uniform there
        kinds = tuple(kind for kind in kinds if kind != UNIFORM)
    rows = libraries.losses(dim, kinds, 0.0)
    turned = [one for one in map(libraries.opposite, rows) if one is not None]
    return tuple(sorted((*rows, *turned), key=lambda row: row[1] == UNIFORM))
