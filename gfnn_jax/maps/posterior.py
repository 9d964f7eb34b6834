"""Posterior of the coefficients of a map."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.coordinates import nearest_image


@dataclasses.dataclass(frozen=True, eq=False, init=False)
class Posterior:
    """Normal distribution about the coefficients of one piece of a map.

    piece: index of the piece. root: (k, m) covariance root, NumPy: the covariance is rootᵀ root.
    Directions that the data do not determine are 0.
    """

    piece: int
    root: Any

    def __init__(self, piece: int, root: Any):
        """Make a posterior. root: the array, or a function that makes it when it is first used.

        For a thousand terms it takes as long as the fit.
        """
        object.__setattr__(self, "piece", piece)
        object.__setattr__(self, "_make" if callable(root) else "root", root)

    def __getattr__(self, name: str) -> Any:
        if name != "root":
            raise AttributeError(name)
        make: Callable[[], Any] = self.__dict__["_make"]
        object.__setattr__(self, "root", np.asarray(make()))
        return self.root

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles hold the root, which is computed for them."""
        return Posterior, (self.piece, self.root)

    @property
    def known(self) -> bool:
        """True where root has been computed."""
        return "root" in self.__dict__

    def of_piece(self, piece: int) -> Posterior:
        """Make the posterior of a piece that has another index."""
        return Posterior(piece, self.root if self.known else lambda: self.root)


QUANTILES = (0.05, 0.5, 0.95)


class Bands(NamedTuple):
    """Bands of a prediction: std (B, S, 2d), quantiles (3, B, S, 2d) at 5, 50 and 95 %, and tube
    (B,): the multiple of std that 95 % of the samples stay within at all steps and coordinates.

    std is the root mean square about the map's own prediction. All are over the samples that have
    not failed, and NaN where all have.
    """

    std: np.ndarray
    quantiles: np.ndarray
    tube: np.ndarray

    @property
    def median(self) -> np.ndarray:
        """Median (B, S, 2d) of the samples."""
        return self.quantiles[1]


def bands(drawn, states, angles: tuple[int, ...] = ()) -> Bands:
    """Compute the bands of the samples' states (n, B, S, 2d) about the prediction (B, S, 2d).

    angles: indices of coordinates that are compared modulo 2π.
    """
    states = np.asarray(states)
    off = np.asarray(drawn) - states
    if angles:
        off = nearest_image(off.reshape(-1, off.shape[-1]), angles).reshape(off.shape)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # for lanes in which all samples failed
        std = np.sqrt(np.nanmean(off**2, axis=0))
        quantiles = states + np.nanquantile(off, QUANTILES, axis=0)
        sizes = np.abs(off) / np.where(std > 0, std, np.inf)
        tube = np.nanquantile(np.nanmax(sizes, axis=(2, 3)), QUANTILES[-1], axis=0)
    return Bands(std, quantiles, tube)


def horizon(std, steps, size: float) -> np.ndarray:
    """First step (B,) of ``steps`` (S,) at which two standard deviations of the position exceed
    ``size``.

    The standard deviation is the Euclidean norm of std (B, S, 2d) over q; one that is not known
    counts as too large. −1 where no step exceeds it.
    """
    dim = std.shape[-1] // 2
    beyond = ~(2 * np.linalg.norm(std[..., :dim], axis=-1) <= size)
    first = np.asarray(steps)[np.argmax(beyond, axis=1)]
    return np.where(beyond.any(axis=1), first, -1)
