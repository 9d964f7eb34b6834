"""Structure of many degrees of freedom that pairs tell of: tried first where a sample bears it out,
proposed where a fit met nothing."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.structures import structure_of
from gfnn_jax.diagnosis.residuals import misfit
from gfnn_jax.generating.charts import CHARTS
from gfnn_jax.learn.request import Request


@dataclasses.dataclass(frozen=True)
class ProposalOptions:
    """Rules of when a structure is proposed, or tried first (study: many)."""

    fewest_dim: int = 6  # below it a fit needs no structure
    most_terms: int = 150  # of a library that a sample is fitted by
    # of the forces or of the velocities, that the midpoint's error may leave over
    explained: float = 0.1
    # of them: so little that a law of the structure is looked for before anything else
    tried: float = 0.02


OPTIONS = ProposalOptions()
_CHARTS = ("midpoint", "type2")  # of flows, to O(h²), and of kicked maps


def proposed(data: Dataset) -> list[str]:
    """One line that names the structure which explains a sample of the pairs best, to O(h²); none
    where none does. data: without a base map or a structure."""
    best, left = _best(data)
    if not left < OPTIONS.explained:
        return []
    return [
        f"the structure {best} explains these pairs: a sample of them leaves relative residuals of "
        f"{left:.1g} in forces and velocities, to second order in dt. Fit again with --structure "
        f"{best} (structure='{best}')"
    ]


def structures_to_try(request: Request, data: Dataset) -> Iterator[tuple[Request, Dataset]]:
    """The request and its data: with the structure that explains nearly all of a sample, where a
    law is looked for and nothing is told of it; then as they are."""
    named = request.options.terms or request.scene is not None or data.structure is not None
    if request.seeks_law and not (named or request.of_network):
        best, left = _best(data)
        if left < OPTIONS.tried:
            structure = structure_of(best, data.dim, data.coordinates)
            request.watch.on_progress(
                f"the structure {best} leaves relative residuals of {left:.1g} in forces and "
                "velocities: it is tried first"
            )
            same = Dataset.of(data.pairs, data.coordinates, structure, data.row)
            yield (
                dataclasses.replace(request, structure=structure),
                dataclasses.replace(same, split=data.split),
            )
    yield request, data


def _best(data: Dataset) -> tuple[str, float]:
    """The structure that leaves least of a sample's forces and velocities over, and that part."""
    if data.dim < OPTIONS.fewest_dim or data.varied or data.coordinates.angles:
        return "", np.inf
    left = {text: _misfit(text, data) for text in _possible(data.dim)}
    best = min(left, key=lambda text: left[text])
    return best, left[best]


def _possible(dim: int) -> Iterator[str]:
    """The structures that so many degrees of freedom may have."""
    yield from ("ring", "chain")
    yield from (f"bodies:{dim // k}" for k in (3, 2, 1) if dim % k == 0 and dim // k > 1)


def _misfit(text: str, data: Dataset) -> float:
    """The least part of the held-out target gradients that a library of the structure leaves."""
    structure = structure_of(text, data.dim)
    assert structure is not None
    libraries = list(structure.libraries(data.dim))
    small = [family for family in libraries if family.num_parameters <= OPTIONS.most_terms]
    charts = [CHARTS[name] for name in _CHARTS]
    return min((misfit(f, data, chart) for f in small for chart in charts), default=np.inf)
