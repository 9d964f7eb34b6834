"""Parts of a recording in which nothing moves: what they tell is no law of motion.

A body that dry friction holds stays where it is, whatever the force on it, as long as that is less
than the friction: its samples are no equation, but an inequality. The smoothed friction of a fit
creeps there, by more than the noise where the rest is long, so that a record that rests for half of
its time would be fitted by its rest. A rest is a period of the fastest motion, or more of them, in
which no coordinate varies by more than its noise.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gfnn_jax.dataset.stretches import Scales, Stretch

_STILL = 1.5  # of the noise: the standard deviation up to which a coordinate stands still
_KEPT = 0.25  # periods of a rest that stay, in which the body comes to a stop or starts


class Moving(NamedTuple):
    """The stretches without their rests, the seconds of these, and those of what moves for less
    than a period of the fastest motion, which is left out too."""

    stretches: list[Stretch]
    resting: float
    short: float


def without_rests(found: Sequence[Stretch], scales: Scales) -> Moving:
    """Take the rests out of stretches of plain positions; where no motion would be left, none."""
    window = max(9, round(scales.period / scales.dt))
    kept, resting, short = [], 0.0, 0.0
    for stretch in found:
        at_rest = _shrunk(_still(stretch, scales.sigma, window), round(_KEPT * window))
        resting += sum(float(stretch.t[b - 1] - stretch.t[a]) for a, b in _runs(at_rest))
        for a, b in _runs(~at_rest):
            if b - a >= window:
                kept.append(_part(stretch, a, b))
            else:
                short += float(stretch.t[b - 1] - stretch.t[a])
    return Moving(kept, resting, short) if kept else Moving(list(found), 0.0, 0.0)


def _still(stretch: Stretch, sigma: np.ndarray, window: int) -> np.ndarray:
    """Samples (n,) that lie in a window of which no coordinate varies by more than its noise."""
    q, count = stretch.q, len(stretch.t) - window + 1
    if count < 1:
        return np.zeros(len(q), bool)
    views = np.lib.stride_tricks.sliding_window_view(q, window, axis=0)
    quiet = (views.std(axis=-1) <= _STILL * sigma[: q.shape[1]]).all(axis=1)
    begun = np.concatenate([np.cumsum(quiet), np.full(window - 1, np.sum(quiet))])
    ended = np.concatenate([np.zeros(window, int), np.cumsum(quiet)[:-1]])[: len(q)]
    return begun > ended


def _shrunk(mask: np.ndarray, by: int) -> np.ndarray:
    """The mask without the first and the last ``by`` samples of each of its runs, but for those at
    its ends."""
    found = np.zeros_like(mask)
    for a, b in _runs(mask):
        found[a + by * (a > 0) : max(b - by * (b < len(mask)), a)] = True
    return found


def _runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """[a, b) of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _part(stretch: Stretch, a: int, b: int) -> Stretch:
    """Samples a to b."""
    names = ("t", "y", "u", "q", "noise")
    return dataclasses.replace(stretch, **{name: getattr(stretch, name)[a:b] for name in names})
