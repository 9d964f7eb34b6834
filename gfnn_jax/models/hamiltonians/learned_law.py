"""A learned H as a candidate: its flow with the cheapest steps, errors, covariance, messages."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.budget import Budget
from gfnn_jax.candidates.assemble import Assembled, composed, measured
from gfnn_jax.candidates.candidate import Candidate, with_error
from gfnn_jax.coordinates import to_user
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import OneStepError, Tolerance, measured_error
from gfnn_jax.dataset.runs import looked_at
from gfnn_jax.exports.symbolic import as_latex, as_sympy
from gfnn_jax.families.family import at_time
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products
from gfnn_jax.families.sums import Sums, matrix_free
from gfnn_jax.families.terms import Terms
from gfnn_jax.fitting import least_squares, shared_noise, uncertainty
from gfnn_jax.fitting.gauss_newton import FlowFit, Problem
from gfnn_jax.fitting.significance import null_terms
from gfnn_jax.flows.collocation import Steps, images, truncation
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.legendre import Legendre
from gfnn_jax.flows.rates import MOST_SUBSTEPS, rates
from gfnn_jax.flows.uniform import without_forces
from gfnn_jax.models.hamiltonians.cost_of_flow import (
    CONTRACTING,
    FREQUENCY_STATES,
    contraction_of,
    omega_h_of,
    operations_of,
)
from gfnn_jax.models.hamiltonians.formula import Rival, Term, as_code, formula
from gfnn_jax.models.hamiltonians.fractions import Proposal
from gfnn_jax.models.hamiltonians.friction_kinds import (
    followed,
    is_smooth,
    told_of,
    without_turns,
)
from gfnn_jax.models.hamiltonians.options import OPTIONS, Options
from gfnn_jax.models.hamiltonians.symmetries import symmetries_of
from gfnn_jax.models.hamiltonians.whole_sequences import Whole
from gfnn_jax.models.lagrangians.text import WhichFriction, odds_text
from gfnn_jax.phase_space import apply_j, symplectic_form

FAST = np.pi / 2  # of ωh: from here on other laws are not far from the same pairs
TURNS = "friction is not smooth in steps in which a body turns or stops"
_NEAR_ROUNDOFF = 3e-15  # of the spread
_NO_FORCE = 1e-9  # of the forces' sum: a total that is roundoff
_FEWEST_SAMPLED = 2_000  # pairs that tell noise from misfit; of many sites, numbers
_NAMED = 5  # terms in a message


@dataclasses.dataclass(frozen=True)
class LearnedHamiltonian:
    """H as learned, in the inner coordinates.

    candidate: as the others of a fit, its error measured by steps in NumPy. flow: the piece.
    terms, shown: what H is, as people read it; () and None of a network. truncation: largest error
    of the flow's own steps on the held-out states, ÷ scale. omega_h: the fastest oscillation of the
    linearised flow, times dt, in the median over the data; beyond π pairs of one dt may not tell H.
    contraction: the fixed point's factor where it is largest. condition: of the terms' columns.
    null_terms: that the data do not tell from the others. left_out: pairs that the flow does not
    resolve. stalled: whether larger libraries were no more accurate. covariance: makes ``root``;
    None of a network. unmet: that the tolerance is missed, and what that may be from; "" where it
    is met. ended: what cut the search for it short, "" where nothing did. dropped: terms that went
    in the end. friction: γ where that is uniform, else the terms of Rayleigh's R; of a system
    without, (). constants: numbers inside terms that noisy sequences told, each with its term and
    its standard error. symmetries: that H has to roundoff. proposals: simple fractions near its
    numbers, which noisy sequences allow. rivals: the next two laws that they allow. misfit: whether
    these sequences are certain that H lacks something.
    """

    candidate: Candidate
    flow: Flow
    terms: tuple[Term, ...]
    shown: str | None
    truncation: float
    omega_h: float
    contraction: float
    condition: float
    null_terms: tuple[str, ...]
    left_out: int
    messages: tuple[str, ...]
    stalled: bool
    covariance: Callable[[], np.ndarray] | None
    noise: np.ndarray | None = None
    arcs: int = 0
    unmet: str = ""
    ended: str = ""
    dropped: Dropped | None = None
    friction: tuple[Term, ...] = ()
    constants: tuple[Term, ...] = ()
    symmetries: tuple[str, ...] = ()
    proposals: tuple[Proposal, ...] = ()
    rivals: tuple[Rival, ...] = ()
    misfit: bool = False
    widths: tuple[float, ...] = ()
    turns: bool = False
    kinds: Callable[[], WhichFriction | None] | None = None

    @cached_property
    def which_friction(self) -> WhichFriction | None:
        """The kinds of friction, their odds against others where all of them competed, and the
        largest coefficients that the pairs allow of those not seen. None of a network, of a law
        with parameters or of many sites, and where the pairs' flow fails. Computed when it is first
        asked for."""
        return None if self.kinds is None else self.kinds()

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
        return as_code(family, self.terms) if isinstance(family, Terms | Sums) else self.shown

    def __str__(self) -> str:
        """H as people read it: "0.5 p1² - cos(q1)"."""
        return self.shown or "a network"

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
        """Lines about H beside its formula: constants inside, symmetries, fractions, rivals."""
        found = []
        if self.constants:
            text = ", ".join(f"{c.coefficient:g} ± {c.std:.0e} in {c.term}" for c in self.constants)
            found.append(f"constants inside: {text}")
        if self.symmetries:
            found.append(f"symmetries: {'; '.join(self.symmetries)}")
        if self.proposals:
            text = ", ".join(map(str, self.proposals))
            found.append(f"near simple fractions, which are not taken: {text}")
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
        return self.omega_h > FAST


class Dropped(NamedTuple):
    """Terms that went because the pairs do not ask for them, and what that cost: the held-out error
    ÷ spread with them and without."""

    terms: int
    error_with: float
    error_without: float


class FittedLaw(NamedTuple):
    """rows: that the fit was given; it has left out those that the flow does not resolve.
    undetermined: of the null terms, those that other states would tell from the rest. ended: why a
    library that grew did so no longer. stalled: whether larger libraries were no better. noisy:
    whether their errors were the same, which is that of the pairs; larger: the largest
    of those. dropped: terms that went in the end. whole:
    what whole sequences tell, where they were fitted. constants: numbers inside terms that were
    fitted with them. symmetries, proposals, rivals: as of `LearnedHamiltonian`. odds: of the kinds
    of its friction against others, where these competed."""

    family: Any  # of terms of H, or of L, with friction or without
    fit: FlowFit
    rows: np.ndarray
    error: OneStepError
    null: tuple[str, ...]
    undetermined: tuple[str, ...] = ()
    ended: str = ""
    stalled: bool = False
    noisy: bool = False
    larger: FittedLaw | None = None
    dropped: Dropped | None = None
    whole: Whole | None = None
    constants: tuple[Term, ...] = ()
    symmetries: tuple[str, ...] = ()
    proposals: tuple[Proposal, ...] = ()
    rivals: tuple[Rival, ...] = ()
    odds: dict[tuple[int, ...], float] | None = None


def learned_from(
    found: FittedLaw, problem, data: Dataset, tolerance: Tolerance, seconds: float,
    options: Options, of_arcs: Callable[[], np.ndarray] | None,
) -> LearnedHamiltonian:  # fmt: skip
    """of_arcs: makes the root, where the fit was not to these pairs but to arcs of them."""
    family, fit, whole = found.family, found.fit, found.whole
    rows = data.validation
    z, args = data.y0[rows], data.given(rows)[1]
    some = slice(FREQUENCY_STATES)
    fastest = rates(family, fit.coefficients, data.y0[some], data.given(some)[1])
    by_row = problem  # each at its own dt
    if data.own_dt is not None:  # the map's own dt, from which others follow
        problem = Problem(data.y0, data.y1, data.dt, data.scale, args=data.args, weight=data.weight)
    steady = without_turns(data, family, fit.coefficients)
    steps = _cheapest(problem, family, fit, fastest, steady, tolerance, options)
    sharp, own_steps, turns = family, steps, not is_smooth(family)
    noise = max(bound_of(tolerance, data.scale), fit.rms)
    family, fewest, widths = followed(family, fit.coefficients, data, noise)
    steps = dataclasses.replace(steps, substeps=max(fewest, steps.substeps))
    steps = _resolving(family, fit.coefficients, steps, data, tolerance)
    contraction = contraction_of(fastest, data.dt, steps)
    by_newton = (contraction > CONTRACTING or bool(widths)) and not matrix_free(family)
    scale = data.scale
    off = truncation(family, fit.coefficients, z, data.dt, steps, args=args, scale=scale) / scale
    flow = Flow(
        family, fit.coefficients, data.dt, data.scale, steps.stages, steps.substeps,
        by_newton,
    )  # fmt: skip
    longest = flow.over(np.max(data.each_dt)).substeps
    of_all = dataclasses.replace(steps, substeps=longest)
    error = error_of_steps(family, fit.coefficients, of_all, data, tolerance)
    candidate = Candidate(
        label=_label(family), family=family.name, chart="flow",
        num_parameters=family.num_parameters,
        operations=operations_of(family, 2 * family.dim, fastest, data.dt, steps),
        validation_rms=error.rms, validation_relative=error.relative,
        validation_bound=error.bound, deviations=error.deviations, train_rms=fit.rms,
        fit_seconds=seconds, condition=fit.condition, rank=family.num_parameters,
        learns="hamiltonian",
    )  # fmt: skip
    terms = tuple(
        Term(*entry)
        for entry in zip(
            family.term_names, fit.coefficients.tolist(), fit.standard_errors.tolist(), strict=True
        )
    )
    of_h = without_forces(family).num_parameters
    terms, friction = terms[:of_h], terms[of_h:]
    omega_h = omega_h_of(family, fit.coefficients, data, fastest)
    symmetries = found.symmetries
    if not symmetries and isinstance(family, Terms) and data.args is None:
        symmetries = symmetries_of(family, fit.coefficients, z, data.coordinates.angles)
    left_out = len(np.setdiff1d(found.rows, fit.used))
    resolved = np.abs(off).max(axis=1) <= bound_of(tolerance, data.scale)
    of_rows = steps if data.own_dt is None else of_all
    covariance = of_arcs or partial(covariance_root, found, by_row, data, of_rows)
    if whole is not None:
        covariance = partial(np.asarray, whole.root)
    return LearnedHamiltonian(
        with_error(candidate, error), flow, terms,
        getattr(without_forces(family), "prefix", "") + formula(terms),
        float(np.abs(off).max()),
        omega_h, contraction, fit.condition, found.null, left_out,
        tuple(_messages(error, omega_h, data, tolerance, found, left_out, int((~resolved).sum()),
                        turns)),
        stalled=found.stalled,
        covariance=covariance, noise=None if whole is None else whole.noise,
        arcs=0 if whole is None else whole.arcs, misfit=whole is not None and whole.misfit,
        dropped=found.dropped, unmet=_unmet(error, omega_h, tolerance, found),
        friction=friction, constants=found.constants, symmetries=symmetries,
        proposals=found.proposals, rivals=found.rivals, widths=widths,
        turns=turns and found.error.bound <= tolerance.bound < error.bound,
        kinds=partial(told_of, by_row, sharp, fit.coefficients, own_steps, data, found.odds or {}),
    )  # fmt: skip


def _label(family) -> str:
    of_h = without_forces(family)
    what = "L" if isinstance(of_h, Legendre) else "H"
    return f"{what}, {of_h.num_parameters} terms" + (", friction" if of_h is not family else "")


def validation_error(family, fit: FlowFit, data: Dataset, tolerance: Tolerance) -> OneStepError:
    """Error by steps that resolve the held-out pairs: an unresolved passage says nothing of the
    law."""
    steps = _resolving(family, fit.coefficients, fit.steps, data, tolerance)
    return error_of_steps(family, fit.coefficients, steps, data, tolerance)


def error_of_steps(
    family, coefficients, steps: Steps, data: Dataset, tolerance: Tolerance
) -> OneStepError:
    states, (dt, args) = data.y0[data.validation], data.given(data.validation)
    found = images(family, coefficients, states, dt, steps, args=args, scale=data.scale).states
    return measured_error(data, tolerance, to_user(data.coordinates, found))


def bound_of(tolerance: Tolerance, scale) -> float:
    """The tolerance as a part of the coordinates' scale."""
    bound = tolerance.bound
    return bound if tolerance.relative else bound / float(scale.max())


def _resolving(family, coefficients, steps: Steps, data: Dataset, tolerance: Tolerance) -> Steps:
    """Keep these steps, or, where the law misses the tolerance by them, take finer ones: halved
    until they resolve the held-out pairs, or there are as many as a flow may have."""
    bound, states = bound_of(tolerance, data.scale), data.y0[data.validation]
    if error_of_steps(family, coefficients, steps, data, tolerance).bound <= tolerance.bound:
        return steps
    (dt, args), scale = data.given(data.validation), data.scale
    while 2 * steps.substeps <= MOST_SUBSTEPS:
        off = truncation(family, coefficients, states, dt, steps, args=args, scale=scale) / scale
        if np.sqrt(np.mean(off**2)) <= OPTIONS.truncation * bound:
            break
        steps = dataclasses.replace(steps, substeps=2 * steps.substeps)
    return steps


def _cheapest(
    problem, family, fit: FlowFit, fastest, data: Dataset, tolerance: Tolerance, options: Options
) -> Steps:
    """Steps whose own error is a tenth of the tolerance; near roundoff, or at it, where that is not
    twice as dear."""

    def cost(steps: Steps) -> float:
        return operations_of(family, 2 * family.dim, fastest, problem.dt, steps)

    bound = max(options.truncation * bound_of(tolerance, problem.scale), 0.3 * fit.rms)
    tolerances = (bound, min(bound, _NEAR_ROUNDOFF), None)
    found = problem.fine_steps(family, fit.coefficients, data.training, tolerances)
    return next(s for s in reversed(found) if s == found[0] or cost(s) < 2 * cost(found[0]))


def covariance_root(found: FittedLaw, problem: Problem, data: Dataset, steps: Steps) -> np.ndarray:
    """(m, m): rootᵀ root is the covariance of the coefficients. What is noise, a generator of
    polynomials tells, which does not explain it, of sites the terms of a larger library; what they
    explain is misfit, of these steps too."""
    fit, count = found.fit, found.family.num_parameters
    most = max(_FEWEST_SAMPLED, OPTIONS.sampled_rows * count // data.y0.shape[1])
    structure = data.structure
    if structure is not None:
        most = max(structure.fewest(data.y0.shape[1]), _FEWEST_SAMPLED // data.y0.shape[1])
    places, goes_on = looked_at(data.pairs, fit.used, most)
    rows = fit.used[places]
    unit, scale = problem.unit(rows), problem.scale
    images = problem.images(found.family, fit.coefficients, rows, steps, derivatives=True)
    residual = images.states - data.y1[rows]
    if not np.isfinite(residual).all():  # of a flow that runs away from some of the states
        return np.full((count, count), np.nan)
    slopes = images.by_coefficient / unit[..., None]
    left, scores, states, noise = residual / unit, None, None, None
    family = without_forces(found.family)
    if isinstance(family, Terms):  # of many coordinates both would take too much
        if goes_on.any():
            first = images.by_state * scale
            second = np.broadcast_to(-np.diag(scale), first.shape)
            scores = shared_noise.scores(
                slopes, left, first / unit[..., None], second / unit[..., None], goes_on
            )
            states = first, second, goes_on
        degree = int(np.max(np.sum(family.powers, axis=1)))
        noise = unexplained(data, rows, residual, count, degree, states)
    elif structure is not None and isinstance(family, Sums):
        noise = _unexplained_of_sites(found, problem, data, rows, steps, slopes, left)
    return uncertainty.root(
        fit.triangle, count, slopes.reshape(-1, count), np.hypot(left, _NEAR_ROUNDOFF).ravel(),
        noise=noise, scores=scores,
    )  # fmt: skip


def _unexplained_of_sites(
    found: FittedLaw, problem: Problem, data: Dataset, rows, steps: Steps, slopes, left
) -> float | None:  # fmt: skip
    """The part that `unexplained` tells, of a structure: what the next library's terms, small
    beside the law's, do not explain. slopes (n, 2d, terms), left (n, 2d): of the law."""
    assert data.structure is not None
    family, count, unit = found.family, found.family.num_parameters, problem.unit(rows)
    libraries = (f for f in data.structure.libraries(data.dim) if f.num_parameters > count)
    larger = next(libraries, None)
    if larger is None or OPTIONS.sampled_rows * (count + larger.num_parameters) > left.size:
        return None
    further = (
        problem.images(
            family, found.fit.coefficients, rows, steps, derivatives=True, along=larger
        ).by_coefficient
        / unit[..., None]
    )
    columns = np.concatenate([slopes, further], axis=-1).reshape(left.size, -1)
    size = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(size > 0, size, 1.0)
    solved, _, rank, _ = np.linalg.lstsq(columns, left.ravel(), rcond=1e-10)
    over = np.sum((left.ravel() - columns @ solved) ** 2) / max(left.size - rank, 1)
    total = np.sum(left**2) / max(left.size - count, 1)
    part = float(over / total) if total > 0 else 1.0
    return part if part < 1 - OPTIONS.explained * np.sqrt(2 * rank) / left.size else 1.0


def unexplained(
    data: Dataset, rows, residual, taken: int, degree: int, states,
    generators: Sequence[Terms] = (),
) -> float | None:  # fmt: skip
    """Part of the mean square of a law's residuals (n, 2d) on these rows that no generator K
    explains, residual = J∇K at the images: K of as high a degree as the rows tell.
    taken: coefficients that the law itself was given, degree: its own. states: the residual's
    derivatives and which pairs go on, as `shared_noise.scores` takes them, or None. generators: by
    rising size, of the state and the args of the data that have such. None where the rows are too
    few.

    1 where K explains no more than it would of noise, by ``explained`` standard errors: an F test.
    """
    z, width = data.y1[rows], residual.shape[1]
    sizes: Sequence[Products | Terms] = generators
    later = None  # the args at the end of a pair
    if generators:
        later = at_time(generators[0], data.given(rows)[1], data.dt)
    else:
        coordinates = data.coordinates
        inputs = box_inputs(
            z, angles=tuple(a for a in coordinates.angles if a < data.dim),
            cyclic=coordinates.cyclic,
        )  # fmt: skip
        degrees = sorted({*OPTIONS.generators, degree + OPTIONS.beyond})
        sizes = [Products(inputs, n) for n in degrees]
    most = min(len(rows) * width // OPTIONS.sampled_rows, OPTIONS.most_terms)
    known = [family for family in sizes if family.num_parameters <= most]
    if not known:
        return None
    family, weight = known[-1], 1.0 / np.roll(data.scale, data.dim)
    if isinstance(family, Terms):  # functions of the args alone have no gradient
        family = family.take(null_terms(family, z, args=later)[0])
    target = -apply_j(residual)
    given = () if later is None else (later,)
    reduced = least_squares.reduce(family, [(z, target, *given)], weight)
    count, freedom = family.num_parameters, None
    if states is not None:
        to_target = -weight[:, None] * symplectic_form(data.dim)
        slopes, (first, second, goes_on) = family.term_gradients(z) * weight[:, None], states
        scores = shared_noise.scores(
            slopes, weight * target, to_target @ first, to_target @ second, goes_on
        )
        freedom = shared_noise.degrees_of_freedom(slopes, weight * target, scores)
    left = reduced.norm**2 / max(reduced.rows - taken, 1)
    if left == 0:
        return 1.0
    part = float(uncertainty.variance(reduced, count, freedom) / left)
    by_chance = OPTIONS.explained * np.sqrt(2 * count) / reduced.rows
    return part if part < 1 - by_chance else 1.0


def _unmet(error: OneStepError, omega_h: float, tolerance, found: FittedLaw) -> str:
    if error.bound <= tolerance.bound:
        return ""
    why = "If you know terms of H, give them: --terms (terms=)"
    if omega_h > FAST:
        why = (
            f"The motion turns by ωh = {omega_h:.2g} radians in a step; beyond π pairs of one dt "
            "do not determine H (aliasing): sample with a smaller dt, or with several"
        )
    elif not is_smooth(found.family):
        why = TURNS.capitalize()
    elif found.ended:
        why = f"The search for modes ended: {found.ended}"
    return (
        "no H of the terms tried meets the tolerance: the best has a one-step error of "
        f"{error.relative:.2e} of the spread. {why}"
    )


def _messages(
    error: OneStepError, omega_h: float, data, tolerance, found: FittedLaw, left_out: int,
    unresolved: int, turns: bool,
) -> Iterator[str]:  # fmt: skip
    if error.bound <= tolerance.bound and omega_h > FAST:
        yield (
            f"the motion turns by ωh = {omega_h:.2g} radians in a step (median over the states"
            f"{', beyond π' if omega_h > np.pi else ''}). Pairs of one dt tell frequencies only "
            "modulo 2π/dt (aliasing): of the H that fit, this is the "
            + ("simplest. A smaller dt, or several, would decide" if omega_h > np.pi else "slowest")
        )
    if found.whole is not None:
        yield from found.whole.messages
        if found.whole.misfit:
            yield (
                "H misses whole sequences by more than their noise: it lacks terms that single "
                "steps do not tell; bands count what it misses"
            )
    if found.undetermined:
        names = found.undetermined
        some = ", ".join(names[:_NAMED]) + (", …" if len(names) > _NAMED else "")
        yield (
            f"the pairs do not determine {len(names)} terms of H ({some}): they are left out, and "
            "H holds only where the pairs are"
        )
    if left_out:
        yield (
            f"{left_out} of {len(found.rows)} pairs move too fast for the steps by which H was "
            "fitted, as in close passages: they were left out"
        )
    if unresolved and turns:
        yield (
            f"{TURNS}: there the map errs, and not the law, in {unresolved} of "
            f"{len(data.validation)} held-out pairs"
        )
    elif unresolved:
        yield (
            f"{unresolved} of {len(data.validation)} held-out pairs move too fast for the map's "
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
    moves = np.abs(force.sum(axis=1)).max() > _NO_FORCE * np.abs(force).sum(axis=1).max()
    return dataclasses.replace(
        data, domain=data.structure.domain(data.y0, uses_positions=bool(moves))
    )
