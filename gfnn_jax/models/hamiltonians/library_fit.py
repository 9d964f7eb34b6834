"""One library of terms of H, fitted from several starts to as many pairs as determine its terms."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gfnn_jax.families.sums import matrix_free
from gfnn_jax.fitting.linear_starts import forward_start, log_start, midpoint_start
from gfnn_jax.fitting.significance import null_terms
from gfnn_jax.flows.collocation import of_lanes
from gfnn_jax.models.hamiltonians.cost_of_flow import FAST
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw
from gfnn_jax.models.hamiltonians.steps_of_law import validation_error
from gfnn_jax.models.hamiltonians.work import LawWork

_TURNING = 2_000  # pairs that tell how far a step turns the states
_EXPLAINED = 0.05  # of the spread: an error below it is that of the right branch of the turns


def fitted_library(
    problem, work: LawWork, family, data, tolerance, last: FittedLaw | None, options, on_progress
) -> FittedLaw:
    """The library fitted to as many training pairs as tell its terms, from the best start."""
    names = family.term_names
    z = data.y0[data.training]
    least, fewest = 200, 100
    if data.structure is not None:
        least = fewest = data.structure.fewest(z.shape[1])
    enough = z[: max(least, -(-4 * family.num_parameters // z.shape[1]))]
    args = data.given(data.training[: len(enough)])[1]
    kept, null = null_terms(family, enough, args=args)
    elsewhere = null_terms(family, _scattered(enough), args=args)[0] if null else []
    undetermined = tuple(names[j] for j in null if j in elsewhere)
    family = family.take(kept)
    count = int(np.ceil(options.rows_compared * family.num_parameters / z.shape[1]))
    rows = data.training[: max(count, fewest)]
    null_names, best = tuple(names[j] for j in null), None
    # Nothing but H is learned of such pairs.
    first = last is None and (data.varied or data.structure is not None)
    with work.library(f"H of {family.num_parameters} terms", family, len(rows), first=first):
        for start in _starts(problem, family, rows, data.training[:_TURNING], last):
            fit = problem.fit(family, start, rows, on_progress=on_progress)
            error = validation_error(family, fit, data, tolerance)
            if best is None or error.relative < best.error.relative:
                best = FittedLaw(family, fit, rows, error, null_names, undetermined)
            if error.relative <= _EXPLAINED:
                break
    assert best is not None
    return best


def _scattered(z) -> np.ndarray:
    """States of all directions around the states z."""
    size = z.std(axis=0)
    size = np.where(size > 0, size, np.maximum(np.abs(z).max(axis=0), size.max()))
    return z + size * np.random.default_rng(0).normal(size=z.shape)


def _starts(problem, family, rows, many, last: FittedLaw | None) -> Iterator[np.ndarray]:
    """The start whose flow is nearest to the pairs; and the one that turns forwards what seems to
    turn backwards, before it where that is by more than a quarter. many: rows that tell turns."""
    dt, args = problem.given(many)
    turned = None
    known = len(many) > problem.z0.shape[1] and not matrix_free(family)
    if args is None and np.ndim(dt) == 0 and known:
        turned = forward_start(family, problem.z0[many], problem.z1[many], dt, problem.scale)
    if turned is not None and turned[0] > FAST:
        yield turned[1]
    yield _start(problem, family, rows, last)
    if turned is not None and turned[0] <= FAST:
        yield turned[1]


def _start(problem, family, rows, last: FittedLaw | None) -> np.ndarray:
    """The start whose flow is nearest to the pairs: midpoint, of all of them or of those that move
    least, logarithm, or the last library's."""
    z0, z1 = problem.z0[rows], problem.z1[rows]
    dt, args = problem.given(rows)

    def midpoint(part):
        own = of_lanes(dt, part), problem.scale, of_lanes(args, part)
        return midpoint_start(family, z0[part], z1[part], *own)

    moved = np.linalg.norm((z1 - z0) / problem.scale, axis=1)
    quieter = moved <= np.median(moved)  # the midpoint says little of a step that goes far
    starts = [midpoint(slice(None)), midpoint(quieter)]
    # Pairs of one affine regression, more of them than it has unknowns.
    alike = args is None and np.ndim(dt) == 0 and len(z0) > z0.shape[1]
    logarithm = log_start(family, z0, z1, dt, problem.scale) if alike else None
    if logarithm is not None:
        starts.append(logarithm)
    if last is not None:
        known = dict(zip(last.family.term_names, last.fit.coefficients, strict=True))
        starts.append(np.array([known.get(name, 0.0) for name in family.term_names]))
    some = rows[:100]
    return min(starts, key=lambda c: problem.distance(family, c, some))
