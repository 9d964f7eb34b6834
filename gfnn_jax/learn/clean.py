"""The pairs that a fit takes: each once, and none that contradicts the pairs around it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gfnn_jax.coordinates import Coordinates
from gfnn_jax.learn.check import check_number
from gfnn_jax.learn.diagnose import outliers
from gfnn_jax.learn.held_out import first_occurrences
from gfnn_jax.learn.prepare import Prepared, prepare
from gfnn_jax.learn.structures import Structure
from gfnn_jax.learn.varied import given_by
from gfnn_jax.phase_space import Pairs

_MOST_OUTLIERS = 0.05  # of the pairs may be left out


class Taken(NamedTuple):
    """The pairs that are taken, the same in the inner coordinates, and warnings about the rest."""

    pairs: Pairs
    prepared: Prepared
    messages: list[str]


def clean(pairs: Pairs, coordinates: Coordinates, structure: Structure | None = None) -> Taken:
    """The pairs without copies and, where they are few, without outliers.

    Raises FitError where too few are left, or states have no inner coordinates.
    """
    messages, first = [], first_occurrences(pairs)
    copies = len(pairs) - len(first)
    if copies:
        messages.append(f"{copies} of {len(pairs)} pairs are copies of others: each counts once")
        pairs = pairs.take(first)
        if structure is None:
            check_number(pairs)
    prepared = prepare(pairs, coordinates, structure)
    if structure is not None:  # too few pairs for so many dimensions to have neighbours
        return Taken(pairs, prepared, messages)
    found = outliers(prepared.y0, prepared.y1, prepared.scale, given_by(prepared))
    if len(found):
        few = len(found) <= _MOST_OUTLIERS * len(pairs)
        rows = ", ".join(map(str, first[found[:5]])) + (", …" if len(found) > 5 else "")
        messages.append(
            f"{len(found)} of {len(pairs)} pairs contradict the pairs around them (rows {rows}): "
            + ("outliers, they are left out" if few else "too many to be left out")
        )
        if few:
            kept = np.setdiff1d(np.arange(len(pairs)), found)
            pairs, prepared = pairs.take(kept), prepared.take(kept)
    return Taken(pairs, prepared, messages)
