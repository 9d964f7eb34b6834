"""Bands of a prediction from rollouts of maps drawn from its posterior: arrays in, arrays out."""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np

from gfnn_jax.coordinates import nearest_image

QUANTILES = (0.05, 0.5, 0.95)


class Bands(NamedTuple):
    """std (B, S, 2d): root mean square about the map's own prediction. quantiles (3, B, S, 2d): 5,
    50 and 95 % of the samples. Both of the samples that go on; NaN where none does."""

    std: np.ndarray
    quantiles: np.ndarray

    @property
    def median(self) -> np.ndarray:
        """(B, S, 2d)."""
        return self.quantiles[1]


def bands(drawn, states, angles: tuple[int, ...] = ()) -> Bands:
    """Bands of the samples' states (n, B, S, 2d) about the prediction (B, S, 2d). angles: indices
    of coordinates that are compared modulo 2π."""
    states = np.asarray(states)
    off = np.asarray(drawn) - states
    if angles:
        off = nearest_image(off.reshape(-1, off.shape[-1]), angles).reshape(off.shape)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of lanes without a sample that goes on
        std = np.sqrt(np.nanmean(off**2, axis=0))
        quantiles = states + np.nanquantile(off, QUANTILES, axis=0)
    return Bands(std, quantiles)


def horizon(std, steps, size: float) -> np.ndarray:
    """(B,) the first of these steps (S,) at which two standard deviations of the position, the
    Euclidean norm of std (B, S, 2d) over q, pass ``size`` or are not known; −1 where none does."""
    dim = std.shape[-1] // 2
    beyond = ~(2 * np.linalg.norm(std[..., :dim], axis=-1) <= size)
    first = np.asarray(steps)[np.argmax(beyond, axis=1)]
    return np.where(beyond.any(axis=1), first, -1)
