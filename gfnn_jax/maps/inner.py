"""States inside a map: in its inner coordinates, with angles reduced and their turns counted.

    coordinates⁻¹ ∘ pieces ∘ coordinates

A map is all that these functions take of one; states are batches (B, 2d), by JAX.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.arrays import as_row
from gfnn_jax.coordinates import TWO_PI
from gfnn_jax.generating.generated import two_sum
from gfnn_jax.maps.inputs import Scheduled
from gfnn_jax.solve.status import LEFT_DOMAIN, NON_FINITE, OK, Info

_DT_EDGE = 1e-6  # relative tolerance at the ends of a range of dt, for printed numbers
_TWO_PI_REST = 2.4492935982947064e-16  # 2π minus its float64 value


def parts_of_two_pi(dtype):
    """Split 2π into a number of this dtype and a small rest."""
    near = np.asarray(TWO_PI, dtype)
    return near, TWO_PI - float(near) + _TWO_PI_REST


def after(map_, args, steps):
    """Advance args by a number of steps (B,)."""
    if isinstance(args, Scheduled):
        return args.at(after(map_, args.params, steps), steps)
    return args if map_.parameters is None else map_.parameters.after(args, steps, map_.dt)


def _angles_of(map_) -> np.ndarray:
    return np.array(map_.coordinates.angles, dtype=int)


def reduced(map_, y, compensation):
    """Reduce the angles of y to their interval: (y, compensation, turns taken out).

    The rounding error of 2π goes to the compensation, so that millions of turns add no drift.
    An angle so large that its last digit exceeds a radian becomes NaN.
    """
    angles = _angles_of(map_)
    if not angles.size:
        return y, compensation, jnp.zeros((y.shape[0], 0), y.dtype)
    two_pi, beyond = parts_of_two_pi(y.dtype)
    turns = jnp.round((y[:, angles] - as_row(map_.angle_centre, y)) / TWO_PI)
    near, lost = two_sum(y[:, angles] - turns * two_pi, compensation[:, angles] - turns * beyond)
    known = jnp.abs(turns) * float(jnp.finfo(y.dtype).eps) < 1.0
    y = y.at[:, angles].set(jnp.where(known, near, jnp.nan))
    return y, compensation.at[:, angles].set(lost), turns


def inner(map_, z):
    """Convert the user's states to the reduced y, the compensation and the turns taken out."""
    y = jax.vmap(map_.coordinates.forward)(z)
    return reduced(map_, y, jnp.zeros_like(y))


def outer(map_, y, turns):
    """Convert the reduced y and its turns to the user's states."""
    angles = _angles_of(map_)
    if angles.size:
        two_pi, beyond = parts_of_two_pi(y.dtype)
        y = y.at[:, angles].set((y[:, angles] + turns * beyond) + turns * two_pi)
    return jax.vmap(map_.coordinates.inverse)(y)


def contains(map_, y, args):
    """Return whether states, parameters and dt lie in the ranges of the data (B,)."""
    inside = map_.domain.contains(y)
    if map_.dt_range is not None:
        low, high = map_.dt_range[0] * (1 - _DT_EDGE), map_.dt_range[1] * (1 + _DT_EDGE)
        inside = inside & (low <= abs(map_.dt)) & (abs(map_.dt) <= high)
    if map_.parameters is None:
        return inside
    given = args.params if isinstance(args, Scheduled) else args
    return inside & map_.parameters.contains(given[..., : len(map_.parameters.names)])


def applied(map_, z, args, *, unrolled: bool | int = False):
    """Step the states z (B, 2d) in the user's coordinates: (Z, Info)."""
    y, _, turns = inner(map_, z)
    inside = contains(map_, y, args)
    infos = []
    for piece in map_.pieces:
        y, info = piece.step(y, args, unrolled=unrolled)
        infos.append(info)
    info = worst(infos)
    status = jnp.where(info.status == OK, jnp.where(inside, OK, LEFT_DOMAIN), info.status)
    status = jnp.where(jnp.all(jnp.isfinite(y), axis=-1), status, NON_FINITE)
    return outer(map_, y, turns), info._replace(status=status.astype(jnp.int32))


def worst(infos: list[Info]) -> Info:
    """Combine the Info of all pieces: the largest status, iterations and residual per lane."""
    return jax.tree.map(lambda *column: jnp.max(jnp.stack(column), axis=0), *infos)
