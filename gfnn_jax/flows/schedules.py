"""Inputs between their samples: held, linear, or band-limited, at the nodes of the Runge–Kutta
steps; and inputs that act later than they were measured."""

from functools import cache

import numpy as np
from numpy.polynomial.chebyshev import chebpts1, chebvander
from scipy.special import i0

from gfnn_jax.flows.dormand_prince import NODES

HOLDS = ("hold", "linear", "band")
TAPS = 32  # samples on either side, of band-limited interpolation
_DEGREE = 17  # between two samples, of polynomials that are its weights to roundoff
_AT_ONCE = 4_096  # times
_GAUSS = 0.5 + np.sqrt(0.15) * np.array([-1, 0, 1])  # nodes of Gauss's rule of order 6, in [0, 1]
_SHARES = np.array([5, 8, 5]) / 18  # and its weights
_UNEVEN = 0.1  # median steps, by which even samples are off a whole number of them at most
_BRIDGED = 4  # median steps from sample to sample, up to which samples count as missing


def at_stages(
    t: np.ndarray,
    u: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
    substeps: int,
    hold: str,
    delay: float = 0.0,
) -> np.ndarray:
    """u(· − delay) (..., substeps, 6, k) at the stages of steps from ``start`` to ``end`` (...), of
    samples u (n, k) at times t (n,).

    A substep sees the parabola that has the moments ∫ sⁿ u ds, n = 0, 1, 2, of its inputs. It takes
    up their momentum, and moves as far by it, however many samples there are within it. Moments are
    by Gauss's rule between samples, exact where inputs are held or linear. Samples that a record
    lacks are linear between those beside them, whatever the rule.
    """
    if u.shape[1] == 0:
        return np.zeros((*start.shape, substeps, len(NODES), 0))
    t, u = _filled(t, u)
    whole = (end - start)[..., None] / substeps
    a = start[..., None] - delay + whole * np.arange(substeps)
    b = a + whole
    first = np.searchsorted(t, a, side="right")
    most = int(np.max(np.searchsorted(t, b) - first, initial=0))
    inside = t[np.minimum(first[..., None] + np.arange(most), len(t) - 1)]
    cuts = [a[..., None], np.clip(inside, a[..., None], b[..., None]), b[..., None]]
    parts: np.ndarray = np.diff(np.concatenate(cuts, axis=-1))[..., None]
    at = np.concatenate(cuts[:2], axis=-1)[..., None] + parts * _GAUSS
    passed = np.broadcast_to(whole > 0, a.shape)[..., None, None]
    size = np.where(passed, whole[..., None, None], 1.0)
    values = interpolate(t, u, at, hold)
    moved = _legendre((at - a[..., None, None]) / size)
    moments = np.einsum("...pg,...pgn,...pgk->...nk", parts / size * _SHARES, moved, values)
    found = (_legendre(NODES) * np.array([1.0, 3.0, 5.0])) @ moments
    return np.where(passed, found, values[..., 0, :1, :])  # no time: the value there


@cache
def of_polynomials(degree: int, substeps: int) -> np.ndarray:
    """Weights (substeps, 6, degree + 1) of the coefficients of a polynomial in time, in units of a
    step, in the inputs at the nodes of its substeps. Each substep sees the parabola of the same
    moments, as `at_stages` has it."""
    x, shares = np.polynomial.legendre.leggauss(degree // 2 + 2)
    s = 0.5 + 0.5 * x
    times = (np.arange(substeps)[:, None] + s) / substeps
    values = times[..., None] ** np.arange(degree + 1)
    moments = np.einsum("g,gn,pgj->pnj", 0.5 * shares, _legendre(s), values)
    return (_legendre(NODES) * np.array([1.0, 3.0, 5.0])) @ moments


def _legendre(s: np.ndarray) -> np.ndarray:
    """Legendre's polynomials (..., 3) of degree 0, 1 and 2 of a variable in [0, 1]."""
    return np.stack([np.ones_like(s), 2 * s - 1, 6 * s * (s - 1) + 1], axis=-1)


def _filled(t: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Samples u (n, k) at t (n,), and those between them that are missing: of even samples a few in
    a row, as a logger drops them."""
    if len(t) < 3:
        return t, u
    steps = np.diff(t)
    apart = steps / np.median(steps)
    whole = np.rint(apart).astype(int)
    even = (np.abs(apart - whole) < _UNEVEN) | (whole > _BRIDGED)
    parts = np.where((whole > 1) & (whole <= _BRIDGED), whole, 1)
    if not np.all(even) or np.all(parts == 1):
        return t, u
    first = np.repeat(np.arange(len(steps)), parts)
    share = (np.arange(len(first)) - np.searchsorted(first, first)) / parts[first]
    filled = np.append(t[first] + share * steps[first], t[-1])
    return filled, np.stack([np.interp(filled, t, column) for column in u.T], axis=1)


def interpolate(t: np.ndarray, u: np.ndarray, at: np.ndarray, hold: str) -> np.ndarray:
    """u (n, k), sampled at t (n,), at the times ``at`` (...): (..., k)."""
    flat = at.reshape(-1)
    if hold == "hold":
        found = u[np.clip(np.searchsorted(t, flat, side="right") - 1, 0, len(t) - 1)]
    elif hold == "linear":
        found = np.stack([np.interp(flat, t, column) for column in u.T], axis=1)
    else:
        found = _band_limited(t, u, flat)
    return found.reshape(*at.shape, u.shape[1])


def _band_limited(t: np.ndarray, u: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Windowed sinc over the samples around, of what is sampled evenly and well below its Nyquist
    frequency; the ends repeat their last value."""
    step = (t[-1] - t[0]) / (len(t) - 1)
    x = (at - t[0]) / step
    places, which = np.unique(np.floor(x).astype(int), return_inverse=True)
    near = u[np.clip(places[:, None] + np.arange(1 - TAPS, TAPS + 1), 0, len(t) - 1)]
    of_places = _of_weights() @ near
    found = np.empty((len(at), u.shape[1]))
    for first in range(0, len(at), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        powers = chebvander(2 * (x[some] - places[which[some]]) - 1, _DEGREE)
        found[some] = (powers[:, None] @ of_places[which[some]])[:, 0]
    return found


@cache
def _of_weights() -> np.ndarray:
    """Chebyshev coefficients (18, samples) of the weights of the samples around a time, in its
    place between the nearest two."""
    x = chebpts1(_DEGREE + 1)
    weights = band_weights((x[:, None] + 1) / 2 - np.arange(1 - TAPS, TAPS + 1))
    return np.linalg.solve(chebvander(x, _DEGREE), weights)


def band_weights(distance: np.ndarray) -> np.ndarray:
    """Weights (n, k) of samples at these distances, in steps, in n band-limited values: a sinc in a
    window of Kaiser's (IEEE Int. Symp. Circuits Syst. (1974) 20)."""
    inside = np.clip(1 - (distance / TAPS) ** 2, 0, None)
    # Shape of the window: the error, 3e-8 up to four fifths of the Nyquist rate, is of one sign in
    # each frequency and becomes one of the gain (`benchmarks/parameters.py`); 8 leaves 4e-5.
    weight = np.where(inside > 0, np.sinc(distance) * i0(16.0 * np.sqrt(inside)), 0.0)
    return weight / weight.sum(axis=1, keepdims=True)
