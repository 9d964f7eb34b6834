"""H together with friction: uniform, ṗ = −∂H/∂q − γp, or Rayleigh's R = Σ ρ_k r_k(v).

Friction is looked for where H alone misses the tolerance and friction would explain a certain part
of what it leaves over, and is kept where it lowers the held-out error by half: a system that keeps
its energy gets no spurious loss. Uniform friction comes first, because its flow keeps a multiple of
J; it is claimed where it meets the tolerance, or where rates of their own for the degrees of
freedom would explain no more. A constant determinant of local Jacobians is no sign of it, which two
oscillators of different friction have too. Then comes friction linear in each velocity, and where
neither meets the tolerance all kinds compete: linear, quadratic and dry, of each velocity and of
the relative ones of neighbours, fitted together with H. |v|v and the sign of v are smooth where v
keeps its sign, and a fit is as exact there as any other; pairs in which a speed turns are left out
of it. Which of the kinds there are held-out pairs say, by the rule of recordings
(`models.lagrangians.friction_choice`).

A map cannot leave such steps out: its dry friction is √(v² + ε²) − ε with ε as small as its steps
can follow, or as the tolerance asks (`followed`).
"""

import contextlib
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.errors import FitError
from gfnn_jax.families.friction import DRY, LINEAR, QUADRATIC, UNIFORM, Friction
from gfnn_jax.families.sums import matrix_free
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.fitting.linearised import Linearised
from gfnn_jax.fitting.significance import CERTAIN
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.flows.collocation import Steps
from gfnn_jax.flows.forces import Forced
from gfnn_jax.flows.rates import MOST_SUBSTEPS
from gfnn_jax.flows.uniform import Uniform, without_forces
from gfnn_jax.maps import laws
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw
from gfnn_jax.models.hamiltonians.legendre import lagrangian_of
from gfnn_jax.models.hamiltonians.problem import LawProblem
from gfnn_jax.models.lagrangians.friction_choice import (
    FrictionChoice,
    Table,
    WhichFriction,
    chosen,
)
from gfnn_jax.models.lagrangians.libraries import losses
from gfnn_jax.models.lagrangians.structure import Loss
from gfnn_jax.models.lagrangians.text import Names
from gfnn_jax.phase_space import split


@dataclasses.dataclass(frozen=True)
class FrictionOptions:
    """Tuned on the pairs of benchmarks/friction.py and friction_kinds.py.

    gained: of the held-out error of H alone, what friction must lower it to. alike: of what uniform
    friction leaves over, what rates of their own must lower it to. looked_at: pairs that tell
    whether friction explains anything, and limits. sharp: ε of dry friction in a fit, in rms
    speeds: of pairs in which none turns, roundoff. turning: of its rms, a speed at which a step is
    taken to turn. rounded: of the scale, residuals below it do not tell kinds apart.
    """

    gained: float = 0.5
    alike: float = 0.7
    looked_at: int = 600
    sharp: float = 1e-9
    turning: float = 0.05
    rounded: float = 1e-12


OPTIONS = FrictionOptions()
Forces = Callable[[Any], Any]  # what makes a family with friction of one of H
Search = Callable[[Forces, Dataset], FittedLaw]  # of laws with these forces, by these pairs


def linear_in_velocities(family) -> Forced:
    """H of ``family`` with friction R = Σ ½ρ_i v_i²."""
    rows = [(tuple(row), LINEAR, 0.0) for row in np.eye(family.dim, dtype=int)]
    return Forced(family, Friction.of(rows, family.dim))


def beside_friction(problem: LawProblem, alone: FittedLaw, search: Search) -> FittedLaw:
    """The best that ``search`` finds with friction, where H alone misses the tolerance and friction
    is certain and worth it; else H alone."""
    best, data, rows = alone, problem.data, problem.data.training[: OPTIONS.looked_at]
    if not problem.simple or problem.met_by(alone):
        return alone
    problem.work.capped(problem.options.max_operations)
    explains, what = False, "whether friction explains anything"
    with problem.work.optional(what), problem.work.again(what, alone.family, len(rows)):
        c = np.append(alone.fit.coefficients, 0.0)  # γ, linearised about H alone
        found = problem.flows.linearised(Uniform(alone.family), c, alone.fit.steps, rows)
        if found.finite:
            gamma = Linearised.of_derivatives(c, found).added(range(len(c) - 1), [len(c) - 1])
            noise = gamma.left / np.sqrt(max(found.rows - len(c), 1))
            explains = bool(np.all(gamma.value * gamma.size > CERTAIN * noise))
    if not explains:
        return alone
    for forces in (Uniform, linear_in_velocities)[: 1 if data.dim == 1 else 2]:
        law = _found(problem, "H with friction", lambda own=forces: search(own, data))
        if law is None or not _certain(law):
            continue
        if not law.error.relative < OPTIONS.gained * best.error.relative:
            continue
        met = problem.met_by(law)
        if forces is Uniform and not met and not _alike(problem.flows, law, rows):
            continue
        best = law
        if met:
            return best
    what = "H with friction of every kind"
    return _found(problem, what, lambda: _of_kinds(problem, alone, best, search)) or best


def _found(
    problem: LawProblem, what: str, search: Callable[[], FittedLaw | None]
) -> FittedLaw | None:
    """Law that a search finds; None where no such friction is in the pairs, or no time is left."""
    with problem.work.optional(what), contextlib.suppress(FitError):
        return search()
    return None


def _of_kinds(
    problem: LawProblem, alone: FittedLaw, near: FittedLaw, search: Search
) -> FittedLaw | None:
    """H with the kinds of friction that held-out pairs choose; None where these are those of
    ``near``, the best so far, or not certain, or not worth it."""
    data, law = problem.data, (near.family, near.fit.coefficients)
    every = candidates(data, *law)
    full = search(lambda family: Forced(family, every), without_turns(data, *law, every))
    table = _table(problem.flows, full.family, full.fit.coefficients, full.fit.steps, full.fit.used)
    choice = None if table is None else chosen(table)
    if choice is None or not choice.kinds:
        return None
    taken = set(choice.kinds)  # of kinds beside these limits tell
    odds = {kinds: odds for kinds, odds in choice.odds.items() if not taken <= set(kinds)}
    if taken <= {LINEAR, UNIFORM} and near is not alone:
        return near._replace(odds=odds)
    family = with_friction(without_forces(full.family), choice.rows)
    start = full.start_of(family)
    steady = without_turns(data, family, start)
    judged = problem.on(steady)
    with problem.work.again("H with the friction that was chosen", family, len(steady.training)):
        own = judged.fitted(family, start, steady.training, rounds=False)
    law = full.with_fit(own)._replace(larger=None, odds=odds)
    before = judged.error_of(alone.family, alone.fit)
    worth_it = law.error.relative < OPTIONS.gained * before.relative
    return law if _certain(law) and worth_it else None


def mechanical(problem: LawProblem) -> FittedLaw | None:
    """The law of a Lagrangian, without friction or with it, as `beside_friction` would have it;
    None where the pairs are of no such system."""
    alone = None
    with problem.work.optional("the Lagrangian"):
        alone = lagrangian_of(problem)
    if alone is None:
        return None

    def search(forces: Forces, data: Dataset) -> FittedLaw:
        found = lagrangian_of(problem.on(data), forces)
        assert found is not None
        return found

    return beside_friction(problem, alone, search)


def _certain(law: FittedLaw) -> bool:
    """Return whether there is friction, all of it certain and above 0."""
    of_h = without_forces(law.family).num_parameters
    rates, errors = law.fit.coefficients[of_h:], law.fit.standard_errors[of_h:]
    return bool(len(rates) and (rates > CERTAIN * errors).all())


def _alike(flows: Problem, law: FittedLaw, rows) -> bool:
    """Return whether rates of their own for the degrees of freedom would explain no more than γ
    does."""
    if not isinstance(law.family, Uniform) or law.family.dim == 1:
        return True
    c, steps, unit = law.fit.coefficients, law.fit.steps, flows.scale[:, None]
    found = flows.images(law.family, c, rows, steps, derivatives=True)
    own = flows.images(law.family, c, rows, steps, derivatives=True, along=Rates(law.family.dim))
    others = own.by_coefficient[..., 1:]  # with γ they span all of the rates
    residual = (found.states - flows.z1[rows])[..., None]
    columns = np.concatenate([found.by_coefficient, others, residual], axis=-1) / unit
    if not np.isfinite(columns).all():
        return True
    triangle = Triangle.of(columns.reshape(-1, columns.shape[-1]))
    left = triangle.residual_norm(len(c) + others.shape[-1])
    return left > OPTIONS.alike * triangle.residual_norm(len(c))


def candidates(data: Dataset, family, coefficients) -> Friction:
    """Friction of every kind and direction but uniform friction, its ε those of a fit."""
    v = _velocities(family, coefficients, data.y0[data.training])
    width = OPTIONS.sharp * float(np.sqrt(np.mean(v**2)))
    return Friction.of(losses(data.dim, (LINEAR, QUADRATIC, DRY), width), data.dim)


def friction_of(family) -> Friction | None:
    """The terms of R of a family; None where it has none, or uniform friction alone."""
    while isinstance(family, Uniform):
        family = family.family
    return family.friction if isinstance(family, Forced) else None


def is_smooth(family) -> bool:
    """Return whether no friction of this family depends on the sign of a speed."""
    friction = friction_of(family)
    return friction is None or not np.any(friction.kinds != LINEAR)


def without_turns(data: Dataset, family, coefficients, friction: Friction | None = None) -> Dataset:
    """The data without the pairs in which a speed of this friction, the family's own where none is
    given, turns; all of them where friction is smooth."""
    friction = friction or friction_of(family)
    if friction is None:
        return data
    own = friction.take(friction.kinds != LINEAR)
    if not own.count:
        return data
    before, after = (
        _velocities(family, coefficients, z) @ own.directions.T for z in (data.y0, data.y1)
    )
    least = OPTIONS.turning * np.sqrt(np.mean(before[data.training] ** 2, axis=0))
    slow = np.minimum(np.abs(before), np.abs(after)) <= least
    goes_on = ~np.any(slow | (before * after < 0), axis=1)
    training, validation = (r[goes_on[r]] for r in (data.training, data.validation))
    return data.trained_on(training).validated_on(validation)


def with_friction(own, rows: Sequence[Loss]) -> Any:
    """The family ``own`` of H with these frictions."""
    losses_of_r = [row for row in rows if row[1] != UNIFORM]
    family = Forced(own, Friction.of(losses_of_r, own.dim)) if losses_of_r else own
    return Uniform(family) if len(losses_of_r) < len(rows) else family


def followed(
    family, coefficients, data: Dataset, noise: float
) -> tuple[Any, int, tuple[float, ...]]:
    """The family as steps over dt follow it, the substeps that it needs, and the widths ε (F,) of
    its dry friction, () without any. noise: of the scale, that the map may err by.

    A body that dry friction holds creeps at up to ε. That is noise ÷ dt, or, where it is more, the
    width over which the most substeps that a flow may have are no stiffer than Newton's method
    bears.
    """
    friction = friction_of(family)
    if friction is None or not np.any(friction.kinds == DRY):
        return family, 1, ()
    own, dry = without_forces(family), friction.kinds == DRY
    directions = friction.directions.astype(float)
    rho = coefficients[own.num_parameters :][: friction.count]
    z, dt = data.y0[data.training], float(np.max(data.each_dt))
    _, hessian = own.gradient_and_hessian(coefficients[: own.num_parameters], z)
    by_p = hessian[:, data.dim :, data.dim :]
    masses = np.einsum("ki,nij,kj->nk", directions, by_p, directions).max(axis=0)
    rates = np.abs(rho) * masses * dt  # of a change of speed over a step
    creeping = noise * np.abs(directions) @ data.scale[: data.dim] / dt
    widths = np.maximum(creeping, rates / (laws.Options.stiffest * MOST_SUBSTEPS))
    substeps = int(np.ceil(np.max(rates[dry] / widths[dry]) / laws.Options.stiffest))
    wide = dataclasses.replace(friction, widths=np.where(dry, widths, friction.widths))
    return _replaced(family, wide), max(substeps, 1), tuple(map(float, widths[dry]))


def kinds_of_friction(problem: LawProblem, law: FittedLaw) -> WhichFriction | None:
    """The kinds that a law has, with odds where these were found, and upper limits of the others by
    the steps of its fit: those of a map err by up to its tolerance. None of a law with parameters
    or of many sites, and in coordinates other than the user's."""
    data, family, coefficients = problem.data, law.family, law.fit.coefficients
    own, taken = without_forces(family), _rows_of(family)
    plain = data.coordinates.forward is CARTESIAN.forward
    if not problem.simple or matrix_free(own) or not plain:
        return None
    every = candidates(data, family, coefficients)
    rows = without_turns(data, family, coefficients, every).training[: OPTIONS.looked_at]
    mine = friction_of(family)
    known = {(c, kind) for c, kind, _ in taken}
    more = [row for row in every.rows() if (row[0], row[1]) not in known]
    friction = Friction.of([*(mine.rows() if mine is not None else ()), *more], data.dim)
    larger: Any = Forced(own, friction)
    known_c = own.num_parameters + (0 if mine is None else mine.count)
    c = np.concatenate([coefficients[:known_c], np.zeros(len(more)), coefficients[known_c:]])
    larger = Uniform(larger) if isinstance(family, Uniform) else larger
    limits: dict[Loss, float] = {}
    if len(rows) * data.dim > len(c):
        table = _table(problem.flows, larger, c, law.fit.steps, rows)
        limits = {} if table is None else table.limits(taken)
    sharp = {(c, kind, 0.0): limit for (c, kind, _), limit in limits.items()}
    choice = FrictionChoice(taken, law.odds or {}, sharp, gains=False)
    q, v = (tuple(f"{letter}{i + 1}" for i in range(data.dim)) for letter in "qv")
    return choice.in_words(1.0, data.dim, Names(q, v))


def _rows_of(family) -> tuple[Loss, ...]:
    """The frictions of a family, uniform friction last."""
    friction = friction_of(family)
    rows = () if friction is None else tuple(friction.rows())
    uniform = (((0,) * family.dim, UNIFORM, 0.0),) if isinstance(family, Uniform) else ()
    return (*rows, *uniform)


def _table(flows: Problem, family, coefficients, steps: Steps, rows) -> Table | None:
    """The pairs of these rows close to a law; uniform friction, where it has none, is a candidate
    more of several degrees of freedom. None where its flow fails."""
    friction, first = friction_of(family), without_forces(family).num_parameters
    assert friction is not None
    found = flows.images(family, coefficients, rows, steps, derivatives=True)
    unit, kinds, rho = flows.unit(rows), friction.rows(), coefficients[first:]
    slopes = found.by_coefficient / unit[..., None]
    left = (flows.z1[rows] - found.states) / unit + slopes[..., first:] @ rho
    if not isinstance(family, Uniform) and family.dim > 1:
        even = flows.images(
            family, coefficients, rows, steps, derivatives=True, along=Rates(family.dim)
        ).by_coefficient.sum(axis=-1, keepdims=True)
        slopes = np.concatenate([slopes, even / unit[..., None]], axis=-1)
    if slopes.shape[-1] > first + len(kinds):
        kinds = [*kinds, ((0,) * family.dim, UNIFORM, 0.0)]
    size = np.linalg.norm(slopes[..., :first].reshape(-1, first), axis=0)
    slopes[..., :first] /= np.where(size > 0, size, 1.0)
    table = np.concatenate([slopes, left[..., None]], axis=-1)[:, None]
    finite = np.isfinite(table).all()
    return Table(tuple(kinds), table, 1.0, OPTIONS.rounded) if finite else None


def _velocities(family, coefficients, z) -> np.ndarray:
    """v = ∂H/∂p (N, d) of states z (N, 2d)."""
    own = without_forces(family)
    return split(own.gradient(coefficients[: own.num_parameters], z))[1]


def _replaced(family, friction: Friction) -> Any:
    """The family with this friction in the place of its own."""
    if isinstance(family, Uniform):
        return Uniform(_replaced(family.family, friction))
    return dataclasses.replace(family, friction=friction)


class Rates:
    """The fields (p_i, 0) of every degree of freedom, as the terms of a linear family."""

    def __init__(self, dim: int):
        self.num_parameters = dim

    def term_gradients(self, w, args=None):
        """(..., 2d, d)."""
        p = split(w)[1]
        rates = p[..., None] * np.eye(p.shape[-1])
        return np.concatenate([rates, np.zeros_like(rates)], axis=-2)
