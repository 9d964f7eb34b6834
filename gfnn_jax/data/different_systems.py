"""Test of whether the runs of a recording are motions of one system.

Accelerations by local polynomials are fitted with functions that small mechanical systems have:
once for all runs together, and for each run by itself, where one half of its windows is fitted and
the other judged. Runs of one system lose nothing by being fitted together. Where the functions do
not describe the runs one by one, nothing can be told.
"""

from __future__ import annotations

import itertools

import numpy as np

from gfnn_jax.data.traits import Traits
from gfnn_jax.signals.local_polynomials import local_fits

_MOST_RUNS = 40
_FEWEST = 40  # windows of a run
_BLOCK = 8  # neighbouring windows that are fitted, or judged, together
_WORSE = 6.0  # times the residual of the run's own fit
_MISSED = (
    0.04  # of the accelerations' spread, that the common fit misses at least, an own one at most
)
_RIDGE = 1e-8


def different_systems(traits: Traits) -> list[str]:
    """Names of runs that move by another law than the rest does; none where that cannot be told."""
    recording = traits.recording
    varied = any(
        np.nanmin(traits.columns[p]) < np.nanmax(traits.columns[p]) for p in recording.parameters
    )
    if len(recording.runs) < 2 or not recording.positions or recording.dim > 3 or varied:
        return []
    # Second derivatives want narrower windows than values do.
    size = max(2 * min(traits.noise[n].size for n in recording.positions) // 3, 9)
    columns = np.stack([traits.columns[n] for n in (*recording.positions, *recording.inputs)])
    fits = local_fits(traits.times, columns, size, 5)
    if fits is None:
        return []
    dim = recording.dim
    angles = [n in recording.angles for n in recording.positions]
    table = _functions(fits.values[:dim], fits.slopes[:dim], angles, fits.values[dim:])
    target = fits.curvatures[:dim].T
    known = np.isfinite(table).all(axis=1) & np.isfinite(target).all(axis=1)
    table, target, run = table[known], target[known], fits.run[known]
    runs = [r for r in range(len(recording.runs)) if np.sum(run == r) >= _FEWEST][:_MOST_RUNS]
    if len(runs) < 2:
        return []
    table = table / np.maximum(table.std(axis=0) + np.abs(table.mean(axis=0)), 1e-300)
    rows = [np.flatnonzero(run == r) for r in runs]
    spread = target.std(axis=0)
    own = np.array([_own(table[k], target[k]) for k in rows])
    if np.any(own > _MISSED * spread):
        return []
    together = np.concatenate(rows)
    common = _fitted(table[together], target[together])
    shared = np.array([_missed(table[k], target[k], common) for k in rows])
    apart = np.any((shared > _WORSE * own) & (shared > _MISSED * spread), axis=1)
    return [recording.runs[r] for r, is_apart in zip(runs, apart, strict=True) if is_apart]


def _fitted(table: np.ndarray, target: np.ndarray) -> np.ndarray:
    normal = table.T @ table / len(table) + _RIDGE * np.eye(table.shape[1])
    return np.linalg.solve(normal, table.T @ target / len(table))


def _missed(table: np.ndarray, target: np.ndarray, c: np.ndarray) -> np.ndarray:
    """RMS (dim,) of the accelerations that coefficients leave."""
    return np.sqrt(np.mean((target - table @ c) ** 2, axis=0))


def _own(table: np.ndarray, target: np.ndarray) -> np.ndarray:
    """RMS (dim,) that fits to every other block of windows leave of the blocks between."""
    half = np.arange(len(table)) // _BLOCK % 2
    left = [
        _missed(table[half == b], target[half == b], _fitted(table[half != b], target[half != b]))
        for b in (0, 1)
    ]
    return np.sqrt(np.mean(np.square(left), axis=0))


def _functions(q: np.ndarray, v: np.ndarray, angles: list[bool], u: np.ndarray) -> np.ndarray:
    """(W, k) functions of positions, speeds and inputs that accelerations are made of."""
    one = np.ones_like(q[0])
    found = [one, *v, *(x * np.abs(x) for x in v), *u]
    scaled = (q - q.mean(axis=1, keepdims=True)) / np.maximum(q.std(axis=1, keepdims=True), 1e-300)
    for x, s, angle in zip(q, scaled, angles, strict=True):
        found += [np.sin(x), np.cos(x), np.sin(2 * x), np.cos(2 * x)] if angle else [s, s**2, s**3]
    for i, j in itertools.combinations(range(len(q)), 2):
        if not (angles[i] and angles[j]):
            found.append(scaled[i] * scaled[j])
            continue
        apart, products = q[i] - q[j], (v[i] ** 2, v[j] ** 2, v[i] * v[j])
        found += [f(m * apart) for m in (1, 2) for f in (np.sin, np.cos)]
        found += [f(apart) * w for f in (np.sin, np.cos) for w in products]
    return np.stack(found, axis=1)
