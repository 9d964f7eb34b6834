"""Starts of a search for a law: libraries in turn, the weak form of each, and a fit to short arcs.

The textbook's library of the coordinates comes first, and a larger one beside it. Where none of
these follows the arcs, others are tried: zeros of angles that are far off, as of an encoder that
was switched on anywhere; coordinates that nothing couples, for the weak form makes the equation of
such a one as small as it likes; bodies in a potential of lengths.
"""

import contextlib
import dataclasses
from collections.abc import Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from gfnn_jax.dataset.stretches import Scales
from gfnn_jax.errors import FitError
from gfnn_jax.families.friction import DRY, ISOTROPIC, LINEAR, LOADED, QUADRATIC, STRIBECK
from gfnn_jax.fitting.evidence import criterion
from gfnn_jax.models.lagrangians import libraries
from gfnn_jax.models.lagrangians.fit import ArcProblem, LawFit
from gfnn_jax.models.lagrangians.input_rules import choose_rule
from gfnn_jax.models.lagrangians.nature import told_by_positions
from gfnn_jax.models.lagrangians.rivals import fades
from gfnn_jax.models.lagrangians.structure import Loss, Row, Structure, is_constant
from gfnn_jax.models.lagrangians.weak_form import (
    centre_of_forces,
    weak_share,
    weak_start,
    zeros_of_angles,
)


@dataclasses.dataclass(frozen=True)
class StartOptions:
    """Limits at which other starts are tried (`benchmarks/random_recordings.py`).

    followed, share: residual of a start, times the noise or of the variation, above which others
    are tried. far: zero of an angle, in radians, that a fit from 0 may not reach. few: samples a
    period, below which more of them are the remedy. plain: times the residual of the larger
    library, that a plainer one's may have. noise: residual, times the noise, that is no more;
    white: that lacks no term. light: share of the kinetic energy, that a coordinate may have which
    is only led by others, and perhaps coupled to none. exponents: of the distance, where a power of
    it begins; beside: up to which it is then found; rounded: up to which it is a half, or whole, or
    none.
    """

    followed: float = 10.0
    share: float = 0.2
    far: float = 0.3
    few: float = 8.0
    plain: float = 1.5
    noise: float = 2.0
    white: float = 1.1
    light: float = 1e-2
    exponents: tuple[float, ...] = (-3.0, -2.0, -1.0, -0.5, 0.5, 1.0, 1.5, 3.0, 4.0)
    beside: float = 0.6
    rounded: float = 0.1


OPTIONS = StartOptions()


def no_law(scales: Scales) -> FitError:
    """Error where no law follows a recording of these scales."""
    few = (
        f"; sample more often: it has about {scales.samples:.1f} samples in a period"
        if scales.samples < OPTIONS.few
        else ""
    )
    return FitError(
        "no law of the terms tried follows this recording. Check units and roles (gfnn look); name "
        "a missing input or position (--inputs, --positions); cut off rest and collisions (--from, "
        f"--to); or give terms that you know (--terms){few}",
        verdict="no law: none of the terms tried follows this recording",
    )


class _Library(NamedTuple):
    """Terms of a start. rank: among libraries, the plainest first. apart: without friction between
    coordinates, which with masses below zero imitates a force at right angles to the motion. equal:
    with equal masses of all coordinates, for the weak form makes the equation of one as small as it
    likes. leaders: coordinates that drive the others and are not moved by them. rubs: a kind
    of friction of single coordinates, or of the plane, beside linear friction."""

    rows: Sequence[Row]
    rank: int = 0
    apart: bool = False
    equal: bool = False
    leaders: tuple[int, ...] = ()
    rubs: int | None = None


def best_start(problem: ArcProblem) -> LawFit:
    """The start that leaves least of short arcs, or of those that leave about as much one of the
    plainest library, by the best of the rules by which inputs act. Richer libraries are tried as
    long as what is left is more than noise.

    Raises FitError where there is none.
    """
    d, angles, some = problem.dim, problem.angles, _Starts(problem)
    textbook, first = _Library(libraries.textbook(d, angles)), libraries.first(d, angles)
    pulls = [*libraries.springs(d, problem.within_a_turn), *libraries.torques(d, angles)]
    every = libraries.every(d, angles)
    some.add(textbook)
    if problem.observation.swing is not None:  # whose sign a sensor may have wrong
        problem = dataclasses.replace(
            problem, nodes=[dataclasses.replace(n, x=-n.x) for n in problem.nodes]
        )
        other = _Starts(problem)
        other.add(textbook)
        some = min(some, other, key=lambda one: min(map(misfit, one.fits), default=np.inf))
    if problem.observation.crossed and some.fits:  # times of one event tell no more
        return some.fits[0]
    if any(not fit.is_definite for fit in some.fits):  # as products of speeds may make it
        apart = [row for row in textbook.rows if not _couples(row)]
        some.add(_Library(apart))
    many = d > libraries.FEW  # whose larger libraries take long
    if many:
        some.add(_Library(libraries.side_by_side(d, angles), equal=True))
        some.add_bodies(4)
    links = [_Library(libraries.relative(d, angles))] if 1 < d == len(angles) else []
    for library in [] if many and some.are_noise else links:
        some.add(library)
    if any(fit.least_share < OPTIONS.light for fit in some.fits):
        some.add(_Library(libraries.uncoupled(d, angles), apart=True))
    some.add_richer([*textbook.rows, *pulls], 1)
    some.add_richer(libraries.spun(d, angles), 1)
    if 0 < len(angles) < d and not some.are_noise:
        some.add(_Library(libraries.polar(d, angles), 1, apart=True, equal=True))
    if not (many and some.are_noise):
        some.add(_Library(first, 2))
    some.add_central(textbook.rows, 3, across=False)
    if 1 < len(problem.lengths) <= libraries.FEW:
        thrown = [row for row in libraries.uncoupled(d, angles) if sum(row[1]) < 2]
        some.add_rubbing(ISOTROPIC, [textbook, _Library(thrown, equal=True)])
        some.add_central(textbook.rows, 3, across=False, rubs=ISOTROPIC)
    for degree in (3, 4):
        some.add_bodies(degree)
    some.add_richer(libraries.on_a_surface(d, angles), 3)
    some.add_rubbing(DRY, [textbook, *links, _Library(first, 2)])
    some.add_rubbing(STRIBECK, [textbook, *links])
    if inputs := problem.num_inputs:
        some.add_rubbing(LOADED, [textbook])
        driven = libraries.driven(d, angles, inputs, problem.squares)
        some.add_richer([*textbook.rows, *driven], 3)
    fields = libraries.gyroscopic(d, angles, 1)
    some.add_richer([*first, *fields], 3)
    if 1 < d <= libraries.FEW and not angles:
        some.add_richer([*libraries.bodies(d, angles), *fields], 4)
    if not some.followed and (zero := some.far_zeros()).any():
        some.add(textbook, zero)
        some.add(_Library(first, 2), zero)
    if d > 1 and not some.followed:
        some.add(_Library(libraries.uncoupled(d, angles), apart=True))
        some.add(_Library(libraries.bodies(d, angles), 2, apart=True))
    some.add_central(textbook.rows, 4, across=True)
    some.add_richer(libraries.forces(d, angles), 5)
    some.add_richer(every, 6)
    # Coordinates that drive others and are not moved by them: a cart whose motor holds its course.
    led = _Library([*first, *libraries.couplings(d, angles)], 7, apart=True)
    for leaders in leading(some.problem):
        if not some.are_noise:
            some.add(led._replace(leaders=leaders))
    if not some.fits or (some.one_valued and not some.followed):
        raise no_law(problem.scales)
    taken = some.likeliest() if some.least < OPTIONS.white else some.plainest()
    return some.with_masses_apart(some.best_along(taken))


def misfit(fit: LawFit) -> float:
    """The largest residual of a channel, in units of its noise; infinite of what is no law."""
    return fit.loudest if fit.follows and fit.is_definite else np.inf


def _criteria(fits: Sequence[LawFit]) -> list[float]:
    """Schwarz's criterion of fits of the same arcs, by the residuals that the best leaves."""
    count = min(fits, key=misfit).independent
    return [criterion(misfit(fit) ** 2, count, len(fit.p)) for fit in fits]


def _couples(row: Row) -> bool:
    """Return whether a term is a constant mass that couples two coordinates."""
    return max(row[0]) == 1 and sum(row[0]) == 2 and is_constant(row)


def leading(problem: ArcProblem) -> list[tuple[int, ...]]:
    """Sets of coordinates that may drive the others without being moved by them: where there are
    inputs, as of a motor."""
    axes = range(problem.dim if problem.num_inputs else 0)
    return [some for n in axes[1:] for some in combinations(axes, n)]


def _is_of(fit: LawFit, structure: Structure) -> bool:
    """Return whether a fit has the terms and zeros of a structure, and its friction that no other
    start has."""
    parts = (
        (
            one.terms,
            one.zeros,
            one.leaders,
            *(r for r in one.friction if r[1] not in (LINEAR, QUADRATIC)),
        )
        for one in (fit.structure, structure)
    )
    return len(set(parts)) == 1


def _about(zero: np.ndarray, problem: ArcProblem) -> ArcProblem:
    """The problem whose coordinates are measured from there (d,)."""
    by = np.concatenate([zero, 0 * zero])
    nodes = [dataclasses.replace(n, x=n.x - by) for n in problem.nodes]
    return dataclasses.replace(problem, nodes=nodes)


class _Starts:
    """The starts so far, and the problem: after the first of the rule by which inputs act."""

    def __init__(self, problem: ArcProblem):
        self.problem, self.fits, self.ranks = problem, [], []
        kinds = (LINEAR, QUADRATIC) if problem.observation.crossed else (LINEAR,)
        self.linear = libraries.losses(problem.dim, kinds, 0.0, joints=problem.joints)
        self.always = self.linear if problem.observation.crossed else self.linear[: problem.dim]
        q, v = np.split(problem.states, 2, axis=1)
        self.one_valued = told_by_positions(q, v, problem.angles)

    def add(self, library: _Library, zero: np.ndarray | None = None) -> None:
        """Start from the terms of a library that the weak form shows, if it determines them.
        zero: (d,) of angles, or a centre of lengths, from which the fit begins."""
        problem = self.problem
        friction = self._friction(library)
        terms = libraries.without_forces(library.rows, problem.observation.shifts())
        seen = problem if zero is None else _about(zero, problem)
        whole = Structure(problem.dim, terms, friction, (), problem.num_inputs, problem.sensors)
        whole = dataclasses.replace(whole, leaders=library.leaders)
        try:
            structure, known = weak_start(whole, seen, equal=library.equal)
        except FitError:
            return
        zeros = structure.with_a_zero(problem.turned)
        structure, known = structure.with_sines_as_zeros(known, zeros)
        if zero is not None:
            zeros = (*zeros, *(i for i in problem.lengths if zero[i]))
            structure = structure.plus([("zero", i) for i in zeros])
        structure = structure.plus([("loss", row) for row in self.always])
        if zero is not None:
            known = known | {("zero", i): float(zero[i]) for i in zeros}
        new = zero is not None and problem.angles
        if not new and any(_is_of(other, structure) for other in self.fits):
            return
        periods = problem.options.periods[0]
        rule = choose_rule(problem, structure, known, seen.arcs(periods), problem.scales.sigma)
        inputs = rule.fit.problem.inputs
        if inputs is not problem.inputs:  # which act so in the other libraries too
            self.problem = dataclasses.replace(problem, inputs=inputs, rules=(rule.hold,))
        self.fits.append(rule.fit)
        self.ranks.append(library.rank)
        problem.on_progress(f"arcs of {periods:g} periods: {rule.fit}")

    def _friction(self, library: _Library) -> tuple[Loss, ...]:
        """Linear friction, and the kind of a library, by a load with dry friction, and so
        Stribeck's, as fast as the weak form prefers."""
        problem, d = self.problem, self.problem.dim
        if library.rubs is None:
            return tuple(self.linear[:d] if library.apart else self.linear)
        kinds = {LINEAR, library.rubs, *((DRY,) if library.rubs in (STRIBECK, LOADED) else ())}
        loads = problem.num_inputs
        rows = libraries.losses(d, tuple(sorted(kinds)), 0.0, problem.lengths, loads)
        rows = [row for row in rows if min(row[0]) >= 0]
        if library.rubs != STRIBECK:
            return tuple(rows)
        found = [
            tuple((c, k, fades(c, problem)[by] if k == STRIBECK else w) for c, k, w in rows)
            for by in range(len(fades(rows[0][0], problem)))
        ]
        terms = tuple(library.rows)
        return min(
            found,
            key=lambda some: weak_share(Structure(d, terms, some, (), problem.num_inputs), problem),
        )

    def add_richer(self, rows: Sequence[Row], rank: int) -> None:
        """Start from a richer library where the residuals of all starts are more than noise: of
        lengths with equal masses first. Not where positions tell the velocities: of what is of
        first order, or one orbit, many terms follow anything."""
        if self.one_valued:
            return
        plain = [row for row in rows if sum(row[0]) < 2 or (max(row[0]) == 2 and is_constant(row))]
        if not self.are_noise and not self.problem.angles:
            self.add(_Library(plain, rank, apart=True, equal=True))
        if not self.are_noise:
            self.add(_Library(rows, rank, apart=True))

    def add_bodies(self, degree: int, always: bool = False) -> None:
        """Start from equal masses in a potential of lengths up to a degree, where some start leaves
        more than noise: along a straight orbit masses are told only together with forces."""
        d = self.problem.dim
        if self.least < OPTIONS.white and not always:
            return
        if d > 1 and not (self.problem.angles or self.one_valued):
            of = libraries.bodies if d <= libraries.FEW else libraries.side_by_side
            self.add(_Library(of(d, (), degree), 2, apart=True, equal=True))

    def add_rubbing(self, kind: int, some: Sequence[_Library]) -> None:
        """Start from plain libraries beside a kind of friction where the residuals of all starts
        are more than noise: what stops a body, and holds it, many terms imitate, and the drag of a
        plane masses that differ, which leave nearly noise along a short flight."""
        d = self.problem.dim
        if d > 1 and kind == DRY and not self.problem.angles:
            some = [*some, _Library(libraries.bodies(d, (), 3), 2, apart=True, equal=True)]
        for library in some:
            least = OPTIONS.white if kind == ISOTROPIC else OPTIONS.noise
            if not self.least < least and not self.one_valued:
                self.add(library._replace(rubs=kind))

    def add_central(
        self, textbook: Sequence[Row], rank: int, across: bool, rubs: int | None = None
    ) -> None:
        """Start from a force along or across the line to the origin, or to the point that forces
        pass through, by a power of the distance, with equal masses, alone or beside the textbook's,
        where the residuals of all starts are more than noise: the likeliest, by Schwarz's
        criterion. Across, the power 0 is a uniform field. rubs: as of a library."""
        problem, d = self.problem, self.problem.dim
        if d == 1 or problem.angles or self.are_noise:
            return
        problem, zero = (problem, None) if across else self._about_centre()
        periods = sum(np.ptp(n.t) for n in problem.nodes) / problem.scales.period
        library = _Library((), rank, apart=True, equal=True, rubs=rubs)

        def rows(exponent: float, others: Sequence[Row]) -> list[Row]:
            if exponent == 2:
                return list(textbook)  # springs
            if abs(exponent) < OPTIONS.rounded:
                return [*others, *(libraries.gyroscopic(d, (), 1) if across else [])]
            along, *fields = libraries.central(d, exponent)
            return [*others, *(fields if across else [along])]

        def share(exponent: float, others: Sequence[Row]) -> float:
            terms, friction = tuple(rows(exponent, others)), self._friction(library)
            return weak_share(Structure(d, terms, friction, (), problem.num_inputs), problem)

        def unlikely(exponent: float, others: Sequence[Row]) -> float:
            return criterion(share(exponent, others), 2 * d * periods, len(others))

        def exponents(others: Sequence[Row]) -> tuple[float, float]:
            """The nearest half of a whole number, and what the weak form prefers."""
            best = min(OPTIONS.exponents, key=lambda e: share(e, others))
            ends = best - OPTIONS.beside, best + OPTIONS.beside
            found: Any = minimize_scalar(share, bounds=ends, method="bounded", args=(others,))
            return float(np.round(2 * found.x) / 2), float(f"{found.x:.4g}")

        masses = [row for row in textbook if any(row[0])]
        found = [(others, exponents(others)) for others in (masses, textbook)]
        if not self.one_valued:  # else many forces suit the orbit, and the plainest is taken
            found.sort(key=lambda one: unlikely(one[1][1], one[0]))
        tried: dict[tuple[int, float], float] = {}

        def attempt(exponent: float, others: Sequence[Row]) -> None:
            exponent = 0.0 if abs(exponent) < OPTIONS.rounded else exponent
            new = (exponent or across) and (len(others), exponent) not in tried
            if new and not self.are_noise:
                before = len(self.fits)
                self.add(library._replace(rows=rows(exponent, others)), zero)
                least = min(map(misfit, self.fits[before:]), default=np.inf)
                tried[len(others), exponent] = least

        for which in range(2):
            for others, of in found:
                attempt(of[which], others)
        for others, (a, b) in found:
            at_a, at_b = (tried.get((len(others), e), np.inf) for e in (a, b))
            if a == b or min(at_a, at_b) > self.least or not np.isfinite(max(at_a, at_b)):
                continue
            for sign in (-1, 1):  # misfits are proportional to the distance from the exponent
                best = (a * at_b + sign * b * at_a) / max(at_b + sign * at_a, 1e-300, key=abs)
                if abs(best - b) > OPTIONS.beside:
                    continue
                plain = float(np.round(2 * best) / 2)
                attempt(
                    plain if abs(best - plain) < OPTIONS.rounded else float(f"{best:.4g}"), others
                )

    def _about_centre(self) -> tuple[ArcProblem, np.ndarray | None]:
        """The problem with its coordinates from the centre of forces, and that centre (d,); as it
        is, and None, where that is the origin."""
        centre = centre_of_forces(self.problem)
        return (_about(centre, self.problem), centre) if centre.any() else (self.problem, None)

    def add_two_powers(self) -> None:
        """Start from equal masses and those two powers of the distance that the weak form
        prefers, as of a force that is nearly one of them."""
        problem, d = self.problem, self.problem.dim
        if d == 1 or problem.angles:
            return
        problem, zero = self._about_centre()
        masses = [row for row in libraries.textbook(d, ()) if any(row[0])]
        pairs = combinations(OPTIONS.exponents, 2)
        found = [[*masses, *(libraries.central(d, a)[0] for a in two)] for two in pairs]

        def share(rows: Sequence[Row]) -> float:
            friction = tuple(self.linear[:d])
            return weak_share(Structure(d, tuple(rows), friction, (), problem.num_inputs), problem)

        self.add(_Library(min(found, key=share), 4, apart=True, equal=True), zero)

    def plainest(self) -> LawFit:
        """The plainest of those that leave little more than the best; noise, where that does."""
        most = OPTIONS.plain * self.least
        if self.are_noise:
            most = min(most, OPTIONS.noise)
        ranked = zip(self.ranks, self.fits, strict=True)
        near = [(rank, misfit(fit), fit) for rank, fit in ranked if misfit(fit) <= most]
        return min(near, key=lambda one: one[:2])[2]

    def likeliest(self) -> LawFit:
        """The likeliest by Schwarz's criterion, which asks for residuals that are noise."""
        return self.fits[int(np.argmin(_criteria(self.fits)))]

    def best_along(self, taken: LawFit) -> LawFit:
        """The start that was taken, or of those that leave noise the one that is likelier by odds
        along longer arcs: noise hides along short ones what a law lacks. Where all of them lack
        something, bodies in a richer potential are tried too."""
        near = [fit for fit in self.fits if misfit(fit) < OPTIONS.noise]
        if taken not in near:
            return taken
        longer = self._along_longer(near)
        least = min(map(misfit, longer))
        if least > min(OPTIONS.white, OPTIONS.noise * self.least):
            count = len(self.fits)
            for degree in (3, 4):
                self.add_bodies(degree, always=True)
            self.add_two_powers()
            d, angles = self.problem.dim, self.problem.angles
            if d <= libraries.FEW and not self.one_valued:
                self.add(_Library(libraries.forces(d, angles), 5, apart=True, equal=not angles))
            if len(self.fits) > count:
                return self.best_along(taken)
        above = _criteria(longer)
        best = int(np.argmin(above))
        deciding = self.problem.options.evidence.deciding
        return near[best] if above[best] < above[near.index(taken)] - deciding else taken

    def with_masses_apart(self, taken: LawFit) -> LawFit:
        """The start that was taken, or where odds do not decide against it one whose constant
        masses couple no coordinates: linear motion has many masses, each with springs to suit, and
        chance would choose."""
        rows = taken.structure.terms
        apart = [row for row in rows if not _couples(row)]
        if len(apart) == len(rows) or taken.structure.leaders:
            return taken
        textbook = libraries.textbook(self.problem.dim, self.problem.angles)
        forces = [row for row in textbook if not any(row[0])]
        self.add(_Library(list(dict.fromkeys([*apart, *forces]))))
        followed = [fit for fit in self.fits if misfit(fit) < np.inf]
        others = [fit for fit in followed if not any(map(_couples, fit.structure.terms))]
        if not others:
            return taken
        other = others[int(np.argmin(_criteria(others)))]
        ours, theirs = _criteria(self._along_longer([taken, other]))
        return other if theirs < ours + self.problem.options.evidence.deciding else taken

    def _along_longer(self, fits: Sequence[LawFit]) -> Sequence[LawFit]:
        """The same laws by longer arcs, which show more of what they lack."""
        for periods in self.problem.options.periods[1:3]:
            fits = [fit.in_arcs(fit.problem.length(periods)) for fit in fits]
        return fits

    @property
    def least(self) -> float:
        """The least misfit of a start."""
        return min(map(misfit, self.fits), default=np.inf)

    @property
    def are_noise(self) -> bool:
        """Return whether the residuals of some start are."""
        return self.least < OPTIONS.noise

    @property
    def followed(self) -> bool:
        """Return whether some start follows its arcs."""
        y = np.concatenate([n.y - n.zero for n in self.problem.nodes])
        most = OPTIONS.share * np.nanstd(y, axis=0)
        return any(misfit(fit) < OPTIONS.followed and np.all(fit.rms() < most) for fit in self.fits)

    def far_zeros(self) -> np.ndarray:
        """Zeros (d,) of angles, by the weak form; 0 where none is far off, or none determined."""
        problem, zero = self.problem, np.zeros(self.problem.dim)
        rows = libraries.first(problem.dim, problem.angles)
        terms = libraries.without_forces(rows, problem.observation.shifts())
        with contextlib.suppress(FitError):
            found, turned = zeros_of_angles(terms, self.linear, problem), list(problem.turned)
            zero[turned] = found[turned]
        return zero if np.max(np.abs(zero)) > OPTIONS.far else 0 * zero
