"""The protocol of a model: sizes by rising cost, and a fit of each that ends in a piece of a map.

``gfnn.fit(pairs, model=OWN)`` asks a user's own for no more. The fit chooses the size, states the
error, and makes the map.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np


class TrainingData(NamedTuple):
    """The training pairs in the coordinates where a model is fitted, and what is known of them.
    NumPy.

    y0, y1: (n, 2d) states and images, angles lifted. dt: a number, or (n,). args: (n, k) values of
    ``parameters``, or None. scale: (2d,) sizes of the coordinates. angles, cyclic: indices of
    coordinates of period 2π, and of those that do not enter. run, place: (n,) the run of each
    pair, and the number of y0 along it. std: (2d,) of the noise, or (n, 2d) of each
    value, or None where it is not known.
    """

    y0: np.ndarray
    y1: np.ndarray
    dt: Any
    args: np.ndarray | None
    parameters: tuple[str, ...]
    scale: np.ndarray
    angles: tuple[int, ...]
    cyclic: tuple[int, ...]
    run: np.ndarray
    place: np.ndarray
    std: np.ndarray | None

    @property
    def dim(self) -> int:
        """Degrees of freedom d."""
        return self.y0.shape[1] // 2


class Fitted(NamedTuple):
    """A size of a model, fitted.

    piece: of a map (`maps.piece.Piece`). label: as the table of candidates shows it.
    operations: counted, of a predicted step. root: (k, m) covariance root of ``piece.params`` (m,),
    the covariance being rootᵀ root, from which maps are drawn; None where it is not known.
    """

    piece: Any
    label: str
    num_parameters: int
    operations: float
    root: np.ndarray | None = None


@runtime_checkable
class Model(Protocol):
    """Model that `gfnn.fit` can learn. name: one word, as in the table of candidates."""

    name: str

    def sizes(self, data: TrainingData) -> Sequence[Any]:
        """Sizes of any type, by rising cost, as far as these data determine them."""
        ...

    def fit(self, data: TrainingData, size: Any) -> Fitted:
        """The model of this size, fitted to these data. It may raise FitError."""
        ...
