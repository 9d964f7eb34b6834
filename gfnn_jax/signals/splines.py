"""Smoothing splines through readings at any times, of which several runs share noise and stiffness.

A run's curve is a spline of degree 5 with knots at even steps, B α, whose fifth differences D α are
white (Eilers & Marx, Stat. Sci. 11 (1996) 89): a motion is that smooth, and with third differences
its velocities err by three times as much.

    y = B α + noise of variance σ²,        D α ~ N(0, σ²/λ)

σ is in closed form, and the stiffness λ is where the restricted likelihood of the readings of all
runs is largest,

    (N − 5R) log(|y − B α|² + λ |D α|²) + log |BᵀB + λ DᵀD| − (M − 5R) log λ  →  min

of N readings, M coefficients, R runs. Every matrix is a band. Where a run has fewer readings than
its own noise needs, the other runs determine it. Readings of dy/dt are rows B' α.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.signals.local_polynomials import Smooth


class _Options:
    """degree: of the splines. order: of the differences. stiffness: log10 of λ, least and most, and
    the step of the search (`tests/test_sampling.py`). fewest: readings of a run."""

    degree: int = 5
    order: int = 5
    stiffness: tuple[float, float, float] = (-6.0, 10.0, 0.25)
    fewest: int = 5


FEWEST = _Options.fewest


class Splines(NamedTuple):
    """Splines of columns: the step between knots, the stiffness (d,) of each column in units of its
    noise, and σ (d,) of that."""

    step: float
    stiffness: np.ndarray
    sigma: np.ndarray

    def smooth(self, t: np.ndarray, y: np.ndarray, at: np.ndarray) -> Smooth:
        """The curves of readings y (n, d) at times t (n,), NaN where nothing was read, with their
        first and second derivatives, at times ``at`` (m,): (m, d) each. A column with fewer
        readings than a curve needs is NaN."""
        found = np.full((3, len(at), y.shape[1]), np.nan)
        for k, stiffness in enumerate(self.stiffness):
            have = np.isfinite(y[:, k])
            if have.sum() < FEWEST:
                continue
            curve = _Problem.of([(t[have], y[have, k])], self.step).curve(float(stiffness))
            for order in range(3):
                found[order, :, k] = curve(np.clip(at, *t[have][[0, -1]]), nu=order)
        return Smooth(*found)

    def curve(self, t: np.ndarray, y: np.ndarray) -> Any:
        """The curve, a SciPy BSpline, of readings y (n,) of the first column, NaN where nothing was
        read."""
        have = np.isfinite(y)
        return _Problem.of([(t[have], y[have])], self.step).curve(float(self.stiffness[0]))


def splines(runs: Sequence[tuple[np.ndarray, np.ndarray]]) -> Splines:
    """The splines of runs (t (n,), y (n, d)), NaN where nothing was read. Knots are as far apart as
    most readings of the column that has most of them.

    Raises ValueError where no run has five readings of a column.
    """
    columns = [
        [(t[have], y[have, k]) for t, y in runs for have in [np.isfinite(y[:, k])]]
        for k in range(runs[0][1].shape[1])
    ]
    steps = [np.concatenate([np.diff(t) for t, _ in every]) for every in columns]
    step = float(min(np.median(one) for one in steps if len(one)))
    found = []
    for k, every in enumerate(columns):
        own = [run for run in every if len(run[0]) >= FEWEST]
        if not own:
            raise ValueError(f"expected a run with {FEWEST} readings of column {k}")
        found.append(_Problem.of(own, step).likeliest())
    return Splines(step, *np.array(found).T)


def with_rates(t: np.ndarray, y: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """The values (n,) at times t (n,) of the spline through readings of it and of its rate, y (n,
    2), each with its noise (n, 2).

        with_rates(t, np.stack([np.sin(t) + rough, np.cos(t)], 1), np.tile([0.1, 0.01], (n, 1)))
    """
    run = np.tile(t, 2), y.T.ravel(), noise.T.ravel(), np.repeat([0, 1], len(t))
    problem = _Problem.of([run], float(np.median(np.diff(t))))
    return problem.curve(problem.likeliest()[0])(t)


@dataclasses.dataclass(frozen=True, eq=False)
class _Problem:
    """The bands (6, M) of BᵀB and DᵀD below their diagonals, Bᵀy (M,), B and y with each row in
    units of its noise, the first knot and the number of coefficients of each run."""

    step: float
    data: np.ndarray
    rough: np.ndarray
    target: np.ndarray
    design: Any
    y: np.ndarray
    begins: tuple[float, ...]
    counts: tuple[int, ...]

    @classmethod
    def of(cls, runs: Sequence[tuple[np.ndarray, ...]], step: float) -> _Problem:
        """Make it of runs (t, y), or of these with the noise (n,) of y, relative to the others, and
        the order (n,) of the derivative that it shows."""
        from scipy import sparse  # loaded when first used
        from scipy.interpolate import BSpline

        k = _Options.degree
        signs = np.diff(np.eye(_Options.order + 1), _Options.order, axis=0)[0]
        designs, roughs, begins, counts, targets = [], [], [], [], []
        for t, y, *rated in runs:
            length = float(np.ptp(t))
            spans = max(1, int(np.ceil(length / step * (1 + 1e-12))))
            begin = t.min() - 0.5 * (spans * step - length)  # the knots' middle is the run's
            knots = begin + step * np.arange(-k, spans + k + 1)
            inside = np.clip(t, knots[k], knots[-k - 1])
            own = BSpline.design_matrix(inside, knots, k)
            if rated:
                noise, order = rated
                slopes = BSpline.design_matrix(inside, knots[1:-1], k - 1)
                differences = sparse.eye_array(spans + k - 1, spans + k, k=1)
                differences = (differences - sparse.eye_array(spans + k - 1, spans + k)) / step
                of_rates = sparse.diags_array(1.0 * order)
                own = own - of_rates @ own + of_rates @ slopes @ differences
                own, y = sparse.diags_array(1 / noise) @ own, y / noise
            designs.append(own)
            targets.append(y)
            size = spans + k - _Options.order
            of_order = [np.full(size, sign) for sign in signs]
            offsets: Any = range(_Options.order + 1)
            roughs.append(sparse.diags_array(of_order, offsets=offsets, shape=(size, spans + k)))
            begins.append(float(begin))
            counts.append(spans + k)
        B = sparse.block_diag(designs, format="csr")
        D = sparse.block_diag(roughs, format="csr")
        y = np.concatenate(targets)
        return cls(
            step, _band(B.T @ B), _band(D.T @ D), B.T @ y, B, y, tuple(begins), tuple(counts)
        )

    def likeliest(self) -> tuple[float, float]:
        """λ of the largest restricted likelihood, and σ there."""
        low, high, by = _Options.stiffness
        tried = 10.0 ** np.arange(low, high + by / 2, by)
        found = []
        for stiffness in tried.tolist():
            with contextlib.suppress(np.linalg.LinAlgError):  # readings of a run nearly coincide
                unlikely, sigma, _ = self._solved(stiffness)
                found.append((unlikely, stiffness, sigma))
        if not found:
            raise np.linalg.LinAlgError("no smoothing spline of these readings can be solved for")
        return min(found, key=lambda one: one[0])[1:]

    def curve(self, stiffness: float) -> Any:
        """The curve of the first run."""
        from scipy.interpolate import BSpline

        k, count = _Options.degree, self.counts[0]
        knots = self.begins[0] + self.step * np.arange(-k, count + 1)
        return BSpline(knots, self._solved(stiffness)[2][:count], k)

    def _solved(self, stiffness: float) -> tuple[float, float, np.ndarray]:
        """Minus twice the logarithm of the likelihood of λ, σ, and the coefficients."""
        from scipy.linalg import cho_solve_banded, cholesky_banded

        root = cholesky_banded(self.data + stiffness * self.rough, lower=True)
        alpha = cho_solve_banded((root, True), self.target)
        rough = alpha @ _times(self.rough, alpha)
        left = np.sum((self.y - self.design @ alpha) ** 2) + stiffness * max(rough, 0.0)
        flat = _Options.order * len(self.counts)
        free = max(len(self.y) - flat, 1)
        unlikely = free * np.log(max(left, 1e-300)) + 2 * np.sum(np.log(root[0]))
        unlikely -= (sum(self.counts) - flat) * np.log(stiffness)
        return float(unlikely), float(np.sqrt(left / free)), alpha


def _band(matrix: Any) -> np.ndarray:
    """The diagonals (6, M) of a symmetric band, the main one first."""
    band = np.zeros((_Options.degree + 1, matrix.shape[0]))
    for k in range(min(len(band), matrix.shape[0])):
        band[k, : matrix.shape[0] - k] = matrix.diagonal(-k)
    return band


def _times(band: np.ndarray, x: np.ndarray) -> np.ndarray:
    """A symmetric band times x (M,)."""
    found = band[0] * x
    for k in range(1, len(band)):
        found[k:] += band[k, :-k] * x[:-k]
        found[:-k] += band[k, :-k] * x[k:]
    return found
