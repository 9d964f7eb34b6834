"""Local polynomials: least squares in windows of consecutive samples, at uneven times."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.polynomial.polynomial import polyvander

_WIDEST = 1.5  # of the median duration of windows of so many samples; wider ones hold a gap
_MOST_NUMBERS = 60_000  # in the windows of one fit, for time and memory


@dataclasses.dataclass(frozen=True)
class LocalFits:
    """Polynomials in W windows of n samples, of C columns.

    rows: (W, n) sample numbers, the runs one after another. centres: (W,) times, and run: (W,) the
    number of the run. values, slopes, curvatures: (C, W) at the centres: the polynomial, its first
    and its second derivative. residuals: (C, W, n). slope_gain, curvature_gain: (W,) standard
    deviation of slope and curvature by white noise of unit size. projection: (W, n, k), orthonormal
    columns that span the polynomials. NaN where a value of the window is missing.
    """

    rows: np.ndarray
    centres: np.ndarray
    run: np.ndarray
    values: np.ndarray
    slopes: np.ndarray
    curvatures: np.ndarray
    residuals: np.ndarray
    slope_gain: np.ndarray
    curvature_gain: np.ndarray
    projection: np.ndarray

    @property
    def variances(self) -> np.ndarray:
        """(C, W) of the residuals, divided by their degrees of freedom."""
        free = self.residuals.shape[-1] - self.projection.shape[-1]
        return np.sum(self.residuals**2, axis=-1) / free


def local_fits(
    times: Sequence[np.ndarray], columns: np.ndarray, size: int, degree: int
) -> LocalFits | None:
    """Fits of ``degree`` in windows of ``size`` samples, spread evenly over the runs.

    times: (n_r,) of each run. columns: (C, T). Windows that hold a gap are left out. None where no
    run has a window.
    """
    rows, centres, run = _windows(times, size)
    if len(rows) == 0:
        return None
    t = np.concatenate(times)[rows]
    x = columns[:, rows]
    half = 0.5 * (t[:, -1] - t[:, 0])
    scaled = (t - centres[:, None]) / half[:, None]
    q, r = np.linalg.qr(polyvander(scaled, degree))
    coefficients = (x[..., None, :] @ q)[..., 0, :]
    residuals = x - (q @ coefficients[..., None])[..., 0]
    inverse = np.linalg.inv(r)
    powers = (inverse @ coefficients[..., None])[..., 0]
    gains = np.sqrt(np.sum(inverse**2, axis=2))  # (W, k), of the coefficient of each power
    return LocalFits(
        rows,
        centres,
        run,
        powers[..., 0],
        powers[..., 1] / half,
        2 * powers[..., 2] / half**2,
        residuals,
        gains[:, 1] / half,
        2 * gains[:, 2] / half**2,
        q,
    )


def _windows(times: Sequence[np.ndarray], size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows (W, size), centres (W,) and runs (W,) of windows without a gap."""
    lengths = np.array([len(t) for t in times])
    begins = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    starts = np.concatenate(
        [b + np.arange(max(n - size + 1, 0)) for b, n in zip(begins, lengths, strict=True)]
    ).astype(int)
    most = max(_MOST_NUMBERS // size, 1)
    if len(starts) > most:
        starts = starts[np.linspace(0, len(starts) - 1, most).astype(int)]
    rows = starts[:, None] + np.arange(size)
    t = np.concatenate(times)[rows] if len(rows) else np.empty((0, size))
    span = t[:, -1] - t[:, 0]
    if len(span):
        keep = span <= _WIDEST * np.median(span)
        rows, t = rows[keep], t[keep]
    run = np.searchsorted(begins, rows[:, 0], side="right") - 1
    return rows, 0.5 * (t[:, 0] + t[:, -1]), run
