"""Diagnosis by the pairs' local Jacobians: whether they are symplectic, and which charts cover
them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.varied import given_by
from gfnn_jax.diagnosis.damping import LearnedDamping, learn_damping, where_areas_differ
from gfnn_jax.diagnosis.local_jacobians import (
    Charts,
    centres,
    choose_charts,
    data_defect,
    local_jacobians,
    look_symplectic,
    sampled_dimension,
)

NOT_SYMPLECTIC = "the pairs do not look symplectic"


class Diagnosis(NamedTuple):
    """data: without what was factored out. plain: without base map and law, yet without a
    ``damping`` of areas, where one was found."""

    data: Dataset
    plain: Dataset
    charts: Charts
    data_defect: float
    messages: list[str]
    damping: LearnedDamping | None = None


def lossy(data: Dataset, chart: str, reversor, seed: int) -> Diagnosis:
    """Diagnose whether pairs that differ in their args lose area; no chart is chosen yet."""
    jacobians, error = local_jacobians(data.y0, data.y1, data.scale, given_by(data), seed=seed)
    damping = learn_damping(data, jacobians, error, chart, reversor)
    return undiagnosed(data if damping is None else data.without(None, damping.piece), damping)


def undiagnosed(data: Dataset, damping: LearnedDamping | None = None) -> Diagnosis:
    """Data of which no chart is chosen yet: H, or a sum of terms, is looked for first."""
    return Diagnosis(data, data, Charts([], None, {}, []), float("nan"), [], damping)


def diagnosed(data: Dataset, chart: str, reversor, seed: int, may_lose: bool = False) -> Diagnosis:
    """Diagnose by the local Jacobians whether the pairs look symplectic, and which charts cover
    them; the base map is factored out where one is needed.

    may_lose: whether a map that loses area is looked for: its D_b is factored out too.
    """
    plain = data
    jacobians, error = local_jacobians(plain.y0, plain.y1, plain.scale, given_by(plain), seed=seed)
    defect, messages, damping = data_defect(jacobians, plain.scale), _thin(plain), None
    if may_lose:
        damping = learn_damping(plain, jacobians, error, chart, reversor)
    if damping is not None:
        jacobians = damping.undone(jacobians)
        data = plain = plain.without(None, damping.piece)
    elif not look_symplectic(jacobians, error, plain.scale):
        at = plain.y0 if plain.args is None else np.concatenate([plain.y0, plain.args], axis=1)
        at = centres(at, jacobians, seed)
        differing = where_areas_differ(jacobians, at, plain.scale, plain.parameters)
        messages.append(
            f"{NOT_SYMPLECTIC}: ‖MᵀJM − J‖ is {defect:.2g} ± {error:.1g} (M: local "
            "Jacobians, coordinates in units of their spread) where a symplectic map has 0. Check "
            "the order q1…qd, p1…pd, and look for friction or a drive. If p are velocities, learn "
            f"the law of a recording (--positions, --velocities; gfnn.Recording).{differing}"
        )
    charts = choose_charts(chart, data, reversor, jacobians)
    if charts.half is not None:
        data = data.without(charts.half, charts.half)
    return Diagnosis(data, plain, charts, defect, [*messages, *charts.messages], damping)


def _thin(data: Dataset) -> list[str]:
    """A warning where the states lie on a curve, or on the torus of an orbit."""
    entering = [i for i in range(2 * data.dim) if i not in data.coordinates.cyclic]
    dimension = sampled_dimension(data.y0[:, entering], data.scale[entering])
    if dimension > min(data.dim, len(entering) - 1):
        return []
    where = "a curve" if dimension == 1 else f"a surface of dimension {dimension}"
    return [
        f"the pairs lie on {where} of the {len(entering)}-dimensional phase space, as those of one "
        "orbit do. The map is learned there only: other initial states widen it"
    ]
