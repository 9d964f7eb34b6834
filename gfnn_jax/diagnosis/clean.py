"""The rows that a fit takes: each once, and none that contradicts the rows around it."""

from __future__ import annotations

import numpy as np

from gfnn_jax.coordinates import Coordinates
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.runs import Identified, first_occurrences, steps_between
from gfnn_jax.dataset.structures import Structure
from gfnn_jax.dataset.varied import given_by
from gfnn_jax.diagnosis.local_jacobians import check_number, outliers
from gfnn_jax.diagnosis.screening import gross_errors

_MOST_OUTLIERS = 0.05  # of the pairs may be left out


def clean(
    found: Identified,
    coordinates: Coordinates,
    structure: Structure | None = None,
    jumps: bool = False,
) -> tuple[Dataset, list[str]]:
    """The data set without copies, without gross errors that are certain, and, where they are few,
    without outliers; and warnings about what was left out. jumps: whether an angle is wrapped that
    was not named: pairs contradict their neighbours where it jumps, and none is an error.

    Raises FitError where too few are left, or states have no inner coordinates.
    """
    (pairs, row), messages = found, []
    first = first_occurrences(pairs)
    copies = len(pairs) - len(first)
    if copies:
        messages.append(f"{copies} of {len(pairs)} pairs are copies of others: each counts once")
        pairs, row = pairs.take(first), row[first]
        if structure is None:
            check_number(pairs)
    data = Dataset.of(pairs, coordinates, structure, row)
    if structure is not None or jumps:  # of many dimensions too few pairs have neighbours
        return data, messages
    everyone, count = data, len(data)
    found_outliers = outliers(data.y0, data.y1, data.scale, given_by(data))
    few = len(found_outliers) <= _MOST_OUTLIERS * count
    wrong = np.zeros(count, bool)
    wrong[found_outliers[: len(found_outliers) if few else 0]] = True
    gross = gross_errors(data, steps_between(pairs) == 1, wrong)
    wrong[gross] = True
    kept = np.flatnonzero(~wrong)
    if len(gross):
        data = everyone.lifted_anew(kept)  # the interval of an angle is that of what is left
        if not few:
            found_outliers = kept[outliers(data.y0, data.y1, data.scale, given_by(data))]
            few = len(found_outliers) <= _MOST_OUTLIERS * count
            kept = np.setdiff1d(kept, found_outliers) if few else kept
            data = everyone.lifted_anew(kept)
    elif len(kept) < count:
        data = data.take(kept)
    if len(found_outliers):
        messages.append(
            f"{len(found_outliers)} of {count} pairs contradict the pairs around them "
            f"(numbers {_named(row[found_outliers])}, from 0): "
            + (
                "outliers, they are left out"
                if few
                else "too many for outliers, they are kept. Is q first, and does z1 follow z0?"
            )
        )
    if len(gross):
        messages.append(
            f"{len(gross)} of {count} pairs (numbers {_named(row[gross])}, from 0) are far from a "
            "polynomial fitted to the others: outliers, they are left out"
        )
    return data, messages


def _named(rows: np.ndarray) -> str:
    return ", ".join(map(str, rows[:5])) + (", …" if len(rows) > 5 else "")
