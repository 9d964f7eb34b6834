"""Pairs that are taken for (q, p) and are not: which bracket they have."""

from __future__ import annotations

import numpy as np

from gfnn_jax.brackets import Magnetic
from gfnn_jax.dataset.runs import identified
from gfnn_jax.dataset.split import split_rows
from gfnn_jax.errors import FitError
from gfnn_jax.models.brackets.search import Data, law_of
from gfnn_jax.phase_space import Pairs, sizes

MOST_COLUMNS = 8  # of states that are looked at
EXACT = 1e-9  # of the spread: a law of these that misses nothing


def other_bracket(pairs: Pairs) -> list[str]:
    """A line about the bracket of pairs: of velocities in place of momenta, of columns in another
    order, of states of another kind. None where no bracket is found, or the pairs have noise,
    parameters or a drive."""
    if pairs.args is not None or pairs.z0.shape[1] > MOST_COLUMNS:
        return []
    pairs = identified(pairs).pairs
    split = split_rows(pairs, 0)
    z0, z1, run, place = (np.asarray(a) for a in (pairs.z0, pairs.z1, pairs.run, pairs.place))
    every = Data(z0, z1, pairs.dt, run, place, sizes(z0))
    names = tuple(f"z{i + 1}" for i in range(z0.shape[1]))
    try:
        law = law_of(every.take(np.sort(split.training)), every.take(split.validation), names)
    except FitError:
        return []
    if law.error > EXACT:
        return []
    what = "states with another bracket"
    if law.bracket.name == "constant":
        what = "(q, p) in another order or scale"
    elif isinstance(law.bracket, Magnetic):
        what = "positions and velocities in a magnetic field"
    learn = 'gfnn.Pairs(…, structure="poisson")'
    return [f"the columns are {what}: {law.bracket}. Learn them with {learn}"]
