"""Arcs of measured states: pairs that follow one another as rows of states."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gfnn_jax.dataset.runs import steps_between
from gfnn_jax.phase_space import Pairs


class Arcs(NamedTuple):
    """states: (A, L, 2d), NaN where nothing was measured, within an arc or beyond its end. moves:
    (A, L − 1) whether a step leads to the next state of the arc; False beyond its end."""

    states: np.ndarray
    moves: np.ndarray

    @property
    def measured(self) -> np.ndarray:
        """(A, L) which states were measured."""
        return np.asarray(np.isfinite(self.states).all(axis=-1))


def onward(pairs: Pairs, rows: np.ndarray) -> np.ndarray:
    """(n − 1,) steps from the state of each of these rising rows to that of the next of them; 0
    where rows between them are not among these: what was left out of the pairs is bridged, what is
    held out is not."""
    return np.where(np.diff(rows) == 1, steps_between(pairs)[rows[:-1]], 0)


def arcs_of_pairs(z0, z1, longest: int, steps=None) -> Arcs | None:
    """Arcs of at most ``longest`` steps of pairs z0 -> z1 (N, 2d) in their order. None where there
    is no pair.

    steps: (N − 1,) from the state of a pair to that of the next, 0 where that is of another arc.
    None: 1 where the image of the one is the state of the other.
    """
    if not len(z0):
        return None
    if steps is None:
        steps = np.all(z1[:-1] == z0[1:], axis=1).astype(int)
    time = np.concatenate([[0], np.cumsum(steps)])
    starts = np.concatenate([[True], np.asarray(steps) == 0])
    time -= time[starts][np.cumsum(starts) - 1]  # from the start of the sequence
    begins = starts.copy()
    begins[1:] |= time[1:] // longest != time[:-1] // longest
    arc = np.cumsum(begins) - 1
    time -= time[begins][arc]
    states = np.full((arc[-1] + 1, int(time.max()) + 2, z0.shape[1]), np.nan)
    states[arc, time + 1] = z1
    states[arc, time] = z0
    last = np.zeros(len(states), int)
    np.maximum.at(last, arc, time + 1)
    return Arcs(states, np.arange(states.shape[1] - 1) < last[:, None])
