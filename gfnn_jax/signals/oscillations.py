"""Oscillations of a few frequencies in one series: what of it belongs to each, window by window."""

from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np
from scipy.linalg import hankel

from gfnn_jax.signals.splines import FEWEST, splines
from gfnn_jax.signals.steps import dominant_frequencies


class _Options:
    """Windows, and lines of their spectra."""

    periods: float = 1.5  # of the slowest oscillation, in a window
    fewest: int = 8  # samples of a window, for each oscillation
    places: int = 64  # where states are told
    dense: int = 10  # values a period of the fastest peak, of which lines are made, and at the most
    cells: int = 400
    lines: int = 12
    width: float = 2.0  # of one whose frequency follows its size, in 2π over the record
    clear: float = 5.0  # standard errors of a line
    weak: float = 2e-3  # its size beside the strongest
    # size beside a stronger one, below which a line may be its tone, or come of how that changes
    imitated: float = 0.5
    sets: int = 3  # that are told, of lines
    apart: float = 1.5  # ratio to the slowest or fastest, of one that no line shows


class Oscillations(NamedTuple):
    """A series as the sum of oscillations of these angular frequencies (count,), whose sizes and
    phases change slowly."""

    omega: np.ndarray

    @property
    def seconds(self) -> float:
        """Length of a window."""
        return _Options.periods * 2 * np.pi / float(np.min(self.omega[self.omega > 0]))

    def parts(self, t: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The parts (n, count) of y (n,) at times t (n,), and their rates of change; y may have
        NaN."""
        known = np.flatnonzero(np.isfinite(y))
        at, c = self._fitted(t[known], y[known])
        nearest = np.abs(t[:, None] - at).argmin(axis=1)
        turned = np.exp(1j * self.omega * (t - at[nearest])[:, None])
        z = (c[nearest, 0::2] + 1j * c[nearest, 1::2]) * turned
        return z.real, (1j * self.omega * z).real

    def _fitted(self, t: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Times (n,) that windows of y are about, and sizes (n, 2 count) of the oscillations in
        them."""
        step = np.ptp(t) / max(len(t) - 1, 1)
        size = max(round(self.seconds / step), _Options.fewest * len(self.omega))
        size = min(size, len(t))
        begun = np.arange(0, len(t) - size + 1, max(1, size // _Options.places))
        index = begun[:, None] + np.arange(size)
        at = t[index].mean(axis=1)
        turned = np.exp(1j * self.omega * (t[index] - at[:, None])[..., None])
        A = np.stack([turned.real, -turned.imag], axis=-1).reshape(*index.shape, -1)
        G = A.swapaxes(1, 2) @ A
        G += 1e-9 * size * np.eye(G.shape[1])
        c = np.linalg.solve(G, A.swapaxes(1, 2) @ y[index][..., None])[..., 0]
        return at, c


def oscillations(t: np.ndarray, y: np.ndarray, count: int) -> list[Oscillations]:
    """Sets of ``count`` oscillations of y (n,) at times t (n,), the likeliest first; none where it
    has fewer.

    They are of the strongest of its oscillations, first of those that no stronger ones make (tones
    at ±a ± b ± c come of powers of degree 4), then each with a weaker one for its last, or with one
    that no line shows: between these, above or below them.
    """
    known = np.isfinite(y)
    if known.sum() < _Options.fewest * max(count, FEWEST):
        return []
    lines, width = _lines(t[known], y[known] - np.mean(y[known]))
    own, others = [], []
    for size, omega in lines:
        strong = [w for other, w in own if size < _Options.imitated * other]
        tones = combinations_with_replacement([*strong, *(-w for w in strong)], 3)
        side = any(abs(w - omega) < 2 * width for w in strong)
        made = side or any(abs(sum(three) - omega) < width for three in tones)
        (others if made else own).append((size, omega))
    ranked = [omega for _, omega in (*own, *others)]
    ends, strong = ranked[count - 1 :][: _Options.sets], np.sort(ranked[: count - 1])
    if ends:
        between = np.sqrt(strong[1:] * strong[:-1])
        ends += [*between, _Options.apart * strong[-1], strong[0] / _Options.apart]
    return [Oscillations(np.sort([*strong, end])) for end in ends]


def _lines(t: np.ndarray, y: np.ndarray) -> tuple[list[tuple[float, float]], float]:
    """Sizes and angular frequencies of the oscillations of y (n,) at times t (n,), the strongest
    first, and how far apart they are at the least.

    A matrix pencil of the Hankel matrix of even values (Hua and Sarkar 1990) has a line, which
    grows or dies down, for each; or several side by side, where its frequency changes with its
    size. Those are clear whose sizes are some standard errors."""
    peaks = dominant_frequencies([t], y, 4)
    if not peaks:
        return [], 0.0
    step = 1 / (_Options.dense * max(peaks))
    n = min(int(np.ptp(t) / step), _Options.cells)
    if n < _Options.fewest:
        return [], 0.0
    even = t[0] + step * np.arange(n)
    seen = t < even[-1] + step
    t, y = t[seen], y[seen]
    z = splines([(t, y[:, None])]).curve(t, y)(even)
    vectors, *_ = np.linalg.svd(hankel(z[: n // 3], z[n // 3 - 1 :]))
    vectors = vectors[:, : min(2 * _Options.lines, n // 6)]
    turns = np.linalg.eigvals(np.linalg.lstsq(vectors[:-1], vectors[1:])[0])
    rates = np.log(turns[turns.imag > 0]) / step
    rates.real = rates.real.clip(-8 / np.ptp(t), 4 / np.ptp(t))
    waves = np.exp((t - t[0])[:, None] * rates)
    waves /= np.sqrt(np.mean(np.abs(waves) ** 2, axis=0))
    A = np.concatenate([waves.real, -waves.imag], axis=1)
    inverse = np.linalg.pinv(A.T @ A)
    c = inverse @ (A.T @ y)
    errors = np.sqrt(np.mean((y - A @ c) ** 2) * np.diag(inverse).reshape(2, -1).sum(axis=0))
    size = np.hypot(*c.reshape(2, -1))
    width = _Options.width * 2 * np.pi / np.ptp(t)
    found: list[tuple[float, float]] = []
    left = np.flatnonzero((size > _Options.clear * errors) & (size > _Options.weak * size.max()))
    while len(left):
        top = left[np.argmax(size[left])]
        near = np.abs(rates.imag[left] - rates.imag[top]) < width
        weight = size[left[near]] ** 2
        omega = float(np.average(rates.imag[left[near]], weights=weight))
        found.append((float(np.sqrt(weight.sum())), omega))
        left = left[~near]
    return sorted(found, reverse=True), width
