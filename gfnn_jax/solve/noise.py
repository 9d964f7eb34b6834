"""The noise of residuals: gross errors among them, and zeros of sensors that wander.

A loss ρ(r) is of residuals in units of their noise, and ρ(r) → r² where r is small. An iteration
minimises Σ w r² with w = ρ'(r) ÷ 2r, the residuals' *weights* (iteratively reweighted least
squares; Huber, Robust Statistics, 1981).

The zero of a sensor may wander: white noise, on an Ornstein–Uhlenbeck process,

    y = g(x) + b(t) + white noise,      E b(t) b(s) = σ_b² exp(−|t − s| / T).

The zero b of a channel moves slowly and comes back, so that residuals r of near samples are alike.
In units of the white noise's σ their covariance is C = I + K, and L⁻¹ r with L Lᵀ = C is white. A
law fitted to white residuals is that of generalised least squares, and what it leaves tells b
(Rasmussen & Williams, Gaussian Processes for Machine Learning (2006) §2.7).
"""

import dataclasses
from typing import Any, Protocol, runtime_checkable

import numpy as np
from scipy.linalg.lapack import dtrtri  # pyright: ignore[reportAttributeAccessIssue]

_NORMAL = 1.4826  # a normal deviation over the median of its size


@runtime_checkable
class Loss(Protocol):
    """ρ and its weights, elementwise."""

    def of(self, residuals: np.ndarray) -> np.ndarray: ...

    def weights(self, residuals: np.ndarray) -> np.ndarray: ...


@dataclasses.dataclass(frozen=True)
class SoftL1:
    """2k²(√(1 + (r/k)²) − 1): grows as |r|, and has one minimum, wherever a fit starts.

    k: in standard deviations.
    """

    k: float = 2.5

    def of(self, residuals: np.ndarray) -> np.ndarray:
        return 2 * self.k**2 * (np.sqrt(1 + (residuals / self.k) ** 2) - 1)

    def weights(self, residuals: np.ndarray) -> np.ndarray:
        return (1 + (residuals / self.k) ** 2) ** -0.5


@dataclasses.dataclass(frozen=True)
class Biweight:
    """Tukey's (k²/3)(1 − (1 − (r/k)²)³), constant beyond k: gross errors have no weight, in a fit
    that starts from states that most of the others bear out.

    k: in standard deviations.
    """

    k: float = 7.0

    def of(self, residuals: np.ndarray) -> np.ndarray:
        return self.k**2 / 3 * (1 - (1 - self._size(residuals) ** 2) ** 3)

    def weights(self, residuals: np.ndarray) -> np.ndarray:
        return (1 - self._size(residuals) ** 2) ** 2

    def _size(self, residuals: np.ndarray) -> np.ndarray:
        return np.minimum(np.abs(residuals) / self.k, 1.0)


def robust(values: np.ndarray, axis: int | None = None) -> Any:
    """The deviation of normal noise around 0, from the median of its size along the axis, of all
    values without one."""
    return _NORMAL * np.median(np.abs(values), axis=axis)


def of_residuals(residual: np.ndarray, free: np.ndarray | float, outlying: float) -> np.ndarray:
    """(k,) from residuals (..., k) that are the noise of one number each; NaN where there is none.

    free: (..., k) the part of each that what was fitted does not follow, 1 − its leverage: the sum
    of squares of a coordinate is that much of its variances (Förstner, Z. Vermess. 104 (1979) 41).
    outlying: robust deviations beyond which a number is a gross error, and does not count.
    """
    k = residual.shape[-1]
    residual, free = residual.reshape(-1, k), np.broadcast_to(free, residual.shape).reshape(-1, k)
    size = np.array([robust(column[np.isfinite(column)]) for column in residual.T])
    inside = np.abs(residual) <= outlying * size
    square = np.sum(np.where(inside, residual, 0.0) ** 2, axis=0)
    left = np.sum(np.where(inside, free, 0.0), axis=0)
    return np.sqrt(square / np.maximum(left, 1e-3 * np.maximum(inside.sum(axis=0), 1)))


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
        whole = (*scale.shape, scale.shape[-1])
        if np.all(scale == scale[:, :1]):  # of all channels one
            scale = scale[:, :1]
        slow = self.covariance(t[:, :, None] - t[:, None, :])[:, None]
        slow = scale[..., :, None] * slow * scale[..., None, :]
        roots = np.linalg.cholesky(np.eye(t.shape[1]) + slow)
        found = [dtrtri(root.T)[0].T for root in roots.reshape(-1, *roots.shape[2:])]
        return np.broadcast_to(np.reshape(found, roots.shape), whole)

    def whitened(
        self, t: np.ndarray, noise: np.ndarray, rows: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """L⁻¹ applied to rows (A, n, k, w), and the sum of the logarithms of its diagonals: by the
        innovations of a Kalman filter of b, whose work grows as n."""
        weight, out = 1 / noise, np.empty(rows.shape)
        fade = np.exp(-np.abs(np.diff(t, axis=1, prepend=t[:, :1])) / self.time)[..., None]
        known, variance = 0.0, self.size**2 * np.ones(weight[:, 0].shape)
        logs = 0.0
        for j in range(t.shape[1]):
            known = fade[:, j, :, None] * known
            variance = fade[:, j] ** 2 * (variance - self.size**2) + self.size**2
            shown = weight[:, j] * variance
            total = 1 + weight[:, j] * shown
            missed = rows[:, j] - weight[:, j, :, None] * known
            out[:, j] = missed / np.sqrt(total)[..., None]
            known = known + (shown / total)[..., None] * missed
            variance = variance - shown**2 / total
            logs -= 0.5 * float(np.sum(np.log(total)))
        return out, logs

    def latest(self, t: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Covariance (A, n, k) of each value, in units of its own noise, with b at the last time of
        its row, in units of its channel's."""
        return self.covariance(t[:, -1:] - t)[..., None] / noise
