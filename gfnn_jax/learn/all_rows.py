"""The final map, fitted to the test rows too once they have stated the error.

Where rows are scarce a tenth of them decides whether a size is determined at all. What is stated is
the error of the map without them.
"""

from __future__ import annotations

import dataclasses

import jax
import numpy as np

from gfnn_jax.budget import ROWS, Budget
from gfnn_jax.errors import OutOfTime
from gfnn_jax.generating.generated import Generated
from gfnn_jax.learn.choose import Chosen
from gfnn_jax.learn.searches import Searched
from gfnn_jax.learn.stated import Stated

_WHAT = "the fit of the chosen size to the test pairs too"
_WORDS = "; the map is fitted to them too"


def with_test_rows(
    chosen: Chosen, error: Stated, found: Searched, budget: Budget
) -> tuple[Chosen, str]:
    """The choice with its coefficients from the test rows too, and the words about what stated its
    error. As it is where that were other rows, where rows are not scarce, or where the validation
    rows are then missed by more."""
    entry, candidate = chosen.entry, error.candidate
    chosen = chosen._replace(candidate=candidate)
    if error.by != "test" or entry is None or not entry.sweep.linear:
        return chosen, error.words
    sweep, size = entry.sweep, entry.size
    work = sweep.work_of_test_rows(size)
    if not work or sweep.data.pairs is not found.data.pairs:
        return chosen, error.words
    try:
        with budget.last(_WHAT, ROWS, work, decides=True):
            again = sweep.with_test_rows(size)
    except OutOfTime:  # told with what else was left out
        return chosen, error.words
    before = sweep.solve(size, Budget(), lambda message: None)[0]
    if not again.validation_rms <= before.validation_rms:
        return chosen, error.words
    params = jax.tree.map(np.asarray, size.family.unflatten(again.coefficients))
    pieces = tuple(
        dataclasses.replace(piece, params=jax.device_put(params))
        if isinstance(piece, Generated)
        else piece
        for piece in candidate.map.pieces
    )
    map_ = dataclasses.replace(candidate.map, pieces=pieces)
    candidate = dataclasses.replace(candidate, map=map_)
    return chosen._replace(candidate=candidate), error.words + _WORDS
