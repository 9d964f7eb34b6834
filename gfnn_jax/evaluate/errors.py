"""Errors of a prediction against a reference, and their statistics over trajectories. NumPy.

An error is NaN where there is no finite reference to compare with, and inf where the reference is
finite and the prediction is not. A lost prediction counts; one without a reference does not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gfnn_jax.coordinates import nearest_image
from gfnn_jax.phase_space import split


class ErrorStatistics(NamedTuple):
    """Statistics over the trajectories with a finite reference; mean, std, median are (L,)."""

    mean: np.ndarray
    std: np.ndarray
    median: np.ndarray
    num_excluded: int  # trajectories left out, whose reference does not stay finite
    num_lost: int  # trajectories that count, whose prediction becomes non-finite


def position_error(predicted, reference, angles=()):
    """Euclidean error of q, (B, L), of trajectories (B, L, 2d). See `momentum_error`."""
    return _euclidean(split(_difference(predicted, reference, angles))[0])


def momentum_error(predicted, reference, angles=()):
    """Euclidean error of p, (B, L), of trajectories (B, L, 2d).

    ``angles`` are the indices in z of the coordinates with period 2π, a q or a p: their
    differences are taken to the nearest image, in [−π, π].
    """
    return _euclidean(split(_difference(predicted, reference, angles))[1])


def absolute_error(predicted, reference):
    """Absolute error |predicted − reference| of an element or an invariant, elementwise."""
    return np.abs(_difference(predicted, reference))


def one_step_rms(predicted, reference, angles=()) -> float:
    """RMS per component of predicted − reference, both (N, 2d): the one-step state error.

    angles: argument of `momentum_error`. The result is inf where a prediction is not finite.
    """
    return float(np.sqrt(np.mean(_difference(predicted, reference, angles) ** 2)))


def _difference(predicted, reference, angles=()):
    predicted, reference = np.asarray(predicted, float), np.asarray(reference, float)
    with np.errstate(invalid="ignore"):
        difference = nearest_image(predicted - reference, angles)
    difference = np.where(np.isfinite(predicted), difference, np.inf)
    return np.where(np.isfinite(reference), difference, np.nan)


def _euclidean(difference):
    return np.sqrt(np.sum(difference**2, axis=-1))


def error_statistics(error) -> ErrorStatistics:
    """Mean, (population) standard deviation and median over trajectories of errors (B, L).

    A trajectory with a NaN error anywhere has no finite reference there. It is left out at every
    step and counted in ``num_excluded``. A lost prediction (inf) is never left out: from that step
    on the mean and the deviation are inf, and the median is inf once half are lost.
    """
    error = np.asarray(error, float)
    kept = error[~np.isnan(error).any(axis=1)]
    num_excluded = len(error) - len(kept)
    if not len(kept):
        nothing = np.full(error.shape[1], np.nan)
        return ErrorStatistics(nothing, nothing, nothing, num_excluded, 0)
    with np.errstate(invalid="ignore"):
        mean, std, median = kept.mean(axis=0), kept.std(axis=0), np.median(kept, axis=0)
    # NumPy's deviation around an infinite mean is NaN, and so is the middle of two infinities.
    std = np.where(np.isfinite(mean), std, np.inf)
    median = np.where(np.isnan(median), np.inf, median)
    num_lost = int(np.isinf(kept).any(axis=1).sum())
    return ErrorStatistics(mean, std, median, num_excluded, num_lost)
