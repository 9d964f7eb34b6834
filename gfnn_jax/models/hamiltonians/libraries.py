"""Libraries of terms for H: polynomials, features, modes of angles, a user's own terms."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.diagnosis.misfit import misfit
from gfnn_jax.errors import FitError
from gfnn_jax.families.expressions import coordinate_names
from gfnn_jax.families.modes import Modes
from gfnn_jax.families.sums import Sums
from gfnn_jax.families.terms import Terms, given_terms, joined, multiplied, polynomial_terms
from gfnn_jax.generating.charts import MIDPOINT
from gfnn_jax.models.hamiltonians.options import LawOptions

_TELLING = 60  # pairs, from which on the midpoints of a sample tell libraries apart
_WORSE = 3.0  # times what another library leaves of their gradients: too far from them


def angles_and_others(data: Dataset) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """The angles that enter H by themselves, and the names of the coordinates that are none."""
    dim, coordinates = data.dim, data.coordinates
    angles = tuple(i for i in coordinates.angles if i < dim and i not in coordinates.cyclic)
    plain = tuple(
        name
        for i, name in enumerate(coordinate_names(dim))
        if i not in angles and i not in coordinates.cyclic
    )
    return angles, plain


def modes_of(data: Dataset, scene, terms) -> Modes | None:
    """The basis that grows, where an angle enters H by itself; else None."""
    if data.args is not None or (scene is not None and scene.features is not None):
        return None
    dim = data.dim
    angles, plain = angles_and_others(data)
    if not angles:
        return None
    own = given_terms(dim, terms).variables if terms else ()
    own = tuple(text for text in own if text not in plain)
    return Modes(dim, angles, (*plain, *own), len(own))


def own_terms(data: Dataset, terms) -> Terms:
    return given_terms(data.dim, terms, data.parameters)


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


def libraries_of(data: Dataset, scene, terms, options: LawOptions) -> Iterator[Terms | Sums]:
    """Families by rising size, of as many terms as the training rows tell apart."""
    dim, coordinates = data.dim, data.coordinates
    if data.structure is not None:
        libraries = data.structure.libraries(dim, terms)
        most = len(data.training) * 2 * dim / options.rows_per_term
        yield from (library for library in libraries if library.num_parameters <= most)
        return
    reversor = scene.reversor if scene is not None else None
    features = scene.features if scene is not None else None
    most = len(data.training) * 2 * dim / options.rows_per_term
    most = min(most, options.most_terms)
    own = own_terms(data, terms) if terms else None
    if own is not None:
        degrees = options.given_degrees
    else:
        degrees = options.degrees if features is None else options.feature_degrees
    for degree in degrees:
        if degree == 0:
            assert own is not None
            yield own
            continue
        family = polynomial_terms(
            dim, degree, cyclic=coordinates.cyclic, features=features, reversor=reversor
        )
        tried = [family] if own is None else [joined(own, family)]
        if own is not None and degree in options.given_products:
            tried.append(joined(tried[0], multiplied(own, family)))
        for library in tried:
            if library.num_parameters > most:
                return
            yield library


def promising(libraries: list[Any], data: Dataset) -> list[Any]:
    """The libraries but those that leave far more of the midpoints' gradients over than another
    does, as that of equal bodies does of unequal ones: the fit of such a one takes longest."""
    if data.varied or len(data.training) < _TELLING:
        return libraries
    left = [misfit(family, data, MIDPOINT) for family in libraries]
    most = _WORSE * min(left, default=np.inf)
    return [f for f, part in zip(libraries, left, strict=True) if part <= most]
