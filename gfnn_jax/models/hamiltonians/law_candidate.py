"""A fitted law as a candidate: its flow with the cheapest steps, errors, covariance, messages."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial

import numpy as np

from gfnn_jax.budget import Budget
from gfnn_jax.candidates.assemble import Assembled, composed, measured
from gfnn_jax.candidates.candidate import Candidate, with_error
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.families.sums import matrix_free
from gfnn_jax.families.terms import Terms
from gfnn_jax.fitting.gauss_newton import Problem
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
from gfnn_jax.models.hamiltonians.friction_kinds import (
    followed,
    is_smooth,
    kinds_of_friction,
    without_turns,
)
from gfnn_jax.models.hamiltonians.law_messages import messages, unmet
from gfnn_jax.models.hamiltonians.learned_law import LearnedHamiltonian
from gfnn_jax.models.hamiltonians.options import LawOptions
from gfnn_jax.models.hamiltonians.steps_of_law import bound_of, cheapest, error_of_steps, resolving
from gfnn_jax.models.hamiltonians.symmetries import symmetries_of

_NO_FORCE = 1e-9  # of the forces' sum: a total that is roundoff


def learned_from(
    found: FittedLaw,
    problem,
    data: Dataset,
    tolerance: Tolerance,
    seconds: float,
    options: LawOptions,
    of_arcs: Callable[[], np.ndarray] | None,
) -> LearnedHamiltonian:
    """Make the candidate of a fitted law, with the cheapest steps that are fine enough.

    of_arcs: makes the root, where the fit was not to these pairs but to arcs of them."""
    family, fit, whole = found.family, found.fit, found.whole
    rows = data.validation
    z, args = data.y0[rows], data.given(rows)[1]
    some = slice(FREQUENCY_STATES)
    fastest = rates(family, fit.coefficients, data.y0[some], data.given(some)[1])
    by_row = problem  # each at its own dt
    if data.own_dt is not None:  # the map's own dt, from which others follow
        problem = Problem(data.y0, data.y1, data.dt, data.scale, args=data.args, weight=data.weight)
    steady = without_turns(data, family, fit.coefficients)
    steps = cheapest(problem, family, fit, fastest, steady, tolerance, options)
    sharp, own_steps, turns = family, steps, not is_smooth(family)
    noise = max(bound_of(tolerance, data.scale), fit.rms)
    family, fewest, widths = followed(family, fit.coefficients, data, noise)
    steps = dataclasses.replace(steps, substeps=max(fewest, steps.substeps))
    steps = resolving(family, fit.coefficients, steps, data, tolerance)
    contraction = contraction_of(fastest, data.dt, steps)
    by_newton = (contraction > CONTRACTING or bool(widths)) and not matrix_free(family)
    scale = data.scale
    off = truncation(family, fit.coefficients, z, data.dt, steps, args=args, scale=scale) / scale
    flow = Flow(
        family,
        fit.coefficients,
        data.dt,
        data.scale,
        steps.stages,
        steps.substeps,
        by_newton,
    )
    longest = flow.over(np.max(data.each_dt)).substeps
    of_all = dataclasses.replace(steps, substeps=longest)
    error = error_of_steps(family, fit.coefficients, of_all, data, tolerance)
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
        with_error(candidate, error),
        flow,
        terms,
        getattr(without_forces(family), "prefix", "") + formula(terms),
        float(np.abs(off).max()),
        omega_h,
        contraction,
        fit.condition,
        found.null,
        left_out,
        tuple(
            messages(
                error, omega_h, data, tolerance, found, left_out, int((~resolved).sum()), turns
            )
        ),
        stalled=found.stalled,
        covariance=covariance,
        noise=None if whole is None else whole.noise,
        arcs=0 if whole is None else whole.arcs,
        misfit=whole is not None and whole.misfit,
        dropped=found.dropped,
        unmet=unmet(error, omega_h, tolerance, found),
        friction=friction,
        constants=found.constants,
        symmetries=symmetries,
        proposals=found.proposals,
        rivals=found.rivals,
        widths=widths,
        turns=turns and found.error.bound <= tolerance.bound < error.bound,
        kinds=partial(
            kinds_of_friction, by_row, sharp, fit.coefficients, own_steps, data, found.odds or {}
        ),
    )


def _label(family) -> str:
    of_h = without_forces(family)
    what = "L" if isinstance(of_h, Legendre) else "H"
    return f"{what}, {of_h.num_parameters} terms" + (", friction" if of_h is not family else "")


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
