"""Windows along the nodes of a record, with the bumps φ = (s(1 − s))³ of a weak form: all rows of
two sparse matrices."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.sparse import csr_array, vstack

from gfnn_jax.dataset.stretches import Nodes, Scales


class Options:
    """Options of windows (`benchmarks/random_recordings.py`).

    lengths: in periods. periods: of the longest run, below which windows are shorter too, for there
    would be few of them, or none. fewest: samples of a window. spacing: of a window's length, to
    the next. most: numbers of terms along nodes that are held at a time, for memory.
    """

    lengths: tuple[float, ...] = (0.5, 1.0)
    periods: float = 2.0
    fewest: int = 7
    spacing: float = 0.25
    most: int = 3_000_000


@dataclasses.dataclass(frozen=True, eq=False)
class Windows:
    """Windows along nodes: times t (n,), states x (n, 2d), inputs u (n, inputs) and parameters of
    the system args (n, k) of these; φ dt and φ̇ dt, each sparse (windows, n), in units of the noise
    that v brings."""

    t: np.ndarray
    x: np.ndarray
    u: np.ndarray
    args: np.ndarray
    phi: csr_array
    slope: csr_array

    @classmethod
    def of(cls, nodes: Sequence[Nodes], lengths: Sequence[np.ndarray]) -> Windows:
        """Make windows along nodes, of each of these lengths (nodes,) in units of t in turn."""
        times = [n.t for n in nodes]
        x, u, args = (
            np.concatenate(part)
            for part in zip(
                *((n.x, n.stretch.u[n.at], np.tile(n.stretch.args, (len(n.t), 1))) for n in nodes),
                strict=True,
            )
        )
        bumps = zip(*(_bumps(times, length) for length in lengths), strict=True)
        phi, slope = (csr_array(vstack(part)) for part in bumps)
        return cls(np.concatenate(times), x, u, args, phi, slope)

    @classmethod
    def of_record(cls, nodes: Sequence[Nodes], scales: Scales) -> Windows:
        """Make those of a weak form: of the usual lengths; where sampling is uneven along even
        nodes, and of a run that is shorter all of it."""
        spans = np.array([np.ptp(n.t) for n in nodes])
        if scales.uneven:
            nodes = [n.evenly(scales.nodes_of(s)) for n, s in zip(nodes, spans, strict=True)]
        most = 0.999 * spans if scales.uneven else np.inf
        period = _period(spans, scales)
        return cls.of(
            nodes, [np.minimum(one * period + 0 * spans, most) for one in Options.lengths]
        )

    @classmethod
    def longest(cls, nodes: Sequence[Nodes], scales: Scales) -> Windows:
        """Make windows of the largest of the usual lengths alone, along the nodes as they are."""
        spans = np.array([np.ptp(n.t) for n in nodes])
        return cls.of(nodes, [Options.lengths[-1] * _period(spans, scales) + 0 * spans])

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Return the means (windows, ...) of values (n, ...) over the nodes inside each window."""
        inside: Any = 1.0 * (self.phi != 0)
        return ((inside @ values).T / inside.sum(axis=1)).T

    def along(self, values: np.ndarray) -> np.ndarray:
        """Integrate φ times values (n, ...): (windows, ...)."""
        return _summed(self.phi, values)

    def changing(self, values: np.ndarray) -> np.ndarray:
        """Integrate φ̇ times values (n, ...): (windows, ...)."""
        return _summed(self.slope, values)

    def parts(self, width: int) -> Iterator[Windows]:
        """Windows of parts of the nodes, whose integrals add up, for so many numbers a node."""
        count = -(-len(self.t) * width // Options.most)
        edges = np.linspace(0, len(self.t), count + 1).astype(int).tolist()
        for a, b in pairwise(edges):
            t, x, u, args = (one[a:b] for one in (self.t, self.x, self.u, self.args))
            yield Windows(t, x, u, args, self.phi[:, a:b], self.slope[:, a:b])

    @property
    def systems(self) -> np.ndarray:
        """Parameters (windows, k) of the system that each window is of."""
        return self.args[self.phi.indices[self.phi.indptr[:-1]]]


def _period(spans: np.ndarray, scales: Scales) -> float:
    return min(scales.period, float(np.max(spans)) / Options.periods)


def _summed(weights: csr_array, values: np.ndarray) -> np.ndarray:
    found = np.asarray(weights @ values.reshape(len(values), -1))
    return found.reshape(len(found), *values.shape[1:])


def _bumps(times: Sequence[np.ndarray], lengths: np.ndarray) -> tuple[csr_array, csr_array]:
    """φ dt and φ̇ dt, each (windows, n), of windows of a length along each of the times."""
    begin, found = 0, []
    for t, length in zip(times, lengths.tolist(), strict=True):
        starts = np.arange(t[0], t[-1] - length, Options.spacing * length)
        first, last = np.searchsorted(t, starts), np.searchsorted(t, starts + length)
        keep = last - first >= Options.fewest
        own = starts[keep], first[keep] + begin, last[keep] + begin, np.full(np.sum(keep), length)
        found.append(own)
        begin += len(t)
    starts, first, last, long = (np.concatenate(part) for part in zip(*found, strict=True))
    t, ends = np.concatenate(times), np.cumsum([0, *(last - first)])
    window = np.repeat(np.arange(len(starts)), last - first)
    at = np.arange(ends[-1]) + (first - ends[:-1])[window]
    s, weight = (t[at] - starts[window]) / long[window], np.gradient(t)[at]
    weight[ends[:-1]] = t[first + 1] - t[first]
    weight[ends[1:] - 1] = t[last - 1] - t[last - 2]
    bump = s * (1 - s)
    phi, slope = bump**3 * weight, 3 * bump**2 * (1 - 2 * s) / long[window] * weight
    norm = np.sqrt(np.bincount(window, slope**2, len(starts)))[window]
    shape = len(starts), len(t)
    return csr_array((phi / norm, at, ends), shape), csr_array((slope / norm, at, ends), shape)
