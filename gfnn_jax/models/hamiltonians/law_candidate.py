"""A fitted law as a candidate: its flow with the cheapest steps, errors, covariance, messages."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from gfnn_jax.budget import Budget
from gfnn_jax.candidates.assemble import Assembled, composed, measured
from gfnn_jax.candidates.candidate import Candidate, with_error
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.families.sums import matrix_free
from gfnn_jax.families.terms import Terms
from gfnn_jax.flows.collocation import truncation
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.legendre import Legendre
from gfnn_jax.flows.rates import rates
from gfnn_jax.flows.uniform import without_forces
from gfnn_jax.models.hamiltonians.cost_of_flow import (
    CONTRACTING,
    FREQUENCY_STATES,
    contraction_of,
    omega_h_of,
    operations_of,
)
from gfnn_jax.models.hamiltonians.covariance import covariance_root
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw
from gfnn_jax.models.hamiltonians.formula import Term, formula
from gfnn_jax.models.hamiltonians.friction import (
    followed,
    is_smooth,
    kinds_of_friction,
    without_turns,
)
from gfnn_jax.models.hamiltonians.learned_law import LearnedHamiltonian
from gfnn_jax.models.hamiltonians.problem import LawProblem
from gfnn_jax.models.hamiltonians.symmetries import symmetries_of

TURNS = "friction is not smooth in steps in which a body turns or stops"
_NAMED = 5  # terms in a message
_NO_FORCE = 1e-9  # of the forces' sum: a total that is roundoff


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
    c, scale, some = fit.coefficients, data.scale, slice(FREQUENCY_STATES)
    z, args = data.y0[data.validation], data.given(data.validation)[1]
    fastest = rates(family, c, data.y0[some], data.given(some)[1])
    own_steps = problem.cheapest(family, fit, fastest, without_turns(data, family, c).training)
    noise, turns = max(problem.bound, fit.rms), not is_smooth(family)
    family, fewest, widths = followed(family, c, data, noise)
    steps = dataclasses.replace(own_steps, substeps=max(fewest, own_steps.substeps))
    steps = problem.resolving(family, c, steps)
    contraction = contraction_of(fastest, data.dt, steps)
    by_newton = (contraction > CONTRACTING or bool(widths)) and not matrix_free(family)
    off = truncation(family, c, z, data.dt, steps, args=args, scale=scale) / scale
    flow = Flow(family, c, data.dt, scale, steps.stages, steps.substeps, by_newton)
    of_all = dataclasses.replace(steps, substeps=flow.over(np.max(data.each_dt)).substeps)
    error = problem.error_of_steps(family, c, of_all)
    candidate = Candidate(
        label=_label(family),
        family=family.name,
        chart="flow",
        num_parameters=family.num_parameters,
        operations=operations_of(family, 2 * family.dim, fastest, data.dt, steps),
        validation_rms=error.rms,
        validation_relative=error.relative,
        validation_bound=error.bound,
        deviations=error.deviations,
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
        with_error(candidate, error),
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
        proposals=found.proposals,
        rivals=found.rivals,
        widths=widths,
        turns=turns and problem.met_by(found) and error.bound > problem.tolerance.bound,
        kinds=partial(kinds_of_friction, problem, found, own_steps),
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
    why = "If you know terms of H, give them: --terms (terms=)"
    if law.fast:
        why = (
            f"The motion turns by ωh = {law.omega_h:.2g} radians in a step; beyond π pairs of one "
            "dt do not determine H (aliasing): sample with a smaller dt, or with several"
        )
    elif not is_smooth(found.family):
        why = TURNS.capitalize()
    elif found.ended:
        why = f"The search for modes ended: {found.ended}"
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
        some = ", ".join(names[:_NAMED]) + (", …" if len(names) > _NAMED else "")
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
    moves = np.abs(force.sum(axis=1)).max() > _NO_FORCE * np.abs(force).sum(axis=1).max()
    return dataclasses.replace(
        data, domain=data.structure.domain(data.y0, uses_positions=bool(moves))
    )
