"""The posterior of the chosen map's coefficients."""

from __future__ import annotations

import dataclasses
from functools import partial

from gfnn_jax.flows.flow import Flow
from gfnn_jax.generating.generated import Generated
from gfnn_jax.learn.choose import Chosen
from gfnn_jax.learn.searches import Searched
from gfnn_jax.maps.posterior import Posterior
from gfnn_jax.models.generating_functions.ensembles import EnsembleSweep
from gfnn_jax.models.generating_functions.sweeps import LinearSweep

# Operations of a root of m terms, ÷ m³: nearly all of them make the factor of a size two further,
# of twice as many terms and twelve times as many rows, which tells noise from misfit.
_OF_ROOT = 200.0


def with_posterior(chosen: Chosen, searched: Searched) -> Chosen:
    """The choice with the posterior of its map, where that was fitted to the user's pairs and is
    linear in its coefficients, an ensemble of networks, or the flow of a learned H; as it is, where
    it is none of these. It is computed when it is first asked for."""
    map_, entry, law = chosen.candidate.map, chosen.entry, searched.law
    if entry is not None:
        own = entry.sweep.data.pairs is searched.data.pairs
        if not (own and isinstance(entry.sweep, (LinearSweep, EnsembleSweep))):
            return chosen
        kind, root = Generated, partial(entry.sweep.root, entry.size)
    elif searched.of_terms is not None and chosen.candidate.learns == "map":
        kind, root = Generated, searched.of_terms.covariance
    elif (
        law is not None and law.covariance is not None and chosen.candidate.learns == "hamiltonian"
    ):
        kind, root = Flow, lambda: law.root
    else:
        return chosen
    piece = next((i for i, p in enumerate(map_.pieces) if isinstance(p, kind)), None)
    if piece is None:
        return chosen
    map_ = dataclasses.replace(map_, posterior=Posterior(piece, root))
    return chosen._replace(candidate=dataclasses.replace(chosen.candidate, map=map_))


def work_of_posterior(num_parameters: int) -> float:
    """Operations of computing it."""
    return _OF_ROOT * float(num_parameters) ** 3
