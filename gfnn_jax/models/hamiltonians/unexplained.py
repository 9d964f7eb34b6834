"""Noise and misfit in what a law leaves over: misfit is what a generator explains.

A law near the true one errs by a map that is symplectic too, residual = J∇K of some generator K;
noise is none. The part of the mean square that no K explains is noise, if K explains more than
noise would let it (an F test).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.families.family import at_time
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products
from gfnn_jax.families.terms import Terms
from gfnn_jax.fitting import least_squares, shared_noise, uncertainty
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.fitting.significance import null_terms
from gfnn_jax.flows.collocation import Steps
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw
from gfnn_jax.models.hamiltonians.options import OPTIONS
from gfnn_jax.phase_space import apply_j, symplectic_form


def unexplained(
    data: Dataset,
    rows,
    residual,
    taken: int,
    degree: int,
    states,
    generators: Sequence[Terms] = (),
) -> float | None:
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
            z,
            angles=tuple(a for a in coordinates.angles if a < data.dim),
            cyclic=coordinates.cyclic,
        )
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


def unexplained_of_sites(
    found: FittedLaw, problem: Problem, data: Dataset, rows, steps: Steps, slopes, left
) -> float | None:
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
