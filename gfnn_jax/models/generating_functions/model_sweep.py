"""The sizes of a model that follows the protocol `models.model.Model`, as a sweep of the search."""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from gfnn_jax.budget import Budget
from gfnn_jax.candidates.assemble import Candidate, composed, stepped
from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance, measured_error
from gfnn_jax.models.model import Fitted, Model, TrainingData


@dataclasses.dataclass(frozen=True)
class ModelSize:
    """A model's own size, and its number among them, by which sizes are in order."""

    own: Any
    number: int

    @property
    def operations(self) -> float:
        return float(self.number)

    @property
    def order(self) -> float:
        return float(self.number)


class ModelSweep:
    """The sizes of one model, each fitted to the training pairs and measured by its own steps."""

    short_of_pairs = False
    linear = False

    def __init__(self, model: Model, data: Dataset, tolerance: Tolerance):
        self.model, self.data, self.tolerance = model, data, tolerance
        self._data = training_data(data, data.training)
        self.sizes = [ModelSize(own, n) for n, own in enumerate(model.sizes(self._data), 1)]
        self._fitted: dict[int, Fitted] = {}

    def named(self, size: ModelSize) -> str:
        """Name of the unit that estimates the size."""
        return f"{self.model.name} {size.own}"

    def work(self, size: ModelSize) -> float:
        """A model counts one operation, for its own are not known."""
        return 1.0

    def work_of_steps(self, size: ModelSize) -> float:
        """The steps are made when the size is estimated."""
        return 0.0

    def work_of_refit(self, size: ModelSize) -> float:
        """A fit to other rows counts one operation, too."""
        return 1.0

    def estimate(
        self, size: ModelSize, budget: Budget, on_progress: Callable[[str], Any]
    ) -> Candidate:
        """The size fitted, and its error measured by steps on the validation rows."""
        started = time.perf_counter()
        on_progress(self.named(size))
        fitted = self._fitted[size.number] = self.model.fit(self._data, size.own)
        seconds = time.perf_counter() - started
        images = self._images_of_users(fitted, self.data.validation)
        error = measured_error(self.data, self.tolerance, images)
        return Candidate.of(
            error,
            label=fitted.label,
            family=self.model.name,
            chart="model",
            num_parameters=fitted.num_parameters,
            operations=float(fitted.operations),
            train_rms=float("nan"),
            fit_seconds=seconds,
            validated=True,
        )

    def validate(
        self, size: ModelSize, estimated: Candidate, budget: Budget, on_progress
    ) -> Candidate:
        """The estimated size as it is: its steps have been made."""
        return estimated

    def at(self, order: float) -> str:
        """Name of the size of this number."""
        return f"size {round(order)} of {self.model.name}"

    def piece(self, size: ModelSize) -> Any:
        """The fitted piece."""
        return self._fitted[size.number].piece

    def posterior(self, size: ModelSize) -> Callable[[], np.ndarray] | None:
        """Function that gives the covariance root; None where the model found none."""
        root = self._fitted[size.number].root
        return None if root is None else lambda: np.asarray(root)

    def predicted(self, size: ModelSize, others: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Images (n, 2d) of these rows, in the user's coordinates, by a fit to other rows."""
        fitted = self.model.fit(training_data(self.data, others), size.own)
        return self._images_of_users(fitted, rows)

    def images(self, size: ModelSize, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Images of these rows (n, 2d), in inner coordinates, and which steps were solved (n,)."""
        plain = dataclasses.replace(
            self.data, coordinates=CARTESIAN, angle_centre=np.zeros(0), whole=()
        )
        map_ = composed(self.piece(size), plain)
        dt, args = self.data.pairs.take(rows).dt, self.data.pairs.take(rows).args
        steps = stepped(map_, self.data.y0[rows], dt, args, timed=False)
        return steps.images, ~steps.failed

    def _images_of_users(self, fitted: Fitted, rows: np.ndarray) -> np.ndarray:
        """Images (n, 2d) in the user's coordinates, NaN where a step fails."""
        map_, pairs = composed(fitted.piece, self.data), self.data.pairs
        pairs = pairs.take(rows)
        steps = stepped(map_, np.asarray(pairs.z0), pairs.dt, pairs.args, timed=False)
        return np.where(steps.failed[:, None], np.nan, steps.images)


def training_data(data: Dataset, rows: np.ndarray) -> TrainingData:
    """Data of these rows that a model is given."""
    dt, args = data.given(rows)
    coordinates, pairs = data.coordinates, data.pairs.take(rows)
    states, about = (data.y0[rows], data.y1[rows]), (dt, args, data.parameters, data.scale)
    kinds, own = (coordinates.angles, coordinates.cyclic), (pairs.run, pairs.place, pairs.std)
    return TrainingData(*states, *about, *kinds, *own)
