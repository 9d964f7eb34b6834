"""H together with friction: uniform, ṗ = −∂H/∂q − γp, or Rayleigh's R = Σ ρ_k r_k(v).

Friction is looked for where H alone misses the tolerance and friction would explain a certain part
of what it leaves over, and is kept where it lowers the held-out error by half: a system that keeps
its energy gets no spurious loss. Uniform friction comes first, because its flow keeps a multiple of
J; it is claimed where it meets the tolerance, or where rates of their own for the degrees of
freedom would explain no more. A constant determinant of local Jacobians is no sign of it, which two
oscillators of different friction have too. Then comes friction linear in each velocity, and where
neither meets the tolerance all kinds compete (`friction_kinds`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.errors import FitError, OutOfTime
from gfnn_jax.families.lagrangian import LINEAR, UNIFORM, Friction
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.fitting.significance import CERTAIN
from gfnn_jax.flows.forces import Forced
from gfnn_jax.flows.uniform import Uniform, without_forces
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw
from gfnn_jax.models.hamiltonians.friction_kinds import (
    Rates,
    candidates,
    choice_of,
    with_friction,
    without_turns,
)
from gfnn_jax.models.hamiltonians.legendre import lagrangian_of
from gfnn_jax.models.hamiltonians.libraries import libraries_of, modes_of
from gfnn_jax.models.hamiltonians.options import OPTIONS, LawOptions
from gfnn_jax.models.hamiltonians.steps_of_law import validation_error
from gfnn_jax.models.hamiltonians.work import LawWork

_GAINED = 0.5  # of the held-out error of H alone: what friction must lower it to
_ALIKE = 0.7  # of what uniform friction leaves over: what rates of their own must lower it to
_LOOKED_AT = 600  # pairs that tell whether friction explains anything
_BOXES = ((1, 1), (1, 2), (2, 2))  # (order, degree) of the modes of angles that are tried

Searched = tuple[FittedLaw, LawOptions]
Forces = Callable[[Any], Any]  # what makes a family with friction of one of H
Search = Callable[[Forces, Dataset], Searched]  # of laws with these forces, by these pairs


def linear_in_velocities(family) -> Forced:
    """H of ``family`` with friction R = Σ ½ρ_i v_i²."""
    rows = [(tuple(row), LINEAR, 0.0) for row in np.eye(family.dim, dtype=int)]
    return Forced(family, Friction.of(rows, family.dim))


def beside_friction(
    problem: Problem,
    work: LawWork,
    before: Searched,
    data: Dataset,
    tolerance: Tolerance,
    search: Search,
) -> Searched:
    """The best that ``search`` finds with friction, where H alone, ``before``, misses the tolerance
    and friction is certain and worth it; else ``before``."""
    best, bound, rows = before, tolerance.bound, data.training[:_LOOKED_AT]
    simple = data.args is None and data.structure is None
    if not simple or best[0].error.bound <= bound:
        return before
    work.capped(before[1].max_operations)
    try:
        with work.again("whether friction explains anything", best[0].family, len(rows)):
            if not _explains(problem, best[0], rows):
                return before
    except OutOfTime:
        work.budget.leave_out("H with friction", work.ended)
        return before
    for forces in (Uniform, linear_in_velocities)[: 1 if data.dim == 1 else 2]:
        try:
            found = search(forces, data)
        except OutOfTime:
            work.budget.leave_out("H with friction", work.ended)
            break
        except FitError:  # no such friction is in the pairs
            continue
        except np.linalg.LinAlgError as error:
            work.budget.leave_out("H with friction", f"the arithmetic failed ({error})")
            continue
        law = found[0]
        met = law.error.bound <= bound
        if not _certain(law) or not law.error.relative < _GAINED * best[0].error.relative:
            continue
        if forces is Uniform and not met and not _alike(problem, law, rows):
            continue
        best = found
        if met:
            return best
    try:
        return _of_kinds(problem, work, before, best, data, tolerance, search) or best
    except OutOfTime:
        work.budget.leave_out("H with friction of every kind", work.ended)
    except FitError:  # no such friction is in the pairs
        pass
    except np.linalg.LinAlgError as error:
        work.budget.leave_out("H with friction of every kind", f"the arithmetic failed ({error})")
    return best


def _of_kinds(
    problem: Problem,
    work: LawWork,
    before: Searched,
    best: Searched,
    data: Dataset,
    tolerance: Tolerance,
    search: Search,
) -> Searched | None:
    """H with the kinds of friction that held-out pairs choose; None where these are those of
    ``best``, or not certain, or not worth it."""
    near = best[0]
    every = candidates(data, near.family, near.fit.coefficients)
    steady = without_turns(data, near.family, near.fit.coefficients, every)
    full, options = search(lambda family: Forced(family, every), steady)
    choice = choice_of(problem, full.family, full.fit.coefficients, full.fit.steps, full.fit.used)
    if choice is None or not choice.kinds:
        return None
    taken = set(choice.kinds)  # of kinds beside these limits tell
    odds = {kinds: odds for kinds, odds in choice.odds.items() if not taken <= set(kinds)}
    if taken <= {LINEAR, UNIFORM} and best is not before:
        return near._replace(odds=odds), best[1]
    own = without_forces(full.family)
    family = with_friction(own, choice.rows)
    names = dict(zip(full.family.term_names, full.fit.coefficients, strict=True))
    start = np.array([names.get(name, 0.0) for name in family.term_names])
    steady = without_turns(data, family, start)
    rows = steady.training
    with work.again("H with the friction that was chosen", family, len(rows)):
        fit = problem.fit(family, start, rows, rounds=False)
    error = validation_error(family, fit, steady, tolerance)
    law = full._replace(family=family, fit=fit, rows=rows, error=error, larger=None, odds=odds)
    alone = validation_error(before[0].family, before[0].fit, steady, tolerance)
    if not _certain(law) or not error.relative < _GAINED * alone.relative:
        return None
    return law, options


def mechanical(
    problem: Problem, work: LawWork, data: Dataset, tolerance: Tolerance
) -> FittedLaw | None:
    """The law of a Lagrangian, without friction or with it, as `beside_friction` would have it;
    None where the pairs are of no such system."""
    try:
        alone = lagrangian_of(problem, work, data, tolerance)
    except OutOfTime:
        work.budget.leave_out("the Lagrangian", work.ended)
        return None
    except np.linalg.LinAlgError:
        return None
    if alone is None:
        return None

    def search(forces: Forces, data: Dataset) -> Searched:
        found = lagrangian_of(problem, work, data, tolerance, forces)
        assert found is not None
        return found, OPTIONS

    return beside_friction(problem, work, (alone, OPTIONS), data, tolerance, search)[0]


def libraries_with(
    forces: Forces, data: Dataset, scene, terms, options: LawOptions
) -> Iterator[Any]:
    """The families of H by rising size, each with these forces; of angles their shortest modes."""
    basis = modes_of(data, scene, terms)
    if basis is None:
        yield from map(forces, libraries_of(data, scene, terms, options))
        return
    most = len(data.training) * 2 * data.dim / options.rows_per_term
    for size in _BOXES:
        family = basis.terms(basis.box(*size))
        if family.num_parameters < most:
            yield forces(family)


def _certain(law: FittedLaw) -> bool:
    """Return whether there is friction, all of it certain and above 0."""
    of_h = without_forces(law.family).num_parameters
    rates, errors = law.fit.coefficients[of_h:], law.fit.standard_errors[of_h:]
    return bool(len(rates) and (rates > CERTAIN * errors).all())


def _explains(problem: Problem, alone: FittedLaw, rows) -> bool:
    """Return whether γ, in the problem linearised about H alone, is certain to be above 0."""
    family = Uniform(alone.family)
    c = np.append(alone.fit.coefficients, 0.0)
    found = problem.linearised(family, c, alone.fit.steps, rows)
    if not found.finite:
        return False
    # The last row of R but one is what γ alone explains, the last what nothing does.
    size, along, left = found.factor[-2, -2], found.factor[-2, -1], found.factor[-1, -1]
    noise = abs(left) / np.sqrt(max(found.rows - len(c), 1))
    return bool(-along / size > CERTAIN * noise / abs(size))


def _alike(problem: Problem, law: FittedLaw, rows) -> bool:
    """Return whether rates of their own for the degrees of freedom would explain no more than γ
    does."""
    if not isinstance(law.family, Uniform) or law.family.dim == 1:
        return True
    c, steps = law.fit.coefficients, law.fit.steps
    found = problem.images(law.family, c, rows, steps, derivatives=True)
    own = problem.images(law.family, c, rows, steps, derivatives=True, along=Rates(law.family.dim))
    residual = ((found.states - problem.z1[rows]) / problem.scale).ravel()
    columns = [f.by_coefficient / problem.scale[:, None] for f in (found, own)]
    if not all(np.isfinite(a).all() for a in (residual, *columns)):
        return True

    def left(*columns) -> float:
        matrix = np.concatenate([a.reshape(len(residual), -1) for a in columns], axis=1)
        size = np.linalg.norm(matrix, axis=0)
        scaled = matrix / np.where(size > 0, size, 1.0)
        return float(np.linalg.norm(scaled @ np.linalg.lstsq(scaled, residual)[0] - residual))

    return left(*columns) > _ALIKE * left(columns[0])
