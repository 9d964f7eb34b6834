"""Where the implicit solve starts: an explicit polynomial model of a chart's unknowns.

The model is fitted to pairs, where the unknowns are explicit: those that S is fitted to, or states
and their images by the map itself, to which a start of a coarse map can be closer. It need not be
symplectic: the solve corrects it and forgets it, but for two things. A start that is as close as
the root of roundoff leaves one Newton update to do, and beside a fold of S it decides which of the
branches is found: that of the data.
"""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.generating.charts import AnyChart
from gfnn_jax.phase_space import sizes
from gfnn_jax.families.inputs import Inputs, box_inputs
from gfnn_jax.families.products import Products, operations_of_values, values

# A start this close, in units of the data's spread, is the root of roundoff: one update is left.
CLOSE = 5e-8
# What that update leaves is the square of it, the same at every step: below the floor, but more
# than roundoff makes of a million steps. Starts so close leave less (Hénon–Heiles, S of degree 8:
# the energy error grows with the 0.55th power of the steps instead of the 0.86th).
_STEADY = 1e-8
# The model goes on a little outside the box, where rollouts of states at its edge do, but not
# where T_n of its own degree is larger than 250.
_REACH, _LARGEST = 1.2, 250.0
_DEGREES = range(1, 21)
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
        reach = min(_REACH, math.cosh(math.acosh(_LARGEST) / self.family.degree))
        return values(self.family, self.matrices, jnp.where(angle, x, jnp.clip(x, -reach, reach)))


class Starts(NamedTuple):
    """Starts of a map and of its inverse, and the RMS error of the worse, in units of the data."""

    there: Start
    back: Start
    error: float


def fit_starts(chart: AnyChart, prepared, features=None) -> list[Starts]:
    """The starts of a chart's map and of its inverse, by rising degree.

    prepared: of the pairs, y0 and y1 (N, 2d) with their coordinates and dt. The degree rises until
    the start is as close as it need be, or no longer gains: then noise, or the number of pairs, is
    the limit.
    """
    coordinates = prepared.coordinates
    rows = np.linspace(0, len(prepared.y0) - 1, min(_ROWS, len(prepared.y0))).astype(int)
    y0, y1 = prepared.y0[rows], prepared.y1[rows]

    def fitted(chart: AnyChart, given, other) -> list[tuple[Start, float]]:
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
    # The one that is close first waits for the other.
    rising = range(max(len(there), len(back)))
    sides = ([side[min(i, len(side) - 1)] for i in rising] for side in (there, back))
    return [
        Starts(one, other, max(error, its_error))
        for (one, error), (other, its_error) in zip(*sides, strict=True)
    ]


def affordable(starts: list[Starts], family, *, spares: bool = False) -> Starts:
    """The closest starts that cost at most half of what the family's own gradient does.

    spares: whether they leave more than one update to do; then such as do not may cost what they
    spare, two or three evaluations with a Jacobian, whose operations take about twice as long as
    those of a start.
    """
    gradient, with_jacobian = family.operations
    close = [
        s for s in starts if s.error <= CLOSE and s.there.operations <= 5 * with_jacobian
    ]  # fmt: skip
    if spares and close:
        return close[-1]
    cheap = [s for s in starts if s.there.operations <= 0.5 * gradient]
    return cheap[-1] if cheap else starts[0]


def _by_degree(inputs: Inputs, y, wanted, unit) -> list[tuple[Start, float]]:
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
            if family.degree > found[-1][0].family.degree + 1:
                break
            continue  # an odd map gains nothing by an even degree
        closest = error
        found.append((Start(family, jnp.asarray(family.basis.placed(solution))), float(error)))
        if error < _STEADY:
            break
    return found
