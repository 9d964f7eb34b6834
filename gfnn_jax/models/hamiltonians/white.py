"""A law whose residuals are white is right, as far as the pairs tell."""

from __future__ import annotations

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.families.terms import Terms
from gfnn_jax.flows.uniform import without_forces
from gfnn_jax.models.hamiltonians.learned_law import LearnedHamiltonian, unexplained

_PAIRS = 2_000  # whose residuals are looked at


def leaves_white(law: LearnedHamiltonian, data: Dataset) -> bool:
    """Return whether no polynomial generator explains more than chance of what the law leaves over,
    by an F test (`learned_law.unexplained`). False where the pairs are too few to tell, of a law
    with parameters or over sites, and where whole sequences are certain of a misfit."""
    family = without_forces(law.flow.family)
    plain = isinstance(family, Terms) and not data.varied and data.structure is None
    if not plain or law.misfit:
        return False
    rows = np.sort(data.training)[:_PAIRS]
    residual = data.y1[rows] - law.flow.image(data.y0[rows])
    resolved = np.isfinite(residual).all(axis=1)
    degree = int(np.max(np.sum(family.powers, axis=1), initial=0))
    taken = law.flow.family.num_parameters
    return unexplained(data, rows[resolved], residual[resolved], taken, degree, None) == 1.0
