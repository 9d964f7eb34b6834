"""Which pairs a fit is trained on, and which are held out to judge it."""

from __future__ import annotations

import numpy as np

_FRACTION, _FEWEST, _MOST = 0.1, 4, 2_000
_OUTSIDE = 0.05  # of the training pairs, by which errors outside the data are measured
_BRIDGED = 10  # pairs of a sequence, left out in a row, beyond which it goes on
_TOGETHER = 50  # pairs of a sequence that are looked at or left out as one


def first_occurrences(pairs) -> np.ndarray:
    """The rows where a pair stands for the first time: held-out copies of training pairs would
    judge nothing."""
    given = [] if not np.ndim(pairs.dt) else [pairs.dt]
    given += [np.asarray(values) for values in (pairs.args or {}).values()]
    rows = np.column_stack([np.asarray(pairs.z0), np.asarray(pairs.z1), *given])
    return np.sort(np.unique(rows, axis=0, return_index=True)[1])


def places(pairs) -> np.ndarray:
    """(N,) consecutive numbers along a sequence, with more than N between sequences: what is left
    of them when pairs are left out tells the steps between the others."""
    begins = np.any(np.asarray(pairs.z1)[:-1] != np.asarray(pairs.z0)[1:], axis=1)
    return np.arange(len(pairs)) + len(pairs) * np.concatenate([[0], np.cumsum(begins)])


def steps_between(pairs, place: np.ndarray | None) -> np.ndarray:
    """(N − 1,) steps from the state of each pair to that of the next: 1 where its image is the
    next one's state, more where pairs between them were left out, 0 where the next one is of
    another sequence, or far along it. place: as of `Prepared`."""
    if place is None:
        return np.all(np.asarray(pairs.z1)[:-1] == np.asarray(pairs.z0)[1:], axis=1).astype(int)
    steps = np.diff(place)
    return np.where((steps > 0) & (steps <= 1 + _BRIDGED), steps, 0)


def split_rows(pairs, seed: int, place: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Rows for training and rows held out, shuffled by the seed.

    Where the image of one pair is the state of the next, both are of one sequence. They share the
    noise of that state and lie on one orbit, so that a random half would judge the other too
    kindly: whole sequences are held out then. A sequence longer than all that is to be held out is
    cut into blocks in time first. place: as of `Prepared`.
    """
    rng, count = np.random.default_rng(seed), len(pairs)
    target = max(_FEWEST, int(_FRACTION * count))
    goes_on = steps_between(pairs, place) > 0  # from each row to the next
    if not goes_on.any():
        order, target = rng.permutation(count), min(target, _MOST)
        return order[target:], order[:target]
    block = _blocks(goes_on, target)
    lengths = np.bincount(block)
    order = rng.permutation(len(lengths))
    # Blocks in random order until there are rows enough: the last one may bring more.
    chosen = order[np.cumsum(lengths[order]) - lengths[order] < target]
    held = np.isin(block, chosen)
    # Beside a block that was cut out, a training pair would share its outermost state.
    border = goes_on & (held[1:] != held[:-1])
    apart = ~held
    apart[:-1] &= ~border
    apart[1:] &= ~border
    held_out = rng.permutation(np.flatnonzero(held))[:_MOST]
    return rng.permutation(np.flatnonzero(apart)), held_out


def looked_at(pairs, rows: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """About ``most`` of these rows, as places among them (n,), the rows there in rising order; and
    (n − 1,) whether the image of one is the state of the next.

    Drawn at random, of sequences by blocks of consecutive pairs.
    """
    z0, z1 = np.asarray(pairs.z0), np.asarray(pairs.z1)

    def goes_on(places) -> np.ndarray:
        return np.all(z1[rows[places[:-1]]] == z0[rows[places[1:]]], axis=1)

    places = np.argsort(rows)
    if len(rows) > most:
        together = _TOGETHER if goes_on(places).any() else 1
        block = np.arange(len(rows)) // together
        drawn = np.random.default_rng(0).permutation(block[-1] + 1)[: -(-most // together)]
        places = places[np.isin(block, drawn)]
    return places, goes_on(places)


def outermost(y: np.ndarray, free: tuple[int, ...] = ()) -> np.ndarray:
    """Which of the states y (N, 2d) are of the outermost twentieth, (N,) bool, by Mahalanobis'
    distance. free: coordinates that do not count, as angles that cover their circle."""
    seen = y[:, [i for i in range(y.shape[1]) if i not in free]]
    centred = seen - seen.mean(axis=0)
    inverse = np.linalg.pinv(centred.T @ centred, rcond=1e-12, hermitian=True)
    distance = np.sum((centred @ inverse) * centred, axis=1)
    return distance > np.quantile(distance, 1 - _OUTSIDE)


def _blocks(goes_on: np.ndarray, target: int) -> np.ndarray:
    """The number of the block that each row is in: a sequence, or, of one longer than ``target``,
    a quarter of ``target`` consecutive rows."""
    starts = np.concatenate([[True], ~goes_on])
    sequence = np.cumsum(starts) - 1
    place = np.arange(len(starts)) - np.flatnonzero(starts)[sequence]
    length = np.bincount(sequence)[sequence]
    cut = (length > target) & (place % max(_FEWEST, target // 4) == 0)
    return np.cumsum(starts | cut) - 1
