"""Noise or structure: what a fit leaves over of neighbouring pairs tells.

Noise differs from one pair to the next however close they are; what a map cannot represent is a
function of the state, so that neighbours have nearly the same of it. (The part of a variogram that
does not vanish with the distance is the nugget: G. Matheron, Econ. Geol. 58 (1963) 1246.)
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

# Neighbours that are looked at; the part of them that is closest, and its least number.
_NEAREST, _CLOSEST, _FEWEST = 6, 0.25, 20
# Mean square of differences between close neighbours, ÷ that of two unrelated ones: of noise 0.9
# and more, of a dry friction that was not learned 0.006, of two bodies by degree 6 0.14.
_NOISE = 0.6
# The same of products of two coordinates, above which neighbours are too far apart to tell: 2,000
# pairs of four degrees of freedom have 0.2, of eight 0.45.
_SMOOTH = 0.3


def is_noise(z, residual, run, place) -> bool | None:
    """Return whether the residuals differ between close neighbours as much as between any two; None
    where the pairs lie too far apart for a smooth function to tell.

    z, residual: (N, 2d) in units of the coordinates' sizes. run, place: (N,) of each row: rows that
    follow each other share a state, and its noise, and are no neighbours.
    """
    one, other = _close_neighbours(np.asarray(z), np.asarray(run), np.asarray(place))
    if len(one) < _FEWEST:
        return None
    if _apart(residual, one, other) < _NOISE:
        return False
    # Products of coordinates are as smooth as what may be missing is at best.
    smooth = np.asarray(z) * np.roll(z, 1, axis=1)
    return True if _apart(smooth, one, other) < _SMOOTH else None


def _apart(values, one, other) -> float:
    values = np.asarray(values)
    each = np.sum(values[one] ** 2 + values[other] ** 2)
    return float(np.sum((values[one] - values[other]) ** 2) / each) if each > 0 else 0.0


def _close_neighbours(z, run, place) -> tuple[np.ndarray, np.ndarray]:
    """Rows and the nearest neighbour of each, the quarter of them that is closest."""
    rows = np.arange(len(z))
    distance, near = cKDTree(z).query(z, k=min(_NEAREST + 1, len(z)))
    distance, near = distance[:, 1:], near[:, 1:]
    follows = (run[near] == run[:, None]) & (np.abs(place[near] - place[:, None]) <= 1)
    distance = np.where(follows, np.inf, distance)
    first = np.argmin(distance, axis=1)
    distance, near = distance[rows, first], near[rows, first]
    closest = np.argsort(distance)[: max(_FEWEST, int(_CLOSEST * len(z)))]
    closest = closest[np.isfinite(distance[closest])]
    return rows[closest], near[closest]
