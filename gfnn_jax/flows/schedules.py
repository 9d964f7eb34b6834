"""Inputs between their samples: held, linear, or band-limited, at the nodes of the Runge–Kutta
steps."""

from __future__ import annotations

import numpy as np

from gfnn_jax.flows.motion import NODES

HOLDS = ("hold", "linear", "band")
_TAPS = 32  # samples on either side, of band-limited interpolation
_AT_ONCE = 4_096  # times


def stage_times(t: np.ndarray, substeps: int) -> np.ndarray:
    """Times (..., L − 1, substeps, 6) of the stages of steps between times t (..., L)."""
    h = np.diff(t)[..., None, None] / substeps
    parts = np.arange(substeps)[:, None] + NODES
    return t[..., :-1, None, None] + h * parts


def interpolate(
    t: np.ndarray, u: np.ndarray, at: np.ndarray, hold: str, starts: np.ndarray | None = None
) -> np.ndarray:
    """u (n, k), sampled at t (n,), at the times ``at`` (...): (..., k). Where it is held, stages at
    the end of a step still see the value at its start, ``starts`` (...)."""
    flat = at.reshape(-1)
    if u.shape[1] == 0:
        return np.zeros((*at.shape, 0))
    if hold == "hold":
        when = (
            flat if starts is None else np.minimum(flat, np.broadcast_to(starts, at.shape).ravel())
        )
        index = np.clip(
            np.searchsorted(t, when + 1e-9 * (t[1] - t[0]), side="right") - 1, 0, len(t) - 1
        )
        found = u[index]
    elif hold == "linear":
        found = np.stack([np.interp(flat, t, column) for column in u.T], axis=1)
    else:
        found = _band_limited(t, u, flat)
    return found.reshape(*at.shape, u.shape[1])


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
