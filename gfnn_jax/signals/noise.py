"""The noise of a column, by what local polynomials leave over, and its resolution.

Where the motion is smooth and well sampled, polynomials of degree 5 in windows of n samples leave
the noise: their residual variance s²(n), divided by its degrees of freedom, does not depend on n.
Wider windows leave the motion's own sixth derivative, and s² grows as n¹². Noise that is correlated
over some samples makes s² grow too, but no faster than n. So σ is s at the widest n but one up to
which s² grows more slowly than n^1.5. Outliers are found first, in narrow windows, and replaced by
what their neighbours say.

Where a record has few samples a period, no window is wide enough: s² grows from the narrowest on.
If the samples are even, σ is then what a linear autoregression leaves of a sample, predicted from
those before it and from the inputs. Both estimates are upper bounds; the smaller one is taken.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from gfnn_jax.signals.local_polynomials import LocalFits, local_fits
from gfnn_jax.signals.steps import even_runs

_SIZES = (9, 11, 13, 15, 19, 23, 29, 37, 45, 57, 71, 89, 111, 139, 173, 217, 271, 339)


@dataclasses.dataclass(frozen=True)
class _Options:
    """Thresholds, chosen on noise of known size on motions of test systems (tests of signals).

    degree: of the polynomials. growth: exponent of s²(n) above which it is the motion that grows.
    trimmed: part of the windows, those with the largest residuals, that may hold outliers. fewest:
    windows. narrow: samples of the windows in which outliers are looked for. rare: part of the
    samples that outliers are at most. unresolved: part of a column's spread, above which what
    polynomials leave is the motion itself. outlier: standard deviations of a residual that the
    sample itself did not pull down. lags, most_rows: of an autoregression. white: autocorrelation
    beyond that of white noise which is no accident.
    """

    degree: int = 5
    growth: float = 1.5
    trimmed: float = 0.02
    fewest: int = 8
    narrow: int = 15
    rare: float = 3e-3
    unresolved: float = 0.3
    outlier: float = 8.0
    lags: int = 16
    most_rows: int = 20_000
    white: float = 0.15


_OPTIONS = _Options()


@dataclasses.dataclass(frozen=True)
class Noise:
    """Noise of one column.

    sigma: standard deviation, None where the column has too few samples. correlation: of the noise
    of neighbouring samples, 0 if it is white; None where the floor of the spectrum told σ.
    outliers: (k,) sample numbers, the runs one after another. size: samples in the widest window
    in which the motion is a polynomial.
    """

    sigma: float | None
    correlation: float | None
    outliers: np.ndarray
    size: int

    @property
    def white(self) -> bool:
        return self.correlation is None or abs(self.correlation) < _OPTIONS.white


def noise(
    times: Sequence[np.ndarray], columns: np.ndarray, inputs: np.ndarray | None = None
) -> list[Noise]:
    """The noise of each column (C, T). inputs: (k, T), what drives the motion."""
    shortest = max((len(t) for t in times), default=0) // 2
    sizes = [size for size in _SIZES if size <= shortest]
    columns, outliers = _without_outliers(times, columns) if sizes else (columns, [])
    fits = [local_fits(times, columns, size, _OPTIONS.degree) for size in sizes]
    found = []
    for c, column in enumerate(columns):
        variances = np.array([np.nan if f is None else _trimmed(f.variances[c]) for f in fits])
        widest = _widest(variances)
        if widest is None:
            found.append(Noise(None, None, np.empty(0, int), _SIZES[0]))
            continue
        k = max(widest - 1, 0)
        fit = fits[k]
        assert fit is not None
        sigma, correlation = float(np.sqrt(variances[k])), _correlation(fit, c)
        if widest == 0 or sigma > _OPTIONS.unresolved * np.nanstd(column):
            predicted = _unpredicted(times, [column, *(() if inputs is None else inputs)])
            if predicted is not None and predicted < sigma:
                sigma, correlation = predicted, None
        found.append(Noise(sigma, correlation, outliers[c], _SIZES[widest]))
    return found


def _without_outliers(
    times: Sequence[np.ndarray], columns: np.ndarray
) -> tuple[np.ndarray, list[np.ndarray]]:
    """(columns with outliers replaced, sample numbers of the outliers of each)."""
    fit = local_fits(times, columns, _OPTIONS.narrow, _OPTIONS.degree)
    if fit is None:
        return columns, [np.empty(0, int)] * len(columns)
    columns, found = columns.copy(), []
    for c, column in enumerate(columns):
        rows, off = _outliers(fit, c)
        if (
            len(rows) > _OPTIONS.rare * column.size
        ):  # noise with long tails, as of a sensor's single counts
            rows, off = rows[:0], off[:0]
        column[rows] -= off
        found.append(rows)
    return columns, found


def _trimmed(variances: np.ndarray) -> float:
    """The mean variance of windows, the largest left out; NaN where there are few."""
    known = np.sort(variances[np.isfinite(variances)])
    if len(known) < _OPTIONS.fewest:
        return np.nan
    return float(np.mean(known[: int(np.ceil(len(known) * (1 - _OPTIONS.trimmed)))]))


def _widest(variances: np.ndarray) -> int | None:
    """The widest window up to which the residual variance grows slowly."""
    known = np.flatnonzero(np.isfinite(variances))
    if len(known) == 0:
        return None
    last = known[0]
    for k in known[1:]:
        growth = np.log(max(variances[k], 1e-300) / max(variances[last], 1e-300))
        if growth > _OPTIONS.growth * np.log(_SIZES[k] / _SIZES[last]):
            break
        last = k
    return int(last)


def _correlation(fit: LocalFits, column: int) -> float:
    """Correlation of the noise of neighbours: that of the residuals, less what fitting makes of
    white noise.

    With P the projection on what polynomials leave, white noise of unit size gives residuals of
    covariance P."""
    residuals = fit.residuals[column]
    residuals = residuals[np.isfinite(residuals).all(axis=1)]
    q = fit.projection
    size = q.shape[1]
    neighbours = -np.einsum("wnk,wnk->", q[:, 1:], q[:, :-1]) / len(q)  # trace of P one off
    total = float(np.sum(residuals**2))
    if total == 0:
        return 0.0
    return float(
        np.sum(residuals[:, 1:] * residuals[:, :-1]) / total - neighbours / (size - q.shape[2])
    )


def _unpredicted(times: Sequence[np.ndarray], columns: Sequence[np.ndarray]) -> float | None:
    """RMS of what the samples before, and the inputs, do not tell linearly of the first column;
    None where the samples are not even or are few."""
    ends = np.cumsum([len(t) for t in times])
    rows, targets = [], []
    for i in even_runs(times):
        series = [np.split(x, ends[:-1])[i] for x in columns]
        if len(times[i]) <= 4 * _OPTIONS.lags or not all(np.isfinite(x).all() for x in series):
            continue
        past = [x[_OPTIONS.lags - k : len(x) - k] for x in series for k in range(_OPTIONS.lags + 1)]
        targets.append(past.pop(0))
        rows.append(np.stack([*past, np.ones(len(past[0]))], axis=1))
    if not rows or sum(map(len, targets)) < 4 * rows[0].shape[1]:
        return None
    table, target = (
        np.concatenate(rows)[: _OPTIONS.most_rows],
        np.concatenate(targets)[: _OPTIONS.most_rows],
    )
    left = target - table @ np.linalg.lstsq(table, target, rcond=None)[0]
    return float(np.sqrt(np.sum(left**2) / (len(left) - table.shape[1])))


def _outliers(fit: LocalFits, column: int) -> tuple[np.ndarray, np.ndarray]:
    """(samples that lie far off the polynomial of their neighbours, how far)."""
    variances = fit.variances[column]
    of_run = np.array([_trimmed(variances[fit.run == r]) for r in range(fit.run.max() + 1)])
    sigma = np.sqrt(np.nan_to_num(of_run, nan=np.inf))[fit.run]
    leverage = np.sum(fit.projection**2, axis=2)
    apart = fit.residuals[column] / (1 - leverage)
    size = fit.rows.shape[1]
    middle = slice(size // 4, size - size // 4)
    lines = np.flatnonzero(np.isfinite(apart).all(axis=1))
    worst = np.abs(apart[lines, middle]).argmax(axis=1) + middle.start
    at = apart[lines, worst]
    # Without that sample the squares fall by (1 - leverage) × (its residual apart)².
    rest = np.sum(fit.residuals[column][lines] ** 2, axis=1)
    rest -= (1 - leverage[lines, worst]) * at**2
    scale = np.sqrt(np.maximum(rest, 0) / (size - fit.projection.shape[2] - 1))
    far = np.abs(at) > _OPTIONS.outlier * np.maximum(scale, sigma[lines])
    rows, first = np.unique(fit.rows[lines[far], worst[far]], return_index=True)
    return rows, at[far][first]


def resolution(values: np.ndarray) -> float | None:
    """The smallest step between the values (T,) of a column that a sensor, or the digits of a file,
    have rounded; None where no two of many values are the same."""
    known = values[np.isfinite(values)]
    levels = np.unique(known)
    if len(levels) < 2:
        return None
    steps = np.diff(levels)
    steps = steps[steps > 1e-9 * np.ptp(levels)]
    if len(levels) < len(known) / 2:  # many values occur again: these are the sensor's levels
        return float(np.median(steps))
    step = float(steps.min())
    for reach in 10.0 ** np.arange(1, 9):  # over more and more steps, each is known better
        way = levels[np.searchsorted(levels, levels[0] + reach * step) - 1] - levels[0]
        step = way / round(way / step) if way > step else step
    multiples = (known[:1000] - known[0]) / step
    even = np.abs(multiples - np.round(multiples)) < 0.02
    return float(step) if np.mean(even) > 0.99 and np.ptp(levels) < 1e9 * step else None
