"""Coefficients without some of the rows that they are fitted to, for cross-validation.

Close to the optimum of all rows one Gauss–Newton step leads to that of most of them, and its
problem is the sum of those of the parts that are kept: each part is linearised once, whichever is
left out (approximate cross-validation: Rad & Maleki, J. R. Stat. Soc. B 82, 2020). Each step is
checked by the residuals where it leads.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import numpy as np

from gfnn_jax.fitting.descent import DESCENT, ROUNDOFF, step
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.flows.collocation import Steps

# Of the residual that the linearised problem foretells, by which that of the step may differ.
_FORETOLD = 0.01


def without_each(
    problem: Problem, family, c: np.ndarray, steps: Steps, parts: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Coefficients (terms,) of the fits to all of these parts but one, for each in turn.

    c: (terms,) of a fit to the rows of the parts, or to most of them. parts: rows, none in two.
    Where one step from c does not reach the optimum, the fit is made.
    """
    if len(parts) > 1 and _is_rounding(problem, family, c, steps, parts):
        return [c] * len(parts)
    triangles = [problem.linearised(family, c, steps, part) for part in parts]
    found = []
    for i in range(len(parts)):
        kept = [j for j in range(len(parts)) if j != i]
        rows = np.sort(np.concatenate([np.zeros(0, int), *(parts[j] for j in kept)]))
        empty = Triangle.empty(family.num_parameters)
        here = reduce(Triangle.merge, (triangles[j] for j in kept), empty)
        there = _one_step(problem, family, c, steps, rows, here)
        if there is None:
            there = problem.fit(family, c, rows, rounds=False, steps=steps).coefficients
        found.append(there)
    return found


def _is_rounding(problem: Problem, family, c, steps: Steps, parts: Sequence[np.ndarray]) -> bool:
    """Return whether the residual at c is rounding, which no fit to most of the rows lowers."""
    largest = max(len(part) for part in parts)
    rows = np.sort(np.concatenate(parts))
    norm = np.linalg.norm(problem.residuals(family, c, steps, rows))
    return bool(norm <= ROUNDOFF * np.sqrt((len(rows) - largest) * problem.z0.shape[1]))


def _one_step(
    problem: Problem, family, c: np.ndarray, steps: Steps, rows: np.ndarray, here: Triangle
) -> np.ndarray | None:
    """c after a Gauss–Newton step over these rows, of which ``here`` is the triangle at c; c itself
    where rounding leaves nothing to gain; None where the step is not what was foretold."""
    if not np.isfinite(here.norm) or here.rows < family.num_parameters:
        return None
    spectrum = here.spectrum()
    tried, foretold = c - step(spectrum, 0.0), spectrum.residual_norm
    norm = float(np.linalg.norm(problem.residuals(family, tried, steps, rows)))
    if here.norm <= norm < 2 * here.norm and foretold > (1 - DESCENT.promised) * here.norm:
        return c  # the descent ends here too: the residual is rounding, or truncation
    return tried if abs(norm - foretold) <= _FORETOLD * foretold else None
