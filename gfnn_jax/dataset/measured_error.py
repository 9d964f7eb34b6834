"""The one-step error of a model on rows of a data set, and the error that is asked for."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from scipy.special import gammaincinv, stdtrit

from gfnn_jax.coordinates import nearest_image
from gfnn_jax.dataset.dataset import Dataset

_LEVEL = 0.95
_NORMAL = 1.6448536269514722  # the level's quantile of a normal number


def bound_of_mean(square: np.ndarray, block: np.ndarray, worst: int = 2) -> float:
    """Upper 95 % bound of the mean of squared errors (n,), those of one block depending on each
    other. block: (n,) integers.

    A sum of squares of errors is near Γ-distributed: the mean times ν / χ²_ν(5 %), with ν = 2
    mean² / variance of the mean (Satterthwaite, Biometrics Bull. 2 (1946) 110). That variance is
    of the blocks' sums; with few blocks it is uncertain itself, and taken as much larger as
    Student's quantile is than the normal one. Infinite from one block alone, which has no scatter.

    The block of the largest error counts ``worst`` times, for what is rarer than one block in n,
    and worse, may not be among them: an event of probability 3/n is missed by n blocks in 5 % of
    cases (e⁻³), which three times stand for.
    """
    _, block = np.unique(block, return_inverse=True)
    sums, counts = np.bincount(block, square), np.bincount(block)
    blocks, largest = len(sums), np.full(worst - 1, np.argmax(sums))
    if blocks < 2 or not np.isfinite(sums).all():
        return float("inf")
    sums, counts = np.append(sums, sums[largest]), np.append(counts, counts[largest])
    rows = counts.sum()
    mean = float(sums.sum() / rows)
    variance = blocks / (blocks - 1) * np.sum((sums - mean * counts) ** 2) / rows**2
    if not variance > 0:
        return mean
    variance *= (stdtrit(blocks - 1, _LEVEL) / _NORMAL) ** 2
    degrees = 2 * mean**2 / variance
    return float(mean * degrees / (2 * gammaincinv(0.5 * degrees, 1 - _LEVEL)))


# Runs from which on their errors tell how much they differ; of fewer, stretches are told apart.
FEWEST_RUNS = 5
# Times that the worst of the rows counts, of those that choose and of those that state an error.
_CHOOSING, _STATING = 2, 3
# Times the median error, above which few states make an RMS, as close passages do: Gaussian errors
# have 1.5, those of polynomials over a box up to 5, beside three bodies 46.
FEW = 10.0


@dataclasses.dataclass(frozen=True)
class Tolerance:
    """The error that is asked for.

    bound:    on the one-step error's upper 95 % bound.
    relative: whether errors are divided by each coordinate's spread first; else they are in the
              user's units, RMS per component.
    """

    bound: float
    relative: bool = True

    @classmethod
    def of(cls, options: Any) -> Tolerance:
        """Tolerance that the options of a fit ask for, which have one of either kind."""
        if options.absolute_tolerance is None:
            return cls(options.tolerance)
        return cls(options.absolute_tolerance, relative=False)

    def met_by(self, candidate: Any) -> bool:
        """Return whether the candidate's error is within it, at 95 %."""
        return candidate.validation_bound <= self.bound

    def size_of(self, candidate: Any) -> float:
        """The candidate's error, in the unit of the tolerance."""
        return candidate.validation_relative if self.relative else candidate.validation_rms

    def text_of(self, candidate: Any) -> str:
        """The candidate's error and its bound as messages say them."""
        size, bound = self.size_of(candidate), candidate.validation_bound
        if not np.isfinite(size):
            return "an infinite one-step error (its step fails at some of the held-out states),"
        shown = f"at most {bound:.1e} with 95 % confidence"
        shown = shown if np.isfinite(bound) else "without a bound"
        return f"a one-step error of {size:.1e}{self.relative * ' of the spread'}, {shown},"

    def missed_by(self, candidate: Any, ended: str) -> str:
        """The warning that nothing meets it, which came nearest, and why the search ended."""
        return (
            f"no candidate meets the tolerance {self.bound:g}: the most accurate, {candidate.label}"
            f", has {self.text_of(candidate)} and the search ended because {ended}"
        )


class OneStepError(NamedTuple):
    """Z_predicted − Z on some rows, in the user's coordinates, angles to the nearest image.

    rms: RMS per component. relative: the RMS over coordinates of error ÷ spread. deviations: (2d,)
    the RMS in each coordinate. bound: the upper 95 % bound in the tolerance's measure
    (`bound_of_mean`). typical: the median over states, in that measure too. All infinite where a
    step fails.
    """

    rms: float
    relative: float
    bound: float
    deviations: np.ndarray
    typical: float


def measured_error(data: Dataset, tolerance: Tolerance, images, rows=None) -> OneStepError:
    """The error of the validation rows' images (N, 2d) in the user's coordinates, or of these
    rows'.

    The bound by the validation rows is the one that the test rows are likely to state: as far above
    their error again as that is above the validation rows'. Their stretches err independently; of
    the rows that state an error runs do, as many as there are.
    """
    own = data.validation if rows is None else rows
    error = nearest_image(images - np.asarray(data.pairs.z1)[own], data.user_angles)
    cluster = data.split.stretch[own] if rows is None else clusters(data, rows)[0]
    worst = _CHOOSING if rows is None else _STATING
    found = one_step_error(error, data.spread, tolerance, cluster, worst)
    size = found.relative if tolerance.relative else found.rms
    if rows is not None or not len(data.test) or not 0 < size < np.inf:
        return found
    return found._replace(bound=found.bound**2 / size)


def error_of_each(data: Dataset, tolerance: Tolerance, images, rows) -> np.ndarray:
    """(n,) the error of each of these rows' images (n, 2d), in the tolerance's measure."""
    error = nearest_image(images - np.asarray(data.pairs.z1)[rows], data.user_angles)
    return np.sqrt(np.mean((error / (data.spread if tolerance.relative else 1.0)) ** 2, axis=1))


def clusters(data: Dataset, rows: np.ndarray) -> tuple[np.ndarray, bool]:
    """(n,) the cluster of each of these rows, of which each errs in its own way, and whether these
    are runs: where there are at least five, else they are stretches of a run."""
    by_run = count_of_runs(data, rows) >= FEWEST_RUNS
    return (data.run if by_run else data.split.stretch)[rows], by_run


def count_of_runs(data: Dataset, rows: np.ndarray) -> int:
    """Runs that these rows are of; a single pair is a run of its own."""
    return len(np.unique(data.run[rows]))


def one_step_error(
    error, spread, tolerance: Tolerance, block=None, worst: int = _CHOOSING
) -> OneStepError:
    """The statistics of errors (N, 2d) of states whose coordinates have this spread (2d,). block:
    (N,) which of them depend on each other; None: none do. worst: as of `bounds.bound_of_mean`."""
    if not np.isfinite(error).all():
        width = error.shape[1]
        return OneStepError(np.inf, np.inf, np.inf, np.full(width, np.inf), np.inf)
    squares = error**2
    deviations = np.sqrt(squares.mean(axis=0))
    measured = np.mean(squares / spread**2 if tolerance.relative else squares, axis=1)
    bound = bound_of_mean(measured, np.arange(len(measured)) if block is None else block, worst)
    relative, typical = np.mean(squares / spread**2), np.median(measured)
    rms, relative, bound, typical = np.sqrt([squares.mean(), relative, bound, typical]).tolist()
    return OneStepError(rms, relative, bound, deviations, typical)


def estimated_error(data: Dataset, tolerance: Tolerance, relative: float) -> OneStepError:
    """The error of a step that a relative residual of the gradient lets expect."""
    rms = relative * float(np.sqrt(np.mean(data.spread**2)))
    bound = relative if tolerance.relative else rms
    return OneStepError(rms, relative, bound, relative * data.spread, bound)
