"""What the pairs say about the map before any fit: local Jacobians, from neighbouring pairs.

From them come the determinant of each chart over the data, and how symplectic the data are.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from gfnn_jax.charts import AnyChart
from gfnn_jax.phase_space import symplecticity_defect

_CENTRES = 400
# Neighbours per unknown of a local fit: enough to average noise, few enough to stay local.
_NEIGHBOURS_PER_TERM = 3
# From so many pairs on the neighbourhoods keep their size: more pairs then average the noise away
# instead of shrinking them below it.
_LOCAL_ENOUGH, _MOST_NEIGHBOURS = 4_000, 1_000
# A determinant this far from zero is safe; below the lower figure the chart folds inside the data.
SAFE, SINGULAR = 0.2, 0.03


class ChartJudgement(NamedTuple):
    """The determinant of a chart over the data.

    low: its 1 % quantile towards zero, counted in the sign of the majority (negative where the sign
    changes). sign: of the majority. negative: the fraction below zero.
    """

    low: float
    sign: int
    negative: float

    @property
    def valid(self) -> bool:
        """Whether w determines z over the data."""
        return self.low > SINGULAR


def local_jacobians(y0, y1, scale, *, seed: int = 0) -> np.ndarray:
    """Jacobians of y0 -> y1 at up to 400 of the states: (n, 2d, 2d).

    y0, y1: (N, 2d) with angles lifted; scale (2d,) makes the coordinates comparable. A local
    quadratic fit where there are pairs enough, else a local linear one.
    """
    n, width = y0.shape
    x, move = np.asarray(y0) / scale, (np.asarray(y1) - np.asarray(y0)) / scale
    i, j = np.triu_indices(width)
    quadratic = n >= 20 * (1 + width + len(i))
    terms = 1 + width + (len(i) if quadratic else 0)
    fewest = _NEIGHBOURS_PER_TERM * terms
    count = min(n, max(fewest, min(_MOST_NEIGHBOURS, fewest * n // _LOCAL_ENOUGH)))
    chosen = np.random.default_rng(seed).permutation(n)[:_CENTRES]
    _, near = cKDTree(x).query(x[chosen], k=count)
    offset = x[near] - x[chosen][:, None, :]
    columns = [np.ones((*offset.shape[:2], 1)), offset]
    if quadratic:
        columns.append(offset[..., i] * offset[..., j])
    design = np.concatenate(columns, axis=-1)
    # The pseudo-inverse takes the map for the identity in what the neighbours do not span: a thin
    # tube of data, the torus of a single orbit.
    solution = np.linalg.pinv(design, rcond=1e-8) @ move[near]
    slope = np.eye(width) + np.swapaxes(solution[:, 1 : 1 + width], 1, 2)
    return slope * scale[:, None] / scale[None, :]


def judge_chart(chart: AnyChart, jacobians, scale) -> ChartJudgement:
    """The chart's determinant over the data; type 1's in coordinates of unit size."""
    dim = len(scale) // 2
    determinant = np.asarray(chart.determinant(jnp.asarray(jacobians)))
    if chart.name == "type1":
        determinant = determinant * np.prod(scale[dim:] / scale[:dim])
    sign = 1 if np.median(determinant) >= 0 else -1
    return ChartJudgement(
        float(np.quantile(sign * determinant, 0.01)), sign, float(np.mean(determinant < 0))
    )


def data_defect(jacobians, scale) -> float:
    """Median over the data of ‖Mᵀ J M − J‖ (largest entry, coordinates of unit size).

    Far below 1 for pairs of a symplectic map, up to the local fits' error; of order 1 where q and p
    are swapped in one snapshot, where velocities stand for momenta, or where there is friction.
    """
    return float(np.median(symplecticity_defect(jnp.asarray(jacobians), jnp.asarray(scale))))
