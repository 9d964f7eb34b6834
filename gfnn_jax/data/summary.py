"""Summary of a trajectory file, in a few lines to read before a fit."""

from __future__ import annotations

import numpy as np

from gfnn_jax.data.files import TrajectoryData
from gfnn_jax.signals.steps import longest_step

_MOST_COLUMNS = 40  # lines; of more columns those of the first degrees of freedom


def summary(data: TrajectoryData) -> list[str]:
    """Lines of text: how many pairs, of each column its range, spread and movement in a step, of
    each parameter its range.

    spread: the standard deviation. movement: the root mean square of the change in one step. An
    error relative to the spread is what a tolerance is for.
    """
    pairs, lengths = data.pairs(), data.lengths
    both = np.concatenate([pairs.z0, pairs.z1], axis=1)
    copies = len(both) - len(np.unique(both, axis=0))
    of = (
        f"{lengths.min()}" if lengths.min() == lengths.max() else f"{lengths.min()}–{lengths.max()}"
    )
    dt = np.asarray(data.dt)
    every = f"{dt:g}" if dt.ndim == 0 else f"{dt.min():g} to {dt.max():g}"
    sampled = "" if data.sampled is None else f" (a sample of {data.sampled})"
    parts = [f"{data.num_pairs} pairs{sampled}, d = {data.dim}, dt = {every}"]
    if data.sampled is None:  # the pairs of a sample stand alone
        parts.append(f"sequences: {len(lengths)}, each of {of} states")
    if dt.ndim:
        parts.append(f"gaps: {np.count_nonzero(dt > longest_step(dt))}")
    lines = ["; ".join([*parts, f"copies: {copies}"])]
    move = np.sqrt(np.mean((pairs.z1 - pairs.z0) ** 2, axis=0))
    low, high = data.states.min(axis=0), data.states.max(axis=0)
    names = [f"{letter}{i + 1}" for letter in "qp" for i in range(data.dim)]
    columns = list(zip(names, low, high, data.states.std(axis=0), move, strict=True))
    if len(columns) > _MOST_COLUMNS:
        some = _MOST_COLUMNS // 4
        columns = columns[:some] + columns[data.dim : data.dim + some]
        lines.append(f"the first {some} of {data.dim} degrees of freedom:")
    for name, *numbers in columns:
        unit = f" {data.units[name]}" if name in data.units else ""
        a, b, spread, step = (f"{x:.4g}" for x in numbers)
        lines.append(f"{name}: {a} to {b}{unit}, spread {spread}, movement in a step {step}")
    for name, values in (data.args or {}).items():
        count = len(np.unique(values))
        drive = f"time t of a drive of period {data.period}"
        what = drive if name == "t" else f"parameter {name}"
        lines.append(f"{what}: {values.min():.4g} to {values.max():.4g}, {count} values")
    return lines
