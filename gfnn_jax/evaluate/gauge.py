"""A map that was learned from positions alone beside a flow whose momenta are known.

Positions leave the generating function open by a factor, S → cS, and by f(Q) − f(q). The momenta of
the learned map at positions of the flow are then

    p' = c p + ∇f(q),

c and f the same everywhere, and in these momenta the two maps are one.
"""

from typing import NamedTuple

import numpy as np

from gfnn_jax.coordinates import nearest_image
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import Pairs, sizes, split


class BesideFlow(NamedTuple):
    """Parts of a map of positions that are those of a flow.

    factor: c. gauge: root mean square of ∇f ÷ that of p'. momenta: of p' − c p − ∇f, ÷ that of p'.
    positions, images: root mean squares of the differences of a step, of its positions and of its
    momenta in this gauge, ÷ the coordinates' spreads.
    """

    factor: float
    gauge: float
    momenta: float
    positions: float
    images: float


def beside_flow(map_: SymplecticMap, pairs: Pairs, degree: int = 6) -> BesideFlow:
    """Compare a map that was learned from positions alone with the flow of these pairs, of states
    (q, p) and their images a step later: c and f, of this degree, by least squares.

    Raises ValueError where the map was not learned from positions alone.
    """
    z0, z1 = (np.asarray(z, float) for z in (pairs.z0, pairs.z1))
    (q, p), (image, later) = split(z0), split(z1)
    dim = q.shape[1]
    momenta = np.asarray(map_.from_positions(q, image))[:, dim:]
    angles = tuple(a for a in map_.angles_of_z if a < dim)
    whole = np.concatenate([z0, z1])
    family = Products(box_inputs(whole, angles=angles, cyclic=tuple(range(dim, 2 * dim))), degree)

    def columns(q: np.ndarray, p: np.ndarray) -> np.ndarray:
        """(N, d, 1 + m): of c, and of the coefficients of f."""
        slopes = family.term_gradients(np.concatenate([q, p], axis=1))[:, :dim]
        return np.concatenate([p[..., None], slopes], axis=2)

    of_state = columns(q, p)
    found = np.linalg.lstsq(of_state.reshape(momenta.size, -1), momenta.ravel(), rcond=None)[0]
    unit, spread = np.sqrt(np.mean(momenta**2)), sizes(q)
    step = np.asarray(map_.step(np.concatenate([q, of_state @ found], axis=1))[0])
    moved = nearest_image(step[:, :dim] - image, angles)
    turned = step[:, dim:] - columns(image, later) @ found

    def relative(x: np.ndarray) -> float:
        return float(np.sqrt(np.mean(x**2)))

    gauge, left = of_state[..., 1:] @ found[1:], momenta - of_state @ found
    parts = relative(gauge / unit), relative(left / unit)
    return BesideFlow(float(found[0]), *parts, relative(moved / spread), relative(turned / unit))
