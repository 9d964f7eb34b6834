"""Oscillations of a few frequencies in one series: what of it belongs to each, window by window."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from gfnn_jax.signals.steps import dominant_frequencies


@dataclasses.dataclass(frozen=True)
class _Options:
    """periods: of the slowest oscillation, in a window. fewest: samples of a window, for each
    oscillation. peaks: of a spectrum that are tried. kept: sets that more is added to. steps: of a
    window, from one to the next, where sets are compared; places: where states are told. apart:
    ratio of neighbouring frequencies that a window tells from one whose size changes. beside:
    ratios to the strongest, that a weak oscillation may have."""

    periods: float = 1.5
    fewest: int = 8
    peaks: int = 4
    kept: int = 3
    steps: int = 4
    places: int = 64
    apart: float = 1.15
    beside: tuple[float, ...] = (0.5, 0.7, 1.4, 2.0, 0.85, 1.2)


_OPTIONS = _Options()


class Oscillations(NamedTuple):
    """A series as the sum of oscillations of these angular frequencies (count,), whose sizes and
    phases change slowly."""

    omega: np.ndarray

    @property
    def seconds(self) -> float:
        """Length of a window."""
        return _OPTIONS.periods * 2 * np.pi / float(np.min(self.omega[self.omega > 0]))

    @property
    def are_apart(self) -> bool:
        """Return whether a window tells each frequency from its neighbours."""
        return bool(np.all(self.omega[1:] > _OPTIONS.apart * self.omega[:-1]))

    def parts(self, t: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The parts (n, count) of y (n,) at times t (n,), and their rates of change; y may have
        NaN."""
        known = np.flatnonzero(np.isfinite(y))
        _, at, _, c = self._fitted(t[known], y[known], _OPTIONS.places)
        nearest = np.abs(t[:, None] - at).argmin(axis=1)
        turned = np.exp(1j * self.omega * (t - at[nearest])[:, None])
        z = (c[nearest, 0::2] + 1j * c[nearest, 1::2]) * turned
        return z.real, (1j * self.omega * z).real

    def left(self, t: np.ndarray, y: np.ndarray) -> float:
        """Mean square of y (n,) that no windows' oscillations follow."""
        Y, _, A, c = self._fitted(t, y, _OPTIONS.steps)
        return float(np.mean((Y - np.einsum("nwi,ni->nw", A, c)) ** 2))

    def _fitted(self, t: np.ndarray, y: np.ndarray, parts: int) -> tuple[np.ndarray, ...]:
        """Windows of y (n, w), the times (n,) that they are about, the oscillations in them
        (n, w, 2 count), and their sizes (n, 2 count)."""
        step = np.ptp(t) / max(len(t) - 1, 1)
        size = max(round(self.seconds / step), _OPTIONS.fewest * len(self.omega))
        size = min(size, len(t))
        begun = np.arange(0, len(t) - size + 1, max(1, size // parts))
        index = begun[:, None] + np.arange(size)
        at = t[index].mean(axis=1)
        turned = np.exp(1j * self.omega * (t[index] - at[:, None])[..., None])
        A = np.stack([turned.real, -turned.imag], axis=-1).reshape(*index.shape, -1)
        G = A.swapaxes(1, 2) @ A
        G += 1e-9 * size * np.eye(G.shape[1])
        c = np.linalg.solve(G, A.swapaxes(1, 2) @ y[index][..., None])[..., 0]
        return y[index], at, A, c


def oscillations(t: np.ndarray, y: np.ndarray, count: int) -> list[Oscillations]:
    """Sets of ``count`` oscillations of y (n,) at times t (n,), the one that follows best first;
    none where it is shorter than a window.

    Each is the last set with a peak of the spectrum of what that does not follow, and then the
    frequencies that follow best. Behind them stand sets of the strongest one and one that is hidden
    behind how its size changes.
    """
    known = np.isfinite(y)
    if known.sum() < _OPTIONS.fewest * count:
        return []
    t, y = t[known], y[known] - np.mean(y[known])
    found = [Oscillations(np.zeros(0))]
    for _ in range(count):
        tried = []
        for one in found:
            rest = y - one.parts(t, y)[0].sum(axis=1) if len(one.omega) else y
            for peak in dominant_frequencies([t], rest, _OPTIONS.peaks):
                tried.append(_refined(t, y, np.append(one.omega, 2 * np.pi * peak)))
        tried = [one for one in tried if one.are_apart]
        tried = _unlike(sorted(tried, key=lambda one: one.left(t, y)))
        if found and len(found[0].omega) == 1:
            strongest = found[0].omega[0]
            tried = tried[: _OPTIONS.kept - 1] + [
                Oscillations(np.sort(strongest * np.array([1.0, ratio])))
                for ratio in _OPTIONS.beside
                if count == 2
            ]
            found = tried
        else:
            found = tried[: _OPTIONS.kept]
    return found


def _unlike(found: list[Oscillations]) -> list[Oscillations]:
    """Sets of as many oscillations, each without those behind it that have its frequencies."""
    kept: list[Oscillations] = []
    for one in found:
        if not any(np.allclose(one.omega, other.omega, rtol=0.01) for other in kept):
            kept.append(one)
    return kept


def _refined(t: np.ndarray, y: np.ndarray, omega: np.ndarray) -> Oscillations:
    """The oscillations near these frequencies that follow best."""
    found = minimize(
        lambda logs: np.log(Oscillations(np.exp(logs)).left(t, y)),
        np.log(omega),
        method="Nelder-Mead",
        options={"xatol": 1e-3, "fatol": 1e-3, "maxfev": 60},
    )
    return Oscillations(np.sort(np.exp(found.x)))
