"""Misfit of a library of terms, told without a flow: what it leaves over of the target gradients
of a chart in a held-out sample of the pairs."""

from __future__ import annotations

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.errors import FitError
from gfnn_jax.fitting.linear_starts import fitted_gradients
from gfnn_jax.generating.charts import AnyChart

_SAMPLE = 50  # pairs that a library is fitted to; as many judge it
_QUIET = 0.75  # of the sample, that moves least


def misfit(family, data: Dataset, chart: AnyChart) -> float:
    """Part of the held-out target gradients that a family, linear in its parameters, leaves over:
    the median over pairs, of the forces or of the velocities, whichever is larger; infinite where
    its functions overflow. data: without args."""
    rows = _quiet(data)
    y0, y1 = data.y0[rows], data.y1[rows]
    half = len(rows) // 2
    w, target = chart.evaluation_point(y0, y1), chart.target_gradient(y0, y1, data.dt)
    try:
        c = fitted_gradients(family, w[:half], target[:half], data.scale)
    except (FitError, np.linalg.LinAlgError):  # functions that overflow at these states
        return np.inf
    off = family.gradient(c, w[half:]) - target[half:]
    left, whole = (
        np.median(np.linalg.norm(np.reshape(x, (len(x), 2, -1)), axis=2), axis=0)
        for x in (off, target[half:])
    )
    part = float(np.max(left / np.maximum(whole, np.finfo(float).tiny)))
    return part if np.isfinite(part) else np.inf


def _quiet(data: Dataset) -> np.ndarray:
    """A sample of the training pairs without those that move most, as close passages do."""
    rows = data.training[: 2 * _SAMPLE]
    moved = np.abs((data.y1[rows] - data.y0[rows]) / data.scale).max(axis=1)
    return rows[moved <= np.quantile(moved, _QUIET)]
