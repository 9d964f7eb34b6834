"""Protocol of a sweep: the sizes of one model, as a search climbs them and a fit goes on with one.

Who searches, chooses, states the error and draws the conclusions asks a sweep for these members,
and never which model it is of.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np

from gfnn_jax.budget import Budget
from gfnn_jax.candidates.candidate import Candidate
from gfnn_jax.dataset.dataset import Dataset

OnProgress = Callable[[str], Any]


@runtime_checkable
class Climbed(Protocol):
    """Sizes of one model as a search climbs them.

    sizes: by rising ``operations`` of a step, each with an ``order`` with which the logarithm of
    the error falls in proportion. short_of_pairs: whether more pairs would allow larger sizes.
    """

    sizes: Sequence[Any]
    short_of_pairs: bool

    def named(self, size: Any) -> str:
        """Name of the unit of work that estimates the size."""
        ...

    def at(self, order: float) -> str:
        """Name of a size of this order, and what it would take."""
        ...

    def work(self, size: Any) -> float:
        """Operations that estimating its error takes."""
        ...

    def work_of_steps(self, size: Any) -> float:
        """Operations that validating it takes."""
        ...

    def estimate(self, size: Any, budget: Budget, on_progress: OnProgress) -> Candidate:
        """The size fitted, with its estimated error."""
        ...

    def validate(
        self, size: Any, estimated: Candidate, budget: Budget, on_progress: OnProgress
    ) -> Candidate:
        """The estimated candidate with the error of its own steps."""
        ...


@runtime_checkable
class Sweep(Climbed, Protocol):
    """Sizes of one model on one data set, with what a fit goes on to ask of one of them.

    data: the pairs that it is fitted to. linear: whether a size is a linear least-squares problem,
    whose residuals, solutions from other rows and noise of the coefficients are at hand.
    """

    data: Dataset
    linear: bool

    def work_of_refit(self, size: Any) -> float:
        """Operations that fitting it to other rows takes, infinite where it is not fitted anew."""
        ...

    def piece(self, size: Any) -> Any:
        """The piece of a map (`maps.piece.Piece`) that the fitted size makes."""
        ...

    def images(self, size: Any, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Images of these rows (n, 2d), inner ones, and which steps were solved (n,)."""
        ...

    def predicted(self, size: Any, others: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Images (n, 2d) of these rows, in the user's coordinates, by a fit to other rows."""
        ...

    def posterior(self, size: Any) -> Callable[[], np.ndarray] | None:
        """Function that makes the covariance root (k, m) of the params of the size's piece; None
        where the model has none."""
        ...
