"""Centrifugal terms of motion on a sphere, p_j²/sin² q_i, where the pairs ask for them.

They are in no library of products: 1/sin² has its poles where the angle q_i is a multiple of π (of
latitudes, 1/cos² at the odd ones of π/2), close to which states are found. Least squares of the
pairs' forces and velocities at their midpoints, exact to second order in dt, tell within
milliseconds whether these terms explain what a library leaves over.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.errors import FitError
from gfnn_jax.families.sums import Sums
from gfnn_jax.families.terms import Terms, given_terms, joined, polynomial_terms
from gfnn_jax.fitting.linear_starts import fitted_gradients
from gfnn_jax.generating.charts import MIDPOINT

_MOST_DIM = 3  # beyond it they are too many
_ROWS_PER_TERM = 4  # numbers for each coefficient, and half as many again to judge by
_GAINED = 0.2  # of what the library leaves over, that may be left with them


def centrifugal_terms(data: Dataset, rows: np.ndarray, family: Terms | Sums) -> tuple[str, ...]:
    """Centrifugal terms, and the cosine and sine of their angles, which with the quadratic terms
    leave a fifth or less of what ``family`` leaves over, and of what they leave without the
    centrifugal ones: cosines alone stand in for any well. None where they do not.

    rows: of pairs in plain coordinates, without args or a structure. At states beyond a pole, and
    where one lies between states, a term is not tried."""
    dim = data.dim
    if dim > _MOST_DIM:
        return ()
    texts = [
        f"p{j + 1}**2/{f}(q{i + 1})**2"
        for f, pole in (("sin", 0.0), ("cos", np.pi / 2))
        for i, j in permutations(range(dim), 2)
        if i not in data.coordinates.cyclic and _between_poles(data.y0[rows, i], pole)
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
    return (*texts, *waves) if left <= _GAINED * min(others) else ()


def _between_poles(q: np.ndarray, pole: float) -> bool:
    """Return whether the values lie between two neighbouring poles, at ``pole`` and every π from
    it."""
    return bool(np.ptp(np.floor((q - pole) / np.pi)) == 0)


def _held_out_residual(family: Terms | Sums, data: Dataset, rows: np.ndarray) -> float:
    """RMS of the held-out target gradients, in units of the coordinates' sizes, that least squares
    leave over; infinite where they fail."""
    count = -(-_ROWS_PER_TERM * family.num_parameters // (2 * data.dim))
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
