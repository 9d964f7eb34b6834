"""One law of several systems, which differ in parameters: a length, an added mass.

The runs of the value with most samples are searched for terms as any recording is. These terms are
then fitted to the runs of each value by themselves, and the coefficients tell on which functions of
the parameters they depend. That law is fitted to all runs at once, and from there on terms are
dropped and added, and friction is chosen, as ever. Where arcs that a fit has not seen do not gain
by the dependence, there is none.

The fit of the runs of one value v has coefficients p_v, and the triangle R_v of their information.
Close to these fits the residuals of any law are R_v (p − p_v), so that sets of functions for all
coefficients,

    p_j(μ) = Σ_a x_ja ∏ μ^a / c(μ),      a whole powers from −2 to 2,

are compared without another look at the arcs. c(μ) is the inertia M₁₁: L → c(μ) L moves nothing
within a run, and what is told of the coefficients is their ratio to it. It is constant, or has one
power more where the others are plainer by it, as where a mass is added to the body that M₁₁ is of.
Gains of inputs do not depend on the parameters. Each coefficient counts as 16, the square of four
standard errors, and each power as 1, so that of functions that do as well the plainest is taken;
sets grow, shrink and change a function at a time.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.errors import FitError
from gfnn_jax.families.friction import UNIFORM
from gfnn_jax.families.lagrangian import functions_of
from gfnn_jax.fitting.evidence import EVIDENCE, Comparison
from gfnn_jax.models.lagrangians import libraries
from gfnn_jax.models.lagrangians.arc_inputs import ArcInputs
from gfnn_jax.models.lagrangians.fit import ArcProblem, LawFit
from gfnn_jax.models.lagrangians.input_rules import InputModel
from gfnn_jax.models.lagrangians.search import (
    SearchResult,
    TermSearch,
    search,
    to_longest_arcs,
)
from gfnn_jax.models.lagrangians.starts import no_law
from gfnn_jax.models.lagrangians.structure import Key, Structure, with_powers
from gfnn_jax.models.lagrangians.weak_form import weak_start
from gfnn_jax.models.lagrangians.zeros import with_zeros_of_runs
from gfnn_jax.models.parameters import keeps_away


class Options:
    """Limits of the functions of parameters that are tried (`benchmarks/parameters.py`).

    largest, total: powers of one parameter, and of all of them: of the lengths of a double pendulum
    l₂²/l₁² is one. below: of a power, that a negative one counts more. steps: of Gauss and Newton.
    most: changes of a set.
    """

    largest: int = 2
    total: int = 4
    below: float = 0.5
    steps: int = 8
    most: int = 30


Function = tuple[int, ...]  # whole powers of the parameters
Sets = tuple[tuple[Function, ...], ...]  # the functions of each coefficient


class GroupEstimate(NamedTuple):
    """Findings from the runs of one value args (k,) of the parameters: coefficients p (n,), and the
    triangle (n, n) of their information, residuals in units of their scatter."""

    args: np.ndarray
    p: np.ndarray
    triangle: np.ndarray


class Dependent(NamedTuple):
    """A structure whose coefficients depend on parameters, where to start from, and how much larger
    the score of coefficients is that do not."""

    structure: Structure
    known: dict[Key, float]
    gain: float


def search_of_systems(problem: ArcProblem) -> SearchResult | None:
    """The law of runs that differ in parameters; None where no coefficient depends on them."""
    groups, nodes = _of_one_value(problem), problem.nodes
    rule = _first_law(problem, groups)
    structure = rule.fit.structure
    if len(structure.uncoupled) > 1:
        parts = "; ".join(
            ", ".join(problem.observation.coordinates[i] for i in part)
            for part in structure.uncoupled
        )
        raise FitError(
            f"nothing couples {parts}: where runs differ in a parameter, expected the positions of "
            "one of these (--positions)"
        )
    inputs = ArcInputs(nodes, problem.scales.substeps, rule.hold, rule.delay)
    problem = dataclasses.replace(problem, inputs=inputs, rules=(rule.hold,))
    fits, followed = [], list(nodes)
    for places in groups:
        fit = _fitted(problem, places, structure)
        if fit is not None:
            fits.append(fit)
            for i, node in zip(places, fit.problem.nodes, strict=True):
                followed[i] = node
    if len(fits) < 2:
        return None
    values = [seen(fit, fit.problem.nodes[0].stretch.args) for fit in fits]
    found = dependence(structure, _inertia(structure, problem.gauge), values)
    if found.structure == structure:
        problem.on_progress(f"no coefficient depends on {', '.join(problem.parameters)}")
        return None
    problem = dataclasses.replace(problem, nodes=followed)
    sigma = np.median([fit.sigma for fit in fits], axis=0)
    arcs = problem.arcs(problem.options.periods[-1])
    fit = problem.fit(found.structure, found.known, arcs, sigma)
    problem.on_progress(f"depending on {', '.join(problem.parameters)}: {fit}")
    fit = with_zeros_of_runs(fit)
    mean = np.mean([one.p for one in values], axis=0).tolist()
    alike = fit.cross_validate(structure, dict(zip(structure.keys(), mean, strict=True)))
    apart = Comparison.of(fit.cross_validate(), alike)
    problem.on_progress(f"  cost of held-out arcs {apart.other:.5g} → {apart.cost:.5g}")
    if not apart.is_lower(problem.options.evidence.gain):
        return None
    every = TermSearch.of(problem).every
    assert every is not None  # terms are searched
    every = _depending(every, fit.structure, (0,) * len(problem.parameters))
    return TermSearch(every, every.friction).finished(fit)


def _depending(every: Structure, found: Structure, none: Function) -> Structure:
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


def _of_one_value(problem: ArcProblem) -> list[list[int]]:
    """Places of the nodes of each value of the parameters, most samples first."""
    groups: dict[tuple[float, ...], list[int]] = {}
    for i, node in enumerate(problem.nodes):
        groups.setdefault(tuple(node.stretch.args.tolist()), []).append(i)
    return sorted(groups.values(), key=lambda places: -sum(len(problem.nodes[i].t) for i in places))


def _first_law(problem: ArcProblem, groups: Sequence[Sequence[int]]) -> InputModel:
    """The law of the runs of one value, with the inputs as they act in it: of the value with most
    samples that has one."""
    for places in groups:
        some = [problem.nodes[i] for i in places]
        own = dataclasses.replace(problem, nodes=some, parameters=(), gauge=None, inputs=None)
        try:
            found = search(own)
        except FitError:
            continue
        if found.fit.follows:
            return found.model
    raise no_law(problem.scales)


def _fitted(problem: ArcProblem, places: Sequence[int], structure: Structure) -> LawFit | None:
    """A structure fitted to the nodes at these places; None where it cannot be."""
    some = [problem.nodes[i] for i in places]
    inputs = ArcInputs(some, problem.scales.substeps, problem.inputs.hold, problem.inputs.delay)
    own = dataclasses.replace(problem, nodes=some, parameters=(), inputs=inputs)
    try:
        known = weak_start(dataclasses.replace(structure, zeros=()), own, prune=False)[1]
    except FitError:
        return None
    first, *longer = own.options.periods
    fit = to_longest_arcs(own.fit(structure, known, own.arcs(first), own.scales.sigma), longer)
    return fit if fit.follows else None


def _inertia(structure: Structure, gauge: np.ndarray) -> np.ndarray:
    """(P,) each term's part in the mean of M₁₁, for a coefficient of 1."""
    form = structure.form(gauge)
    return np.concatenate([[1.0], -form.basis[0]]) / form.fixed[0]


def functions_tried(args: np.ndarray) -> list[Function]:
    """Powers of parameters args (n, k), the plainest first: negative ones where a parameter keeps
    away from 0."""
    most = Options.largest
    ranges = [range(-most if keeps_away(a) else 0, most + 1) for a in args.T]
    found = [powers for powers in product(*ranges) if sum(map(abs, powers)) <= Options.total]
    return sorted(found, key=_size_of)


def _size_of(function: Function) -> float:
    """The size of the powers: that of the plainest function is 0."""
    return sum(abs(n) + Options.below * (n < 0) for n in function)


def seen(fit: LawFit, args: np.ndarray) -> GroupEstimate:
    """Take them from a fit to the runs of one value."""
    return GroupEstimate(args, fit.p, fit.fitted.triangle / np.sqrt(fit.correlation))


def dependence(
    structure: Structure, inertia: np.ndarray, values: Sequence[GroupEstimate]
) -> Dependent:
    """The functions of the parameters that these values show. inertia (P,): each term's part in
    M₁₁, for a coefficient of 1."""
    every = functions_tried(np.stack([one.args for one in values]))
    problem = _Problem(structure, inertia, tuple(values), tuple(every))
    none = every[0]
    plain = problem.solved(((none,),) * problem.count)
    of_inertia = [(none,), *((none, powers) for powers in every[1:])]
    if structure.num_inputs:  # whose gains tell the scale of L in every run
        of_inertia += [(powers,) for powers in every[1:]]
    found = min((problem.descended(first) for first in of_inertia), key=lambda one: one.score)
    return problem.dependent(found, plain.score - found.score)


class _Solved(NamedTuple):
    """Sets with their coefficients x, in the order of the sets, and their score."""

    sets: Sets
    x: np.ndarray
    score: float


@dataclasses.dataclass(frozen=True, eq=False)
class _Problem:
    """Comparison of sets of functions for the terms and frictions of a structure."""

    structure: Structure
    inertia: np.ndarray
    values: tuple[GroupEstimate, ...]
    every: tuple[Function, ...]

    @property
    def rows(self) -> tuple[Any, ...]:
        return (*self.structure.terms, *self.structure.friction)

    @property
    def count(self) -> int:
        """The coefficients that may depend on parameters: those of terms and of friction."""
        return len(self.rows)

    def tables(self, sets: Sets) -> tuple[np.ndarray, np.ndarray]:
        """Functions (V, K) at the values, in units of their mean size, and the row of each (K,)."""
        args = np.stack([one.args for one in self.values])
        powers = tuple(function for functions in sets for function in functions)
        found = functions_of(powers, args)
        home = np.repeat(np.arange(len(sets)), [len(functions) for functions in sets])
        return found / np.mean(np.abs(found), axis=0), home

    def solved(self, sets: Sets) -> _Solved:
        """The coefficients of these sets, and their score."""
        table, home = self.tables(sets)
        terms, count = len(self.structure.terms), self.count
        rate = np.array([row[1] == UNIFORM for row in self.structure.friction], dtype=bool)
        scaled = np.concatenate([np.ones(terms, bool), ~rate])
        further = len(self.values[0].p) - (count - 1)  # gains, zeros, sensors
        gains = self.structure.dim * self.structure.num_inputs
        x = self._begun(home)
        open_ = np.arange(1, len(x))  # the first function of M₁₁ has a given coefficient
        turn = np.zeros((len(self.values), count + further, len(x)))
        for k, row in enumerate(home):
            turn[:, row, k] = table[:, k]
        turn[:, range(count, count + further), range(len(home), len(x))] = 1.0
        by_inertia = self.inertia @ turn[:, :terms]  # (V, n)
        scaled = np.concatenate([scaled, np.arange(further) < gains])
        R = np.stack([one.triangle for one in self.values])
        p = np.stack([one.p for one in self.values])
        cost, best = np.inf, x
        for _ in range(Options.steps):
            with np.errstate(all="ignore"):  # of no inertia in some run
                shares = np.where(scaled, 1 / (by_inertia @ x)[:, None], 1.0)
                own = (turn @ x) * shares
                off = np.einsum("vij,vj->vi", R, own[:, 1:] - p)
                now = float(np.sum(off**2))
            if not now < cost * (1 - 1e-6):
                break
            cost, best = now, x
            by = turn * shares[..., None]
            by -= (scaled * own * shares)[..., None] * by_inertia[:, None]
            J = np.einsum("vij,vjk->vik", R, by[:, 1:][..., open_]).reshape(-1, len(open_))
            size = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
            x = x.copy()
            x[open_] -= np.linalg.lstsq(J / size, off.ravel(), rcond=1e-10)[0] / size
        rare = sum(_size_of(function) for functions in sets for function in functions)
        return _Solved(sets, best, cost + EVIDENCE.significant**2 * len(open_) + rare)

    def _begun(self, home: np.ndarray) -> np.ndarray:
        """Coefficients to start from: the mean of the values."""
        mean = np.mean([one.p for one in self.values], axis=0)
        terms = len(self.structure.terms)
        first = (1 - self.inertia[1:] @ mean[: terms - 1]) / self.inertia[0]
        whole = np.concatenate([[first], mean])
        x = np.where(np.diff(home, prepend=-1) > 0, whole[home], 0.0)
        return np.concatenate([x, whole[self.count :]])

    def descended(self, first: tuple[Function, ...]) -> _Solved:
        """The sets of the lowest score that single changes lead to, M₁₁ with these functions."""
        none = self.every[0]
        here = self.solved((first, *((none,),) * (self.count - 1)))
        for _ in range(Options.most):
            best = min(
                map(self.solved, self._changed(here.sets)),
                key=lambda one: one.score,
                default=here,
            )
            if not best.score < here.score:
                break
            here = best
        return here

    def _changed(self, sets: Sets) -> Iterator[Sets]:
        """Sets with a function more, less, or in place of another; uniform friction has none."""
        for i, row in enumerate(self.rows):
            if i == 0 or (i >= len(self.structure.terms) and row[1] == UNIFORM):
                continue
            own = sets[i]
            others = [function for function in self.every if function not in own]
            further = [(*own, function) for function in others]
            for k in range(len(own)):
                rest = (*own[:k], *own[k + 1 :])
                further += [rest] if rest else []
                further += [(*rest, function) for function in others]
            for functions in further:
                yield (*sets[:i], functions, *sets[i + 1 :])

    def dependent(self, found: _Solved, gain: float) -> Dependent:
        """The structure of these sets, and its coefficients where the mean of M₁₁ over the values
        is 1."""
        args = np.stack([one.args for one in self.values])
        table, _ = self.tables(found.sets)
        terms, known, at = len(self.structure.terms), {}, 0
        mean = 0.0
        rows: list[list[Any]] = [[], []]
        for i, (row, functions) in enumerate(zip(self.rows, found.sets, strict=True)):
            kind = "term" if i < terms else "loss"
            for function in functions:
                size = float(np.mean(np.abs(functions_of((function,), args))))
                own = with_powers(row, function)
                rows[i >= terms].append(own)
                known[kind, own] = found.x[at] / size
                mean += self.inertia[i] * found.x[at] * np.mean(table[:, at]) if i < terms else 0.0
                at += 1
        structure = dataclasses.replace(
            self.structure, terms=tuple(rows[0]), friction=tuple(rows[1])
        )
        known |= dict(zip(self.structure.keys()[self.count - 1 :], found.x[at:], strict=True))
        known = {k: float(x if _has_no_scale(k) else x / mean) for k, x in known.items()}
        return Dependent(structure, known, gain)


def _has_no_scale(key: Key) -> bool:
    """Return whether a coefficient stays where L is multiplied by a number."""
    return key[0] in ("zero", "sensor") or (key[0] == "loss" and key[1][1] == UNIFORM)


def with_functions(rows: Sequence[Any], functions: Sequence[Function]) -> tuple[Any, ...]:
    """Each row with each of the functions, the rows as they are first."""
    return tuple(dict.fromkeys(with_powers(row, f) for f in functions for row in rows))


def functions_in(rows: Sequence[Any], none: Function) -> tuple[Function, ...]:
    """The functions of parameters that rows have, none first."""
    found = {row[-1] for row in rows if isinstance(row[-1], tuple)}
    return (none, *sorted(found - {none}))
