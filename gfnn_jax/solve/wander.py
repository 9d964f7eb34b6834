"""Noise of a sensor whose zero wanders: white, on an Ornstein–Uhlenbeck process.

    y = g(x) + b(t) + white noise,      E b(t) b(s) = σ_b² exp(−|t − s| / T)

The zero b of a channel moves slowly and comes back, so that residuals r of near samples are alike.
In units of the white noise's σ their covariance is C = I + K, and L⁻¹ r with L Lᵀ = C is white. A
law fitted to white residuals is that of generalised least squares, and what it leaves tells b
(Rasmussen & Williams, Gaussian Processes for Machine Learning (2006) §2.7).
"""

from __future__ import annotations

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Wander:
    """size: σ_b in units of the noise of its channel. time: T, in seconds."""

    size: float
    time: float

    def covariance(self, apart: np.ndarray) -> np.ndarray:
        """E b(t) b(s) of times that are ``apart`` (...), in units of the noise's variance."""
        return self.size**2 * np.exp(-np.abs(apart) / self.time)

    def whitening(self, t: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """L⁻¹ (A, k, n, n) of values at times t (A, n) with relative noise (A, n, k), infinite
        where one was not seen."""
        scale = 1 / noise.swapaxes(1, 2)
        slow = self.covariance(t[:, :, None] - t[:, None, :])[:, None]
        slow = scale[..., :, None] * slow * scale[..., None, :]
        return np.linalg.inv(np.linalg.cholesky(np.eye(t.shape[1]) + slow))

    def latest(self, t: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Covariance (A, n, k) of each value, in units of its own noise, with b at the last time of
        its row, in units of its channel's."""
        return self.covariance(t[:, -1:] - t)[..., None] / noise

    def fading(self, ahead: np.ndarray) -> np.ndarray:
        """Part of b that is left after times ``ahead``."""
        return np.exp(-ahead / self.time)
