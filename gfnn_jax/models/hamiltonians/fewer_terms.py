"""Pruning of a law: terms that are noise, or that the pairs do not ask for, go.

The held-out error decides: it must not rise.
"""

from __future__ import annotations

import numpy as np

from gfnn_jax.budget import Allowance, Budget
from gfnn_jax.fitting.significance import ABOVE_NOISE, significant_terms, terms_above_noise
from gfnn_jax.models.hamiltonians.fitted_law import Dropped, FittedLaw
from gfnn_jax.models.hamiltonians.options import OPTIONS, LawOptions
from gfnn_jax.models.hamiltonians.steps_of_law import validation_error
from gfnn_jax.models.hamiltonians.whole_sequences import fitted_to_sequences

ROUNDOFF = 1e-12  # of the spread: above it the pairs carry noise, and every one of them counts


def without_noise(
    problem, smallest: FittedLaw, rows, data, tolerance, options: LawOptions
) -> FittedLaw:
    """The terms that these pairs tell from noise: of the smallest library whose error is that of
    the noise, and those of the largest that they tell beside them. An error that is noise for the
    most part hides terms which 10,000 pairs tell."""
    found = _pruned(problem, smallest, rows, data, tolerance, options)
    if smallest.larger is None:
        return found
    few = _significant(problem, smallest.larger, rows, options)
    more = 0 if few is None else few.family.num_parameters - found.family.num_parameters
    if few is None or more <= 0:
        return found
    few = refitted(problem, few, rows, data, tolerance)
    # Twice the logarithm of the likelihood's ratio.
    gained = 2 * few.fit.triangle.rows * np.log(found.fit.rms / few.fit.rms)
    if gained > ABOVE_NOISE**2 * more and few.error.relative <= found.error.relative:
        return few._replace(noisy=True)
    return found


def _pruned(problem, full: FittedLaw, rows, data, tolerance, options: LawOptions) -> FittedLaw:
    """The terms that all of these pairs tell from noise, fitted to them."""
    few = _significant(problem, full, rows, options)
    if few is not None:
        few = refitted(problem, few, rows, data, tolerance)
        if few.error.relative <= options.rise * full.error.relative:
            return few
    return refitted(problem, full, rows, data, tolerance)


def _significant(problem, full: FittedLaw, rows, options: LawOptions) -> FittedLaw | None:
    """The terms that these pairs tell from noise, which one Gauss–Newton problem of all terms says,
    so that only a few are fitted to many pairs; None where it tells none."""
    resolved = np.setdiff1d(rows, np.setdiff1d(full.rows, full.fit.used))
    found = problem.linearised(full.family, full.fit.coefficients, full.fit.steps, resolved)
    if not np.isfinite(found.norm):
        return None
    kept, start = terms_above_noise(found, full.fit.coefficients, ABOVE_NOISE)
    if not len(kept):
        return None
    return full._replace(
        family=full.family.take(tuple(kept.tolist())), fit=full.fit._replace(coefficients=start)
    )


def sparse(
    problem, full: FittedLaw, data, tolerance, options: LawOptions, on_progress
) -> FittedLaw:
    """Drop the terms that the pairs do not ask for, as far as the held-out error allows."""
    tried: set[tuple[int, ...]] = set()
    for threshold in options.thresholds:
        kept = tuple(significant_terms(full.fit, threshold).tolist())
        if len(kept) == full.family.num_parameters:
            break
        if not kept or kept in tried:
            continue
        tried.add(kept)
        family = full.family.take(kept)
        on_progress(f"H: {len(kept)} of {full.family.num_parameters} terms")
        start = full.fit.coefficients[list(kept)]
        fit = problem.fit(family, start, full.fit.used, rounds=False, steps=full.fit.steps)
        error = validation_error(family, fit, data, tolerance)
        before = full.error.relative
        if error.relative <= max(options.rise * before, options.rounding):
            dropped = Dropped(full.family.num_parameters - len(kept), before, error.relative)
            change = f"error {error.relative:.2e}, before {before:.2e}"
            on_progress(f"H without {dropped.terms} terms: {change}")
            return full._replace(family=family, fit=fit, error=error, dropped=dropped)
    return full


def refitted(problem, found: FittedLaw, rows, data, tolerance) -> FittedLaw:
    """Fitted to all training pairs: each of them averages the noise."""
    fit = problem.fit(found.family, found.fit.coefficients, rows, rounds=False)
    error = validation_error(found.family, fit, data, tolerance)
    return found._replace(fit=fit, rows=rows, error=error)


def of_whole_sequences(problem, found: FittedLaw, data, tolerance, budget: Budget) -> FittedLaw:
    """Fitted to whole sequences, where there are such and held-out steps bear it out."""
    if found.error.relative <= ROUNDOFF:
        return found
    whole = fitted_to_sequences(problem, found.family, found.fit, data, Allowance(budget))
    if whole is None:
        return found
    family = found.family.take(whole.kept)
    error = validation_error(family, whole.fit, data, tolerance)
    if not error.relative <= OPTIONS.rise * found.error.relative:
        return found
    return found._replace(family=family, fit=whole.fit, error=error, whole=whole)
