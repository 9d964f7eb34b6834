"""A learned H: its flow, its formula, what the pairs tell of it; and how a fitted law becomes one:
with the cheapest steps, errors, covariance, messages.
"""

import dataclasses
import time
from collections.abc import Callable, Iterator
from functools import cached_property, partial
from typing import Any

import numpy as np

from gfnn_jax.budget import Budget
from gfnn_jax.candidates.assemble import Assembled, Candidate, composed, measured
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.exports.symbolic import as_latex, as_sympy
from gfnn_jax.families.sums import Sums, matrix_free
from gfnn_jax.families.terms import Terms
from gfnn_jax.families.told import Constrained
from gfnn_jax.fitting.evidence import Rival
from gfnn_jax.flows.collective import Collective
from gfnn_jax.flows.collocation import truncation
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.legendre import Legendre
from gfnn_jax.flows.rates import rates
from gfnn_jax.flows.uniform import without_forces
from gfnn_jax.models.hamiltonians.covariance import covariance_root
from gfnn_jax.models.hamiltonians.fitted_law import (
    Dropped,
    FittedLaw,
    Term,
    as_code,
    formula,
)
from gfnn_jax.models.hamiltonians.friction import (
    followed,
    is_smooth,
    kinds_of_friction,
    without_turns,
)
from gfnn_jax.models.hamiltonians.problem import (
    OPTIONS,
    LawProblem,
    contraction_of,
    omega_h_of,
    operations_of,
)
from gfnn_jax.models.hamiltonians.symmetries import symmetries_of
from gfnn_jax.models.lagrangians.friction_choice import WhichFriction, odds_text
from gfnn_jax.phase_space import apply_j


@dataclasses.dataclass(frozen=True)
class LearnedHamiltonian:
    """H as learned, in the inner coordinates.

    candidate: as the others of a fit, its error measured by steps in NumPy. flow: the piece.
    terms, shown: what H is, as people read it; () and None of a network. omega_h: the fastest
    oscillation of the linearised flow, times dt, in the median over the data; beyond π pairs of one
    dt may not tell H.
    null_terms: that the data do not tell from the others. left_out: pairs that the flow does not
    resolve. stalled: whether larger libraries were no more accurate. covariance: makes ``root``;
    None of a network. noise: (2d,) of the coordinates, arcs: into which sequences were cut, where
    whole ones were fitted. unmet: that the tolerance is missed, and what that may be from; "" where
    it is met. ended: what cut the search for it short, "" where nothing did. dropped: terms that
    went in the end. friction: γ where that is uniform, else the terms of Rayleigh's R; of a system
    without, (). constants: numbers inside terms that noisy sequences told, each with its term and
    its standard error. symmetries: that H has to roundoff. constrained: H in the coefficients that
    were fitted, where others are told. rivals: the next two laws that they allow. misfit: whether
    these sequences are certain that H lacks something.
    """

    candidate: Candidate
    flow: Flow
    terms: tuple[Term, ...]
    shown: str | None
    omega_h: float
    messages: tuple[str, ...] = ()
    null_terms: tuple[str, ...] = ()
    left_out: int = 0
    stalled: bool = False
    covariance: Callable[[], np.ndarray] | None = None
    noise: np.ndarray | None = None
    arcs: int = 0
    unmet: str = ""
    ended: str = ""
    dropped: Dropped | None = None
    friction: tuple[Term, ...] = ()
    constants: tuple[Term, ...] = ()
    symmetries: tuple[str, ...] = ()
    rivals: tuple[Rival, ...] = ()
    misfit: bool = False
    widths: tuple[float, ...] = ()
    turns: bool = False
    kinds: Callable[[], WhichFriction | None] | WhichFriction | None = None
    constrained: Constrained | None = None

    @cached_property
    def which_friction(self) -> WhichFriction | None:
        """The kinds of friction, their odds against others where all of them competed, and the
        largest coefficients that the pairs allow of those not seen. None of a network, of a law
        with parameters or of many sites, and where the pairs' flow fails. Computed when it is first
        asked for."""
        return self.kinds() if callable(self.kinds) else self.kinds

    @cached_property
    def root(self) -> np.ndarray | None:
        """(m, m): rootᵀ root is the coefficients' covariance; None of a network. Computed when it
        is first asked for."""
        return None if self.covariance is None else self.covariance()

    @property
    def formula(self) -> str | None:
        """H as ``terms`` and sympy read it: "0.5*p1**2 - cos(q1)" (`learn.formula.as_code`). None
        of a network; of a Lagrangian, which is no expression in q and p, as it is shown."""
        family = without_forces(self.flow.family)
        family = family.family if isinstance(family, Collective) else family
        return as_code(family, self.terms) if isinstance(family, Terms | Sums) else self.shown

    def __str__(self) -> str:
        """H as people read it: "0.5 p1² - cos(q1)"."""
        return self.shown or "a network"

    def __repr__(self) -> str:
        return f"LearnedHamiltonian({self})"

    def sympy(self) -> Any:
        """H as a sympy expression. Raises ValueError of a network and a Lagrangian."""
        return as_sympy(self._expression)

    def latex(self) -> str:
        """H in LaTeX's notation. Raises ValueError as ``sympy`` does."""
        return as_latex(self._expression)

    def _repr_latex_(self) -> str | None:
        """H as a notebook shows it; None where it is no short expression."""
        short = isinstance(without_forces(self.flow.family), Terms)
        return f"$H = {self.latex()}$" if short else None

    def vector_field(self, t: Any, z: Any, args: Any = None) -> Any:
        """ż = J∇H(z), as `diffrax.ODETerm` takes it. args: of H, (k,) or None.

        Raises ValueError of a law with friction.
        """
        if self.friction:
            raise ValueError("expected a law without friction, got one whose field is not J∇H")
        return apply_j(self.flow.family.gradient(self.flow.params, z, args))

    @property
    def notes(self) -> tuple[str, ...]:
        """Lines about H beside its formula: constants inside, symmetries, rivals."""
        found = []
        if self.constants:
            text = ", ".join(f"{c.coefficient:g} ± {c.std:.0e} in {c.term}" for c in self.constants)
            found.append(f"constants inside: {text}")
        if self.symmetries:
            found.append(f"symmetries: {'; '.join(self.symmetries)}")
        if self.rivals:
            text = "; ".join(f"{odds_text(r.odds)} against {r.formula}" for r in self.rivals)
            found.append(f"odds by description length: {text}")
        if self.friction and self.which_friction is not None:
            found.append(f"friction: {self.which_friction}")
        if self.widths:
            text = ", ".join(f"{width:.1g}" for width in self.widths)
            found.append(f"dry friction of the map is smoothed over speeds ε = {text}")
        return tuple(found)

    @property
    def _expression(self) -> str:
        if self.formula is None or self.formula.startswith(Legendre.prefix):
            raise ValueError(
                "expected an H that is an expression in q and p, got a network or a Lagrangian"
            )
        return self.formula

    @property
    def fast(self) -> bool:
        """Return whether H oscillates so fast that other laws are not far from the same pairs."""
        return self.omega_h > OPTIONS.fast


TURNS = "friction is not smooth in steps in which a body turns or stops"


def learned_from(
    problem: LawProblem,
    found: FittedLaw,
    started: float,
    of_arcs: Callable[[], np.ndarray] | None = None,
) -> LearnedHamiltonian:
    """Make the candidate of a fitted law, with the cheapest steps that are fine enough.

    started: when its search did. of_arcs: makes the root, where the fit was not to these pairs but
    to arcs of them."""
    seconds = time.perf_counter() - started
    data, family, fit, whole = problem.data, found.family, found.fit, found.whole
    c, scale, some = fit.coefficients, data.scale, slice(OPTIONS.rated)
    z, args = data.y0[data.validation], data.given(data.validation)[1]
    fastest = rates(family, c, data.y0[some], data.given(some)[1])
    own_steps = problem.cheapest(family, fit, fastest, without_turns(data, family, c).training)
    noise, turns = max(problem.bound, fit.rms), not is_smooth(family)
    family, fewest, widths = followed(family, c, data, noise)
    steps = dataclasses.replace(own_steps, substeps=max(fewest, own_steps.substeps))
    steps = problem.resolving(family, c, steps)
    contraction = contraction_of(fastest, data.dt, steps)
    by_newton = (contraction > OPTIONS.contracting or bool(widths)) and not matrix_free(family)
    off = truncation(family, c, z, data.dt, steps, args=args, scale=scale) / scale
    flow = Flow(family, c, data.dt, scale, steps.stages, steps.substeps, by_newton)
    of_all = dataclasses.replace(steps, substeps=flow.over(np.max(data.each_dt)).substeps)
    error = problem.error_of_steps(family, c, of_all)
    candidate = Candidate.of(
        error,
        validated=True,
        label=_label(family),
        family=family.name,
        chart="flow",
        num_parameters=family.num_parameters,
        operations=operations_of(family, 2 * family.dim, fastest, data.dt, steps),
        train_rms=fit.rms,
        fit_seconds=seconds,
        condition=fit.condition,
        rank=family.num_parameters,
        learns="hamiltonian",
    )
    columns = family.term_names, c.tolist(), fit.standard_errors.tolist()
    terms, of_h = tuple(map(Term, *columns)), without_forces(family)
    terms, friction = terms[: of_h.num_parameters], terms[of_h.num_parameters :]
    symmetries = found.symmetries
    if not symmetries and isinstance(family, Terms) and data.args is None:
        symmetries = symmetries_of(family, c, z, data.coordinates.angles)
    unresolved = np.abs(off).max(axis=1) > problem.bound
    of_rows = steps if data.own_dt is None else of_all
    covariance = of_arcs or partial(covariance_root, found, problem.flows, data, of_rows)
    if whole is not None:
        covariance = partial(np.asarray, whole.root)
    law = LearnedHamiltonian(
        candidate,
        flow,
        terms,
        getattr(of_h, "prefix", "") + formula(terms),
        omega_h_of(family, c, data, fastest),
        null_terms=found.null,
        left_out=len(np.setdiff1d(found.rows, fit.used)),
        stalled=found.stalled,
        covariance=covariance,
        noise=None if whole is None else whole.noise,
        arcs=0 if whole is None else whole.arcs,
        misfit=whole is not None and whole.misfit,
        dropped=found.dropped,
        friction=friction,
        constants=found.constants,
        symmetries=symmetries,
        rivals=found.rivals,
        widths=widths,
        turns=turns and problem.met_by(found) and error.bound > problem.tolerance.bound,
        kinds=partial(kinds_of_friction, problem, found),
    )
    messages = _messages(problem, found, law, turns, int(unresolved.sum()))
    return dataclasses.replace(
        law, messages=tuple(messages), unmet=_unmet(problem.tolerance, found, law)
    )


def _label(family) -> str:
    of_h = without_forces(family)
    what = "L" if isinstance(of_h, Legendre) else "H"
    return f"{what}, {of_h.num_parameters} terms" + (", friction" if of_h is not family else "")


def _unmet(tolerance: Tolerance, found: FittedLaw, law: LearnedHamiltonian) -> str:
    """State why the tolerance is missed; "" where it is met."""
    if tolerance.met_by(law.candidate):
        return ""
    why = "If you know terms of H, give them: --terms"
    if law.fast:
        why = (
            f"The motion turns by ωh = {law.omega_h:.2g} radians in a step; beyond π pairs of one "
            "dt do not determine H (aliasing): sample with a smaller dt, or with several"
        )
    elif not is_smooth(found.family):
        why = TURNS.capitalize()
    return (
        "no H of the terms tried meets the tolerance: the best has a one-step error of "
        f"{law.candidate.validation_relative:.2e} of the spread. {why}"
    )


def _messages(
    problem: LawProblem, found: FittedLaw, law: LearnedHamiltonian, turns: bool, unresolved: int
) -> Iterator[str]:
    """Lines about a law: aliasing, misfit, terms that are not determined, pairs too fast for it.
    unresolved: held-out pairs, at some of which a body ``turns``."""
    omega_h, held_out = law.omega_h, len(problem.data.validation)
    if problem.tolerance.met_by(law.candidate) and law.fast:
        yield (
            f"the motion turns by ωh = {omega_h:.2g} radians in a step (median over the states"
            f"{', beyond π' if omega_h > np.pi else ''}). Pairs of one dt determine "
            "frequencies only modulo 2π/dt (aliasing): of the H that fit, this is the "
            + ("simplest. A smaller dt, or several, would decide" if omega_h > np.pi else "slowest")
        )
    if found.whole is not None:
        yield from found.whole.messages
        if found.whole.misfit:
            yield (
                "H misses whole sequences by more than their noise: it lacks terms that single "
                "steps do not show; bands count what it misses"
            )
    if found.undetermined:
        names = found.undetermined
        some = ", ".join(names[: OPTIONS.named]) + (", …" if len(names) > OPTIONS.named else "")
        yield (
            f"the pairs do not determine {len(names)} terms of H ({some}): they are left out, and "
            "H holds only where the pairs are"
        )
    if law.left_out:
        yield (
            f"{law.left_out} of {len(found.rows)} pairs move too fast for the steps by which H was "
            "fitted, as in close passages: they were left out"
        )
    if unresolved and turns:
        yield (
            f"{TURNS}: there the map errs, and not the law, in {unresolved} of "
            f"{held_out} held-out pairs"
        )
    elif unresolved:
        yield (
            f"{unresolved} of {held_out} held-out pairs move too fast for the map's "
            "steps, as in close passages: there the map errs, and not H"
        )


def assembled(
    learned: LearnedHamiltonian, data: Dataset, tolerance: Tolerance, budget: Budget
) -> Assembled:
    """The candidate's map, measured."""
    data = _in_relative_domain(learned.flow, data)
    map_ = composed(learned.flow, data)
    return measured(learned.candidate, map_, data, tolerance, budget)


def _in_relative_domain(flow: Flow, data: Dataset) -> Dataset:
    """Take a domain that leaves out where the whole is, if no force depends on that."""
    if data.structure is None:
        return data
    force = flow.family.gradient(flow.params, data.y0)[:, : data.dim]
    moves = np.abs(force.sum(axis=1)).max() > OPTIONS.no_force * np.abs(force).sum(axis=1).max()
    return dataclasses.replace(
        data, domain=data.structure.domain(data.y0, uses_positions=bool(moves))
    )
