"""Local polynomials: least squares in windows of consecutive samples, at uneven times."""

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyvander
from scipy.special import comb

from gfnn_jax.signals.steps import Runs

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


def local_fits(times: Runs, columns: np.ndarray, size: int, degree: int) -> LocalFits | None:
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


def _windows(times: Runs, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows (W, size), centres (W,) and runs (W,) of windows without a gap."""
    lengths = np.array([len(t) for t in times])
    begins = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    each = zip(begins, lengths, strict=True)
    starts = np.concatenate([b + np.arange(max(n - size + 1, 0)) for b, n in each]).astype(int)
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


class _Options:
    """Windows, and when what they leave is noise."""

    # samples on either side
    halves: tuple[int, ...] = (2, 3, 4, 5, 6, 8, 10, 13, 16, 20, 25, 32, 40, 50, 64, 80)
    samples: int = 2_000  # where the errors of a window are measured
    tolerance: float = 1.05  # of the leave-one-out error, against the best window's
    rounding: float = 1e-13  # of a channel's range, below which an error is that of a constant
    orders: tuple[int, ...] = tuple(range(4, 11))  # of differences
    fewest: int = 20  # of them that tell noise
    biased: float = 0.1  # share of the noise that cubics tell, below which that is theirs
    least: float = 1e-6  # of the range: what a start of a law leaves by the error of its steps


class Smooth(NamedTuple):
    """Positions, velocities and accelerations (n, d) at the samples of one stretch."""

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray


def smooth(
    t: np.ndarray, y: np.ndarray, half: int, at: np.ndarray | None = None
) -> tuple[Smooth, np.ndarray]:
    """Local cubics through y (n, d) at times t (n,), ``half`` samples to either side, and their
    leave-one-out errors, at the samples ``at`` (m,) or all: (m, d) each. At the ends windows keep
    their number of samples."""
    n = len(t)
    at = np.arange(n) if at is None else at
    width = min(2 * half + 1, n)
    index = np.clip(at - width // 2, 0, n - width)[:, None] + np.arange(width)
    span = 0.5 * (t[index[:, -1]] - t[index[:, 0]])
    x = (t[index] - t[at, None]) / span[:, None]
    square = x * x  # products: `**` takes five times as long as all the rest
    powers = np.stack([np.ones_like(x), x, square, square * x], axis=1)
    inverse = np.linalg.inv(powers @ powers.swapaxes(1, 2))
    c = inverse @ (powers @ y[index])
    left_out = (y[at] - c[:, 0]) / (1 - inverse[:, 0, 0])[:, None]
    return Smooth(c[:, 0], c[:, 1] / span[:, None], 2 * c[:, 2] / span[:, None] ** 2), left_out


def choose_half(stretches: list[tuple[np.ndarray, np.ndarray]]) -> tuple[int, np.ndarray]:
    """The window (samples to either side) for these stretches (t (n,), y (n, d)) of a recording,
    and the noise σ (d,) of the channels: the smallest leave-one-out error, less the cubic's own
    part, or what is left of differences where that is less than a tenth."""
    total = sum(len(t) for t, _ in stretches)
    rounding = _Options.rounding * np.max([np.ptp(y, axis=0) for _, y in stretches], axis=0)
    every = max(1, total // _Options.samples)
    halves = [h for h in _Options.halves if any(len(t) >= 2 * h + 1 for t, _ in stretches)]
    errors, sigmas = [], []
    for half in halves:
        longer = [(t, y) for t, y in stretches if len(t) >= 2 * half + 1]
        left_out = [smooth(t, y, half, np.arange(0, len(t), every))[1] for t, y in longer]
        squares = np.concatenate(left_out) ** 2
        squares[squares < rounding**2] = np.nan  # a sensor's step hides the noise of what rests
        squares[:, np.isnan(squares).all(axis=0)] = 0.0
        variance = np.nanmedian(squares, axis=0) / 0.4549  # that of χ² with one degree is 0.4549
        errors.append(np.sqrt(variance))
        sigmas.append(np.sqrt(variance / (1 + 9 / (4 * (2 * half + 1)))))
    relative = np.array(errors) / np.maximum(np.min(errors, axis=0), 1e-300)
    score = relative.max(axis=1)
    good = np.flatnonzero(score <= _Options.tolerance * score.min())
    sigma = np.min(sigmas, axis=0)
    ranges = rounding / _Options.rounding
    by_differences = _by_differences([y for _, y in stretches], rounding)
    by_differences = np.maximum(by_differences, _Options.least * ranges)
    told = by_differences < _Options.biased * sigma
    return halves[good[-1]], np.where(told, by_differences, sigma)


def _by_differences(each: Runs, rounding: np.ndarray) -> np.ndarray:
    """σ (d,) of white noise by the differences of y (n, d) at even times that are least for their
    order; infinite of few. Of a smooth motion they vanish with their order, faster than what a
    cubic leaves."""
    sigma = np.full(len(rounding), np.inf)
    for order in _Options.orders:
        left = np.concatenate([np.diff(y, order, axis=0) for y in each])
        gain = np.sqrt(comb(2 * order, order))
        left[np.abs(left) < rounding * gain] = np.nan
        enough = np.isfinite(left).sum(axis=0) >= _Options.fewest
        size = np.nanmedian(np.abs(left[:, enough]), axis=0) / (0.6745 * gain)
        sigma[enough] = np.minimum(sigma[enough], size)
    return sigma
