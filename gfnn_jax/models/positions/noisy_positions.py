"""S(q, Q) of noisy readings: which size the readings tell, fitted with latent positions.

Of the sizes of S, from the smallest on, each is fitted to arcs whose positions are latent. Akaike's
criterion chooses: terms that held-out arcs are too few to ask for still bend a forecast. That
latent positions explain arcs that were held out no worse than least squares is then a test.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.budget import FLOW, Budget
from gfnn_jax.errors import OutOfTime
from gfnn_jax.models.positions.discrete_lagrangian import Solved, solve
from gfnn_jax.models.positions.latent_positions import (
    LatentFit,
    arcs_of,
    fit_latent,
    held_out_cost,
    starting_noise,
)
from gfnn_jax.models.positions.triples import Triples

_CERTAIN = 2.0  # standard errors, by which least squares has to be better to be kept
_WORSE = 2  # sizes in a row that are no better end the search
_PASSES = 32.0  # over the rows: some four iterations, twice, with all derivatives
_MOST_OPERATIONS = 2e10  # of one size: about a minute


class Latent(NamedTuple):
    """A family with its S of latent positions, and the least squares that it began with."""

    family: Any
    fit: LatentFit
    solved: Solved


def without_noise(
    families: Iterable[Any],
    training: Triples,
    held_out: Triples,
    budget: Budget,
    on_progress: Callable[[str], Any],
) -> Latent | None:
    """The S that readings with noise tell; None where latent positions explain arcs that were held
    out no better than least squares, or time ends before the first size."""
    arcs, held_out_arcs = arcs_of(training), arcs_of(held_out)
    best: Latent | None = None
    sigma, worse = None, 0
    for family in families:
        work = _PASSES * arcs.size * (family.num_parameters + 2 * training.dim) ** 2
        if best is not None and work > _MOST_OPERATIONS:
            break
        try:
            with budget.unit(f"latent positions, S of {family.label}", FLOW, work):
                on_progress(f"latent positions, S of {family.label}, {family.num_parameters} terms")
                solved = solve(family, training)
                if sigma is None:
                    sigma = starting_noise(family, solved.coefficients, training)
                fit = fit_latent(family, solved, training, sigma, arcs)
        except OutOfTime:
            break
        if not fit.converged or (best and fit.criterion >= best.fit.criterion):
            worse += 1
        else:
            best, sigma, worse = Latent(family, fit, solved), fit.sigma, 0
        if worse == _WORSE:
            break
    if best is None:
        return None
    latent, plain = (
        held_out_cost(best.family, coefficients, held_out, best.fit.sigma, held_out_arcs)
        for coefficients in (best.fit.coefficients, best.solved.coefficients)
    )
    gain = latent - plain
    plain_is_better = gain.mean() > _CERTAIN * gain.std() / np.sqrt(len(gain))
    return best if np.isfinite(latent).all() and not plain_is_better else None
