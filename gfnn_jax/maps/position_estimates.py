"""A map of positions and its readings: states estimated from noisy ones, and forecasts with bands.

The readings before a time are fitted by one orbit of S(q, Q), its positions latent; that gives the
last two with their covariance. A forecast is the rollout from them. Its band holds their error,
that of the coefficients of S, by which the estimate and the rollout err together, and the noise of
a reading; all to first order.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import numpy as np

from gfnn_jax.coordinates import whole_turns
from gfnn_jax.data.recording import Recording
from gfnn_jax.errors import InputError
from gfnn_jax.generating.arcs import PositionArcs, nodes_of
from gfnn_jax.solve.latent_arcs import Readings

_EVEN = 0.01  # of a time step, by which times may miss an even grid


class _Ends(NamedTuple):
    """The last two positions (B, 2d) of every run, a root (B, 2d, 2d) of their covariance with S as
    it is, and how far each direction of the posterior of S, a row of its root, moves them (B, 2d,
    k)."""

    positions: np.ndarray
    root: np.ndarray
    by_posterior: np.ndarray

    @property
    def spread(self) -> np.ndarray:
        """(B, 2d, 2d + k), of which spread spreadᵀ is the covariance."""
        return np.concatenate([self.root, self.by_posterior], axis=2)


def estimate(map_: Any, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Implement `maps.forecasts.estimate` for a map of positions alone."""
    piece = jax.tree.map(np.asarray, map_.pieces[0])
    ends = _ends(map_, piece, recording)
    return _states(piece, ends)


def forecast(
    map_: Any, recording: Recording, times: np.ndarray, inputs: Recording | None = None
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], tuple[str, ...]]:
    """Implement `maps.forecasts.forecast` for a map of positions alone: values, std, outside."""
    piece, sensors, dim = jax.tree.map(np.asarray, map_.pieces[0]), map_.sensors, map_.dim
    dt, last = float(piece.dt), np.array([np.max(recording.times(run)) for run in recording.runs])
    ahead = (times - last[:, None]) / dt
    steps = np.round(ahead).astype(int)
    if not (steps > 0).all() or not np.abs(ahead - steps).max() < _EVEN:
        raise InputError(
            f"expected times that are whole steps of {dt:g} s after the end of each run "
            f"({last.max():g} s), got {times[0]:g} to {times[-1]:g} s"
        )
    ends = _ends(map_, piece, recording)
    orbits = np.asarray(map_.rollout(_states(piece, ends)[0], int(steps.max()))[0])[..., :dim]
    before = ends.positions[:, None, :dim] + orbits[:, :1] - ends.positions[:, None, dim:]
    nodes = nodes_of(np.concatenate([before, orbits], axis=1))[0]
    arcs, spread = _arcs(map_, piece), ends.spread
    moved = arcs.defects(np.zeros(arcs.basis.shape[1]), nodes)
    deviations = np.empty((len(spread), 1 + steps.max(), dim))
    for k in range(steps.max() + 1):
        deviations[:, k] = np.sqrt(np.sum(spread[:, dim:] ** 2, axis=2) + sensors.sigma**2)
        if k < steps.max():
            spread = moved.by_state[:, k] @ spread
            spread[..., 2 * dim :] += moved.by_coefficients[:, k]
    rows = np.arange(len(steps))[:, None]
    values, std = orbits[rows, steps], deviations[rows, steps]
    named = [{name: of[..., i] for i, name in enumerate(sensors.positions)} for of in (values, std)]
    return named[0], named[1], ()


def _states(piece: Any, ends: _Ends) -> tuple[np.ndarray, np.ndarray]:
    """z = (q, p) (B, 2d) at the last positions, p = h ∂S/∂Q, and its covariance."""
    dim, w = ends.positions.shape[1] // 2, ends.positions
    gradient, hessian = piece.family.gradient_and_hessian(piece.params, w)
    turn = np.concatenate([np.zeros((len(w), dim, 2 * dim)), piece.dt * hessian[:, dim:]], axis=1)
    turn[:, range(dim), range(dim, 2 * dim)] = 1.0
    z = np.concatenate([w[:, dim:], piece.dt * gradient[:, dim:]], axis=1)
    spread = turn @ ends.spread
    return z, spread @ spread.swapaxes(1, 2)


def _arcs(map_: Any, piece: Any) -> PositionArcs:
    """S along arcs, beside it the directions of its posterior."""
    terms = piece.family.num_parameters
    root = np.zeros((0, terms)) if map_.posterior is None else np.asarray(map_.posterior.root)
    return PositionArcs(piece.family, float(piece.dt), piece.params, root.T)


def _ends(map_: Any, piece: Any, recording: Recording) -> _Ends:
    """Fit an orbit of S through the last readings of every run."""
    sensors, dim = map_.sensors, map_.dim
    windows = [_window(map_, piece, recording, run) for run in recording.runs]
    arcs, sigma = _arcs(map_, piece), np.tile(sensors.sigma, 2)
    known = dataclasses.replace(arcs, basis=arcs.basis[:, :0])
    directions, num = arcs.basis.shape[1], len(windows)
    positions, root = np.empty((num, 2 * dim)), np.empty((num, 2 * dim, 2 * dim))
    by_posterior = np.empty((num, 2 * dim, directions))
    lengths = np.array([len(window) for window in windows])
    for length in np.unique(lengths):
        rows = np.flatnonzero(lengths == length)
        x, y = nodes_of(np.array([windows[row] for row in rows]))
        found = Readings(known, y, sigma).fit(np.zeros(0), x, sigma)
        positions[rows] = found.x[:, -1]
        root[rows] = found.transports @ np.linalg.pinv(found.arcs)
        moved = Readings(arcs, y, sigma).last_by_coefficients(np.zeros(directions), found.x)
        by_posterior[rows] = moved
    return _Ends(positions, root, by_posterior)


def _window(map_: Any, piece: Any, recording: Recording, run: str) -> np.ndarray:
    """The last readings (n, d) of a run without a gap, angles as the map lifts moves."""
    sensors, dt = map_.sensors, float(piece.dt)
    missing = [name for name in sensors.positions if name not in recording.columns]
    if missing:
        raise InputError(f"{recording.source}: expected columns {', '.join(missing)}")
    q = np.stack([recording.values(name, run) for name in sensors.positions], axis=1)
    times = recording.times(run)
    apart = ~np.isfinite(q[1:] + q[:-1]).all(axis=1)
    apart |= np.abs(np.diff(times) - dt) > _EVEN * dt
    first = 1 + int(np.flatnonzero(apart)[-1]) if apart.any() else 0
    first = max(first, int(np.searchsorted(times, times[-1] - sensors.window)))
    q = q[first:]
    if len(q) < 2 or not np.isfinite(q).all():
        raise InputError(
            f"{recording.source}: run {run}: expected at least two positions {dt:g} s apart at its "
            "end"
        )
    for k in range(1, len(q)):
        q[k] = piece.family.lifted(q[k - 1], q[k])
        if k > 1:
            q[k] += _turns_missed(piece, q[k - 2 : k + 1])
    return q


def _turns_missed(piece: Any, q: np.ndarray) -> np.ndarray:
    """Whole turns (d,) by which the last of three positions (3, d) is off, where positions are
    known modulo 2π: a move that goes on from the one before may lie beyond half a turn.

    h² (∂₂S(q₋, q) + ∂₁S(q, q₊)) is about the error of q₊, with the other sign.
    """
    family, dim = piece.family, q.shape[1]
    if family.moves is None:
        return np.zeros(dim)
    w = np.concatenate([q[:-1], q[1:]], axis=1)
    gradient = piece.dt**2 * np.asarray(family.gradient(piece.params, w))
    turns = whole_turns(gradient[0, dim:] + gradient[1, :dim])
    return np.where(np.isnan(family.moves), 0.0, turns)
