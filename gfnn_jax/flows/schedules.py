"""Inputs between their samples: held, linear, or band-limited, at the nodes of the Runge–Kutta
steps; and inputs that act later than they were measured."""

from __future__ import annotations

import numpy as np

from gfnn_jax.flows.motion import NODES

HOLDS = ("hold", "linear", "band")
_TAPS = 32  # samples on either side, of band-limited interpolation
_AT_ONCE = 4_096  # times
_UNEVEN = 0.1  # median steps, by which even samples are off a whole number of them at most
_BRIDGED = 4  # median steps from sample to sample, up to which samples count as missing


def stage_times(t: np.ndarray, substeps: int) -> np.ndarray:
    """Times (..., L − 1, substeps, 6) of the stages of steps between times t (..., L)."""
    h = np.diff(t)[..., None, None] / substeps
    parts = np.arange(substeps)[:, None] + NODES
    return t[..., :-1, None, None] + h * parts


def at_stages(
    t: np.ndarray, u: np.ndarray, ends: np.ndarray, substeps: int, hold: str, delay: float = 0.0
) -> np.ndarray:
    """u(· − delay) (..., L − 1, substeps, 6, k) at the stages of steps between times ``ends``
    (..., L), of samples u (n, k) at times t (n,). Where inputs are held, every stage of a substep
    sees their mean over it, so that the substep takes up all of their momentum. Samples that a
    record lacks are linear between those beside them, whatever the rule."""
    at = stage_times(ends, substeps) - delay
    if u.shape[1] == 0:
        return np.zeros((*at.shape, 0))
    t, u = _filled(t, u)
    if hold == "hold":
        mean = _mean_of_held(t, u, at[..., 0], at[..., -1])
        return np.broadcast_to(mean[..., None, :], (*at.shape, u.shape[1]))
    return interpolate(t, u, at, hold)


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
    """u (n, k), sampled at t (n,), at the times ``at`` (...): (..., k), "linear" or "band"."""
    flat = at.reshape(-1)
    if hold == "linear":
        found = np.stack([np.interp(flat, t, column) for column in u.T], axis=1)
    else:
        found = _band_limited(t, u, flat)
    return found.reshape(*at.shape, u.shape[1])


def _mean_of_held(t: np.ndarray, u: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Means (..., k) from ``start`` to ``end`` (...) of inputs that keep each sample until the
    next; before the first sample it is that one, where no time passes the value there."""
    index = np.clip(np.searchsorted(t, start, side="right") - 1, 0, len(t) - 1)
    passed = (end - start)[..., None]
    steps = np.diff(t)[:, None]
    whole = np.concatenate([np.zeros((1, u.shape[1])), np.cumsum(u[:-1] * steps, axis=0)])

    def integral(s: np.ndarray) -> np.ndarray:
        """∫ u from t[0] to s."""
        before, after = np.minimum(s - t[0], 0.0), np.maximum(s - t[-1], 0.0)
        inside = np.stack([np.interp(s, t, column) for column in whole.T], axis=-1)
        return inside + before[..., None] * u[0] + after[..., None] * u[-1]

    moved = integral(end) - integral(start)
    return np.where(passed > 0, moved / np.where(passed > 0, passed, 1.0), u[index])


def _band_limited(t: np.ndarray, u: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Windowed sinc (Kaiser, β = 8) over the samples around: exact for what is sampled evenly, and
    well below its Nyquist frequency; the ends repeat their last value."""
    step = (t[-1] - t[0]) / (len(t) - 1)
    x = (at - t[0]) / step
    found = np.empty((len(at), u.shape[1]))
    for first in range(0, len(at), _AT_ONCE):
        some = x[first : first + _AT_ONCE, None]
        index = np.floor(some).astype(int) + np.arange(1 - _TAPS, _TAPS + 1)
        s = some - index
        weight = np.sinc(s) * np.i0(8 * np.sqrt(np.clip(1 - (s / _TAPS) ** 2, 0, None)))
        weight /= weight.sum(axis=1, keepdims=True)
        near = u[np.clip(index, 0, len(t) - 1)]
        found[first : first + _AT_ONCE] = np.einsum("nk,nkj->nj", weight, near)
    return found
