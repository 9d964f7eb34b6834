"""A law whose residuals are white is right, as far as the pairs tell."""

from __future__ import annotations

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.families.terms import Terms, multiplied
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.uniform import without_forces
from gfnn_jax.models.hamiltonians.libraries import angles_and_others
from gfnn_jax.models.hamiltonians.unexplained import unexplained
from gfnn_jax.models.parameters import functions_of_parameters, state_libraries

_PAIRS = 2_000  # whose residuals are looked at


def leaves_white(flow: Flow, data: Dataset) -> bool:
    """Return whether no polynomial generator explains more than chance of what the flow of H
    leaves over, by an F test (`unexplained`). False also where the pairs are too few for the test,
    for an H over sites, and for pairs of many dt."""
    family = without_forces(flow.family)
    plain = isinstance(family, Terms) and data.own_dt is None and data.structure is None
    if not plain:
        return False
    rows = np.sort(data.training)[:_PAIRS]
    residual = data.y1[rows] - flow.image(data.y0[rows], data.given(rows)[1])
    resolved = np.isfinite(residual).all(axis=1)
    degree = int(np.max(np.sum(family.powers, axis=1), initial=0))
    taken = flow.family.num_parameters
    given = data, rows[resolved], residual[resolved], taken, degree, None
    return unexplained(*given, _with_args(data, rows)) == 1.0


def _with_args(data: Dataset, rows: np.ndarray) -> list[Terms]:
    """Generators of the state and of the parameters or the drive's time that the pairs have; none
    of pairs without such."""
    if data.args is None:
        return []
    angles, plain = angles_and_others(data)
    states = state_libraries(
        data.dim,
        data.parameters,
        angles=angles,
        cyclic=data.coordinates.cyclic,
        plain=plain,
        features=None,
        reversor=None,
        own=None,
    )
    args = data.given(rows)[1]
    functions = functions_of_parameters(data.dim, data.parameters, args, False, data.period)
    every = (multiplied(state, own) for own in functions[0] for state in states)
    return sorted(every, key=lambda family: family.num_parameters)
