"""Libraries of terms for H: polynomials, features, modes of angles, a user's own terms."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.diagnosis.residuals import misfit
from gfnn_jax.errors import FitError
from gfnn_jax.families.modes import Modes
from gfnn_jax.families.sums import Sums
from gfnn_jax.families.terms import Terms, given_terms, joined, multiplied, polynomial_terms
from gfnn_jax.families.told import Constrained, anything_told, untold
from gfnn_jax.generating.charts import MIDPOINT
from gfnn_jax.models.hamiltonians.problem import LawProblem
from gfnn_jax.models.hamiltonians.told_terms import constrained
from gfnn_jax.models.parameters import angles_and_others

# Pairs, from which on the midpoints of a sample tell libraries apart, and times what another one
# leaves of their gradients, too far from them (three bodies).
_TELLING, _WORSE = 60, 3.0


def modes_of(problem: LawProblem) -> Modes | None:
    """The basis that grows, where an angle enters H by itself, beside a user's terms; else None,
    and where something is told of their coefficients."""
    data, scene, terms = problem.data, problem.scene, problem.terms
    if data.args is not None or (scene is not None and scene.features is not None):
        return None
    if anything_told(terms):
        return None
    angles, plain = angles_and_others(data)
    if not angles:
        return None
    own = given_terms(data.dim, terms).variables if terms else ()
    own = tuple(text for text in own if text not in plain)
    return Modes(data.dim, angles, (*plain, *own), len(own))


def own_terms(problem: LawProblem) -> Terms | None:
    """The user's own terms, None where there are none."""
    given, data = problem.terms, problem.data
    return given_terms(data.dim, untold(given), data.parameters) if given else None


def check_finite(given: Terms, data: Dataset, rows) -> None:
    """Raises FitError for a user's term that has no value or no slope at some of the states."""
    z = data.y0[rows]
    slopes = given.term_gradients(z, data.given(rows)[1])
    for j, name in enumerate(given.term_names):
        bad = ~np.isfinite(slopes[:, :, j]).all(axis=1)
        if bad.any():
            raise FitError(
                f"expected terms that are finite at all states, got '{name}', which is not at "
                f"{int(bad.sum())} of {len(z)}"
            )


def libraries_of(problem: LawProblem) -> Iterator[Terms | Sums | Constrained]:
    """Families by rising size, of as many terms as the training rows tell apart."""
    data, scene, options = problem.data, problem.scene, problem.options
    if data.structure is not None:
        libraries = data.structure.libraries(data.dim, problem.terms)
        yield from (f for f in libraries if f.num_parameters <= problem.most_terms)
        return
    reversor = scene.reversor if scene is not None else None
    features = scene.features if scene is not None else None
    most, own = min(problem.most_terms, options.most_terms), own_terms(problem)
    degrees = options.degrees if features is None else options.feature_degrees
    for degree in degrees if own is None else options.given_degrees:
        if degree == 0:
            assert own is not None
            yield constrained(problem, own)
            continue
        family = polynomial_terms(
            data.dim,
            degree,
            cyclic=data.coordinates.cyclic,
            features=features,
            reversor=reversor,
        )
        tried = [family] if own is None else [joined(own, family)]
        if own is not None and degree in options.given_products:
            tried.append(joined(tried[0], multiplied(own, family)))
        for library in tried:
            if library.num_parameters > most:
                return
            yield library if own is None else constrained(problem, library)


def promising(libraries: list[Any], data: Dataset) -> list[Any]:
    """The libraries but those that leave far more of the midpoints' gradients over than another
    does, as that of equal bodies does of unequal ones: the fit of such a one takes longest."""
    if data.varied or len(data.training) < _TELLING:
        return libraries
    left = [misfit(family, data, MIDPOINT) for family in libraries]
    most = _WORSE * min(left, default=np.inf)
    return [f for f, part in zip(libraries, left, strict=True) if part <= most]
