"""Stretches of a column in which its sensor was stuck, or which lie far from all beside them.

`gfnn look` tells them, and leaves them out of its figures; a fit leaves them out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from gfnn_jax.signals.noise import resolution
from gfnn_jax.signals.wrong_values import WrongValues, wrong_values

if TYPE_CHECKING:
    from gfnn_jax.data.recording import Recording


def wrong_values_of(recording: Recording) -> dict[str, tuple[WrongValues, ...]]:
    """The wrong values of each position and sensor, by name."""
    times = [recording.times(run) for run in recording.runs]
    found = {}
    for name in (*recording.positions, *recording.sensors):
        values = np.concatenate([recording.values(name, run) for run in recording.runs])
        parts = [recording.unwrapped(name, run) for run in recording.runs]
        found[name] = wrong_values(times, parts, resolution(values))
        if name in recording.angles:  # one wrong value makes a wrapped angle seem lifted
            lifted = wrong_values(times, [_lifted(x) for x in parts], resolution(values))
            found[name] = _joined(found[name], lifted)
    return found


def _joined(one: Sequence[WrongValues], other: Sequence[WrongValues]) -> tuple[WrongValues, ...]:
    """Both, without stretches of the second that share a sample with one of the first."""
    known = {int(row) for wrong in one for row in wrong.rows}
    more = [wrong for wrong in other if known.isdisjoint(wrong.rows.tolist())]
    return tuple(sorted([*one, *more], key=lambda wrong: wrong.rows[0]))


def _lifted(angle: np.ndarray) -> np.ndarray:
    """An angle that moves by less than half a turn between neighbours."""
    known, lifted = np.isfinite(angle), angle.copy()
    lifted[known] = np.unwrap(angle[known])
    return lifted


def without_wrong_values(recording: Recording) -> tuple[Recording, tuple[str, ...]]:
    """The recording without its wrong values, and a message for each kind of them in a column."""
    wrong = wrong_values_of(recording)
    rows = {n: np.concatenate([w.rows for w in of]) for n, of in wrong.items() if of}
    lines = (line for name, of in wrong.items() for line in in_words(recording, name, of).values())
    return recording.without(rows), tuple(f"{line}: left out" for line in lines)


def in_words(recording: Recording, name: str, wrong: Sequence[WrongValues]) -> dict[str, str]:
    """The wrong values of a column in a line for each kind, "stuck" or "outliers": how many, where
    the first ones are."""
    times, found = np.concatenate([recording.times(run) for run in recording.runs]), {}
    for kind in ("stuck", "outliers"):
        of_kind = [stretch for stretch in wrong if (stretch.off is None) == (kind == "stuck")]
        if not of_kind:
            continue
        count, first = sum(len(stretch.rows) for stretch in of_kind), of_kind[0]
        apart = f" in {len(of_kind)} stretches" if 1 < len(of_kind) < count else ""
        run = f" of run {recording.runs[first.run]}" if len(recording.runs) > 1 else ""
        when = f"the first at {times[first.rows[0]]:.6g} s{run}"
        if kind == "stuck":
            found[kind] = f"{name} is stuck: {count} samples{apart} repeat the one before, {when}"
        else:
            most = max(stretch.off or 0.0 for stretch in of_kind) / recording.factors[name]
            size = f"up to {most:.2g} {recording.unit(name)}".rstrip()
            many = f"{count} outlier{'s' * (count > 1)}{apart}"
            found[kind] = f"{name} has {many}, {size} off, {when}"
    return found
