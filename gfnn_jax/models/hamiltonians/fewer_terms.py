"""Pruning of a law: terms that are noise, or that the pairs do not ask for, go.

The held-out error decides: it must not rise.
"""

from __future__ import annotations

import numpy as np

from gfnn_jax.fitting.significance import ABOVE_NOISE, significant_terms, terms_above_noise
from gfnn_jax.models.hamiltonians.fitted_law import Dropped, FittedLaw
from gfnn_jax.models.hamiltonians.problem import LawProblem


def without_noise(problem: LawProblem, smallest: FittedLaw) -> FittedLaw:
    """The terms that the training pairs tell from noise: of the smallest library whose error is
    that of the noise, and those of the largest that they tell beside them. An error that is noise
    for the most part hides terms which 10,000 pairs tell."""
    rows = problem.data.training
    found, few = _significant(problem, smallest), None
    if found is not None:
        found = problem.refitted(found, rows)
    if found is None or not found.error.relative <= problem.options.rise * smallest.error.relative:
        found = problem.refitted(smallest, rows)
    if smallest.larger is not None:
        few = _significant(problem, smallest.larger)
    more = 0 if few is None else few.family.num_parameters - found.family.num_parameters
    if few is None or more <= 0:
        return found
    few = problem.refitted(few, rows)
    # Twice the logarithm of the likelihood's ratio.
    gained = 2 * few.fit.triangle.rows * np.log(found.fit.rms / few.fit.rms)
    if gained > ABOVE_NOISE**2 * more and few.error.relative <= found.error.relative:
        return few._replace(noisy=True, thresholds=found.thresholds)
    return found


def _significant(problem: LawProblem, full: FittedLaw) -> FittedLaw | None:
    """The terms that the training pairs tell from noise, which one Gauss–Newton problem of all
    terms says, so that only a few are fitted to many pairs; None where it tells none."""
    c, rows = full.fit.coefficients, problem.data.training
    resolved = np.setdiff1d(rows, np.setdiff1d(full.rows, full.fit.used))
    found = problem.flows.linearised(full.family, c, full.fit.steps, resolved)
    if not np.isfinite(found.norm):
        return None
    kept, start = terms_above_noise(found, c, ABOVE_NOISE)
    if not len(kept):
        return None
    family = full.family.take(tuple(kept.tolist()))
    return full._replace(family=family, fit=full.fit._replace(coefficients=start))


def sparse(problem: LawProblem, full: FittedLaw) -> FittedLaw:
    """Drop the terms that the pairs do not ask for, as far as the held-out error allows."""
    options, count, before = problem.options, full.family.num_parameters, full.error.relative
    tried: set[tuple[int, ...]] = set()
    thresholds = options.thresholds if full.thresholds is None else full.thresholds
    for threshold in thresholds:
        kept = tuple(significant_terms(full.fit, threshold).tolist())
        if len(kept) == count:
            break
        if not kept or kept in tried:
            continue
        tried.add(kept)
        problem.on_progress(f"H: {len(kept)} of {count} terms")
        start = full.fit.coefficients[list(kept)]
        few = problem.fitted(
            full.family.take(kept), start, full.fit.used, rounds=False, steps=full.fit.steps
        )
        after = few.error.relative
        if after <= max(options.rise * before, options.rounding):
            dropped = Dropped(count - len(kept), before, after)
            change = f"error {after:.2e}, before {before:.2e}"
            problem.on_progress(f"H without {dropped.terms} terms: {change}")
            return full._replace(family=few.family, fit=few.fit, error=few.error, dropped=dropped)
    return full
