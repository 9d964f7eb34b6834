"""Laws of physics, tried before libraries of terms: see `models.textbook.search`.

What the search finds is fitted through its flow as any library is, and taken where held-out pairs
bear it out to the tolerance: an H of few terms, with the constants inside them, or none at all.
"""

from __future__ import annotations

import copy
import dataclasses

import numpy as np

from gfnn_jax.budget import MATCHING
from gfnn_jax.diagnosis.symmetries import symmetries_of_pairs
from gfnn_jax.errors import OutOfTime
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw
from gfnn_jax.models.hamiltonians.formula import PartialLaw, Term, formula
from gfnn_jax.models.hamiltonians.problem import LawProblem
from gfnn_jax.models.textbook.search import OPTIONS, Law, Textbook


@dataclasses.dataclass(frozen=True)
class DictionaryOptions:
    """Tuned on the laws of benchmarks/textbook.py.

    dictionaries: name, contents, and operations of a search by degrees of freedom from 1, in the
    order in which they are tried: about the longest of the laws. fewest: pairs. nothing: of the
    largest term, one so small is roundoff. shown: of a coefficient of a partial law, what is not
    shown of it. certain: of the spread, that a law of the pairs' symmetries may leave over. exact:
    of the spread, the error of a law that is no approximation.
    """

    dictionaries: tuple[tuple[str, tuple[str, ...], tuple[float, ...]], ...] = (
        ("laws of physics", (), (1e8, 1.5e8, 3e8, 5e8)),
        ("laws of physics with products", ("products",), (2e8, 3e8, 4e8, 5e8)),
        ("laws of physics with centres", ("centres",), (0.0, 2e8, 4e8, 0.0)),
    )
    fewest: int = 60
    nothing: float = 1e-9
    shown: float = 1e-5
    certain: float = 1e-12
    exact: float = 1e-9


OF_LAWS = DictionaryOptions()


def law_of_physics(problem: LawProblem) -> FittedLaw | None:
    """The law, or None where none is found, or the pairs are of no autonomous flow of a few degrees
    of freedom in plain coordinates and angles. ``partly`` is called with the three laws that come
    closest, where none is exact."""
    data, rows, work = problem.data, problem.data.training, problem.work
    if not problem.simple or data.dim > OPTIONS.most_dim or len(rows) < OF_LAWS.fewest:
        return None
    own = copy.copy(problem.flows)  # its flows are no part of what libraries may take
    own.allowance = dataclasses.replace(own.allowance, cap=None)
    angles = tuple(a for a in data.coordinates.angles if a < data.dim)
    symmetric, search = (
        Textbook(
            own,
            rows,
            angles=angles,
            cyclic=data.coordinates.cyclic,
            on_progress=problem.on_progress,
            symmetries=symmetries,
        )
        for symmetries in (symmetries_of_pairs(data), ())
    )
    law = None
    for name, contents, operations in OF_LAWS.dictionaries:
        if law is not None or not operations[data.dim - 1]:
            continue
        try:
            with work.budget.unit(name, MATCHING, operations[data.dim - 1]):
                law = _found(symmetric, search, dict.fromkeys(contents, True))
        except OutOfTime:
            work.budget.leave_out(name, work.ended)
            return None
        except np.linalg.LinAlgError:
            return None
    if law is None:
        for partial in search.partial:
            family, c = _without_nothing(partial, data.y0[rows], data.scale)
            named = zip(family.term_names, c.tolist(), strict=True)
            shown = formula([Term(name, x, OF_LAWS.shown * abs(x)) for name, x in named])
            problem.partly(PartialLaw(shown, partial.left, "of the spread"))
        return None
    family, start = _without_nothing(law, data.y0[rows], data.scale)
    try:
        # Whatever it took to fit the libraries before, this law is close to its optimum.
        with work.again(f"H of {family.num_parameters} terms", family, len(rows)):
            found = problem.fitted(family, start, rows, rounds=False)
    except OutOfTime:
        work.budget.leave_out("the law of physics that was found", work.ended)
        return None
    if not (problem.met_by(found) and found.error.relative <= OF_LAWS.exact):
        return None
    return found._replace(null=search.null, undetermined=search.null)


def _found(symmetric: Textbook, search: Textbook, contents: dict[str, bool]) -> Law | None:
    """The law of a dictionary: of the atoms that have the pairs' symmetries, where it is as exact
    as clean pairs are, else of all atoms."""
    law = symmetric.law(**contents) if symmetric.symmetric else None
    return law if law is not None and law.left <= OF_LAWS.certain else search.law(**contents)


def _without_nothing(law: Law, z: np.ndarray, scale: np.ndarray):
    """(family, coefficients) of the terms whose part in the gradients is not roundoff."""
    gradients = law.family.term_gradients(z) * scale[:, None]
    part = np.abs(law.coefficients) * np.sqrt(np.mean(gradients**2, axis=(0, 1)))
    kept = np.flatnonzero(part > OF_LAWS.nothing * part.max())
    return law.family.take(kept.tolist()), law.coefficients[kept]
