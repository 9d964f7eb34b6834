"""H as the Legendre transform of a Lagrangian of few terms: mechanical systems whose masses depend
on angles, of which H itself is rational (a double pendulum: five terms of L).

    p = ∂L/∂v,      ṗ = ∂L/∂q − γ p

Both are linear in the coefficients of L, with v the difference of positions over dt, at the middle
of a pair: to O(dt²) that is where the fit through the flow starts.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.families.lagrangian import Terms
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.fitting.significance import significant
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.flows.legendre import Legendre
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw
from gfnn_jax.models.hamiltonians.problem import OPTIONS, LawProblem
from gfnn_jax.models.lagrangians.libraries import SINE, modes, powers
from gfnn_jax.phase_space import split


def lagrangian_of(
    problem: LawProblem, forces: Callable[[Any], Any] | None = None
) -> FittedLaw | None:
    """The law of all terms, with these forces, fitted to the training pairs; None where there are
    not several degrees of freedom with an angle among them, or the pairs are too few."""
    data, rows = problem.data, problem.data.training
    coordinates, dim = data.coordinates, data.dim
    angles = tuple(a for a in coordinates.angles if a < dim)
    mechanical = coordinates.forward is CARTESIAN.forward and len(angles) == len(coordinates.angles)
    if not (angles and dim > 1 and mechanical) or coordinates.cyclic or data.varied:
        return None
    family = Legendre(library(dim, angles))
    if problem.options.rows_per_lagrangian_term * family.num_parameters > len(rows) * dim:
        return None
    start, none = _start(family, problem.flows, rows), np.zeros(family.num_parameters)
    last = None
    for share in (*problem.options.shares, 0.0):
        kept, few = significant(start, none, 1.0, share * start.norm / np.sqrt(start.rows))
        if last is not None and len(kept) == last.family.num_parameters:
            continue
        last = _fitted(problem, family.take(kept.tolist()), few, forces)
        if problem.met_by(last):
            break
    return last


def _fitted(problem: LawProblem, family: Legendre, start: np.ndarray, forces) -> FittedLaw:
    """Fit these terms of L and these forces to the training pairs."""
    rows = problem.data.training
    if forces is not None:
        family = forces(family)
        start = np.concatenate([start, np.zeros(family.num_parameters - len(start))])
    with problem.work.library(family.label, family, len(rows)), np.errstate(all="ignore"):
        return problem.fitted(family, start, rows)


def library(dim: int, angles: tuple[int, ...]) -> Terms:
    """Masses of modes of the angles and powers of the lengths, potentials of both."""
    none, lengths = (0,) * dim, [i for i in range(dim) if i not in angles]
    waves = [none, *sorted(modes(dim, angles, OPTIONS.shortest))]

    def functions(degree: int) -> list[tuple]:
        phases = {wave: (0.0, SINE) if any(wave) else (0.0,) for wave in waves}
        products = powers(dim, lengths, *range(degree + 1))
        return [(n, wave, phase) for n in products for wave in waves for phase in phases[wave]]

    speeds, others = powers(dim, range(dim), 2), functions(OPTIONS.shortest)
    masses = [(speed, *rest) for speed in speeds for rest in others]
    potentials = [(none, *rest) for rest in functions(OPTIONS.potential)]
    return Terms.of([*masses, *(row for row in potentials if any(row[1]) or any(row[2]))], dim)


def _start(family: Legendre, problem: Problem, rows) -> Triangle:
    """The triangle of the coefficients of L, from 0, by p = ∂L/∂v and ṗ = ∂L/∂q in the middle of
    these pairs."""
    z0, z1, (dt, _) = problem.z0[rows], problem.z1[rows], problem.given(rows)
    q, p = split(0.5 * (z0 + z1))
    v, force = split((z1 - z0) / dt)
    value, slope, _ = family.terms.potentials(q, order=1)
    motion, by_motion = family.terms.motion(v)
    columns = [value[..., None] * by_motion, slope * motion[..., None]]  # (n, P, d) each
    sizes = [np.sqrt(np.mean(wanted**2)) for wanted in (p, force)]
    design = np.concatenate([c / s for c, s in zip(columns, sizes, strict=True)], axis=0)
    matrix = np.moveaxis(design, 1, 2).reshape(-1, family.num_parameters)
    target = np.concatenate([p / sizes[0], force / sizes[1]]).ravel()
    return Triangle.of(np.column_stack([matrix, -target]))
