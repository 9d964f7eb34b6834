"""Structure of many degrees of freedom that pairs tell of: tried first where a sample bears it out,
proposed where a fit met nothing."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.structures import structure_of
from gfnn_jax.errors import FitError
from gfnn_jax.families.sums import Sums
from gfnn_jax.fitting.linear_starts import fitted_gradients
from gfnn_jax.generating.charts import CHARTS
from gfnn_jax.learn.request import Request

_FEWEST_DIM = 6  # below it a fit needs no structure
_CHARTS = ("midpoint", "type2")  # of flows, to O(h²), and of kicked maps
_SAMPLE = 50  # pairs that a structure is fitted to; as many judge it
_QUIET = 0.75  # of the sample, that moves least
_MOST_TERMS = 60
_EXPLAINED = 0.1  # of the forces or of the velocities, that the midpoint's error may leave over
_TRIED = 0.02  # of them: so little that a law of the structure is looked for before anything else


def proposed(data: Dataset) -> list[str]:
    """One line that names the structure which explains a sample of the pairs best, to O(h²); none
    where none does. data: without a base map or a structure."""
    best, left = _best(data)
    if not left < _EXPLAINED:
        return []
    return [
        f"the structure {best} explains these pairs: a sample of them leaves relative residuals of "
        f"{left:.1g} in forces and velocities, to second order in dt. Fit again with --structure "
        f"{best} (structure='{best}')"
    ]


def structures_to_try(request: Request, data: Dataset) -> Iterator[tuple[Request, Dataset]]:
    """The request and its data: with the structure that explains nearly all of a sample, where a
    law is looked for and nothing is told of it; then as they are."""
    told = request.options.terms or request.scene is not None or data.structure is not None
    if request.seeks_law and not (told or request.of_network):
        best, left = _best(data)
        if left < _TRIED:
            structure = structure_of(best, data.dim, data.coordinates)
            request.say(
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
    if data.dim < _FEWEST_DIM or data.varied or data.coordinates.angles:
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
    small = [family for family in libraries if family.num_parameters <= _MOST_TERMS]
    return min((_of_library(f, data) for f in small), default=np.inf)


def _of_library(family: Sums, data: Dataset) -> float:
    y0, y1 = _quiet(data)
    half, found = len(y0) // 2, []
    for chart in (CHARTS[name] for name in _CHARTS):
        w, target = chart.evaluation_point(y0, y1), chart.target_gradient(y0, y1, data.dt)
        try:
            c = fitted_gradients(family, w[:half], target[:half], data.scale)
        except (FitError, np.linalg.LinAlgError):  # functions that overflow at these states
            continue
        off = family.gradient(c, w[half:]) - target[half:]
        found.append(_part(off, target[half:]))
    return min(found, default=np.inf)


def _quiet(data: Dataset) -> tuple[np.ndarray, np.ndarray]:
    """A sample of the pairs without those that move most, as close passages do."""
    y0, y1 = data.y0[: 2 * _SAMPLE], data.y1[: 2 * _SAMPLE]
    moved = np.abs((y1 - y0) / data.scale).max(axis=1)
    quiet = moved <= np.quantile(moved, _QUIET)
    return y0[quiet], y1[quiet]


def _part(off: np.ndarray, target: np.ndarray) -> float:
    """Size of off ÷ that of target in the median over pairs, of the forces or of the velocities,
    whichever is larger."""
    sizes = [np.linalg.norm(np.reshape(x, (len(x), 2, -1)), axis=2) for x in (off, target)]
    left, whole = (np.median(size, axis=0) for size in sizes)
    part = float(np.max(left / np.maximum(whole, np.finfo(float).tiny)))
    return part if np.isfinite(part) else np.inf
