"""Measures of a prediction: errors, their growth, invariants, statistics of chaotic orbits.

Arrays in, arrays out. B trajectories of L saved states are an array (B, L, 2d), q first; ``steps``
(L,) are the step numbers of the saved states. The measures do not depend on how a prediction was
made, so that all methods are measured alike. Measures of saved arrays are NumPy in float64. Orbital
elements and Lyapunov exponents also work inside a jitted computation.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import stdtrit

from gfnn_jax.arrays import namespace
from gfnn_jax.coordinates import nearest_image
from gfnn_jax.phase_space import split


class ErrorStatistics(NamedTuple):
    """Statistics over the trajectories with a finite reference; mean, std, median are (L,)."""

    mean: np.ndarray
    std: np.ndarray
    median: np.ndarray
    num_excluded: int  # trajectories left out, whose reference does not stay finite
    num_lost: int  # trajectories that count, whose prediction becomes non-finite


def position_error(predicted, reference, angles=()):
    """Euclidean error of q, (B, L), of trajectories (B, L, 2d).

    ``angles`` are the indices in z of the coordinates with period 2π, a q or a p: their
    differences are taken to the nearest image, in [−π, π].
    """
    off = split(_difference(predicted, reference, angles))[0]
    return np.sqrt(np.sum(off**2, axis=-1))


def absolute_error(predicted, reference):
    """Absolute error |predicted − reference| of an element or an invariant, elementwise."""
    return np.abs(_difference(predicted, reference))


def one_step_rms(predicted, reference, angles=()) -> float:
    """RMS per component of predicted − reference, both (N, 2d): the one-step state error.

    angles: as of `position_error`. The result is inf where a prediction is not finite.
    """
    return float(np.sqrt(np.mean(_difference(predicted, reference, angles) ** 2)))


def _difference(predicted, reference, angles=()):
    predicted, reference = np.asarray(predicted, float), np.asarray(reference, float)
    with np.errstate(invalid="ignore"):
        difference = nearest_image(predicted - reference, angles)
    difference = np.where(np.isfinite(predicted), difference, np.inf)
    return np.where(np.isfinite(reference), difference, np.nan)


def error_statistics(error) -> ErrorStatistics:
    """Mean, (population) standard deviation and median over trajectories of errors (B, L).

    A trajectory with a NaN error anywhere has no finite reference there. It is left out at every
    step and counted in ``num_excluded``. A lost prediction (inf) is never left out: from that step
    on the mean and the deviation are inf, and the median is inf once half are lost.
    """
    error = np.asarray(error, float)
    kept = error[~np.isnan(error).any(axis=1)]
    num_excluded = len(error) - len(kept)
    if not len(kept):
        nothing = np.full(error.shape[1], np.nan)
        return ErrorStatistics(nothing, nothing, nothing, num_excluded, 0)
    with np.errstate(invalid="ignore"):
        mean, std, median = kept.mean(axis=0), kept.std(axis=0), np.median(kept, axis=0)
    # NumPy's deviation around an infinite mean is NaN, and so is the middle of two infinities.
    std = np.where(np.isfinite(mean), std, np.inf)
    median = np.where(np.isnan(median), np.inf, median)
    num_lost = int(np.isinf(kept).any(axis=1).sum())
    return ErrorStatistics(mean, std, median, num_excluded, num_lost)


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
    lanes, steps = lanes[:, chosen], steps[chosen]
    return _slope(np.log(steps), lanes, steps, lambda mean: power * np.log(mean))


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


def semi_major_axis(z):
    """Semi-major axis a of states (..., 4), from the energy −1/(2a). Negative on a hyperbola."""
    xp, (q, p) = namespace(z), split(z)
    return 1 / (2 / xp.linalg.norm(q, axis=-1) - xp.sum(p * p, axis=-1))


def eccentricity(z):
    """Eccentricity e of states (..., 4): the length of the Laplace–Runge–Lenz vector.

    The formula √(1 + 2 E L²) would lose half the digits on a nearly circular orbit.
    """
    xp, (q, p) = namespace(z), split(z)
    speed = xp.sum(p * p, axis=-1, keepdims=True)
    radial = xp.sum(q * p, axis=-1, keepdims=True)
    vector = (speed - 1 / xp.linalg.norm(q, axis=-1, keepdims=True)) * q - radial * p
    return xp.linalg.norm(vector, axis=-1)


ELEMENTS: dict[str, Callable] = {"axis": semi_major_axis, "eccentricity": eccentricity}


# Number of saved states, even, from which `section_crossings` interpolates a crossing.
STENCIL = 16


def kl_divergence(predicted, reference, bins: int, range) -> float:
    """Divergence D(predicted ‖ reference) = Σ P log(P/R) in nats, of histograms of two samples.

    It is that of the predicted marginal *from* the reference, as in the paper. There are ``bins``
    equal bins over ``range`` and one more for all samples outside, NaN included. Half a count is
    added to each bin of both (Krichevsky & Trofimov's rule), so that a bin without a reference
    sample costs much but not infinitely much. Two sets of N and M independent samples of one law
    have a divergence of about (bins − 1)/2 · (1/N + 1/M), not 0.
    """

    def probabilities(samples):
        samples = np.ravel(np.asarray(samples, float))
        inside, _ = np.histogram(samples[np.isfinite(samples)], bins, range)
        counts = np.append(inside, samples.size - inside.sum()) + 0.5
        return counts / counts.sum()

    p, r = probabilities(predicted), probabilities(reference)
    return float(np.sum(p * np.log(p / r)))


def section_crossings(trajectory, index: int, direction: int = 1):
    """States (K, 2d) where z[index] passes 0, upwards for ``direction`` +1, downwards for −1.

    trajectory: (L, 2d), evenly sampled, its coordinates continuous (angles not reduced mod 2π).
    Each change of sign is refined on the polynomial in time through the 16 saved states around it.
    A map that is known at its own time steps only thus gives a sharp section, and all methods are
    interpolated alike. Measured on Hénon–Heiles at dt = 0.5 (about 12 states a period), crossings
    have errors of 6e-6 at E = 1/12 and of 2e-5 just below E = 1/6, where straight lines have some
    1e-2. Crossings within 7 steps of either end are left out, and so are two within one step.
    """
    trajectory = np.asarray(trajectory, float)
    height = direction * trajectory[:, index]
    before = np.flatnonzero((height[:-1] < 0) & (height[1:] >= 0))
    reach = STENCIL // 2
    before = before[(before >= reach - 1) & (before + reach < len(trajectory))]
    nodes = np.arange(STENCIL) - (reach - 1.0)  # the crossing lies between the nodes 0 and 1
    windows = trajectory[before[:, None] + nodes.astype(int)]
    heights = direction * windows[..., index]
    # Barycentric weights of equispaced nodes: binomial coefficients of alternating sign.
    k = np.arange(STENCIL - 1)
    weights = np.cumprod(np.append(1.0, -(STENCIL - 1 - k) / (k + 1)))

    def lagrange(t):
        """Values (K, STENCIL) of the Lagrange polynomials at times t (K,), none of them a node."""
        terms = weights / (t[:, None] - nodes)
        return terms / terms.sum(axis=1, keepdims=True)

    low, high = np.zeros(len(before)), np.ones(len(before))
    for _ in range(50):  # bisection never meets a node, and cannot leave the interval
        middle = (low + high) / 2
        below = np.sum(lagrange(middle) * heights, axis=1) < 0
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    crossings = np.einsum("kn,knz->kz", lagrange((low + high) / 2), windows)
    return crossings[np.isfinite(crossings).all(axis=1)]


def curve_distance(z, curve, harmonics: int = 64):
    """Distance of states (..., 2) of (θ, p) from an invariant curve that winds around the cylinder.

    curve: (M, 2) points of the curve, an orbit of the reference, M at least a few times
    ``harmonics``. p as a trigonometric polynomial of θ is fitted to them by least squares, which is
    exact to roundoff for an analytic curve. The distance is that in p, times the cosine of the
    slope.
    """
    z, curve = np.asarray(z, float), np.asarray(curve, float)
    k = np.arange(1, harmonics + 1)

    def design(theta):
        angle = theta[..., None] * k
        return np.concatenate([np.ones((*theta.shape, 1)), np.cos(angle), np.sin(angle)], axis=-1)

    coefficients = np.linalg.lstsq(design(curve[:, 0]), curve[:, 1], rcond=None)[0]
    constant, even, odd = np.split(coefficients, [1, 1 + harmonics])
    slope = design(z[..., 0]) @ np.concatenate([0 * constant, k * odd, -k * even])
    height = design(z[..., 0]) @ coefficients
    return np.abs(z[..., 1] - height) / np.sqrt(1 + slope**2)


def lyapunov_exponent(step, z0, num_steps: int):
    """Largest Lyapunov exponent per step of the map ``step(z) -> z`` along the orbit of z0 (2d,).

    A tangent vector is propagated by the tangent map and normalised after each step (Benettin,
    Galgani, Giorgilli & Strelcyn 1980). The exponent is the mean logarithm of its growth; divide by
    dt for a rate in time. The function can be differentiated, jitted and vmapped (over z0). A
    regular orbit gives about log(num_steps)/num_steps, not 0.
    """

    def body(carry, _):
        z, tangent = carry
        z, tangent = jax.jvp(step, (z,), (tangent,))
        growth = jnp.linalg.norm(tangent)
        return (z, tangent / growth), jnp.log(growth)

    z0 = jnp.asarray(z0)
    tangent = jnp.full_like(z0, z0.size**-0.5)
    _, logs = jax.lax.scan(body, (z0, tangent), length=num_steps)
    return jnp.mean(logs)
