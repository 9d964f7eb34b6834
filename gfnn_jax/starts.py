"""Where the implicit solve starts: an explicit polynomial model of a chart's unknowns.

The model is fitted to the pairs that S is, where the unknowns are explicit in the data. It need not
be symplectic: the solve corrects it and forgets it, but for two things. A start that is as close as
the root of roundoff leaves one Newton update to do, and beside a fold of S it decides which of the
branches is found: that of the data.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.charts import AnyChart
from gfnn_jax.phase_space import sizes
from gfnn_jax.scalars.inputs import Inputs, box_inputs
from gfnn_jax.scalars.products import Products, operations_of_values, values

# A start this close, in units of the data's spread, is the root of roundoff: nothing more to gain.
_CLOSE = 1e-8
# The model goes on a little outside the box, where rollouts of states at its edge do.
_REACH = 1.2
_DEGREES = range(1, 11)
_MOST_TERMS = 250
_ROWS = 4_000


@partial(jax.tree_util.register_dataclass, data_fields=("family", "matrices"), meta_fields=())
@dataclasses.dataclass(frozen=True, eq=False)
class Start:
    """What the unknowns differ from the chart's own first guess by, as polynomials of the state.

    family: the products and their box; far outside the model is that of the nearest point of a
    slightly larger box, so that it stays as small as it is near the data. matrices: coefficients
    (k, m, n) of the k unknowns.
    """

    family: Products
    matrices: Any

    @property
    def operations(self) -> int:
        """Floating-point operations of an evaluation."""
        return operations_of_values(self.family, len(self.matrices))

    def __call__(self, z):
        """The difference (k,) at the state z (2d,)."""
        x = self.family.inputs(z)
        angle = np.isin(np.arange(x.shape[0]), self.family.inputs.angles)
        return values(self.family, self.matrices, jnp.where(angle, x, jnp.clip(x, -_REACH, _REACH)))


def fit_starts(chart: AnyChart, prepared, features=None) -> list[tuple[Start, Start]]:
    """The starts of a chart's map and of its inverse, by rising degree.

    prepared: of the pairs, y0 and y1 (N, 2d) with their coordinates and dt. The degree rises until
    the start is as close as it need be, or no longer gains: then noise, or the number of pairs, is
    the limit.
    """
    coordinates = prepared.coordinates
    rows = np.linspace(0, len(prepared.y0) - 1, min(_ROWS, len(prepared.y0))).astype(int)
    y0, y1 = prepared.y0[rows], prepared.y1[rows]

    def fitted(chart: AnyChart, given, other) -> list[Start]:
        dim = given.shape[1] // 2
        free = np.array(chart.free(dim))
        known = np.asarray(jax.vmap(chart.start)(jnp.asarray(given)))
        point = np.asarray(chart.point(given, other))
        inputs = box_inputs(
            given, angles=tuple(a for a in coordinates.angles if a < dim),
            cyclic=coordinates.cyclic, features=features,
        )  # fmt: skip
        return _by_degree(inputs, given, (point - known)[:, free], sizes(point)[free])

    there, back = fitted(chart, y0, y1), fitted(chart.reverse(prepared.dt)[0], y1, y0)
    return list(zip(there, back, strict=False))


def affordable(starts: list[tuple[Start, Start]], family) -> tuple[Start, Start]:
    """The closest starts that cost at most half of what the family's own gradient does."""
    most = 0.5 * family.operations[0]
    return max((s for s in starts if s[0].operations <= most), default=starts[0], key=_degree)


def _degree(starts: tuple[Start, Start]) -> int:
    return starts[0].family.degree


def _by_degree(inputs: Inputs, y, wanted, unit) -> list[Start]:
    held = np.arange(len(y)) % 5 == 0
    x = np.asarray(jax.vmap(inputs)(jnp.asarray(y)))
    found, closest = [], np.inf
    for degree in _DEGREES:
        family = Products(inputs, degree)
        most = min(_MOST_TERMS, len(y) // 3)
        if found and family.num_parameters > most:
            break
        design = family.basis.design(x)
        solution = np.linalg.lstsq(design[~held], wanted[~held], rcond=1e-13)[0]
        error = np.sqrt(np.mean((design[held] @ solution - wanted[held]) ** 2 / unit**2))
        if found and not error < 0.5 * closest:
            if family.degree > found[-1].family.degree + 1:
                break
            continue  # an odd map gains nothing by an even degree
        closest = error
        found.append(Start(family, jnp.asarray(family.basis.placed(solution))))
        if error < _CLOSE:
            break
    return found
