"""The noise of a column, by what local polynomials leave over, and its resolution.

Where the motion is smooth and well sampled, polynomials of degree 5 in windows of n samples leave
the noise: their residual variance s²(n), divided by its degrees of freedom, does not depend on n.
Wider windows leave the motion's own sixth derivative, and s² grows as n¹². Noise that is correlated
over some samples makes s² grow too, but no faster than n. So σ is s at the widest n but one up to
which s² grows more slowly than n^1.5. Outliers (`wrong_values`) are left out.

Where a record has few samples a period, no window is wide enough: s² grows from the narrowest on.
If the samples are even, σ is then what a linear autoregression leaves of a sample, predicted from
those before it and from the inputs. Both estimates are upper bounds; the smaller one is taken.
"""

import dataclasses

import numpy as np

from gfnn_jax.signals.local_polynomials import LocalFits, local_fits
from gfnn_jax.signals.steps import Runs, even_runs
from gfnn_jax.signals.wrong_values import wrong_values

_SIZES = (9, 11, 13, 15, 19, 23, 29, 37, 45, 57, 71, 89, 111, 139, 173, 217, 271, 339)


class _Options:
    """Thresholds, chosen on noise of known size on motions of test systems (tests of signals)."""

    degree: int = 5  # of the polynomials
    growth: float = 1.5  # exponent of s²(n) above which it is the motion that grows
    trimmed: float = 0.02  # of the windows: those of the largest residuals, which may hold outliers
    fewest: int = 8  # windows
    rare: float = 3e-3  # of the samples, that outliers are at most
    unresolved: float = 0.3  # of a column's spread, above which polynomials leave the motion itself
    lags: int = 16  # of an autoregression, fitted to so many rows
    most_rows: int = 20_000
    white: float = 0.15  # autocorrelation beyond that of white noise which is no accident


@dataclasses.dataclass(frozen=True)
class Noise:
    """Noise of one column.

    sigma: standard deviation, None where the column has too few samples. correlation: of the noise
    of neighbouring samples, 0 if it is white; None where the floor of the spectrum told σ. size:
    samples in the widest window in which the motion is a polynomial.
    """

    sigma: float | None
    correlation: float | None
    size: int

    @property
    def white(self) -> bool:
        return self.correlation is None or abs(self.correlation) < _Options.white


def noise(times: Runs, columns: np.ndarray, inputs: np.ndarray | None = None) -> list[Noise]:
    """The noise of each column (C, T). inputs: (k, T), what drives the motion."""
    shortest = max((len(t) for t in times), default=0) // 2
    sizes = [size for size in _SIZES if size <= shortest]
    if sizes and len(columns):
        columns = np.stack([_without_outliers(times, column) for column in columns])
    fits = [local_fits(times, columns, size, _Options.degree) for size in sizes]
    found = []
    for c, column in enumerate(columns):
        variances = np.array([np.nan if f is None else _trimmed(f.variances[c]) for f in fits])
        widest = _widest(variances)
        if widest is None:
            found.append(Noise(None, None, _SIZES[0]))
            continue
        k = max(widest - 1, 0)
        fit = fits[k]
        assert fit is not None
        sigma, correlation = float(np.sqrt(variances[k])), _correlation(fit, c)
        if widest == 0 or sigma > _Options.unresolved * np.nanstd(column):
            predicted = _unpredicted(times, [column, *(() if inputs is None else inputs)])
            if predicted is not None and predicted < sigma:
                sigma, correlation = predicted, None
        found.append(Noise(sigma, correlation, _SIZES[widest]))
    return found


def _without_outliers(times: Runs, column: np.ndarray) -> np.ndarray:
    """A column (T,), NaN at its outliers, unless they are so many that they are noise with long
    tails, as of a sensor's single counts."""
    runs = np.split(column, np.cumsum([len(t) for t in times])[:-1])
    wrong = wrong_values(times, runs, resolution(column))
    off = [stretch.rows for stretch in wrong if stretch.off is not None]
    if not off or sum(map(len, off)) > _Options.rare * column.size:
        return column
    column = column.copy()
    column[np.concatenate(off)] = np.nan
    return column


def _trimmed(variances: np.ndarray) -> float:
    """The mean variance of windows, the largest left out; NaN where there are few."""
    known = np.sort(variances[np.isfinite(variances)])
    if len(known) < _Options.fewest:
        return np.nan
    return float(np.mean(known[: int(np.ceil(len(known) * (1 - _Options.trimmed)))]))


def _widest(variances: np.ndarray) -> int | None:
    """The widest window up to which the residual variance grows slowly."""
    known = np.flatnonzero(np.isfinite(variances))
    if len(known) == 0:
        return None
    last = known[0]
    for k in known[1:]:
        growth = np.log(max(variances[k], 1e-300) / max(variances[last], 1e-300))
        if growth > _Options.growth * np.log(_SIZES[k] / _SIZES[last]):
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
    shared = np.sum(residuals[:, 1:] * residuals[:, :-1]) / total
    return float(shared - neighbours / (size - q.shape[2]))


def _unpredicted(times: Runs, columns: Runs) -> float | None:
    """RMS of what the samples before, and the inputs, do not tell linearly of the first column;
    None where the samples are not even or are few."""
    ends, lags = np.cumsum([len(t) for t in times]), _Options.lags
    rows, targets = [], []
    for i in even_runs(times):
        series = [np.split(x, ends[:-1])[i] for x in columns]
        if len(times[i]) <= 4 * lags:
            continue
        past = np.stack([x[lags - k : len(x) - k] for x in series for k in range(lags + 1)])
        past = past[:, np.isfinite(past).all(axis=0)]
        targets.append(past[0])
        rows.append(np.concatenate([past[1:], np.ones((1, past.shape[1]))]).T)
    if not rows or sum(map(len, targets)) < 4 * rows[0].shape[1]:
        return None
    some = slice(_Options.most_rows)
    table, target = np.concatenate(rows)[some], np.concatenate(targets)[some]
    left = target - table @ np.linalg.lstsq(table, target, rcond=None)[0]
    return float(np.sqrt(np.sum(left**2) / (len(left) - table.shape[1])))


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
