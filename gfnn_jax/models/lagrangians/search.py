"""The search for a law: a linear start, arcs of growing length, terms dropped and added.

Half a period, one, two and four periods: short arcs find the law from afar, long ones tell small
forces. At each length terms that are not seen at four standard errors are dropped, and of those
that the law lacks the one with the largest score is tried; it stays where arcs that the fit has
not seen gain. Which friction there is, held-out arcs say in the end. Where terms are given they are
all that is fitted.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from gfnn_jax.dataset.stretches import arcs_of
from gfnn_jax.errors import FitError, InputError
from gfnn_jax.families.friction import (
    DRY,
    ISOTROPIC,
    LINEAR,
    LOADED,
    PLACED,
    STRIBECK,
    UNIFORM,
    kind_of,
)
from gfnn_jax.families.lagrangian import has_inputs, shape_of
from gfnn_jax.fitting.evidence import EVIDENCE, Comparison, criterion, improved
from gfnn_jax.models.lagrangians import libraries
from gfnn_jax.models.lagrangians.exchange import may_be_chosen, with_exchanges
from gfnn_jax.models.lagrangians.fine_steps import with_fine_steps
from gfnn_jax.models.lagrangians.fit import ArcProblem, LawFit
from gfnn_jax.models.lagrangians.friction_choice import (
    FrictionChoice,
    chosen,
    is_coupled,
    kinds_of,
    plainness,
    table_of,
)
from gfnn_jax.models.lagrangians.given_terms import Given
from gfnn_jax.models.lagrangians.input_rules import InputModel, choose_rule, with_delay
from gfnn_jax.models.lagrangians.rivals import (
    as_it_fades,
    fades,
    with_a_shape,
    with_constant,
    with_fading,
    with_likeliest_power,
    with_viscous_as_it_fades,
)
from gfnn_jax.models.lagrangians.starts import OPTIONS, best_start, leading, misfit
from gfnn_jax.models.lagrangians.structure import (
    AS_EQUAL,
    AT_BOUND,
    Held,
    Key,
    Loss,
    Row,
    Structure,
    is_constant,
)
from gfnn_jax.models.lagrangians.weak_form import promising, protected, weak_start
from gfnn_jax.models.lagrangians.zeros import with_zeros_of_runs


class SearchResult(NamedTuple):
    """Findings of a search: the fit to the longest arcs with the inputs as they act, which friction
    and how sure that is; the same of shorter arcs, where these tell the coefficients better; and a
    message where the search ended before its end."""

    model: InputModel
    choice: FrictionChoice
    shorter: SearchResult | None = None
    ended: str = ""

    @property
    def fit(self) -> LawFit:
        return self.model.fit

    @property
    def follows(self) -> bool:
        """Return whether orbits of the law follow all arcs."""
        return self.fit.is_definite and self.fit.follows


def search(problem: ArcProblem) -> SearchResult:
    """The law of a problem, by the best of its rules between samples of the inputs."""
    terms = TermSearch.of(problem)  # which refuses friction that cannot be
    fit = best_start(problem)
    if len(fit.structure.uncoupled) > 1:  # what couples them is seen best along short arcs
        fit = terms.grow(fit)
    return terms.along(fit, problem.options.periods[1:])


def search_on(model: InputModel) -> SearchResult:
    """The law that a search comes to from one that was found, with its inputs as they are found to
    act and arcs of a period."""
    problem = model.fit.problem
    problem.on_progress(f"arcs of 1 period: {model.fit}")
    longer = [periods for periods in problem.options.periods if periods > 1]
    return TermSearch.of(problem).along(model.fit, longer)


def fit_given(given: Given, scale: float, problem: ArcProblem) -> SearchResult:
    """Fit exactly the terms that are given, with what is told of their coefficients, those of L
    ÷ ``scale``. Where systems differ in parameters, terms may be multiplied by these.

    A coefficient that a fit puts beyond its bound is held there, and the others are fitted again.
    """
    d, options = problem.dim, problem.options
    linear = tuple(libraries.losses(d, (LINEAR,), 0.0)[:d])
    if given.friction is not None:
        problem = dataclasses.replace(problem, options=dataclasses.replace(options, frictions=()))
    friction = linear if given.friction is None else given.friction
    whole = Structure(d, given.terms, friction, (), problem.num_inputs, problem.sensors)
    held, bounds = told_in(given, whole, scale)
    whole = dataclasses.replace(whole, held=held)
    plain = all(row[3] == 0 for row in given.terms)  # a sine or a phase says where zero is
    zeros = whole.with_a_zero(problem.turned) if plain else ()
    (first, *longer), models = options.periods, []
    for leaders in ((), *leading(problem)):
        try:
            own, known = weak_start(dataclasses.replace(whole, leaders=leaders), problem, False)
        except FitError:
            if leaders:
                continue
            raise
        structure = own.plus([("zero", i) for i in zeros])
        model = choose_rule(problem, structure, known, problem.arcs(first), problem.scales.sigma)
        problem.on_progress(f"arcs of {first:g} periods: {model.fit}")
        models.append(model)
        if misfit(model.fit) < OPTIONS.noise:
            break
    least = min(misfit(model.fit) for model in models)
    model = next(m for m in models if misfit(m.fit) <= OPTIONS.plain * least)
    if model.fit.undetermined:
        p = model.fit.linearised.shortest()
        known = dict(zip(model.fit.structure.keys(), p.tolist(), strict=True))
        model = model._replace(fit=model.fit.again(known=known, rescale=False))
    tried = frictions_tried(problem) if given.friction is None else None
    terms, fit = TermSearch(None, tried), model.fit
    found = terms.along(fit, longer)
    for _ in bounds:
        beyond = passed(found.fit, bounds)
        if not beyond:
            break
        held = (*held, *beyond)
        for one in beyond:
            word = problem.word(("term", one.row))
            problem.on_progress(f"  {word}: held at its bound {scale * one.value:g}")
        found = terms.along(fit.again(dataclasses.replace(fit.structure, held=held)), longer)
    return found


def told_in(
    given: Given, structure: Structure, scale: float
) -> tuple[tuple[Held, ...], dict[Row, tuple[float, float]]]:
    """The coefficients that are held from the start, and the bounds of others, in the gauge of the
    structure. Raises InputError for one that sets the scale of L."""
    held, bounds = [], {}
    for row, low, high, of in given.told:
        if row in [structure.terms[k] for k in structure.given]:
            if of is None and low <= 0.5 * scale <= high and is_constant(row):
                continue
            raise InputError(
                "terms: the coefficient of the first term in v**2 sets the scale of L, and is ½ of "
                "the mass: give the mass instead (--mass)"
            )
        if of is not None:
            if of in [structure.terms[k] for k in structure.given]:
                raise InputError(
                    "terms: a multiple of v**2, whose coefficient is known: give a value"
                )
            held.append(Held(row, low, of))
        elif low == high:
            held.append(Held(row, low / scale))
        else:
            bounds[row] = low / scale, high / scale
    return tuple(held), bounds


def passed(fit: LawFit, bounds: Mapping[Row, tuple[float, float]]) -> list[Held]:
    """The bounds at which coefficients of a fit that is beyond some of them end, by least squares
    close to the fit."""
    keys, p = fit.structure.keys(), fit.p
    ends = np.array([bounds.get(k[1], (-np.inf, np.inf)) for k in keys]).reshape(-1, 2).T
    if np.all((p >= ends[0]) & (p <= ends[1])):
        return []
    near = fit.linearised
    size = np.maximum(np.linalg.norm(near.columns, axis=0), 1e-300)
    low, high = (ends - p) * size
    change = lsq_linear(near.columns / size, near.residual, (low, high)).active_mask
    out = (p < ends[0]) | (p > ends[1])
    side = np.where(change != 0, change, np.where(out, np.sign(p - ends[1]), 0))
    return [
        Held(keys[k][1], float(ends[int(side[k] > 0)][k]), None, AT_BOUND)
        for k in np.flatnonzero(side)
    ]


def to_longer_arcs(fit: LawFit, length: int) -> LawFit | None:
    """The same structure fitted to arcs of this length (nodes); None where no run is longer, or
    where no orbit of the law follows one of them."""
    arcs = arcs_of(fit.problem.nodes, length)
    if arcs.t.shape == fit.arcs.t.shape:
        return None
    longer = fit.in_arcs(length)
    return longer if longer.follows else None


def to_longest_arcs(fit: LawFit, lengths: Sequence[float]) -> LawFit:
    """The same structure fitted to arcs of these lengths, in periods, in turn, as far as its orbits
    follow them."""
    for periods in lengths:
        longer = to_longer_arcs(fit, fit.problem.length(periods))
        if longer is None:
            break
        fit = longer
    return fit


@dataclasses.dataclass(frozen=True)
class TermSearch:
    """Search among terms and frictions, by one rule of evidence (`fitting.evidence`).

    every: all terms that a law may come to; None: its terms are given. frictions: all that it may
    come to; None: they are given.
    """

    every: Structure | None
    frictions: tuple[Loss, ...] | None

    @classmethod
    def of(cls, problem: ArcProblem) -> TermSearch:
        """The search among all that the coordinates of a problem may have."""
        d, shifted = problem.dim, problem.observation.shifts()
        of = libraries.textbook if problem.observation.crossed else libraries.every
        rows = [*of(d, problem.angles), *libraries.springs_between(d, problem.within_a_turn)]
        terms, frictions = (
            libraries.without_forces(rows, shifted),
            frictions_tried(problem),
        )
        inputs, sensors = problem.num_inputs, problem.sensors
        rubs = tuple(row for row in frictions if row[1] < LOADED)
        return cls(Structure(d, terms, rubs, problem.turned, inputs, sensors), frictions)

    def every_beside(self, fit: LawFit) -> Structure:
        """All terms that the law of a fit may come to: of angles of which it has powers, springs
        too, that harden or soften, and torques on angles."""
        assert self.every is not None
        d, within = self.every.dim, fit.problem.within_a_turn
        sprung = [i for i in within if fit.structure.has_powers(i)]
        rows = libraries.springs(d, sprung)
        rows += [row for i in sprung for row in libraries.potentials(d, [i], 4)]
        rows += libraries.torques(d, fit.problem.angles)
        rows += libraries.driven(d, fit.problem.angles, fit.problem.num_inputs, False)
        rubs = self.every.friction
        if self.frictions is not None:
            rubs = (*self._may_rub(fit), *libraries.between(fit.structure.friction))
        every = dataclasses.replace(self.every, friction=rubs)
        return every.plus([("term", row) for row in rows])

    # From a fit to the law.

    def along(self, fit: LawFit, lengths: Sequence[float]) -> SearchResult:
        """The law that a fit comes to by arcs of these lengths, in periods: by the longest along
        which its friction leaves it an orbit."""
        reached = [fit]
        for periods in lengths:
            longer = to_longer_arcs(fit, fit.problem.length(periods))
            if longer is None:
                break
            fit = with_zeros_of_runs(longer)
            if periods == 1 and self.every is not None:
                fit = with_fine_steps(fit)
                fit = self.grow(fit, dataclasses.replace(self.every, terms=self.every.terms[:1]))
                fit = self.grow(self.prune(fit))
            fit.problem.on_progress(f"arcs of {periods:g} periods: {fit}")
            reached.append(fit)
        for fit in reversed(reached):
            found = self.finished(fit)
            if found.follows:
                break
        return found

    def finished(self, fit: LawFit) -> SearchResult:
        """The law of a fit to the longest arcs: by steps that are short enough, its friction
        chosen, terms dropped and added; and, where shorter arcs tell its coefficients better, that
        of these."""
        fit, choice = self.with_friction(with_fine_steps(fit))
        fit = with_zeros_of_runs(fit)
        found = self._settled(fit, choice)
        shorter = self.telling_more(fit) if found.follows else None
        if shorter is None:
            return found
        periods = shorter.arcs.t.shape[1] / fit.problem.scales.per_period
        fit.problem.on_progress(
            f"arcs of {periods:.2g} periods determine more than longer ones: {shorter}"
        )
        other = self._settled(*self.with_friction(shorter))
        is_law = other.follows and np.isfinite(other.fit.linearised.covariance).all()
        return found._replace(shorter=other) if is_law else found

    def _settled(self, fit: LawFit, choice: FrictionChoice) -> SearchResult:
        """The law by arcs as long as those of the fit: terms that they do not tell are dropped, and
        others tried; with the delay of its inputs."""
        if self.every is not None:
            before, terms = fit.structure, dataclasses.replace(self.every, friction=())
            fit = self.prune(with_likeliest_power(fit), friction=False)
            fit = self.prune(self.grow(fit, terms), friction=False)
            waves = fit
            fit = with_a_shape(fit)
            for angle in fit.problem.within_a_turn:
                fit = with_a_spring(fit, angle)
            fit = fit if fit is waves else with_constant(self.prune(fit, friction=False))
            if fit.structure != before:
                fit, choice = self.with_friction(fit)
                fit = with_constant(fit)
            if self.frictions is not None and not fit.problem.parameters:
                fit, choice = self._exchanged(fit, choice)
            fit = with_equal_masses(fit, fit.problem.options.evidence.significant)
        if {STRIBECK, PLACED} & {*choice.kinds} and self.frictions is not None:
            fit = with_fading(fit)
            choice = choice._replace(rows=fit.structure.friction)
        return SearchResult(with_delay(fit), choice)

    def _exchanged(self, fit: LawFit, choice: FrictionChoice) -> tuple[LawFit, FrictionChoice]:
        """The fit with other terms and friction where these are likelier, and the odds of these."""
        other = with_exchanges(fit, self.every_beside(fit))
        if other is fit:
            return fit, choice
        assert self.every is not None  # terms are searched
        terms = dataclasses.replace(self.every, friction=())
        other = self.prune(self.grow(other, terms), friction=False)
        rows = other.structure.friction
        table = table_of(other, list(dict.fromkeys((*self._may_rub(other), *rows))))
        return other, chosen(table, rows=rows)

    def telling_more(self, fit: LawFit) -> LawFit | None:
        """The fit to arcs of the length that tells the coefficients best, longer ones first as long
        as shorter ones tell more. None where the standard errors, in the geometric mean, are not
        much smaller than those of ``fit``: longer arcs are a longer lever, but where motion is
        chaotic, or forces unknown, their residuals grow faster."""
        if not len(fit.p):
            return None  # a driven mass: nothing of its law is free
        best, options = fit, fit.problem.options
        for size in sorted(map(fit.problem.length, options.periods), reverse=True):
            arcs = arcs_of(best.problem.nodes, size)
            if arcs.t.shape[1] >= best.arcs.t.shape[1]:
                continue
            other = best.again(arcs=arcs)
            if not other.linearised.sharpness < best.linearised.sharpness:
                break
            best = other
        sharper = options.sharper * best.linearised.sharpness < fit.linearised.sharpness
        return best if sharper else None

    # Terms.

    def prune(self, fit: LawFit, friction: bool = True) -> LawFit:
        """The fit without terms that are not seen, the least seen first, as long as held-out arcs
        do not lose; and, unless ``friction`` has been chosen, without that which would drive.
        First, of terms that the record determines only together, without one."""
        evidence = fit.problem.options.evidence
        kinds = {"term", "zero", "loss"} if friction else {"term", "zero"}

        def unseen(fit: LawFit) -> list[Key]:
            z, fixed = fit.significance, protected(fit.structure, others=True)
            weak = [k for k in z if k[0] in kinds and k not in fixed]
            return sorted((k for k in weak if z[k] < evidence.significant), key=lambda k: z[k])

        def without(fit: LawFit, key: Key) -> LawFit | None:
            z, smaller = fit.significance[key], fit.structure.without({key})
            less = fit.again(smaller)
            if not _leaves_little_more(less, fit):
                return None  # the others take no orbit to where they would make up for it
            if fit.fitted.converged and not less.fitted.converged:
                return None  # without it others are not determined
            doubtful = z > evidence.nothing or (key[0] == "loss" and z >= 0)
            if doubtful and Comparison.of(fit.costs, fit.cross_validate(smaller)).is_lower(
                evidence.gain
            ):
                return None
            _dropped(fit, key, f"{z:.1f} standard errors")
            return less

        fit = with_equal_masses(without_degeneracies(fit))
        return without_first_mass(improved(fit, unseen, without))

    def grow(self, fit: LawFit, every: Structure | None = None) -> LawFit:
        """The fit with terms (of ``every``) that the residuals ask for, each kept where held-out
        arcs gain."""
        every = every or self.every
        assert every is not None  # terms are searched
        every = dataclasses.replace(every, leaders=fit.structure.leaders)
        if any(map(has_inputs, fit.structure.terms)):
            problem, d = fit.problem, every.dim
            more = libraries.driven(d, problem.angles, problem.num_inputs, problem.squares)
            every = every.plus([("term", row) for row in more])
        every, scores = promising(fit, every), dict[Key, float]()
        options, problem = fit.problem.options, fit.problem

        def asked_for(fit: LawFit) -> list[Key]:
            scores.clear()
            scores.update(fit.scores(every))
            high = (k for k in scores if scores[k] > options.evidence.scored)
            return sorted(filter(fit.structure.may_have, high), key=lambda k: -scores[k])

        def with_term(fit: LawFit, key: Key) -> LawFit | None:
            larger = fit.structure.plus([key])
            apart = Comparison.of(fit.cross_validate(larger), fit.costs)
            kept = apart.is_lower(options.evidence.gain)
            problem.on_progress(
                f"  {'added' if kept else 'refused'} {problem.word(key)}: "
                f"{scores[key]:.1f} standard errors, cost of held-out arcs {apart.other:.5g} → "
                f"{apart.cost:.5g}"
            )
            return fit.again(larger) if kept else None

        return improved(fit, asked_for, with_term, options.tries)

    # Friction.

    def _may_rub(self, fit: LawFit) -> list[Loss]:
        """Friction that the law of a fit may have; Stribeck's as it has it, and by a load where it
        has dry friction."""
        found = {STRIBECK, PLACED}  # with a number inside that a fit tells
        rows = [as_it_fades(r, fit) if r[1] in found else r for r in self.frictions or ()]
        dry = np.any(fit.form.friction.dry) or not fit.problem.options.choose_friction
        rows = [row for row in rows if row[1] < LOADED or dry]
        return [row for row in rows if fit.structure.may_have(("loss", row))]

    def with_friction(self, fit: LawFit) -> tuple[LawFit, FrictionChoice]:
        """The fit with the friction that held-out arcs choose, and how sure that is. Arcs are as
        long as those of the fit, or as long as three of them can be. A choice holds close to its
        fit, so that it is made again until it stands; where none has stood when the third is looked
        at, the likeliest of these fits is taken. Longer arcs of the fit then see more
        (`_with_more_along`)."""
        if self.frictions is None:
            return fit, FrictionChoice(fit.structure.friction, {}, {}, gains=False)
        problem, options, begun = fit.problem, fit.problem.options, fit
        fit = with_fading(fit)
        third = problem.systems.a_third(problem.nodes)
        length = max(options.fewest, min(fit.arcs.t.shape[1], third))
        arcs = arcs_of(problem.nodes, length)
        if arcs.t.shape != fit.arcs.t.shape:
            fit = fit.again(arcs=arcs)
        frictions = self._may_rub(fit)
        choice = chosen(table_of(fit, frictions), options.choose_friction)
        tried = [(fit, choice)]
        for _ in range(options.choices):
            rows = [problem.word(("loss", row)) for row in choice.rows]
            problem.on_progress(f"  friction: {', '.join(rows) or 'none'}")
            if set(choice.rows) == set(fit.structure.friction):
                break
            fit = with_fading(fit.again(dataclasses.replace(fit.structure, friction=choice.rows)))
            frictions = self._may_rub(fit)
            choice = chosen(table_of(fit, frictions), options.choose_friction, choice)
            tried.append((fit, choice))
        else:
            if options.choose_friction:
                fit, choice = likeliest(tried)
        if options.choose_friction:
            fit = with_viscous_as_it_fades(fit)
            frictions = self._may_rub(fit)
            fit = _with_more_beside_a_load(fit, frictions)
        rows = fit.structure.friction
        if set(choice.rows) != set(rows):
            choice = chosen(table_of(fit, frictions), options.choose_friction, rows=rows)
        along = without_drives(begun.again(fit.structure, fit.values))
        if options.choose_friction and length < along.arcs.t.shape[1]:
            whole = _with_more_along(along, frictions)
            if whole is not along:
                table = table_of(fit.again(whole.structure, whole.values), frictions)
                choice = chosen(table, rows=whole.structure.friction)._replace(odds={})
            along = whole
        return along, choice._replace(rows=along.structure.friction)


def _with_more_beside_a_load(fit: LawFit, frictions: Sequence[Loss]) -> LawFit:
    """The fit with the usual friction that stands beside that by a load, by odds that decide. The
    choice sees what changes close to its fit: without linear friction that by the load and dry
    friction make up for it, and what they miss, in which bodies stick at other times, no small
    coefficient mends."""
    along = {row[0] for row in fit.structure.friction if row[1] >= LOADED}
    usual = [row for row in frictions if row[0] in along and not kind_of(row[1]).rare]

    def likelier(here: LawFit, row: Loss) -> LawFit | None:
        other = here.again(here.structure.plus([("loss", row)]), rescale=False)
        gain = here.criterion() - other.criterion(here.independent)
        return other if other.follows and gain > 2 * np.log(EVIDENCE.decided) else None

    def missing(here: LawFit) -> list[Loss]:
        kinds = {row[1] for row in here.structure.friction}
        rows = [row for row in usual if row not in here.structure.friction]
        return [row for row in rows if libraries.together((*kinds, row[1]))]

    return improved(fit, missing, likelier)


def _with_more_along(fit: LawFit, frictions: Sequence[Loss]) -> LawFit:
    """The fit with the usual friction that its arcs show and thirds of the record do not, by odds
    that decide; of what is about as likely the plainest. What friction takes adds up, and each
    third of a short record begins with a state of its own."""
    evidence = fit.problem.options.evidence

    def likelier(here: LawFit) -> list[tuple[Loss, float, LawFit]]:
        kinds = {row[1] for row in here.structure.friction}
        usual = [row for row in frictions if not kind_of(row[1]).rare]
        rows = [row for row in usual if libraries.together((*kinds, row[1]))]
        z = here.scores(here.structure.plus([("loss", row) for row in rows]))
        least, found = np.log(here.independent) + evidence.deciding, []
        for key in (key for key in z if z[key] ** 2 > least):
            other = here.again(here.structure.plus([key]), rescale=False)
            gain = here.criterion() - other.criterion(here.independent)
            if may_be_chosen(other) and gain > evidence.deciding:
                found.append((key[1], gain, other))
        return found

    while fit.follows and (found := likelier(fit)):
        most = max(gain for _, gain, _ in found)
        tied = [one for one in found if one[1] > most - evidence.deciding]
        row, _, other = min(tied, key=lambda one: (is_coupled(one[0]), plainness([one[0][1]])))
        fit.problem.on_progress(f"  friction: {fit.problem.word(('loss', row))}, along whole arcs")
        fit = other.again()
    return fit


def with_a_spring(fit: LawFit, angle: int) -> LawFit:
    """The fit with a spring x² in place of several waves of one angle that stays within a turn,
    where held-out arcs do not lose: a series of cosines imitates what is not periodic."""
    d, structure = fit.problem.dim, fit.structure
    alone = tuple(int(i == angle) for i in range(d))
    waves = [
        row
        for row in structure.terms
        if not any(row[0] + row[1]) and not shape_of(row) and tuple(map(bool, row[2])) == alone
    ]
    if len(waves) < 2 or any(row[1][angle] for row in structure.terms):
        return fit
    none = (0,) * d
    spring = [("term", (none, tuple(n * k for k in alone), none, 0.0)) for n in (2, 1)]
    gone = {("term", row) for row in waves} | {("zero", angle)}
    plainer = structure.without(gone).plus(spring)
    apart = Comparison.of(fit.cross_validate(plainer), fit.costs)
    if not apart.cost <= apart.other * (1 + fit.problem.options.evidence.gain):
        return fit
    word = fit.problem.word(spring[0])
    fit.problem.on_progress(f"  {word} in place of {len(waves)} waves: held-out arcs do not lose")
    return fit.again(plainer)


def frictions_tried(problem: ArcProblem) -> tuple[Loss, ...]:
    """Friction of all the kinds that are asked for, in every direction; of many
    coordinates, where there is a choice, no rare kind, and of two speeds none of their
    sum."""
    dim, options = problem.dim, problem.options
    kinds = tuple(map(libraries.kind_named, options.frictions))
    if dim == 1 and len(kinds) > 1:  # linear friction is uniform there
        kinds = tuple(kind for kind in kinds if kind != UNIFORM)
    inputs, joints = problem.num_inputs, problem.joints
    rows = libraries.losses(dim, kinds, 0.0, problem.lengths, inputs, joints)
    rows = [(c, k, fades(c, problem)[-3]) if k == STRIBECK else (c, k, w) for c, k, w in rows]
    turning = {*problem.angles} - {*problem.within_a_turn}
    rows = [row for row in rows if row[1] != PLACED or not turning & {*np.flatnonzero(row[0])}]
    if not options.choose_friction and ISOTROPIC in kinds and ISOTROPIC not in kinds_of(rows):
        raise InputError(
            "isotropic friction is that of a plane or of space: expected two or three positions "
            f"that are no angles, got {len(problem.lengths)}. Give friction of each: quadratic"
        )
    if not options.choose_friction and STRIBECK in kinds and DRY not in kinds:
        raise InputError(
            "stribeck friction is a part of dry friction, which falls with speed: expected both, "
            f"got {'+'.join(options.frictions)}. Give them together: dry+stribeck"
        )
    if not options.choose_friction and LOADED in kinds and not problem.num_inputs:
        raise InputError(
            "load-dependent friction is in proportion to an input, the load: expected one, got "
            "none. Name its column: --inputs"
        )
    if dim > libraries.FEW and options.choose_friction:
        return tuple(row for row in rows if not kind_of(row[1]).rare)
    turned = [one for one in map(libraries.opposite, rows) if one is not None]
    return tuple(sorted((*rows, *turned), key=lambda row: row[1] == UNIFORM))


def without_degeneracies(fit: LawFit) -> LawFit:
    """The fit without the first term, kinetic ones before others, of each combination that moves
    nothing; which costs nothing. Masses that couple two coordinates give way to a spring that
    does as well."""
    fixed, terms = protected(fit.structure), fit.structure.terms
    for row in terms:
        spring = ((0,) * len(row[0]), row[0], *row[2:])
        couples = max(row[0]) == 1 and is_constant(row)
        if couples and spring not in fit.structure.terms:
            with_it = fit.again(fit.structure.plus([("term", spring)]), rescale=False)
            fit = with_it if with_it.degenerate() else fit

    def combined(fit: LawFit) -> list[Key]:
        return [key for key in fit.degenerate() if key[0] == "term" and key not in fixed]

    def without(fit: LawFit, gone: Key) -> LawFit | None:
        step, values = fit.degenerate(), fit.values
        along = values[gone] / step[gone]
        moved = {key: value - along * step.get(key, 0.0) for key, value in values.items()}
        less = fit.again(fit.structure.without({gone}), moved, rescale=False)
        if less.fitted.cost > fit.problem.options.as_well * fit.fitted.cost:
            return None  # its zero is out of reach
        others = ", ".join(fit.problem.word(key) for key in combined(fit) if key != gone)
        _dropped(fit, gone, f"determined only together with {others}")
        return less

    return improved(fit, combined, without)


def _leaves_little_more(less: LawFit, fit: LawFit) -> bool:
    """Return whether a fit of fewer coefficients leaves little more than one, along orbits."""
    if not less.follows:  # residuals of states that are no orbit tell nothing
        return False
    rise = np.max(np.log(np.maximum(less.rms(), 1e-300) / np.maximum(fit.rms(), 1e-300)))
    return bool(fit.independent * rise < fit.problem.options.evidence.significant**2)


def with_equal_masses(fit: LawFit, least: float = np.inf) -> LawFit:
    """The fit with the masses of lengths that stand less than ``least`` standard errors from zero
    held at that of the first, where that leaves little more, and with the others free: bodies that
    little couples, or that swing together, move alike whatever the ratio of their masses. Where M
    has products of velocities too, linear motion leaves their coefficients and the masses open
    together: the fit without products, of free masses, comes first."""
    if fit.problem.angles or fit.problem.parameters or not fit.follows:
        return fit
    free = dataclasses.replace(fit.structure, held=())
    free = fit.again(free, fit.values) if fit.structure.held else fit
    if not (free.follows and free.is_definite):
        free = fit
    z, masses = free.significance, protected(free.structure)
    held = tuple(Held(k[1], 0.5, None, AS_EQUAL) for k in z if k in masses and z[k] < least)
    if not held or (free.is_definite and _far_from(free, held)):
        return free
    across = {
        ("term", row) for row in free.structure.terms if max(row[0]) == 1 and is_constant(row)
    }
    if across:
        apart = free.structure.without(across)
        known = free.values_within(apart)
        with contextlib.suppress(FitError):  # M of the fit may be far from one without them
            known = weak_start(apart, free.problem, prune=False)[1]
        apart = free.again(apart, known)
        if apart.is_definite and _leaves_little_more(apart, free):
            return apart
    equal = free.again(dataclasses.replace(free.structure, held=held))
    stands = _leaves_little_more(equal, free)
    stands |= equal.follows and equal.loudest < OPTIONS.noise and not free.is_definite
    return equal if stands else free


def _far_from(fit: LawFit, held: Sequence[Held]) -> bool:
    """Return whether coefficients that are held there would leave some times as much, by the
    residuals close to the fit."""
    places = [fit.structure.keys().index(("term", one.row)) for one in held]
    apart = np.array([one.value for one in held]) - fit.p[places]
    rise = apart @ np.linalg.lstsq(fit.linearised.covariance[np.ix_(places, places)], apart)[0]
    return bool(1 + rise / fit.independent > OPTIONS.noise**2)


def without_first_mass(fit: LawFit) -> LawFit:
    """The fit without the constant mass of the first coordinate where one that depends on position
    does by itself, as of an angle about a center: likelier by Schwarz's criterion."""
    first, *rest = fit.structure.terms
    others = [row for row in rest if row[0] == first[0]]
    if not (is_constant(first) and others) or fit.problem.parameters:
        return fit
    terms = (others[0], *(row for row in rest if row != others[0]))
    other = fit.again(dataclasses.replace(fit.structure, terms=terms), fit.values, rescale=False)
    likelier = other.criterion(fit.independent) < fit.criterion()
    if not (other.follows and other.is_definite and likelier):
        return fit
    _dropped(fit, ("term", first), "it is not significant")
    return other


def without_drives(fit: LawFit) -> LawFit:
    """The fit without friction whose coefficient has fallen below zero, or of friction that nobody
    asked for to nothing, by other arcs than those that chose it, the farthest below first: friction
    does not drive."""
    options = fit.problem.options
    least = options.evidence.nothing if options.choose_friction else 0.0

    def driving(fit: LawFit) -> list[Key]:
        z = fit.significance if fit.follows else {}
        return sorted((k for k in z if k[0] == "loss" and z[k] < least), key=lambda k: z[k])

    def without(fit: LawFit, key: Key) -> LawFit:
        _dropped(fit, key, f"{fit.significance[key]:.1f} standard errors")
        return fit.again(fit.structure.without({key}))

    return improved(fit, driving, without)


def likeliest(
    tried: Sequence[tuple[LawFit, FrictionChoice]],
) -> tuple[LawFit, FrictionChoice]:
    """The likeliest of these fits whose friction does not drive, by Schwarz's criterion: what their
    residuals add up to, of which those that are correlated count once."""
    fits = [one for one in tried if may_be_chosen(one[0])] or tried[-1:]
    last = tried[-1][0]
    loss = last.problem.observation.loss

    def of(fit: LawFit) -> float:
        unit = last.fitted.sigma / fit.fitted.sigma
        cost = np.nansum(loss.of(fit.fitted.residuals / unit))
        return criterion(float(cost), last.independent, len(fit.p))

    return min(fits, key=lambda one: of(one[0]))


def _dropped(fit: LawFit, key: Key, why: str) -> None:
    fit.problem.on_progress(f"  dropped {fit.problem.word(key)}: {why}")
