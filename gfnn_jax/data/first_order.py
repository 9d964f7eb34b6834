"""Columns whose rates are functions of the columns themselves: populations, rates of turning.

Of positions that is never so, for a body passes a place with many velocities."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_simpson
from scipy.linalg import eigh


@dataclasses.dataclass(frozen=True)
class _Options:
    """Limits, chosen on tops, populations and mechanical systems drawn at random (tests of
    proposals).

    lags: samples over which changes are taken. quarter: of the columns' variance that a change may
    have. samples: changes for each function, at least. parts: into which the runs are cut, each
    judged by the fit to the others. invariant: part of a function's variance within runs,
    that noise leaves of one that is constant in each.
    """

    lags: tuple[int, ...] = (1, 2, 4, 8, 16, 32)
    quarter: float = 1.5
    samples: int = 4
    parts: int = 8
    told_apart: float = 3e-3
    invariant: float = 0.05
    runs: int = 3
    most: int = 20_000


_OPTIONS = _Options()
TOLD = 0.9  # share of the changes that quadratic functions explain of no positions


class FirstOrder(NamedTuple):
    """explained: share of the variance of the changes that quadratic functions explain, of the
    column with the least. constants: number of quadratic functions, or of linear ones with
    logarithms, that are constant in each run and differ between runs."""

    explained: float
    constants: int

    @property
    def told(self) -> bool:
        """True of columns that are no positions: their rates, and an energy, depend on them."""
        return self.explained > TOLD and self.constants > 0


def first_order(times: Sequence[np.ndarray], runs: Sequence[np.ndarray]) -> FirstOrder:
    """Columns (n_r, k) of runs, at times (n_r,), as the motion of states ẋ = f(x).

    x(t + h) − x(t) = ∫ f dt is fitted with f quadratic, which no noise of a derivative spoils.
    """
    kept = [np.isfinite(x).all(axis=1) for x in runs]
    times = [t[own] for t, own in zip(times, kept, strict=True)]
    runs = [x[own] for x, own in zip(runs, kept, strict=True)]
    runs = [x for x in runs if len(x) > 2 * _OPTIONS.parts]
    times = [t for t in times if len(t) > 2 * _OPTIONS.parts]
    if not runs:
        return FirstOrder(0.0, 0)
    every = np.concatenate(runs)
    size = np.sqrt(np.mean(every**2, axis=0)) + 1e-300
    tables = [_quadratic(x / size) for x in runs]
    sums = [
        cumulative_simpson(p, x=t, axis=0, initial=0) for t, p in zip(times, tables, strict=True)
    ]
    shares = [
        _explained(
            [x[lag:] - x[:-lag] for x in runs], [s[lag:] - s[:-lag] for s in sums], lag, every
        )
        for lag in _OPTIONS.lags
    ]
    return FirstOrder(max(shares), _constants(runs, tables))


def _quadratic(x: np.ndarray) -> np.ndarray:
    """1, x and products of two (n, m)."""
    products = [
        x[:, i] * x[:, j] for i, j in itertools.combinations_with_replacement(range(x.shape[1]), 2)
    ]
    return np.stack([np.ones(len(x)), *x.T, *products], axis=1)


def _explained(moved: list[np.ndarray], sums: list[np.ndarray], lag: int, every) -> float:
    """The least share of the changes (n_r, k) over ``lag`` that functions (n_r, m) explain, of each
    part by the fit to the others; 0 of changes that are too few or too long."""
    target, rows = np.concatenate(moved), np.concatenate(sums)
    if not len(target):
        return 0.0
    variance = np.var(target, axis=0)
    if np.any(variance > _OPTIONS.quarter * np.var(every, axis=0)):
        return 0.0
    thin, left, judged = 1 + len(target) // _OPTIONS.most, np.zeros(target.shape[1]), 0
    for own, others in _parts([len(x) for x in moved], lag):
        own, others = own[::thin], others[::thin]
        if len(others) < _OPTIONS.samples * rows.shape[1]:
            return 0.0
        c = np.linalg.lstsq(rows[others], target[others], rcond=_OPTIONS.told_apart)[0]
        left += np.sum((target[own] - rows[own] @ c) ** 2, axis=0)
        judged += len(own)
    return float(np.min(1 - left / np.maximum(judged * variance, 1e-300)))


def _parts(lengths: list[int], lag: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(changes of a part, those of the others that share no time with them): of many runs a part is
    every eighth run, of few an eighth of each run."""
    run = np.repeat(np.arange(len(lengths)), lengths)
    place = np.concatenate([np.arange(n) for n in lengths])
    for k in range(_OPTIONS.parts):
        if len(lengths) >= _OPTIONS.runs:
            own = run % _OPTIONS.parts == k
            others = ~own
        else:
            edges = np.array([(n * k, n * (k + 1)) for n in lengths])[run] // _OPTIONS.parts
            own = (edges[:, 0] <= place) & (place < edges[:, 1])
            others = (place <= edges[:, 0] - lag) | (place >= edges[:, 1] - 1 + lag)
        if own.any():
            yield np.flatnonzero(own), np.flatnonzero(others)


def _constants(runs: list[np.ndarray], tables: list[np.ndarray]) -> int:
    """Number of functions that are constant in each run and differ between runs."""
    if len(runs) < _OPTIONS.runs:
        return 0
    found = [_constant_within([table[:, 1:] for table in tables])]
    if all((x > 0).all() for x in runs):
        found.append(_constant_within([np.concatenate([x, np.log(x)], axis=1) for x in runs]))
    return max(found)


def _constant_within(tables: list[np.ndarray]) -> int:
    """Number of combinations of functions (n_r, m) whose variance is that between runs."""
    every = np.concatenate(tables)
    within = np.concatenate([table - table.mean(axis=0) for table in tables])
    scale = every.std(axis=0) + 1e-300
    within, every = within / scale, (every - every.mean(axis=0)) / scale
    total = every.T @ every
    total += 1e-6 * len(every) * np.eye(len(total))
    parts = eigh(within.T @ within, total, eigvals_only=True)
    return int(np.sum(parts < _OPTIONS.invariant))
