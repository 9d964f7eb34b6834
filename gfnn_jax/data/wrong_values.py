"""Stretches of a column in which its sensor was stuck, or which lie far from all beside them.

`gfnn look` tells them, and leaves them out of its figures; a fit leaves them out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

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
    lines = (told.text for name, of in wrong.items() for told in in_words(recording, name, of))
    return recording.without(rows), tuple(f"{line}: left out" for line in lines)


class Told(NamedTuple):
    """Wrong values of one kind, "stuck" or "outliers", in words."""

    kind: str
    text: str


def in_words(recording: Recording, name: str, wrong: Sequence[WrongValues]) -> tuple[Told, ...]:
    """The wrong values of a column by kinds: of a stuck sensor, single outliers, several in a
    row."""
    found = []
    held = [stretch for stretch in wrong if stretch.off is None]
    if held:
        stuck_at = f"{name} is stuck{_when(recording, held[0])}"
        repeated = f"{len(held[0].rows)} samples repeat the one before"
        found.append(Told("stuck", f"{stuck_at} ({repeated}){_more(len(held))}"))
    off = [stretch for stretch in wrong if stretch.off is not None]
    for single in (True, False):
        of_kind = [stretch for stretch in off if (len(stretch.rows) == 1) == single]
        if of_kind:
            found.append(Told("outliers", _outliers(recording, name, of_kind, single)))
    return tuple(found)


def _outliers(recording: Recording, name: str, off: list[WrongValues], single: bool) -> str:
    most = max(stretch.off or 0.0 for stretch in off) / recording.factors[name]
    size = f"{'up to ' * (len(off) > 1 or not single)}{most:.2g} {recording.unit(name)}".rstrip()
    when = _when(recording, off[0])
    if single:
        count = "1 outlier" if len(off) == 1 else f"{len(off)} outliers"
        return f"{name} has {count}, {size} off{'' if len(off) == 1 else ', the first'}{when}"
    return f"{name} has {len(off[0].rows)} outliers in a row{when}, {size} off{_more(len(off))}"


def _more(count: int) -> str:
    """Clause on the others of a kind, where there are several."""
    if count == 1:
        return ""
    return ", and once more" if count == 2 else f", and {count - 1} times more"


def _when(recording: Recording, stretch: WrongValues) -> str:
    """The time, and the run where there are several."""
    times = np.concatenate([recording.times(run) for run in recording.runs])
    begin, end = times[stretch.rows[[0, -1]]]
    of = f" of run {recording.runs[stretch.run]}" if len(recording.runs) > 1 else ""
    return f" at {begin:.6g} s{of}" if begin == end else f" from {begin:.6g} s to {end:.6g} s{of}"
