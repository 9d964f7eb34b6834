"""Growth of errors with the step: exponents, drifts, diffusion, with uncertainties. NumPy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

POINTS_PER_DECADE = 20


class Estimate(NamedTuple):
    """Estimate from trajectories, with its uncertainty and the range of steps that it is from."""

    value: float
    standard_error: float
    interval: tuple[float, float]  # 95 % confidence, Student's t
    first: float
    last: float
    num_trajectories: int


def growth_exponent(steps, error, first=10, last=None, floor=1e-13) -> Estimate:
    """Exponent α of mean error ∝ stepᵅ: the least-squares slope on log–log axes.

    error: (B, L) per trajectory, or (L,) of one. The paper's theorem on regular orbits gives α = 1.
    The fit uses about 20 points per decade, evenly in log(step), so that the many late steps do not
    outweigh the early ones. The points lie between the steps ``first`` and ``last`` (those used are
    in the result), where the mean error is finite and above ``floor``, the plateau of roundoff and
    of the reference's own error. ``last`` must exclude errors that have saturated at the size of
    the orbit. The interval comes from the scatter over trajectories (jackknife). For a single
    trajectory it comes from the residuals of the fit; these are correlated, and it is too narrow.
    """
    error = np.atleast_2d(np.asarray(error, float))
    error = error[~np.isnan(error).any(axis=1)]
    return _power_law(np.asarray(steps, float), error, first, last, floor)


def energy_error(values):
    """Energy error (H − H₀)/|H₀| of an invariant along trajectories, (B, L) -> (B, L); H₀ ≠ 0."""
    values = np.asarray(values, float)
    start = values[..., :1]
    return (values - start) / np.abs(start)


def energy_drift(steps, energy_error) -> Estimate:
    """Secular trend of the energy error (B, L), per step: least squares on the mean trajectory.

    The interval comes from the scatter of the trend over trajectories, which is correct also where
    the error of each is a random walk. Trajectories that do not stay finite are left out.
    """
    steps, lanes = np.asarray(steps, float), _finite(energy_error)
    return _slope(steps, lanes, steps, lambda mean: mean)


def drift_exponent(steps, energy_error, window: int) -> Estimate:
    """Exponent of the growth of the smoothed energy error (B, L): ½ for roundoff, 1 for a drift.

    By Brouwer's law (Hairer, McLachlan & Razakarivony 2008, "Achieving Brouwer's law") the roundoff
    of a well implemented symplectic step is a random walk. The error is averaged over blocks of
    ``window`` saved states, several periods of the motion, which removes its bounded oscillation.
    The fit is to the root mean square over trajectories of a block's difference from the first
    block, from ten blocks on. The exponent of a single trajectory is meaningless.
    """
    steps, lanes = np.asarray(steps, float), _finite(energy_error)
    num_blocks = lanes.shape[1] // window
    blocks = lanes[:, : num_blocks * window].reshape(len(lanes), num_blocks, window).mean(axis=-1)
    centres = steps[: num_blocks * window].reshape(num_blocks, window).mean(axis=-1)
    elapsed = centres[1:] - centres[0]
    squares = (blocks[:, 1:] - blocks[:, :1]) ** 2
    return _power_law(elapsed, squares, 10 * elapsed[0], None, 0.0, power=0.5)


def diffusion_coefficient(p) -> Estimate:
    """Diffusion coefficient D of ⟨(p_n − p_0)²⟩ = 2 D n, half the slope of the displacement.

    p: momenta (B, L) at the steps 0 … L − 1, not reduced mod 2π. For the standard map D → K²/4 at
    large K, times 1 − 2 J₂(K) + 2 J₂(K)² to the next orders (Rechester & White 1980).
    """
    p = _finite(p)
    steps = np.arange(p.shape[1], dtype=float)
    return _slope(steps, (p - p[:, :1]) ** 2 / 2, steps, lambda mean: mean)


def _finite(lanes):
    lanes = np.atleast_2d(np.asarray(lanes, float))
    return lanes[np.isfinite(lanes).all(axis=1)]


def _power_law(steps, lanes, first, last, floor, power=1.0):
    """Slope of log(mean of lanes ** power) against log(steps), on points even in log(steps)."""
    mean = lanes.mean(axis=0) if len(lanes) else np.full(len(steps), np.nan)
    usable = (steps >= first) & (steps > 0) & np.isfinite(mean) & (mean > floor)
    if last is not None:
        usable &= steps <= last
    chosen = np.flatnonzero(usable)
    if len(chosen):
        grid = np.log(steps[chosen])
        num = 2 + int(POINTS_PER_DECADE * (grid[-1] - grid[0]) / np.log(10))
        targets = np.linspace(grid[0], grid[-1], num) - 1e-9  # the first target is the first step
        chosen = chosen[np.unique(np.searchsorted(grid, targets))]
    return _slope(
        np.log(steps[chosen]), lanes[:, chosen], steps[chosen], lambda mean: power * np.log(mean)
    )


def _slope(x, lanes, steps, transform):
    """Slope of transform(mean over lanes) against x by least squares, with its uncertainty."""
    num_lanes, num_points = lanes.shape
    if num_lanes == 0 or num_points < 3:
        nan = float("nan")
        return Estimate(nan, nan, (nan, nan), nan, nan, num_lanes)
    centred = x - x.mean()
    weights = centred / (centred @ centred)
    curve = transform(lanes.mean(axis=0))
    value = curve @ weights
    if num_lanes > 1:  # delete-one jackknife; for a linear transform, the scatter of the slopes
        replicates = transform((lanes.sum(axis=0) - lanes) / (num_lanes - 1)) @ weights
        variance = (num_lanes - 1) * np.var(replicates)
        degrees = num_lanes - 1
    else:
        residual = curve - curve.mean() - value * centred
        variance = residual @ residual / (num_points - 2) * (weights @ weights)
        degrees = num_points - 2
    error = float(np.sqrt(variance))
    half = float(stdtrit(degrees, 0.975)) * error
    value = float(value)
    return Estimate(
        value, error, (value - half, value + half), float(steps[0]), float(steps[-1]), num_lanes
    )
