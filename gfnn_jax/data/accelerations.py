"""Accelerations of a recording by local polynomials, fitted with functions that small mechanical
systems have: what is the same law, what is an angle, what drives."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np

from gfnn_jax.data.traits import Traits
from gfnn_jax.signals.local_polynomials import local_fits


@dataclasses.dataclass(frozen=True)
class _Options:
    """narrowest: samples of a window. degree: of its polynomial. block: windows fitted or judged
    together. ridge: of the fits, relative to columns of unit size."""

    narrowest: int = 9
    degree: int = 5
    block: int = 8
    ridge: float = 1e-8


_OPTIONS = _Options()


@dataclasses.dataclass(frozen=True)
class Accelerations:
    """Positions q, speeds v, accelerations a (d, W) and inputs u (k, W) at the centres of windows;
    run (W,) and time (W,) of each."""

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    u: np.ndarray
    run: np.ndarray
    time: np.ndarray

    def taken(self, keep: np.ndarray) -> Accelerations:
        """The windows of these places."""
        fields = (getattr(self, f.name) for f in dataclasses.fields(self))
        return Accelerations(*(x[..., keep] for x in fields))

    def held_out(self, angles: Sequence[bool]) -> np.ndarray:
        """RMS (d,) that fits to every other block of windows leave in the blocks between, where
        some positions are angles."""
        table = functions(self.q, self.v, angles, self.u)
        return held_out(scaled(table), self.a.T)


def accelerations(traits: Traits, inputs: Sequence[str]) -> Accelerations | None:
    """Accelerations of the positions beside some inputs; None where no window holds them."""
    names = traits.recording.positions
    if not names:
        return None
    # Second derivatives want narrower windows than values do.
    size = max(2 * min(traits.noise[n].size for n in names) // 3, _OPTIONS.narrowest)
    columns = np.stack([traits.columns[n] for n in (*names, *inputs)])
    fits = local_fits(traits.times, columns, size, _OPTIONS.degree)
    if fits is None:
        return None
    dim = len(names)
    found = Accelerations(
        fits.values[:dim],
        fits.slopes[:dim],
        fits.curvatures[:dim],
        fits.values[dim:],
        fits.run,
        fits.centres,
    )
    every = np.concatenate([found.q, found.v, found.a, found.u])
    known = np.asarray(np.isfinite(every).all(axis=0))
    return found.taken(known) if known.sum() >= 2 * _OPTIONS.block else None


def scaled(table: np.ndarray) -> np.ndarray:
    """Columns (W, k) of unit size."""
    return table / np.maximum(table.std(axis=0) + np.abs(table.mean(axis=0)), 1e-300)


def fitted(table: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Coefficients of a least-squares fit with a small ridge."""
    normal = table.T @ table / len(table) + _OPTIONS.ridge * np.eye(table.shape[1])
    return np.linalg.solve(normal, table.T @ target / len(table))


def missed(table: np.ndarray, target: np.ndarray, c: np.ndarray) -> np.ndarray:
    """RMS (d,) of the accelerations that coefficients leave."""
    return np.sqrt(np.mean((target - table @ c) ** 2, axis=0))


def held_out(table: np.ndarray, target: np.ndarray) -> np.ndarray:
    """RMS (d,) that fits to every other block of windows leave in the blocks between."""
    half = np.arange(len(table)) // _OPTIONS.block % 2
    left = [
        missed(table[half == b], target[half == b], fitted(table[half != b], target[half != b]))
        for b in (0, 1)
    ]
    return np.sqrt(np.mean(np.square(left), axis=0))


def functions(q: np.ndarray, v: np.ndarray, angles: Sequence[bool], u: np.ndarray) -> np.ndarray:
    """(W, k) functions of positions, speeds and inputs that accelerations are made of."""
    found = [np.ones_like(q[0]), *v, *(x * np.abs(x) for x in v), *u]
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
