"""Derivatives among columns: whether one is that of another, with which factor, and how late.

In windows of consecutive samples a polynomial of degree p + 1 through x gives ẋ at the centre, one
of degree p through v the value of v there: exact for the same motions, at uneven times too. Then

    v(t) = s ẋ(t − τ) ≈ s ẋ − s τ ẍ

is a linear regression for the factor s and the lag τ. Noise of ẋ, which is known from that of x,
makes the factor of a plain regression too small, and is taken out of the sum of squares.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from gfnn_jax.signals.local_polynomials import LocalFits, local_fits
from gfnn_jax.signals.noise import Noise
from gfnn_jax.signals.steps import Runs


class _Options:
    """degree: of the polynomials of values. fewest: windows. narrowest: samples of a window."""

    degree: int = 3
    fewest: int = 12
    narrowest: int = 7


@dataclasses.dataclass(frozen=True)
class Relation:
    """v ≈ s ẋ(t − τ).

    factor: s, with its standard error. lag: τ in s, likewise. explained: the part of v's variance
    that ẋ explains at no lag (R²), 1 for a derivative without noise.
    """

    factor: float
    factor_error: float
    lag: float
    lag_error: float
    explained: float

    @property
    def likeness(self) -> float:
        """1 where v = ẋ; lower for other factors, which lengths of time and angle may make, and
        for negative ones: of a linear oscillator x is a derivative of v, too, times −1/ω²."""
        unlike = 1 - np.exp(-abs(np.log(abs(self.factor))))
        return self.explained - 0.3 * unlike - 0.3 * (self.factor < 0)


@dataclasses.dataclass(frozen=True)
class Derivatives:
    """Local values, first and second derivatives of C columns at W centres, (C, W)."""

    values: LocalFits
    slopes: LocalFits
    sigmas: Sequence[float | None]

    def relation(self, of: int, column: int) -> Relation | None:
        """Relation of ``column`` to the derivative of column ``of``; None where too few windows
        tell."""
        v = self.values.values[column]
        rate, bend = self.slopes.slopes[of], self.slopes.curvatures[of]
        known = np.isfinite(v) & np.isfinite(rate)
        if known.sum() < _Options.fewest or np.ptp(v[known]) == 0 or np.ptp(rate[known]) == 0:
            return None
        v, rate, bend = (x[known] - np.mean(x[known]) for x in (v, rate, bend))
        noise = (self.sigmas[of] or 0.0) * self.slopes.slope_gain[known]
        squares = float(rate @ rate)
        clean = max(squares - float(noise @ noise), 0.1 * squares)
        explained = float((v @ rate) ** 2 / (squares * (v @ v)))
        table = np.stack([rate, bend], axis=1)
        normal = table.T @ table
        normal[0, 0] = clean
        if np.linalg.cond(normal / np.outer(*[np.sqrt(np.diag(normal))] * 2)) > 1e6:
            return None
        factor, minus_lag = np.linalg.solve(normal, table.T @ v)
        left = v - factor * rate - minus_lag * bend
        # Windows overlap, and the errors of polynomials vary slowly: blocks of windows tell errors.
        errors = _errors(table * left[:, None], normal)
        if factor == 0:
            return None
        of_factor, of_lag = float(errors[0]), float(errors[1] / abs(factor))
        return Relation(float(factor), of_factor, float(-minus_lag / factor), of_lag, explained)


def window(noises: Sequence[Noise]) -> int:
    """Samples of a window for derivatives of columns with this noise."""
    return max(min((n.size for n in noises), default=0) // 2, _Options.narrowest)


def derivatives(
    times: Runs, columns: np.ndarray, size: int, sigmas: Sequence[float | None]
) -> Derivatives | None:
    """Local polynomials of columns (C, T) in windows of ``size`` samples; None where none fits.

    sigmas: of the columns' noise.
    """
    values = local_fits(times, columns, size, _Options.degree)
    slopes = local_fits(times, columns, size, _Options.degree + 1)
    if values is None or slopes is None:
        return None
    return Derivatives(values, slopes, sigmas)


def _errors(scores: np.ndarray, normal: np.ndarray, blocks: int = 20) -> np.ndarray:
    """Standard errors of a regression whose residuals are correlated, by sums over blocks."""
    sums = np.stack([part.sum(axis=0) for part in np.array_split(scores, blocks)])
    inverse = np.linalg.inv(normal)
    return np.sqrt(np.diag(inverse @ (sums.T @ sums) @ inverse))


def difference(times: Runs, x: np.ndarray, v: np.ndarray) -> str | None:
    """Forward, backward or central, where v (T,) is that difference of x (T,) but for the digits of
    the file; None otherwise, also where the difference of fourth order is closer: then v was
    measured, or computed, and the motion is smooth."""
    kinds = {"forward": [], "backward": [], "central": [], "fourth": []}
    ends = np.cumsum([len(t) for t in times])[:-1]
    for t, a, b in zip(times, np.split(x, ends), np.split(v, ends), strict=True):
        if len(t) < 3:
            continue
        steps = np.diff(a) / np.diff(t)
        kinds["forward"].append(b[1:-1] - steps[1:])
        kinds["backward"].append(b[1:-1] - steps[:-1])
        kinds["central"].append(b[1:-1] - (a[2:] - a[:-2]) / (t[2:] - t[:-2]))
        step = np.diff(t).mean()
        even = np.allclose(np.diff(t), step, rtol=1e-6)
        fourth = b[2:-2] - (8 * (a[3:-1] - a[1:-3]) - a[4:] + a[:-4]) / (12 * step)
        kinds["fourth"].append(fourth if even else np.full(len(t), np.nan))
    sizes = {}
    for kind, parts in kinds.items():
        off = np.abs(np.concatenate(parts)) if parts else np.empty(0)
        off = off[np.isfinite(off)]
        sizes[kind] = float(np.quantile(off, 0.95)) if len(off) else np.inf
    best = min(sizes, key=lambda kind: sizes[kind])
    return best if best != "fourth" and sizes[best] < 1e-3 * np.nanstd(v) else None
