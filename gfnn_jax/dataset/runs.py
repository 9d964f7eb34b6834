"""Runs: which pairs follow one another, known once and kept to the end of a fit.

A run is a trajectory that was measured; the place of a pair is the number of its state along the
run. Two pairs of a run whose places differ by one share a state, and its noise.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from gfnn_jax.phase_space import Pairs


class _Options:
    """Sequences that runs are made of."""

    bridged: int = 10  # pairs of a run, left out one after another, beyond which it does not go on
    together: int = 50  # pairs of a run that are looked at or left out as one
    stretches: int = 20  # of a sample of the runs, at least


class Identified(NamedTuple):
    """Pairs in the order of their runs, with ``run`` as numbers from 0 on and ``place``; and the
    user's row (N,) of each."""

    pairs: Pairs
    row: np.ndarray


def identified(pairs: Pairs) -> Identified:
    """The pairs with their runs and places.

    Pairs with a run are sorted by run and place, so that the order of a user's rows does not
    matter. Without places, the pairs of a run follow one another where the image of one is the
    state of the other. Pairs without a run stay in their order, and a run lasts as long as the
    image of a pair is the state of the next.
    """
    z0, z1 = np.asarray(pairs.z0), np.asarray(pairs.z1)
    row = np.arange(len(pairs))
    if pairs.run is None:
        begins = np.ones(len(pairs), bool)
        begins[1:] = np.any(z1[:-1] != z0[1:], axis=1)
        run = np.cumsum(begins) - 1
        return Identified(_numbered(pairs, run, row - np.flatnonzero(begins)[run]), row)
    run = np.unique(np.asarray(pairs.run), return_inverse=True)[1].reshape(-1)
    if pairs.place is not None:
        place = np.asarray(pairs.place)
        row = np.lexsort((place, run))
        return Identified(_numbered(pairs.take(row), run[row], place[row]), row)
    chain, along = _chains(run, z0, z1)
    row = np.lexsort((along, chain))
    # Chains of one run are farther apart than what is bridged.
    place = along[row] + chain[row] * (len(pairs) + _Options.bridged)
    return Identified(_numbered(pairs.take(row), run[row], place), row)


def _numbered(pairs: Pairs, run: np.ndarray, place: np.ndarray) -> Pairs:
    """The pairs with these runs and places."""
    return dataclasses.replace(pairs, t0=None, run=run, place=place)


def _chains(run: np.ndarray, z0: np.ndarray, z1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The number of the chain that each pair is of (N,), by rising run and first state, and its
    place in the chain (N,).

    The next of a pair is the one pair of its run whose state is its image; where several are, none.
    """
    count = len(run)
    states = np.column_stack([np.tile(run, 2), np.concatenate([z0, z1])])
    name = np.unique(states, axis=0, return_inverse=True)[1].reshape(-1)
    of_state, of_image = name[:count], name[count:]
    pair_of = np.full(name.max() + 1, -1)
    pair_of[of_state] = np.arange(count)
    pair_of[np.bincount(of_state, minlength=len(pair_of)) != 1] = -1
    after = pair_of[of_image]
    entered = np.bincount(after[after >= 0], minlength=count)
    after = np.where((after >= 0) & (entered[after] == 1), after, -1)
    first = np.ones(count, bool)
    first[after[after >= 0]] = False
    chain, along, number = np.full(count, -1), np.zeros(count, int), 0
    # Closed chains, a periodic orbit's, have no first pair: they begin at their smallest state.
    for start in np.argsort(of_state + name.max() * ~first, kind="stable"):
        place, pair = 0, int(start)
        while pair >= 0 and chain[pair] < 0:
            chain[pair], along[pair] = number, place
            place, pair = place + 1, int(after[pair])
        number += place > 0
    starts = of_state[along == 0][np.argsort(chain[along == 0])]
    return np.argsort(np.argsort(starts, kind="stable"))[chain], along


def steps_between(pairs: Pairs) -> np.ndarray:
    """(N − 1,) steps from the state of each pair to that of the next row: 1 where its image is the
    next one's state, more where pairs between them were left out, 0 where the next row is of
    another run, or far along it; none where pairs have no run."""
    if pairs.run is None:
        return np.zeros(max(0, len(pairs) - 1), int)
    steps = np.diff(pairs.place)
    same = (np.diff(pairs.run) == 0) & (steps > 0) & (steps <= 1 + _Options.bridged)
    return np.where(same, steps, 0)


def next_of(pairs: Pairs, rows: np.ndarray) -> np.ndarray:
    """(n − 1,) whether the image of each of these rows (n,) is the state of the one after it; none
    where pairs have no run."""
    if pairs.run is None:
        return np.zeros(max(0, len(rows) - 1), bool)
    run, place = np.asarray(pairs.run)[rows], np.asarray(pairs.place)[rows]
    return (np.diff(run) == 0) & (np.diff(place) == 1)


def looked_at(pairs: Pairs, rows: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """About ``most`` of these rows, as places among them (n,), the rows there in rising order; and
    (n − 1,) whether the image of one is the state of the next.

    Drawn at random, of runs by blocks of consecutive pairs.
    """
    places = np.argsort(rows)
    if len(rows) > most:
        together = _Options.together if next_of(pairs, rows[places]).any() else 1
        block = np.arange(len(rows)) // together
        drawn = np.random.default_rng(0).permutation(block[-1] + 1)[: -(-most // together)]
        places = places[np.isin(block, drawn)]
    return places, next_of(pairs, rows[places])


def sampled(pairs: Pairs, most: int, seed: int) -> np.ndarray:
    """About ``most`` rows in rising order, drawn by the seed: whole runs, the longer ones in
    stretches of a twentieth of all that are drawn. ``pairs``: in the order of their runs."""
    first = np.concatenate([[True], ~(steps_between(pairs) > 0)])
    run = np.cumsum(first) - 1
    along = np.arange(len(pairs)) - np.flatnonzero(first)[run]
    longest = max(1, most // _Options.stretches)
    block = np.cumsum(first | (along % longest == 0)) - 1
    order = np.random.default_rng(seed).permutation(block[-1] + 1)
    drawn = order[: np.searchsorted(np.cumsum(np.bincount(block)[order]), most) + 1]
    return np.flatnonzero(np.isin(block, drawn))


def first_occurrences(pairs: Pairs) -> np.ndarray:
    """The rows where a pair stands for the first time: held-out copies of training pairs would
    judge nothing."""
    given = [] if not np.ndim(pairs.dt) else [pairs.dt]
    given += [np.asarray(values) for values in (pairs.args or {}).values()]
    rows = np.column_stack([np.asarray(pairs.z0), np.asarray(pairs.z1), *given])
    if _all_differ(rows):
        return np.arange(len(rows))
    return np.sort(np.unique(rows, axis=0, return_index=True)[1])


def _all_differ(rows: np.ndarray) -> bool:
    """Return whether no two rows (n, k) have one sum of their bits times random factors.

    Then all rows differ. Sorting these sums takes a tenth of the time of sorting the rows."""
    bits = (rows + 0.0).view(np.uint64)  # no zero is negative
    factors = np.random.default_rng(0).integers(2**63, size=rows.shape[1], dtype=np.uint64) | 1
    sums = np.sort(bits @ factors)
    return not (sums[1:] == sums[:-1]).any()


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
