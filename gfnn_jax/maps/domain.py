"""Region of phase space that the data covered.

A box would include its empty corners. The empirical Christoffel function does not: with
v(y) the monomials of degree at most 2 and G = mean of v vᵀ over the data, κ(y) = vᵀ G⁻¹ v is small
where the data are and grows fast outside them, for shells and annuli too (Lasserre & Pauwels, Adv.
Comput. Math. 45 (2019), 1439). It is a sum of squares of a few dozen terms, cheap enough for every
step. Scaling the coordinates does not change it.
"""

from typing import Any

import numpy as np

from gfnn_jax.arrays import as_row, matmul, namespace, pytree
from gfnn_jax.families.jets import jets
from gfnn_jax.families.sums import Sums
from gfnn_jax.phase_space import sizes

# κ is of degree 4 in y: a factor 2 is a margin of about a fifth of the region's size.
_MARGIN = 2.0
_RANGE_MARGIN = 0.25  # on either side, relative to a range's width


@pytree("keep")
class Domain:
    """Domain {y : κ(y) <= limit} in the coordinates ``keep`` of y; all states where it is empty.

    centre, scale: (k,), factor: (m, m) the inverse Cholesky factor of G, limit: scalar.
    """

    keep: tuple[int, ...]
    centre: Any
    scale: Any
    factor: Any
    limit: Any

    def contains(self, y):
        """Return whether the states y (..., 2d) lie in the domain. NumPy or JAX.

        Non-finite states do not.
        """
        xp = namespace(y)
        finite = xp.all(xp.isfinite(y), axis=-1)
        return finite & (self.christoffel(y) <= self.limit) if self.keep else finite

    def christoffel(self, y):
        """Christoffel function κ (...) at the states y (..., 2d), NumPy or JAX."""
        x = y[..., np.array(self.keep)]
        x = (x - as_row(self.centre, x)) / as_row(self.scale, x)
        return namespace(y).sum(matmul(_monomials(x), self.factor.T) ** 2, axis=-1)


def _monomials(x):
    """Monomials 1, x_i, x_i x_j of x (..., k): (..., 1 + k + k(k+1)/2)."""
    xp, (i, j) = namespace(x), np.triu_indices(x.shape[-1])
    return xp.concatenate([xp.ones_like(x[..., :1]), x, x[..., i] * x[..., j]], axis=-1)


def covering(y, *, ignore: tuple[int, ...] = ()) -> Domain:
    """Make the domain of the states y (N, 2d), without the coordinates ``ignore``.

    ``ignore`` names cyclic coordinates and angles whose whole circle is covered.
    """
    y = np.asarray(y, dtype=np.float64)
    keep = tuple(i for i in range(y.shape[1]) if i not in ignore)
    if not keep:
        empty = np.zeros(0)
        return Domain((), empty, empty, np.zeros((0, 0)), np.zeros(()))
    x = y[:, keep]
    centre, scale = x.mean(axis=0), sizes(x)
    v = _monomials((x - centre) / scale)
    # Data on a surface (one energy, say) leave G singular; the floor gives the surface a thickness.
    values, vectors = np.linalg.eigh(v.T @ v / len(v))
    values = np.maximum(values, 1e-6 * values[-1])
    factor = vectors.T / np.sqrt(values)[:, None]
    limit = _MARGIN * np.max(np.sum((v @ factor.T) ** 2, axis=1))
    return Domain(keep, centre, scale, factor, np.asarray(limit))


@pytree("sums")
class Ranges:
    """Domain of a sum over neighbourhoods, by the ranges of each variable of a neighbourhood.

    A range is that of the data, over all neighbourhoods together. A state is inside where the
    variables of all its neighbourhoods are within their ranges.

    sums: the family whose variables they are. low, high: (variables of all parts,).
    """

    sums: Sums
    low: Any
    high: Any

    def contains(self, y):
        """Return whether the states y (..., 2d) lie in the domain. NumPy or JAX.

        Non-finite states do not.
        """
        xp = namespace(y)
        inside, n = xp.all(xp.isfinite(y), axis=-1), 0
        for values in variables_of(self.sums, y):
            good = (values >= self.low[n]) & (values <= self.high[n])
            inside, n = inside & xp.all(good, axis=-1), n + 1
        return inside


def variables_of(sums: Sums, y) -> list:
    """Variables (..., neighbourhoods) of all parts at the states y (..., 2d)."""
    return [
        jet.value for part in sums.parts for jet in jets(part.terms.trees, part.over.gather(y), 0)
    ]


def ranges_of(sums: Sums, y) -> Ranges:
    """Make the ranges over the states y (N, 2d), with a margin."""
    values = variables_of(sums, np.asarray(y, np.float64))
    low, high = (np.array([f(v) for v in values]) for f in (np.min, np.max))
    margin = _RANGE_MARGIN * (high - low)
    return Ranges(sums, low - margin, high + margin)
