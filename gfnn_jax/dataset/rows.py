"""The rows of the least-squares problem of S, from the rows of a data set."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.families.inputs import Inputs, box_inputs
from gfnn_jax.families.time_step import OfTimeStep
from gfnn_jax.generating.charts import AnyChart
from gfnn_jax.solve.linear import non_negative


def inputs_of(data: Dataset, w: np.ndarray, **more: Any) -> Inputs:
    """The variables of S at points w (N, 2d), as these coordinates have them; the angles among q
    alone enter by harmonics. more: as of `box_inputs`."""
    coordinates = data.coordinates
    angles = tuple(a for a in coordinates.angles if a < data.dim)
    return box_inputs(w, angles=angles, cyclic=coordinates.cyclic, **more)


def rows_of(data: Dataset, chart: AnyChart, rows) -> tuple[Any, np.ndarray]:
    """(w, target_gradient) of these rows, with their args where there are some, and the weight that
    makes a row of ∇S unit-free. Where each pair has its own dt: (w, h times that, dt), as `_Moves`
    has its terms."""
    (y0, y1), (_, args) = (data.y0[rows], data.y1[rows]), data.given(rows)
    dt = data.dt
    if data.own_dt is not None:
        dt, args = 1.0, data.own_dt[rows, None]
    found = chart.evaluation_point(y0, y1), chart.target_gradient(y0, y1, dt)
    found = found if args is None else (*found, args)
    return found, residual_weight(chart, data.scale, dt)


def weighted_rows_of(data: Dataset, chart: AnyChart, rows) -> tuple[Any, np.ndarray]:
    """`rows_of` these rows in units of their own noise, where it is known of each value: the target
    is multiplied by the weight of the coordinate that it changes, (n, 2d), which comes last."""
    found, weight = rows_of(data, chart, rows)
    if data.weight is None:
        return found, weight
    w, target, *args = found
    of_row = _changed(chart, data.weight[rows])
    return (w, of_row * target, *args, of_row), weight


def of_rows(family: Any, *, weighted: bool = False) -> Any:
    """The family whose terms make the rows: the moves h ∇φ where pairs have a dt of their own, and
    those of ``weighted_rows_of``."""
    family = _Moves(family) if isinstance(family, OfTimeStep) else family
    return _Weighted(family) if weighted else family


@dataclasses.dataclass(frozen=True)
class _Moves:
    """h ∇φ of the terms of an S of dt."""

    family: OfTimeStep

    @property
    def num_parameters(self) -> int:
        return self.family.num_parameters

    def term_gradients(self, w, dt):
        return dt[..., None] * self.family.term_gradients(w, dt)


@dataclasses.dataclass(frozen=True)
class _Weighted:
    """The terms of a family, each row times its weight."""

    family: Any

    @property
    def num_parameters(self) -> int:
        return self.family.num_parameters

    def term_gradients(self, w, *given):
        *args, of_row = given
        return of_row[..., None] * self.family.term_gradients(w, *args)


def residual_weight(chart: AnyChart, scale, dt: float) -> np.ndarray:
    """h over the scale of what each entry of ∇S changes, (2d,): ∂S/∂q changes p and conversely; in
    type 1 both entries are momenta."""
    return dt / _changed(chart, scale)


def _changed(chart: AnyChart, of_coordinates: np.ndarray) -> np.ndarray:
    """(..., 2d) of the coordinate that each entry of ∇S changes, from those of the coordinates."""
    dim = of_coordinates.shape[-1] // 2
    if chart.name == "type1":
        return np.concatenate(2 * [of_coordinates[..., dim:]], axis=-1)
    return np.roll(of_coordinates, dim, axis=-1)


# Where the residuals cannot tell two coordinates' noise apart, each is given half of its own
# residual's variance, by this weight beside the moments' own.
_PRIOR = 0.1


def of_differences(moves: Sequence[np.ndarray], order: int, alike: float) -> float | None:
    """One deviation for all coordinates, from the steps z_{k+1} − z_k (n, 2d) along each run.

    Differences of a high order leave nothing of a smooth orbit, and √C(2n, n) times the noise. None
    where those of this order and of the one before tell deviations that differ by more than the
    factor ``alike``.
    """
    found = []
    for n in (order - 1, order):
        differences = [np.diff(along, n - 1, axis=0) for along in moves if len(along) > n]
        size = np.sqrt(np.mean(np.concatenate(differences) ** 2))
        found.append(float(size / np.sqrt(math.comb(2 * n, n))))
    low, high = min(found), max(found)
    return found[-1] if 0 < high <= alike * low else None


def of_pairs(residual: np.ndarray, jacobian: np.ndarray, shared: np.ndarray) -> np.ndarray:
    """(2d,) from what pairs leave over, r = e₁ − M e₀.

    residual: (n, 2d). jacobian: M (n, 2d, 2d) of the step. shared: (k,) pairs whose image is the
    state of the next.

    The second moments of r are linear in the variances: Σ + M Σ Mᵀ for one pair, and −Σ Mᵀ between
    a pair and the next one where they share a state. Non-negative least squares over all entries.
    """
    width, count = residual.shape[1], len(residual)
    deviation = np.sqrt(np.mean(residual**2, axis=0))
    deviation = np.where(deviation > 0, deviation, deviation.max() or 1.0)
    r, m = residual / deviation, jacobian * deviation[None, None, :] / deviation[None, :, None]
    one = np.einsum("nik,njk->ijk", m, m) / count
    unit = np.arange(width)
    one[unit, unit, unit] += 1.0
    between = np.zeros((width, width, width))
    between[unit, :, unit] = -m[shared + 1].sum(axis=0).T / count
    moments = r.T @ r / count, r[shared].T @ r[shared + 1] / count
    parts = one.reshape(-1, width), between.reshape(-1, width), _PRIOR * np.eye(width)
    target = *(moment.ravel() for moment in moments), np.full(width, 0.5 * _PRIOR)
    variance = non_negative(np.concatenate(parts), np.concatenate(target))
    # So many residuals tell no less.
    return deviation * np.sqrt(np.maximum(variance, 1.0 / count))


def of_halves(residual: np.ndarray, grown: np.ndarray) -> np.ndarray:
    """(2d,) where all positions have one noise, and all momenta one.

    residual: (n, 2d) of pairs. grown: (2, n, 2d), the sums Σ_j M_ij² over the positions j, and over
    the momenta: the mean square of r_i is s² + Σ_j M_ij² s_j², linear in the two variances.
    """
    halves = np.arange(residual.shape[1]) // (residual.shape[1] // 2)
    mean = np.array([np.mean(residual[:, halves == half] ** 2) for half in (0, 1)])
    factors = np.array(
        [[np.mean(grown[by][:, halves == half]) for by in (0, 1)] for half in (0, 1)]
    ) + np.eye(2)
    # In units of each half's own residual, as q and p may differ by orders of magnitude.
    relative = factors * mean / mean[:, None]
    rows = np.concatenate([relative, _PRIOR * np.eye(2)])
    found = non_negative(rows, np.concatenate([np.ones(2), np.full(2, 0.5 * _PRIOR)]))
    return np.sqrt(mean * found)[halves]
