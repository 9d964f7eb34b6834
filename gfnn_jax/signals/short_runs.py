"""The noise of many short runs of one law, by what their neighbours do not tell of readings.

A run of a few readings a period does not tell its noise from its motion, as a long one does by its
spectrum; that all runs obey one law does. With y₋, y, y₊ three readings in a row, even in time,

    (y₋ + y₊)/2 − y = F(y, y₊ − y₋) + noise

with one F for all, half the square of the step times the acceleration: a polynomial, whose
derivatives say how much of each reading's noise is in what is left. That tells σ, too large where F
leaves motion; but then what neighbouring equations of a run leave is not correlated as by the
readings that they share. The first degree is taken at which it is.
"""

from collections.abc import Sequence
from math import comb

import numpy as np
from scipy.optimize import nnls

from gfnn_jax.arrays import products


class _Options:
    """even: part of a step that times may be off. degrees: of polynomials, at most. share:
    equations for each coefficient. small: of a spread, over which is differenced. alike: difference
    of correlations, up to which what is left is noise (`tests/test_sampling.py`)."""

    even: float = 0.01
    degrees: int = 9
    share: int = 4
    small: float = 1e-5
    alike: float = 0.1


def noise_of_one_law(
    runs: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
) -> np.ndarray | None:
    """The noise σ (k,) of the readings of runs: times (n,), readings (n, k), NaN where nothing was
    read, and inputs and parameters (n, m) that the law depends on. None where they do not tell it:
    where times are uneven, readings few, or the motion depends on more, or is more than a
    polynomial follows.
    """
    step = np.quantile(np.concatenate([np.diff(t) for t, *_ in runs]), 0.5, method="lower")
    rows, told, follows = [], [], []
    for t, y, others in runs:
        even = np.abs(np.diff(t) / step - 1) < _Options.even
        known = np.all(np.isfinite(np.concatenate([y, others], axis=1)), axis=1)
        first = np.flatnonzero(even[:-1] & even[1:] & known[:-2] & known[1:-1] & known[2:])
        rows.append(y[first[:, None] + np.arange(3)])
        told.append(np.concatenate([others[first + k] for k in range(3)], axis=1))
        follows.append(np.diff(first, append=-1) == 1)
    y, variables = np.concatenate(rows), np.concatenate(told)
    variables = variables[:, np.std(variables, axis=0) > 0] if len(y) else variables
    many, pairs = 2 * y.shape[2] + variables.shape[1], np.flatnonzero(np.concatenate(follows))
    for degree in range(1, _Options.degrees + 1):
        if _Options.share * comb(many + degree, degree) > len(y):
            return None
        sigma = _noise(y, variables, degree, pairs)
        if sigma is not None:
            return sigma
    return None


def _noise(
    y: np.ndarray, variables: np.ndarray, degree: int, pairs: np.ndarray
) -> np.ndarray | None:
    """σ (k,) of readings y (n, 3, k) in a row by a polynomial in them and in variables (n, m)
    without noise; None where it leaves more than their noise. pairs: equations whose next is of the
    same run."""
    bent, (here, moved) = (y[:, 0] + y[:, 2]) / 2 - y[:, 1], (y[:, 1], y[:, 2] - y[:, 0])
    own = np.concatenate([here, moved, variables], axis=1)
    size = own.std(axis=0)
    own = (own - own.mean(axis=0)) / size
    X = products(own, degree)
    c, _, rank, _ = np.linalg.lstsq(X, bent, rcond=None)
    r, d = bent - X @ c, y.shape[2]
    by = np.empty((2 * d, *r.shape))  # of F, in readings and in differences
    for j, axis in enumerate(np.eye(own.shape[1])[: 2 * d]):
        further = products(own + _Options.small * axis, degree)
        by[j] = (further - X) @ c / (_Options.small * size[j])
    self, slope = np.eye(d)[:, None], by[d:]
    J = np.stack([self / 2 + slope, -self - by[:d], self / 2 - slope])  # of r (place, j, n, i)
    scale = np.maximum(np.sum(r**2, axis=0) / (len(r) - rank), 1e-300)
    gains = np.mean(np.sum(J**2, axis=0), axis=1).T
    squares = nnls(gains * scale / scale[:, None], np.ones(d))[0] * scale
    shared = squares @ np.mean(np.sum(J[1:, :, pairs] * J[:-1, :, pairs + 1], axis=0), axis=1)
    correlated = np.mean(r[pairs] * r[pairs + 1], axis=0) if len(pairs) else np.inf
    is_noise = np.abs(correlated - shared) < _Options.alike * scale
    return np.sqrt(squares) if np.all(is_noise) and np.all(squares > 0) else None
