"""The posterior of the chosen map's coefficients."""

from __future__ import annotations

import dataclasses

from gfnn_jax.learn.choose import Chosen
from gfnn_jax.learn.searches import Searched
from gfnn_jax.maps.posterior import Posterior

# Operations of a root of m terms, ÷ m³: nearly all of them make the factor of a size two further,
# of twice as many terms and twelve times as many rows, which tells noise from misfit.
_OF_ROOT = 200.0


def with_posterior(chosen: Chosen, searched: Searched) -> Chosen:
    """The choice with the posterior of its map, where that was fitted to the user's pairs and its
    model tells the covariance of its coefficients; as it is elsewhere. It is computed when it is
    first asked for."""
    map_, entry, law = chosen.candidate.map, chosen.entry, searched.law
    if entry is not None:
        data = entry.sweep.data
        root = entry.sweep.posterior(entry.size) if data.pairs is searched.data.pairs else None
    elif searched.of_terms is not None and chosen.candidate.learns == "map":
        data, root = searched.of_terms.data, searched.of_terms.covariance
    elif (
        law is not None and law.covariance is not None and chosen.candidate.learns == "hamiltonian"
    ):
        data, root = searched.data, lambda: law.root
    else:
        return chosen
    if root is None:
        return chosen
    map_ = dataclasses.replace(map_, posterior=Posterior(len(data.before), root))
    return chosen._replace(candidate=dataclasses.replace(chosen.candidate, map=map_))


def work_of_posterior(num_parameters: int) -> float:
    """Operations of computing it."""
    return _OF_ROOT * float(num_parameters) ** 3
