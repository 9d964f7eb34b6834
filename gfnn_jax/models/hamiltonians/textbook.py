"""Laws of physics, tried before libraries of terms: see `models.textbook.search`.

What the search finds is fitted through its flow as any library is, and taken where held-out pairs
bear it out to the tolerance: an H of few terms, with the constants inside them, or none at all.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from gfnn_jax.budget import MATCHING
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.diagnosis.symmetries import symmetries_of_pairs
from gfnn_jax.errors import OutOfTime
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw
from gfnn_jax.models.hamiltonians.formula import OnPartial, PartialLaw, Term, formula
from gfnn_jax.models.hamiltonians.steps_of_law import validation_error
from gfnn_jax.models.hamiltonians.work import LawWork
from gfnn_jax.models.textbook.search import OPTIONS, Law, Textbook

# Dictionaries, in the order in which they are tried, and the operations of a search by degrees of
# freedom from 1: about the longest of the laws of benchmarks/textbook.py.
_DICTIONARIES = (
    ("laws of physics", {}, (1e8, 1.5e8, 3e8, 5e8)),
    ("laws of physics with products", {"products": True}, (2e8, 3e8, 4e8, 5e8)),
    ("laws of physics with centres", {"centres": True}, (0.0, 2e8, 4e8, 0.0)),
)
_FEWEST = 60  # pairs
_NOTHING = 1e-9  # of the largest term: a term so small is roundoff
_SHOWN = 1e-5  # of a coefficient of a partial law: what is not shown of it
_CERTAIN = 1e-12  # of the spread, that a law of the pairs' symmetries may leave over
_EXACT = 1e-9  # of the spread: the error of a law that is no approximation


def law_of_physics(
    problem: Problem,
    work: LawWork,
    data: Dataset,
    tolerance: Tolerance,
    on_progress: Callable[[str], Any],
    partly: OnPartial,
) -> FittedLaw | None:
    """The law, or None where none is found, or the pairs are of no autonomous flow of a few degrees
    of freedom in plain coordinates and angles. partly: called with the three laws that come
    closest, where none is exact."""
    simple = data.args is None and data.structure is None
    if not simple or data.dim > OPTIONS.most_dim or len(data.training) < _FEWEST:
        return None
    rows, coordinates = data.training, data.coordinates
    own = copy.copy(problem)  # its flows are no part of what libraries may take
    own.allowance = dataclasses.replace(problem.allowance, cap=None)
    symmetric, search = (
        Textbook(
            own,
            rows,
            angles=tuple(a for a in coordinates.angles if a < data.dim),
            cyclic=coordinates.cyclic,
            on_progress=on_progress,
            symmetries=symmetries,
        )
        for symmetries in (symmetries_of_pairs(data), ())
    )
    law = None
    for name, contents, operations in _DICTIONARIES:
        if law is not None or not operations[data.dim - 1]:
            continue
        try:
            with work.budget.unit(name, MATCHING, operations[data.dim - 1]):
                law = _found(symmetric, search, contents)
        except OutOfTime:
            work.budget.leave_out(name, work.ended)
            return None
        except np.linalg.LinAlgError:
            return None
    if law is None:
        for partial in search.partial:
            family, c = _without_nothing(partial, data.y0[rows], data.scale)
            named = zip(family.term_names, c.tolist(), strict=True)
            shown = formula([Term(name, value, _SHOWN * abs(value)) for name, value in named])
            partly(PartialLaw(shown, partial.left, "of the spread"))
        return None
    family, start = _without_nothing(law, data.y0[rows], data.scale)
    try:
        # Whatever it took to fit the libraries before, this law is close to its optimum.
        with work.again(f"H of {family.num_parameters} terms", family, len(rows)):
            fit = problem.fit(family, start, rows, rounds=False)
            error = validation_error(family, fit, data, tolerance)
    except OutOfTime:
        work.budget.leave_out("the law of physics that was found", work.ended)
        return None
    if not (error.bound <= tolerance.bound and error.relative <= _EXACT):
        return None
    return FittedLaw(family, fit, rows, error, search.null, search.null)


def _found(symmetric: Textbook, search: Textbook, contents: dict[str, bool]) -> Law | None:
    """The law of a dictionary: of the atoms that have the pairs' symmetries, where it is as exact
    as clean pairs are, else of all atoms."""
    law = symmetric.law(**contents) if symmetric.symmetric else None
    return law if law is not None and law.left <= _CERTAIN else search.law(**contents)


def _without_nothing(law: Law, z: np.ndarray, scale: np.ndarray):
    """(family, coefficients) of the terms whose part in the gradients is not roundoff."""
    gradients = law.family.term_gradients(z) * scale[:, None]
    part = np.abs(law.coefficients) * np.sqrt(np.mean(gradients**2, axis=(0, 1)))
    kept = np.flatnonzero(part > _NOTHING * part.max())
    return law.family.take(kept.tolist()), law.coefficients[kept]
