"""Start of the descent to H: the start whose flow is nearest to the pairs."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gfnn_jax.families.sums import matrix_free
from gfnn_jax.fitting.linear_starts import forward_start, log_start, midpoint_start
from gfnn_jax.flows.collocation import of_lanes
from gfnn_jax.models.hamiltonians.cost_of_flow import FAST
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw


def starts(problem, family, rows, many, last: FittedLaw | None) -> Iterator[np.ndarray]:
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
