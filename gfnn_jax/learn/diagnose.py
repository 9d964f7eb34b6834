"""Diagnosis of the pairs of a request, before anything is searched for."""

from __future__ import annotations

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.diagnosis.diagnosis import Diagnosis, diagnosed, lossy, undiagnosed
from gfnn_jax.families.terms import given_terms
from gfnn_jax.learn.request import Request
from gfnn_jax.models.maps_of_laws.law_maps import factored_out, flow_of


def diagnose_request(request: Request, plain: Dataset) -> Diagnosis:
    """The diagnosis of the pairs that a fit takes; a law that the user knows is factored out.

    plain: as taken. Raises FitError where no chart covers the data.
    """
    data, options = plain, request.options
    by_args = plain.args is not None and plain.period is None and plain.own_dt is None
    if by_args and plain.structure is None and options.learn != "hamiltonian":
        return lossy(plain, options.chart, request.reversor, options.seed)
    if plain.varied or plain.structure is not None:
        return undiagnosed(plain)
    if options.base is not None:
        known = given_terms(plain.dim, (options.base,))
        flow = flow_of(known, np.ones(known.num_parameters), plain)
        _, data = factored_out([flow], plain, options.seed)
    # A law of the user's keeps areas, and so does what H of an autonomous system generates.
    may_lose = options.base is None and options.learn != "hamiltonian" and not plain.after
    return diagnosed(data, options.chart, request.reversor, options.seed, may_lose=may_lose)
