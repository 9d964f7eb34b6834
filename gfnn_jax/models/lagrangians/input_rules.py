"""Actions of the inputs of a record: what they do between their samples, and how much later than
they were measured.

A fit's residuals are linear in a small delay τ as they are in the coefficients:

    r(p, τ + δ) = r(p, τ) + Σ_ij G_ij ∂r/∂G'_ij δ,

with G' the gains of further inputs ∂u(t − τ)/∂τ, and terms that have inputs alike. So one
evaluation of the arcs gives the delay that fits best, with its standard error, and how far the
coefficients imitate it. It is taken where it is significant and held-out arcs gain by it more than
the standard error of what they gain: by less the one or the other hangs on roundoff. The rule
between samples is that of which held-out arcs cost least, each with its own delay: chosen with the
first law, whose misfit may hide the choice, and again with the last. Inputs that are held act as
those in between do half a sample later, but for little: of rules whose costs differ by no more than
chance the one without a delay is taken.
"""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from gfnn_jax.dataset.stretches import Arcs, arcs_of
from gfnn_jax.families.expressions import Expression, parameter, to_text, with_leaves
from gfnn_jax.families.lagrangian import INPUTS, has_inputs, shape_of, tree_of
from gfnn_jax.fitting.evidence import Comparison, criterion
from gfnn_jax.models.lagrangians.fit import ArcProblem, LawFit
from gfnn_jax.models.lagrangians.structure import Key, Row, Structure

RULES = {
    "hold": "held from sample to sample",
    "linear": "linear between samples",
    "band": "band-limited between samples",
}


class Options:
    """Options of the search for a delay (`benchmarks/measured.py`).

    apart: of a sample, by which inputs are differentiated. settled: standard errors, within which a
    delay is found. most: corrections. furthest: samples, of a correction. step: of inputs, over
    which shapes that have them are differentiated.
    """

    apart: float = 0.05
    settled: float = 0.1
    most: int = 4
    furthest: float = 1.0
    step: float = 1e-4


class InputModel(NamedTuple):
    """A fit with the inputs as they act, and the standard error of their delay, in seconds: NaN
    where the record does not determine it. others: other rules between samples -> their cost of
    held-out arcs over that of this one."""

    fit: LawFit
    error: float = np.nan
    others: Mapping[str, float] = MappingProxyType({})

    @property
    def hold(self) -> str:
        return self.fit.problem.inputs.hold

    @property
    def delay(self) -> float:
        return self.fit.problem.inputs.delay

    def held_out(self, sigma: np.ndarray) -> np.ndarray:
        """The held-out cost (A,), in units of σ, the same for all that are compared."""
        return dataclasses.replace(self.fit, sigma=sigma).cross_validate()

    def followed(self, sigma: np.ndarray) -> np.ndarray:
        """The cost (A,) of the arcs that were fitted, in units of σ."""
        return dataclasses.replace(self.fit, sigma=sigma).held_out(self.fit.arcs)


def choose_rule(
    problem: ArcProblem,
    structure: Structure,
    known: Mapping[Key, float],
    arcs: Arcs,
    sigma: np.ndarray,
) -> InputModel:
    """The fit of these arcs by the rule between samples (of the problem's) and the delay that
    held-out arcs choose, of those whose orbits follow the arcs; where none does, by the first."""
    found = [
        with_delay(problem.by_rule(rule).fit(structure, known, arcs, sigma))
        for rule in problem.rules
    ]
    found = [one for one in found if one.fit.follows] or found[:1]
    if len(found) == 1:
        return found[0]
    of_arcs = [one.held_out(sigma) for one in found]
    costs = np.array([np.sum(cost) for cost in of_arcs])
    least = of_arcs[int(np.argmin(costs))]
    # Held-out arcs of one third agree by chance: the errors of its coefficients are theirs all.
    seen = [np.sum(one.followed(sigma)) for one in found]
    above = [criterion(cost, found[0].fit.independent, 0) for cost in seen]
    likely = min(above) + problem.options.evidence.deciding
    alike = [
        k
        for k, cost in enumerate(of_arcs)
        if above[k] < likely or not Comparison.of(cost, least).is_higher()
    ]
    best = min(alike, key=lambda k: (found[k].delay != 0, costs[k]))
    others = {one.hold: float(c / costs[best]) for one, c in zip(found, costs, strict=True)}
    return found[best]._replace(others={h: c for h, c in others.items() if h != found[best].hold})


def choose_again(last: InputModel, rules: tuple[str, ...], length: int) -> InputModel:
    """The rule between samples (of ``rules``) that held-out arcs choose with the last law: ``last``
    as it was, where that is its own, or no orbit follows these arcs by any. length: nodes of these
    arcs; many short ones tell it better than a few long ones."""
    if len(rules) < 2:
        return last
    fit = last.fit
    problem = dataclasses.replace(fit.problem, rules=rules)
    arcs = arcs_of(problem.nodes, length)
    best = choose_rule(problem, fit.structure, fit.values, arcs, fit.sigma)
    stays = best.hold == last.hold or not best.fit.follows
    return last._replace(others=best.others) if stays else best


def with_delay(fit: LawFit) -> InputModel:
    """The fit with its delay corrected, where held-out arcs gain by that."""
    begun = here = InputModel(fit)
    if not fit.structure.num_inputs or not fit.follows:
        return begun
    interval, significant = fit.problem.scales.dt, fit.problem.options.evidence.significant
    for _ in range(Options.most):
        change, error = _correction(here)
        here = here._replace(error=error)
        most = Options.furthest * interval
        delay = here.delay + np.clip(change, -most, most)
        if not abs(change) > Options.settled * error or not abs(delay) > significant * error:
            break
        problem = here.fit.problem
        later = dataclasses.replace(problem, inputs=problem.inputs.delayed(delay))
        here = InputModel(here.fit.again(problem=later), error)
    if here.fit is fit:
        return here
    apart = Comparison.of(here.held_out(fit.sigma), begun.held_out(fit.sigma))
    gains = apart.is_lower() and apart.apart < -apart.error
    return here if gains else begun._replace(error=here.error)


def _correction(here: InputModel) -> tuple[float, float]:
    """The change of the delay that fits best, and its standard error, both in seconds; 0 and NaN
    where the coefficients imitate it."""
    fit, inputs = here.fit, here.fit.problem.inputs
    apart = Options.apart * fit.problem.scales.dt
    ahead, behind = (inputs.delayed(inputs.delay + by)(fit.arcs) for by in (apart, -apart))
    return correction(fit, (ahead - behind) / (2 * apart))


def correction(fit: LawFit, slope: np.ndarray) -> tuple[float, float]:
    """The change of a number that inputs depend on, of which ``slope`` is the derivative along the
    arcs of a fit, and its standard error; 0 and NaN where the coefficients imitate it."""
    count = fit.structure.num_inputs
    both = np.concatenate([fit.problem.inputs(fit.arcs), slope], axis=-1)
    driven = {_along_inputs(row, count): row for row in fit.structure.terms if has_inputs(row)}
    changes: dict[Key, float] = {
        ("gain", i, count + j): fit.values["gain", i, j]
        for i in range(fit.form.dim)
        for j in range(count)
    }
    changes |= {("term", slope): fit.values["term", row] for slope, row in driven.items()}
    structure = dataclasses.replace(fit.structure, num_inputs=2 * count)
    structure = structure.plus([("term", slope) for slope in driven])
    problem = dataclasses.replace(fit.problem, inputs=lambda arcs: both)
    return fit.along(changes, structure, problem)


def _along_inputs(row: Row, count: int) -> Row:
    """The derivative of a term along its inputs, times the ``count`` inputs that follow."""
    d = len(row[0])

    def moved(by: float) -> Expression:
        def later(leaf: Expression) -> Expression:
            of_input = leaf.operation == "parameter"
            return leaf + by * parameter(leaf.operands[0] + count) if of_input else leaf

        return with_leaves(tree_of(shape_of(row), d), later)

    slope = (moved(Options.step) - moved(-Options.step)) * (0.5 / Options.step)
    return (*row[:4], to_text(slope, d, INPUTS), *row[5:])
