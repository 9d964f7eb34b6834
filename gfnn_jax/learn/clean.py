"""The pairs that a fit takes: each once, and none that contradicts the pairs around it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gfnn_jax.coordinates import Coordinates
from gfnn_jax.dataset.runs import first_occurrences, steps_between
from gfnn_jax.learn.check import check_number
from gfnn_jax.learn.diagnose import outliers
from gfnn_jax.learn.prepare import Prepared, prepare
from gfnn_jax.learn.screening import gross_errors
from gfnn_jax.learn.structures import Structure
from gfnn_jax.learn.varied import given_by
from gfnn_jax.phase_space import Pairs

_MOST_OUTLIERS = 0.05  # of the pairs may be left out


class Taken(NamedTuple):
    """The pairs that are taken, the same in the inner coordinates, the user's row of each, and
    warnings about the rest."""

    pairs: Pairs
    prepared: Prepared
    row: np.ndarray
    messages: list[str]


def clean(
    pairs: Pairs, row: np.ndarray, coordinates: Coordinates, structure: Structure | None = None
) -> Taken:
    """The pairs without copies, without gross errors that are certain, and, where they are few,
    without outliers.

    pairs: with their runs and places. row: (N,) the user's row of each.

    Raises FitError where too few are left, or states have no inner coordinates.
    """
    messages, first = [], first_occurrences(pairs)
    copies = len(pairs) - len(first)
    if copies:
        messages.append(f"{copies} of {len(pairs)} pairs are copies of others: each counts once")
        pairs, row = pairs.take(first), row[first]
        if structure is None:
            check_number(pairs)
    prepared = prepare(pairs, coordinates, structure)
    if structure is not None:  # too few pairs for so many dimensions to have neighbours
        return Taken(pairs, prepared, row, messages)
    count = len(pairs)
    found = outliers(prepared.y0, prepared.y1, prepared.scale, given_by(prepared))
    few = len(found) <= _MOST_OUTLIERS * count
    wrong = np.zeros(count, bool)
    wrong[found[: len(found) if few else 0]] = True
    gross = gross_errors(prepared, steps_between(pairs) == 1, wrong)
    wrong[gross] = True
    kept = np.flatnonzero(~wrong)
    if len(gross):
        # Sizes, and the interval of an angle, are those of what is left.
        prepared = prepare(pairs.take(kept), coordinates)
        if not few:
            found = kept[outliers(prepared.y0, prepared.y1, prepared.scale, given_by(prepared))]
            few = len(found) <= _MOST_OUTLIERS * count
            kept = np.setdiff1d(kept, found) if few else kept
            prepared = prepare(pairs.take(kept), coordinates)
    elif len(kept) < count:
        prepared = prepared.take(kept)
    if len(found):
        messages.append(
            f"{len(found)} of {count} pairs contradict the pairs around them "
            f"(rows {_named(row[found])}): "
            + ("outliers, they are left out" if few else "too many to be left out")
        )
    if len(gross):
        messages.append(
            f"{len(gross)} of {count} pairs (rows {_named(row[gross])}) are gross errors beside "
            "a polynomial through the others: they are left out"
        )
    if len(kept) < count:
        pairs, row = pairs.take(kept), row[kept]
    return Taken(pairs, prepared, row, messages)


def _named(rows: np.ndarray) -> str:
    return ", ".join(map(str, rows[:5])) + (", …" if len(rows) > 5 else "")
