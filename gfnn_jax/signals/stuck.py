"""Stretches in which a sensor was stuck: equal values, then a jump to where the motion is by then.

A body that rests starts slowly from where it rested, and a coarse sensor shows its turning points
by equal values beside which it moves by its smallest step. Only a sensor that was stuck while the
motion went on catches up in one step, with a jump far above the steps around it.
"""

from __future__ import annotations

import numpy as np

_FEWEST = 5  # equal values; two or three are what a camera makes of a frame that it dropped
_AROUND = 8  # steps before and behind, that tell how fast the motion is
_JUMP = 3.0  # times the fastest of them, at least
_RESOLUTIONS = 2.0  # that the motion goes in a step; slower, equal values are the sensor's digits


def stuck(t: np.ndarray, x: np.ndarray, resolution: float, rough: float) -> list[tuple[int, int]]:
    """(begin, end) of the samples of a run (n,) that repeat the one before ``begin``.

    t, x: without missing values. resolution: the smallest step between values, 0 if it is unknown.
    rough: of the column (`roughness`), which the motion goes in a step at least.
    """
    if len(x) < _FEWEST:
        return []
    times = np.diff(t)
    ways = np.abs(np.diff(x)) * np.minimum(np.median(times) / times, 1.0)  # a gap makes a long way
    same = np.concatenate([[False], ways == 0, [False]])
    begins = np.flatnonzero(same[1:] & ~same[:-1])
    ends = np.flatnonzero(~same[1:] & same[:-1])
    slow = max(_RESOLUTIONS * resolution, rough)
    many = (ends - begins + 1 >= _FEWEST) & (ends < len(ways))
    found = []
    for begin, end in zip(begins[many], ends[many], strict=True):
        before, behind = ways[max(begin - _AROUND, 0) : begin], ways[end + 1 : end + 1 + _AROUND]
        around = [part for part in (before, behind) if len(part) == _AROUND]
        moves = any(np.median(part) > slow for part in around)
        way = max(_FEWEST * slow, _JUMP * max((part.max() for part in around), default=0.0))
        if moves and ways[end] > way:
            found.append((int(begin) + 1, int(end) + 1))
    return found
