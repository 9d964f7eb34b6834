"""S along arcs of measured states: the states that they most likely had, and rows of S there.

∇S(w) = g holds at the true states. Both w and g of a pair are linear in its two states and carry
their noise, and a fit at the measured w is biased, however many pairs there are. With

    F(z, Z) = ∇S(w) − g,        w, g of the chart,        F = 0 where S maps z onto Z,

as the defect of an arc (`solve.latent_arcs`), the states of an S that is near are those nearest to
the measured ones, in units of the noise, that it maps onto each other; and the rows of all other S
there, without the moves of the states, are explicit and linear in their coefficients. Their fit
minimises the squared distance of the arcs from the map's graph to first order (orthogonal distance
regression: Britt & Luecke, Technometrics 15 (1973) 233; Boggs, Byrd & Schnabel, SIAM J. Sci. Stat.
Comput. 8 (1987) 1052). Residuals have variance one where noise is all that is left, in any chart.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from gfnn_jax.dataset.runs import Arcs
from gfnn_jax.fitting.triangle import Triangle, folded
from gfnn_jax.generating.arcs import GeneratedOnArcs
from gfnn_jax.solve.latent_arcs import Known, Readings
from gfnn_jax.solve.noise import Biweight

LONGEST = 10  # steps of an arc: what S cannot represent adds up along a longer one
# Of normal residuals it takes one part in forty, so that rows keep their variance of one.
BIWEIGHT = Biweight(15.0)
_SETTLED = 1e-3  # of the squared distance: what the states still gain moves no coefficient
_BLOCK_BYTES = 4 * 2**20  # of the rows of a block of arcs: they stay in the cache


@dataclasses.dataclass(frozen=True, eq=False)
class NearestArcs:
    """Arcs and the states x (A, L, 2d) that ``model`` with coefficients p finds nearest to them.
    sigma: noise of the measured states, (2d,) or of each value (A, L, 2d)."""

    model: GeneratedOnArcs
    p: np.ndarray
    arcs: Arcs
    x: np.ndarray
    sigma: np.ndarray

    @classmethod
    def of(cls, model: GeneratedOnArcs, p, arcs: Arcs, sigma) -> NearestArcs:
        """Raises numpy.linalg.LinAlgError where the chart is singular at some pair, or no states
        near the measured ones are an orbit."""
        x = arcs.states.copy()
        for n in range(1, x.shape[1]):  # one that is missing starts from the one before
            x[:, n] = np.where(np.isfinite(x[:, n]), x[:, n], x[:, n - 1])
        usual = sigma if sigma.ndim == 1 else np.sqrt(np.mean(sigma**2, axis=(0, 1)))
        readings = Readings(Known(model, p), arcs.states, sigma, BIWEIGHT)
        found = readings.fit(p[:0], x, usual, tolerance=_SETTLED)
        if not np.isfinite(found.cost):
            raise np.linalg.LinAlgError("expected states near the measured ones")
        return cls(model, p, arcs, found.x, sigma)

    def rows(self, along: Any) -> Iterator[tuple[np.ndarray, int]]:
        """Rows [A b] (R, n + 1) of the coefficients of a family, block by block, and for how many
        numbers they stand."""
        arcs, length, width = self.x.shape
        bytes_of_arc = 16 * length * width * (along.num_parameters + width + 1)
        size = max(1, _BLOCK_BYTES // bytes_of_arc)
        for first in range(0, arcs, size):
            some = slice(first, first + size)
            model = dataclasses.replace(self.model, moves=self.arcs.moves[some], along=along)
            y, sigma = self.arcs.states[some], _of_arcs(self.sigma, some)
            rows = Readings(model, y, sigma, BIWEIGHT).eliminated_rows(self.p, self.x[some])
            yield rows, int(np.isfinite(y).sum()) - len(y) * width

    def triangle(self, along: Any, on_block: Callable[[], Any] = lambda: None) -> Triangle:
        """Triangle of the rows of a family; on_block: called before each block of rows."""
        found = Triangle.empty(along.num_parameters)
        factor, count = found.factor, 0
        for rows, numbers in self.rows(along):
            on_block()
            folded(factor, np.asfortranarray(rows))
            count += numbers
        return Triangle(factor, count)

    def take(self, arcs: np.ndarray) -> NearestArcs:
        """Keep these arcs alone."""
        model = dataclasses.replace(self.model, moves=self.model.moves[arcs])
        chosen = Arcs(self.arcs.states[arcs], self.arcs.moves[arcs])
        return NearestArcs(model, self.p, chosen, self.x[arcs], _of_arcs(self.sigma, arcs))


def _of_arcs(sigma: np.ndarray, arcs) -> np.ndarray:
    """The noise of these arcs."""
    return sigma if sigma.ndim == 1 else sigma[arcs]
