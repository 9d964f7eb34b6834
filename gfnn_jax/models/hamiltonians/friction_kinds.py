"""Kinds of friction that canonical pairs show: linear, quadratic, dry, or uniform.

H and friction of all kinds, of each velocity and of the relative ones of neighbours, are fitted
together. |v|v and the sign of v are smooth where v keeps its sign, and a fit is as exact there as
any other; pairs in which a speed turns are left out of it. Which of the kinds there are held-out
pairs say, by the rule of recordings (`models.lagrangians.friction_choice`).

A map cannot leave such steps out: its dry friction is √(v² + ε²) − ε with ε as small as its steps
can follow, or as the tolerance asks (`followed`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.families.lagrangian import DRY, LINEAR, QUADRATIC, UNIFORM, Friction
from gfnn_jax.families.sums import matrix_free
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.flows.collocation import Steps
from gfnn_jax.flows.forces import Forced
from gfnn_jax.flows.rates import MOST_SUBSTEPS
from gfnn_jax.flows.uniform import Uniform, without_forces
from gfnn_jax.maps.laws import STIFFEST
from gfnn_jax.models.lagrangians.friction_choice import FrictionChoice, Table, chosen
from gfnn_jax.models.lagrangians.libraries import losses
from gfnn_jax.models.lagrangians.structure import Loss
from gfnn_jax.models.lagrangians.text import WhichFriction, which_friction_line
from gfnn_jax.phase_space import split

_SHARP = 1e-9  # ε of dry friction in a fit, in rms speeds: of pairs in which none turns, roundoff
_TURNING = 0.05  # of its rms, a speed at which a step is taken to turn
_ROUNDED = 1e-12  # of the scale: residuals below it do not tell kinds apart
_LOOKED_AT = 600  # pairs that tell limits
_KINDS = (LINEAR, QUADRATIC, DRY)


class Smoothed(NamedTuple):
    """A family as a map steps it, the substeps that it needs, and the widths ε (F,) of its dry
    friction, () without any."""

    family: Any
    substeps: int
    widths: tuple[float, ...]


def candidates(data: Dataset, family, coefficients) -> Friction:
    """Friction of every kind and direction but uniform friction, its ε those of a fit."""
    v = _velocities(family, coefficients, data.y0[data.training])
    width = _SHARP * float(np.sqrt(np.mean(v**2)))
    return Friction.of(losses(data.dim, _KINDS, width), data.dim)


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
    least = _TURNING * np.sqrt(np.mean(before[data.training] ** 2, axis=0))
    slow = np.minimum(np.abs(before), np.abs(after)) <= least
    goes_on = ~np.any(slow | (before * after < 0), axis=1)
    training, validation = (r[goes_on[r]] for r in (data.training, data.validation))
    return data.trained_on(training).validated_on(validation)


def choice_of(problem: Problem, family, coefficients, steps: Steps, rows) -> FrictionChoice | None:
    """The choice among the kinds of friction by these rows, close to a law that has them all; None
    where its flow fails."""
    table = _table(problem, family, coefficients, steps, rows)
    return None if table is None else chosen(table)


def with_friction(own, rows: Sequence[Loss]) -> Any:
    """The family ``own`` of H with these frictions."""
    losses_of_r = [row for row in rows if row[1] != UNIFORM]
    family = Forced(own, Friction.of(losses_of_r, own.dim)) if losses_of_r else own
    return Uniform(family) if len(losses_of_r) < len(rows) else family


def followed(family, coefficients, data: Dataset, noise: float) -> Smoothed:
    """The family as steps over dt follow it. noise: of the scale, that the map may err by.

    A body that dry friction holds creeps at up to ε. That is noise ÷ dt, or, where it is more, the
    width over which the most substeps that a flow may have are no stiffer than Newton's method
    bears.
    """
    friction = friction_of(family)
    if friction is None or not np.any(friction.kinds == DRY):
        return Smoothed(family, 1, ())
    own, dry = without_forces(family), friction.kinds == DRY
    directions = friction.directions.astype(float)
    rho = coefficients[own.num_parameters :][: friction.count]
    z, dt = data.y0[data.training], float(np.max(data.each_dt))
    _, hessian = own.gradient_and_hessian(coefficients[: own.num_parameters], z)
    by_p = hessian[:, data.dim :, data.dim :]
    masses = np.einsum("ki,nij,kj->nk", directions, by_p, directions).max(axis=0)
    rates = np.abs(rho) * masses * dt  # of a change of speed over a step
    creeping = noise * np.abs(directions) @ data.scale[: data.dim] / dt
    widths = np.maximum(creeping, rates / (STIFFEST * MOST_SUBSTEPS))
    substeps = int(np.ceil(np.max(rates[dry] / widths[dry]) / STIFFEST))
    wide = dataclasses.replace(friction, widths=np.where(dry, widths, friction.widths))
    smoothed = _replaced(family, wide)
    return Smoothed(smoothed, max(substeps, 1), tuple(map(float, widths[dry])))


def kinds_of_friction(
    problem: Problem,
    family,
    coefficients,
    steps: Steps,
    data: Dataset,
    odds: dict[tuple[int, ...], float],
) -> WhichFriction | None:
    """The kinds that a law has, with odds where these were found, and upper limits of the others;
    None of a law with parameters or of many sites, and in coordinates other than the user's."""
    own, taken = without_forces(family), _rows_of(family)
    simple = data.args is None and data.structure is None and not matrix_free(own)
    if not simple or data.coordinates.forward is not CARTESIAN.forward:
        return None
    every = candidates(data, family, coefficients)
    rows = without_turns(data, family, coefficients, every).training[:_LOOKED_AT]
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
        table = _table(problem, larger, c, steps, rows)
        limits = {} if table is None else table.limits(taken)
    sharp = {(c, kind, 0.0): limit for (c, kind, _), limit in limits.items()}
    return which_friction_line(
        FrictionChoice(taken, odds, sharp, gains=False),
        1.0,
        data.dim,
        [f"v{i + 1}" for i in range(data.dim)],
    )


def _rows_of(family) -> tuple[Loss, ...]:
    """The frictions of a family, uniform friction last."""
    friction = friction_of(family)
    rows = () if friction is None else tuple(friction.rows())
    uniform = (((0,) * family.dim, UNIFORM, 0.0),) if isinstance(family, Uniform) else ()
    return (*rows, *uniform)


def _table(problem: Problem, family, coefficients, steps: Steps, rows) -> Table | None:
    """The pairs of these rows close to a law; uniform friction, where it has none, is a candidate
    more of several degrees of freedom. None where its flow fails."""
    friction, first = friction_of(family), without_forces(family).num_parameters
    assert friction is not None
    found = problem.images(family, coefficients, rows, steps, derivatives=True)
    unit, kinds, rho = problem.unit(rows), friction.rows(), coefficients[first:]
    slopes = found.by_coefficient / unit[..., None]
    left = (problem.z1[rows] - found.states) / unit + slopes[..., first:] @ rho
    if not isinstance(family, Uniform) and family.dim > 1:
        even = problem.images(
            family, coefficients, rows, steps, derivatives=True, along=Rates(family.dim)
        ).by_coefficient.sum(axis=-1, keepdims=True)
        slopes = np.concatenate([slopes, even / unit[..., None]], axis=-1)
    if slopes.shape[-1] > first + len(kinds):
        kinds = [*kinds, ((0,) * family.dim, UNIFORM, 0.0)]
    size = np.linalg.norm(slopes[..., :first].reshape(-1, first), axis=0)
    slopes[..., :first] /= np.where(size > 0, size, 1.0)
    table = np.concatenate([slopes, left[..., None]], axis=-1)[:, None]
    return Table(tuple(kinds), table, 1.0, _ROUNDED) if np.isfinite(table).all() else None


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
