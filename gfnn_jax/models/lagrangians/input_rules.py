"""Actions of the inputs of a record: what they do between their samples, and how much later than
they were measured.

A fit's residuals are linear in a small delay τ as they are in the coefficients:

    r(p, τ + δ) = r(p, τ) + Σ_ij G_ij ∂r/∂G'_ij δ,

with G' the gains of further inputs ∂u(t − τ)/∂τ. So one evaluation of the arcs tells the delay that
fits best, with its standard error, and how far the coefficients imitate it. It is taken where it is
significant and held-out arcs gain by it. The rule between samples is that of which held-out arcs
cost least, each with its own delay: chosen with the first law, whose misfit may hide the choice,
and again with the last. Inputs that are held act as those in between do half a sample later, but
for little: of rules whose costs differ by no more than chance the one without a delay is taken.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from gfnn_jax.dataset.stretches import Arcs, Nodes, arcs_of, with_states
from gfnn_jax.models.lagrangians.fit import LawFit, Workbench, places
from gfnn_jax.models.lagrangians.structure import Key, Structure

RULES = {
    "hold": "held from sample to sample",
    "linear": "linear between samples",
    "band": "band-limited between samples",
}
_SIGNIFICANT = 4.0  # standard errors of a delay
_APART = 0.05  # of a sample: the change of a delay by which inputs are differentiated
_SETTLED = 0.1  # standard errors, within which a delay is found
_MOST = 4  # corrections of a delay
_FURTHEST = 1.0  # samples, of a correction
_CHANCE = 2.0  # standard errors of a difference of costs
_IMITATED = 0.03  # of what a delay changes, that no coefficient does: less is not told apart


class Acting(NamedTuple):
    """A fit, the workbench with the inputs as they act, and the standard error of their delay, in
    seconds: NaN where the record does not tell it. others: other rules between samples -> their
    cost of held-out arcs over that of this one."""

    fit: LawFit
    bench: Workbench
    error: float
    others: Mapping[str, float] = MappingProxyType({})

    @property
    def hold(self) -> str:
        return self.bench.inputs.hold

    @property
    def delay(self) -> float:
        return self.bench.inputs.delay


def choose_rule(
    benches: Mapping[str, Workbench],
    nodes: Sequence[Nodes],
    structure: Structure,
    known: Mapping[Key, float],
    arcs: Arcs,
    sigma: np.ndarray,
    interval: float,
) -> Acting:
    """The fit of these arcs by the rule between samples (of ``benches``: rule -> workbench) and the
    delay that held-out arcs choose. interval: between samples, in seconds."""
    found = []
    for bench in benches.values():
        fit = bench.fit(structure, known, arcs, sigma)
        found.append(with_delay(bench, nodes, fit, interval))
    if len(found) == 1:
        return found[0]
    of_arcs = [_held_out(one, nodes, sigma) for one in found]
    costs = np.array([np.sum(cost) for cost in of_arcs])
    least = of_arcs[int(np.argmin(costs))]
    alike = [k for k, cost in enumerate(of_arcs) if not _costs_more(cost, least)]
    best = min(alike, key=lambda k: (found[k].delay != 0, costs[k]))
    others = {one.hold: float(c / costs[best]) for one, c in zip(found, costs, strict=True)}
    return found[best]._replace(others={h: c for h, c in others.items() if h != found[best].hold})


def choose_again(
    last: Acting, holds: Sequence[str], nodes: Sequence[Nodes], length: int, interval: float
) -> Acting:
    """The rule between samples (of ``holds``) that held-out arcs choose with the last law: ``last``
    as it was, where that is its own. length: nodes of these arcs; many short ones tell it better
    than a few long ones."""
    if len(holds) < 2:
        return last
    fit = last.fit
    inputs = {hold: last.bench.inputs.by_rule(hold) for hold in holds}
    benches = {hold: dataclasses.replace(last.bench, inputs=of) for hold, of in inputs.items()}
    arcs = arcs_of(with_states(nodes, fit.arcs, fit.fitted.x), length)
    best = choose_rule(benches, nodes, fit.structure, fit.values, arcs, fit.sigma, interval)
    return last._replace(others=best.others) if best.hold == last.hold else best


def with_delay(bench: Workbench, nodes: Sequence[Nodes], fit: LawFit, interval: float) -> Acting:
    """The fit with its delay corrected, where held-out arcs gain by that."""
    if not fit.structure.num_inputs or not np.isfinite(fit.fitted.cost):
        return Acting(fit, bench, np.nan)
    begun = Acting(fit, bench, np.nan)
    here = begun
    for _ in range(_MOST):
        change, error = _correction(here, interval)
        here = here._replace(error=error)
        delay = here.delay + np.clip(change, -_FURTHEST * interval, _FURTHEST * interval)
        if not abs(change) > _SETTLED * error or not abs(delay) > _SIGNIFICANT * error:
            break
        later = dataclasses.replace(here.bench, inputs=here.bench.inputs.delayed(delay))
        arcs = dataclasses.replace(fit.arcs, x=here.fit.fitted.x)
        here = Acting(later.fit(fit.structure, here.fit.values, arcs, here.fit.sigma), later, error)
    if here.bench is bench:
        return here
    gains = np.sum(_held_out(here, nodes, fit.sigma)) < np.sum(_held_out(begun, nodes, fit.sigma))
    return here if gains else begun._replace(error=here.error)


def _held_out(one: Acting, nodes: Sequence[Nodes], sigma: np.ndarray) -> np.ndarray:
    """The held-out cost (A,) of a fit's structure, in units of σ, the same for all that are
    compared."""
    fit = dataclasses.replace(one.fit, sigma=sigma)
    return one.bench.cross_validate(nodes, fit, fit.structure, fit.values)


def _costs_more(of_arcs: np.ndarray, least: np.ndarray) -> bool:
    """Return whether these costs (A,) are together above the least by more than chance, as their
    differences from arc to arc tell it."""
    if of_arcs is least:
        return False
    with np.errstate(invalid="ignore"):  # infinite ones, of which chance is NaN
        more = np.where(of_arcs == least, 0.0, of_arcs - least)
        chance = np.sqrt(len(more)) * np.std(more, ddof=min(1, len(more) - 1))
    return not float(np.sum(more)) <= _CHANCE * chance


def _correction(here: Acting, interval: float) -> tuple[float, float]:
    """The change of the delay that fits best, and its standard error, both in seconds; 0 and NaN
    where the coefficients imitate it."""
    fit, inputs, count = here.fit, here.bench.inputs, here.fit.structure.num_inputs
    apart = _APART * interval
    by_delay = (
        inputs.delayed(inputs.delay + apart)(fit.arcs)
        - inputs.delayed(inputs.delay - apart)(fit.arcs)
    ) / (2 * apart)
    both = np.concatenate([inputs(fit.arcs), by_delay], axis=-1)
    structure = dataclasses.replace(fit.structure, num_inputs=2 * count)
    bench = dataclasses.replace(here.bench, inputs=lambda arcs: both)
    further = [("gain", i, count + j) for i in range(fit.form.dim) for j in range(count)]
    own, others = places(structure, fit.structure, further)
    turn = np.zeros((len(structure.keys()), len(own) + 1))
    turn[own, range(len(own))] = 1.0
    turn[others, -1] = [fit.values["gain", i, j - count] for _, i, j in further]
    whole = bench.linearised(structure, fit).combined(turn)
    found = whole.added(range(len(own)), [len(own)])
    if not found.share[0] > _IMITATED:
        return 0.0, np.nan
    return float(found.value[0]), float(np.sqrt(fit.correlation) / found.size[0])
