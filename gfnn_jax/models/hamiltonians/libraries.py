"""Libraries of terms for H: polynomials, features, modes of angles, a user's own terms; and the
centrifugal terms of motion on a sphere, p_j²/sin² q_i, where the pairs ask for them.

Those are in no library of products: 1/sin² has its poles where the angle q_i is a multiple of π (of
latitudes, 1/cos² at the odd ones of π/2), close to which states are found. Least squares of the
pairs' forces and velocities at their midpoints, exact to second order in dt, tell within
milliseconds whether these terms explain what a library leaves over.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from itertools import permutations
from typing import Any

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.diagnosis.misfit import misfit
from gfnn_jax.errors import FitError
from gfnn_jax.families.modes import Modes
from gfnn_jax.families.sums import Sums
from gfnn_jax.families.terms import Terms, given_terms, joined, multiplied, polynomial_terms
from gfnn_jax.fitting.linear_starts import fitted_gradients
from gfnn_jax.generating.charts import MIDPOINT
from gfnn_jax.models.hamiltonians.problem import LawProblem
from gfnn_jax.models.parameters import angles_and_others


@dataclasses.dataclass(frozen=True)
class LibraryOptions:
    """Tuned on three bodies, and on the spherical pendulum whose angles are not told.

    telling: pairs, from which on the midpoints of a sample tell libraries apart; worse: times what
    another library leaves of their gradients, too far from them. Of centrifugal terms: most_dim:
    degrees of freedom, beyond which they are too many; rows_per_term: numbers for each coefficient,
    and half as many again to judge by; gained: of what the library leaves over, that may be left
    with them.
    """

    telling: int = 60
    worse: float = 3.0
    most_dim: int = 3
    rows_per_term: int = 4
    gained: float = 0.2


OPTIONS = LibraryOptions()


def modes_of(problem: LawProblem, terms: Sequence[Any]) -> Modes | None:
    """The basis that grows, where an angle enters H by itself, beside a user's terms; else None."""
    data, scene = problem.data, problem.scene
    if data.args is not None or (scene is not None and scene.features is not None):
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
    return given_terms(data.dim, given, data.parameters) if given else None


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


def libraries_of(problem: LawProblem) -> Iterator[Terms | Sums]:
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
            yield own
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
            yield library


def promising(libraries: list[Any], data: Dataset) -> list[Any]:
    """The libraries but those that leave far more of the midpoints' gradients over than another
    does, as that of equal bodies does of unequal ones: the fit of such a one takes longest."""
    if data.varied or len(data.training) < OPTIONS.telling:
        return libraries
    left = [misfit(family, data, MIDPOINT) for family in libraries]
    most = OPTIONS.worse * min(left, default=np.inf)
    return [f for f, part in zip(libraries, left, strict=True) if part <= most]


def centrifugal_terms(data: Dataset, rows: np.ndarray, family: Terms | Sums) -> tuple[str, ...]:
    """Centrifugal terms, and the cosine and sine of their angles, which with the quadratic terms
    leave a fifth or less of what ``family`` leaves over, and of what they leave without the
    centrifugal ones: cosines alone stand in for any well. None where they do not.

    rows: of pairs in plain coordinates, without args or a structure. At states beyond a pole, and
    where one lies between states, a term is not tried."""
    dim = data.dim
    if dim > OPTIONS.most_dim:
        return ()

    def between_poles(q: np.ndarray, pole: float) -> bool:
        """Return whether the values lie between two neighbours of the poles, every π from one."""
        return bool(np.ptp(np.floor((q - pole) / np.pi)) == 0)

    texts = [
        f"p{j + 1}**2/{f}(q{i + 1})**2"
        for f, pole in (("sin", 0.0), ("cos", np.pi / 2))
        for i, j in permutations(range(dim), 2)
        if i not in data.coordinates.cyclic and between_poles(data.y0[rows, i], pole)
    ]
    if not texts:
        return ()
    angles = [i for i in range(dim) if any(f"(q{i + 1})" in text for text in texts)]
    waves = [f"{f}(q{i + 1})" for i in angles for f in ("cos", "sin")]
    with_them, without = (
        joined(given_terms(dim, own), polynomial_terms(dim, 2)) for own in (texts + waves, waves)
    )
    left = _held_out_residual(with_them, data, rows)
    others = [_held_out_residual(known, data, rows) for known in (family, without)]
    return (*texts, *waves) if left <= OPTIONS.gained * min(others) else ()


def _held_out_residual(family: Terms | Sums, data: Dataset, rows: np.ndarray) -> float:
    """RMS of the held-out target gradients, in units of the coordinates' sizes, that least squares
    leave over; infinite where they fail."""
    count = -(-OPTIONS.rows_per_term * family.num_parameters // (2 * data.dim))
    rows, scale = rows[: count + count // 2], data.scale
    if len(rows) <= count:
        return np.inf
    y0, y1 = data.y0[rows], data.y1[rows]
    w = MIDPOINT.evaluation_point(y0, y1)
    dt = np.reshape(data.given(rows)[0], (-1, 1))
    target = MIDPOINT.target_gradient(y0, y1, dt)
    try:
        c = fitted_gradients(family, w[:count], target[:count], scale)
    except (FitError, np.linalg.LinAlgError):  # terms that overflow at these states
        return np.inf
    off = (family.gradient(c, w[count:]) - target[count:]) / np.roll(scale, data.dim)
    rms = float(np.sqrt(np.mean(off**2)))
    return rms if np.isfinite(rms) else np.inf
