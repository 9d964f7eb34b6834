"""One library of terms of H, fitted to as many pairs as tell its terms."""

from __future__ import annotations

import numpy as np

from gfnn_jax.fitting.significance import null_terms
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw
from gfnn_jax.models.hamiltonians.starts import starts
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
    count = int(np.ceil(options.judged_rows * family.num_parameters / z.shape[1]))
    rows = data.training[: max(count, fewest)]
    null_names, best = tuple(names[j] for j in null), None
    # Nothing but H is learned of such pairs.
    first = last is None and (data.varied or data.structure is not None)
    with work.library(f"H of {family.num_parameters} terms", family, len(rows), first=first):
        for start in starts(problem, family, rows, data.training[:_TURNING], last):
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
