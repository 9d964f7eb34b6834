"""Coordinates in which a map is learned: angles, cyclic coordinates, canonical changes.

A scene declares its coordinates and a fit uses them; the user sees their own. A change of
coordinates must be canonical (its Jacobian D satisfies Dᵀ J D = J), so that a map which is
symplectic in the inner coordinates is symplectic in the user's.
"""

import dataclasses
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.arrays import namespace
from gfnn_jax.phase_space import sizes, split

TWO_PI = 2 * np.pi
_NEAR = 8  # neighbours of a state that are tried first when states are joined to a tree
# States that are transformed at once: batches are padded to a power of two between these.
_FEWEST, _MOST = 64, 2**16


def _identity(z):
    return z


@dataclasses.dataclass(frozen=True)
class Coordinates:
    """Inner coordinates y = forward(z) of a scene, and their structure.

    angles:    indices of y with period 2π: the map commutes with the shift by 2π. An index of a q
               is an angle, and enters S through its Fourier harmonics; an index of a p is periodic
               for the map only (the standard map's p), and S need not be periodic in it.
    cyclic:    indices of y that do not enter S at all; the conjugate variable is conserved.
    forward, inverse: the canonical change z -> y and back, for one state of shape (2d,).
    names: of y, as people write them; () for q1 … pd.
    """

    name: str
    angles: tuple[int, ...] = ()
    cyclic: tuple[int, ...] = ()
    forward: Callable = _identity
    inverse: Callable = _identity
    names: tuple[str, ...] = ()

    @property
    def plain(self) -> bool:
        """Return whether the inner coordinates are the user's own."""
        return self.forward is _identity

    @property
    def user_angles(self) -> tuple[int, ...]:
        """The angles among the user's coordinates."""
        return self.angles if self.plain else ()


CARTESIAN = Coordinates("cartesian")
# Of a log-canonical bracket: not canonical, but its bracket is constant in log z.
LOG = Coordinates("log", forward=jnp.log, inverse=jnp.exp)


def _to_polar(z):
    (x, y), (px, py) = split(z)
    r = jnp.hypot(x, y)
    return jnp.stack([r, jnp.arctan2(y, x), (x * px + y * py) / r, x * py - y * px])


def _from_polar(y):
    (r, phi), (p_r, p_phi) = split(y)
    c, s = jnp.cos(phi), jnp.sin(phi)
    p_t = p_phi / r
    return jnp.stack([r * c, r * s, p_r * c - p_t * s, p_r * s + p_t * c])


def polar(*, cyclic: bool) -> Coordinates:
    """Plane polar coordinates (r, φ, p_r, p_φ) of (x, y, p_x, p_y); p_φ is the angular momentum.

    cyclic: True where the dynamics is invariant under rotation: φ does not enter S, and p_φ is
    conserved to roundoff. The change is not defined at r = 0.
    """
    names, cyclic_angles = ("r", "φ", "p_r", "p_φ"), (1,) if cyclic else ()
    return Coordinates("polar", (1,), cyclic_angles, _to_polar, _from_polar, names)


def to_inner(coordinates: Coordinates, z) -> np.ndarray:
    """Compute y = forward(z) of states z (..., 2d), NumPy float64. NaN where y does not exist."""
    return _batch(coordinates.forward, z)


def to_user(coordinates: Coordinates, y) -> np.ndarray:
    """Compute z = inverse(y) of states y (..., 2d), NumPy float64."""
    return _batch(coordinates.inverse, y)


def inner_slopes(coordinates: Coordinates, z) -> np.ndarray:
    """Compute ∂y/∂z (..., 2d, 2d) of y = forward(z) at states z (..., 2d), NumPy float64. Of
    coordinates that are not the user's own."""
    return _batch(coordinates.forward, z, _slopes)


@partial(jax.jit, static_argnames="change")
def _changed(z, *, change):
    return jax.vmap(change)(z)


@partial(jax.jit, static_argnames="change")
def _slopes(z, *, change):
    return jax.vmap(jax.jacfwd(change))(z)


def _batch(change: Callable, z, of: Callable = _changed) -> np.ndarray:
    z = np.array(z, dtype=np.float64)
    if change is _identity or z.size == 0:
        return z
    flat, done = z.reshape(-1, z.shape[-1]), []
    size = min(_MOST, max(_FEWEST, 1 << (len(flat) - 1).bit_length()))
    for first in range(0, len(flat), size):
        part = flat[first : first + size]
        padded = np.concatenate([part, np.repeat(part[:1], size - len(part), axis=0)])
        done.append(np.asarray(of(padded, change=change))[: len(part)])
    found = np.concatenate(done)
    return found.reshape(*z.shape[:-1], *found.shape[1:])


def whole_turns(angle):
    """Multiple of 2π nearest to an angle of any shape. NumPy or JAX."""
    return TWO_PI * namespace(angle).round(angle / TWO_PI)


def nearest_image(difference, angles: tuple[int, ...]) -> np.ndarray:
    """Copy differences of states (..., 2d), with those of angles brought to [−π, π]. NumPy.

    angles: indices of the coordinates of period 2π. An infinite difference of an angle becomes NaN.
    """
    difference, index = np.array(difference, dtype=np.float64), list(angles)
    if index:
        with np.errstate(invalid="ignore"):
            difference[..., index] -= whole_turns(difference[..., index])
    return difference


def circle_centre(angle) -> tuple[float, bool]:
    """Centre of the shortest arc that holds all values of an angle (N,), and True for a circle.

    The angle jumps by 2π opposite to the centre. Data cover the whole circle where no gap is wider
    than an eighth of it. The centre is then 0, where floating-point numbers are densest and
    symmetric, so that rounding errors of a kick average out.
    """
    wrapped = np.sort(np.mod(angle, TWO_PI))
    gaps = np.diff(wrapped, append=wrapped[0] + TWO_PI)
    widest = int(np.argmax(gaps))
    if gaps[widest] < TWO_PI / 8:
        return 0.0, True
    centre = wrapped[(widest + 1) % len(wrapped)] + 0.5 * (TWO_PI - gaps[widest])
    return float(np.mod(centre + np.pi, TWO_PI) - np.pi), False


def lift(y0, y1, coordinates: Coordinates):
    """Lift the angles of pairs: y0 is reduced, and y1 − y0 is continuous over the data.

    y0, y1: (N, 2d) in the inner coordinates, angles wrapped or not. Returns y0, y1, the centre of
    each angle's interval (a,), and a flag for each angle that covers the circle (a,). The multiples
    of 2π in y1 − y0 are found along a minimal spanning tree of neighbouring states. The nearest
    image of each pair alone would tear a map whose angle moves by more than π.
    """
    y0, y1 = np.array(y0, dtype=np.float64), np.array(y1, dtype=np.float64)
    centres, covered = [], []
    for i in coordinates.angles:
        centre, whole = circle_centre(y0[:, i])
        turns = whole_turns(y0[:, i] - centre)
        y0[:, i] -= turns
        y1[:, i] -= turns
        centres.append(centre)
        covered.append(whole)
    if coordinates.angles:
        order, parent = _spanning_order(_embedded(y0, coordinates))
        for i in coordinates.angles:
            difference = y1[:, i] - y0[:, i]
            difference -= whole_turns(difference)
            for node in order[1:]:
                difference[node] -= whole_turns(difference[node] - difference[parent[node]])
            difference -= whole_turns(np.median(difference))
            y1[:, i] = y0[:, i] + difference
    return y0, y1, np.array(centres), np.array(covered, dtype=bool)


def lift_sites(y0, y1, coordinates: Coordinates):
    """Lift the angles of pairs of equal sites, as `lift` does, with each site as a pair of its own.

    The q of all sites are angles, and all or none of their p. The step of a site is assumed
    continuous in that site's own (q, p).
    """
    count, dim = y0.shape[0], y0.shape[1] // 2
    own = Coordinates("site", angles=tuple(sorted({a // dim for a in coordinates.angles})))

    def of_sites(y):
        return np.reshape(y, (count, 2, dim)).swapaxes(1, 2).reshape(-1, 2)

    def of_states(y):
        return y.reshape(count, dim, 2).swapaxes(1, 2).reshape(count, -1)

    y0, y1, centres, covered = lift(of_sites(y0), of_sites(y1), own)
    return of_states(y0), of_states(y1), np.repeat(centres, dim), np.repeat(covered, dim)


def _embedded(y, coordinates: Coordinates):
    """Embed states in a Euclidean space: unit-sized, each angle of a q as a point of a circle."""
    dim, unit = y.shape[1] // 2, sizes(y)
    columns = []
    for i in range(y.shape[1]):
        if i in coordinates.cyclic:
            continue
        if i in coordinates.angles and i < dim:
            columns += [np.cos(y[:, i]), np.sin(y[:, i])]
        else:
            columns.append(y[:, i] / unit[i])
    return np.column_stack(columns)


def _spanning_order(points):
    """Order the nodes of a minimal spanning tree of the points breadth-first; with parents."""
    from scipy.sparse import csr_array  # loaded when first used
    from scipy.sparse.csgraph import (
        breadth_first_order,
        connected_components,
        minimum_spanning_tree,
    )
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

    count = len(points)
    distance, to = cKDTree(points).query(points, k=np.arange(1, min(_NEAR, count) + 1))
    edges = np.repeat(np.arange(count), distance.shape[1]), to.ravel(), distance.ravel()
    while True:
        row, column, length = edges
        # A zero would mean "no edge" to the sparse graph.
        graph = csr_array((length + 1e-12, (row, column)), (count, count))
        number, part = connected_components(graph, directed=False)
        if number == 1:
            return breadth_first_order(minimum_spanning_tree(graph), 0, directed=False)
        edges = [np.concatenate(both) for both in zip(edges, _bridges(points, part), strict=True)]


def _bridges(points, part):
    """Shortest edge from each part of the points (``part`` numbers them) to another part.

    Any two parts differ in some bit of their numbers. For each bit, the points of one value are
    searched among those of the other. Memory stays that of the points."""
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

    distance, to = np.full(len(points), np.inf), np.zeros(len(points), dtype=int)
    for bit in range(int(part.max()).bit_length()):
        for side in (0, 1):
            here = (part >> bit) & 1 == side
            ours, others = np.flatnonzero(here), np.flatnonzero(~here)
            found, index = cKDTree(points[others]).query(points[ours])
            nearer = found < distance[ours]
            distance[ours[nearer]] = found[nearer]
            to[ours[nearer]] = others[index[nearer]]
    order = np.lexsort((distance, part))
    shortest = order[np.unique(part[order], return_index=True)[1]]
    return shortest, to[shortest], distance[shortest]
