"""Arcs of several steps, where one step of a sequence moves the states little against their noise.

Of a pair that is noise for the most part, the noise stands on both sides of the flow: it is of the
state at which the terms are evaluated, too. Over k steps the states move k times as far, and the
noise is the same: H is then learned from the pairs (z_i, z_{i+k}), k dt apart.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.noise import of_differences
from gfnn_jax.dataset.runs import steps_between
from gfnn_jax.dataset.split import Split
from gfnn_jax.phase_space import Pairs


@dataclasses.dataclass(frozen=True)
class ArcOptions:
    """Tuned on Hénon–Heiles at dt 0.005 to 0.5 with noise of 1e-3 (`benchmarks/bands.py`).

    quiet: displacements, in units of their noise, of a step that needs no arcs, and of those that
    are made. part: of a sequence, that an arc may be as long as. short: displacement of a step, in
    units of the coordinates' sizes, up to which the noise is told by the sequences' differences.
    order: of these; alike: a factor within which those of the order before tell the same noise.
    fewest: arcs for each set of pairs.
    """

    quiet: float = 100.0
    part: float = 0.5
    short: float = 0.2
    order: int = 6
    alike: float = 1.5
    fewest: int = 50


OPTIONS = ArcOptions()


class Arcs(NamedTuple):
    """The arcs as a data set, in chains whose images are the states of the next, and k."""

    data: Dataset
    length: int


def arcs_of(data: Dataset) -> Arcs | None:
    """The arcs that H is to be learned from; None where the pairs themselves serve: where no
    sequences are, where a step is long against its noise, and for pairs of many dt or parameters,
    or of a structure."""
    if data.varied or data.structure is not None:
        return None
    starts, lengths = _runs(data.pairs)
    usual = int(np.median(np.repeat(lengths, lengths)))  # that a pair stands in
    if usual <= OPTIONS.order:
        return None
    moved = (data.y1 - data.y0) / data.scale
    displacement = float(np.sqrt(np.mean(moved**2)))
    runs = [moved[first : first + count] for first, count in zip(starts, lengths, strict=True)]
    noise = of_differences(runs, OPTIONS.order, OPTIONS.alike)
    if noise is None or displacement > OPTIONS.short:
        return None
    wanted = int(np.ceil(OPTIONS.quiet * np.sqrt(2) * noise / displacement))
    length = min(wanted, int(OPTIONS.part * usual))
    if length < 2:
        return None
    return _strided(data, starts, lengths, length)


def _runs(pairs: Pairs) -> tuple[np.ndarray, np.ndarray]:
    """First row and number of rows of each stretch of a run without a gap."""
    starts = np.flatnonzero(np.append(True, steps_between(pairs) != 1))
    return starts, np.diff(np.append(starts, len(pairs)))


def _strided(data: Dataset, starts, lengths, length: int) -> Arcs | None:
    """The arcs of so many steps that are wholly in the training pairs, or in those held out."""
    first = np.concatenate(
        [
            np.arange(begin + offset, begin + count - length + 1, length)
            for begin, count in zip(starts, lengths, strict=True)
            for offset in range(length)
        ]
    )
    along = first[:, None] + np.arange(length)
    pairs, moved = data.pairs, data.y1 - data.y0
    last = first + length - 1
    # In chains of arcs that follow one another, one for each offset in a run.
    begin = np.repeat(starts, lengths)[first]
    strided = Pairs(
        np.asarray(pairs.z0)[first],
        np.asarray(pairs.z1)[last],
        length * data.dt,
        run=begin + (first - begin) % length,
        place=(first - begin) // length,
    )
    angles = np.isin(np.arange(moved.shape[1]), data.coordinates.angles)
    # Angles go on over turns; what is no angle is as measured, without a sum's rounding.
    y0 = data.y0[first]
    y1 = np.where(angles, y0 + moved[along].sum(axis=1), data.y1[last])
    rows = []
    for own in (data.training, data.validation):
        inside = np.zeros(len(moved), bool)
        inside[own] = True
        rows.append(np.random.default_rng(0).permutation(np.flatnonzero(inside[along].all(axis=1))))
    if min(map(len, rows)) < OPTIONS.fewest:
        return None
    split = Split(rows[0], rows[1], np.zeros(0, int), np.arange(len(first)))
    arcs = dataclasses.replace(data, pairs=strided, row=data.row[first], y0=y0, y1=y1, split=split)
    return Arcs(arcs, length)
