"""Compiled programs of one step of a map: the step, its derivatives, its Hamiltonian.

Each takes states z (B, 2d) or one state (2d,), in the user's coordinates, and the args of a step.
Inside, coordinates⁻¹ ∘ pieces ∘ coordinates, angles are reduced and their turns counted.
"""

from functools import partial, wraps

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.arrays import as_row
from gfnn_jax.brackets import poisson_defect
from gfnn_jax.compiling import compiled_sooner
from gfnn_jax.coordinates import TWO_PI
from gfnn_jax.generating.generated import Generated, two_sum
from gfnn_jax.maps.inputs import Scheduled
from gfnn_jax.maps.modified_hamiltonian import NUM_STEPS, Cells, of_cells
from gfnn_jax.phase_space import defect_of_pairs, symplecticity_defect
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


# Up to this 2d a defect uses all tangent vectors; beyond it this many random pairs of them.
_WIDEST, _TANGENT_PAIRS = 64, 4


def of_one_or_many(function):
    """Extend a function (map, z (B, 2d), args, ...) of a batch to one state z (2d,)."""

    @wraps(function)
    def either(map_, z, args, *static):
        if z.ndim == 2:
            return function(map_, z, args, *static)
        return jax.tree.map(lambda a: a[0], function(map_, z[None], args, *static))

    return either


@compiled_sooner
@of_one_or_many
def step(map_, z, args):
    """Step: (Z, Info)."""
    return applied(map_, z, args)


@partial(compiled_sooner, static_argnums=(3,), seldom_run=True)
@of_one_or_many
def defect(map_, z, args, unrolled):
    """Defect (B,) of the unrolled derivative A, in units of the scale: `SymplecticMap.defect`."""
    multiplier = map_.multiplier(args)
    if multiplier is None:
        return jnp.full(z.shape[0], jnp.nan, z.dtype)

    def tangent(unit):
        step = partial(applied, map_, args=args, unrolled=unrolled)
        return jax.jvp(lambda y: step(y)[0], (z,), (jnp.broadcast_to(unit, z.shape),))[1]

    width, bracket = z.shape[1], map_.bracket
    if width > _WIDEST and bracket is None:
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (2 * _TANGENT_PAIRS, width))
        before = jnp.asarray(signs / np.sqrt(width), z.dtype) * map_.scale[None]
        after = jax.vmap(tangent)(before)
        return defect_of_pairs(before[:, None], after, map_.scale, multiplier)
    jacobian = jax.vmap(tangent, out_axes=-1)(jnp.eye(z.shape[1], dtype=z.dtype))
    if bracket is None:
        return symplecticity_defect(jacobian, map_.scale, multiplier)
    image, _ = applied(map_, z, args)
    forms = bracket.matrix(z), bracket.matrix(image)
    return poisson_defect(jacobian, *forms, map_.scale, multiplier)


@compiled_sooner
@of_one_or_many
def linearised(map_, z, args):
    """(∂Z/∂z, ∂Z/∂u): (B, 2d, 2d), (B, 2d, k), u the inputs during the step."""
    width, signals = z.shape[1], map_.signals
    count = 0 if signals is None else len(signals.names)

    def step(moved):
        acting = args
        if signals is not None:  # the constant coefficients of the inputs come first of theirs
            first = args.shape[-1] - (signals.degree + 1) * count
            acting = jnp.broadcast_to(args, (len(z), args.shape[-1]))
            acting = acting.at[:, first : first + count].add(moved[:, width:])
        return applied(map_, z + moved[:, :width], acting)[0]

    def along(unit):
        at = jnp.zeros((len(z), width + count), z.dtype)
        return jax.jvp(step, (at,), (jnp.broadcast_to(unit, at.shape),))[1]

    both = jax.vmap(along, out_axes=-1)(jnp.eye(width + count, dtype=z.dtype))
    return both[..., :width], both[..., width:]


@compiled_sooner
@of_one_or_many
def hamiltonian(map_, z, args):
    """H (B,) of the flow that is the map's only piece."""
    return map_.pieces[0].value(inner(map_, z)[0], args)


@partial(compiled_sooner, seldom_run=True)
@of_one_or_many
def modified(map_, z, args):
    """Modified Hamiltonian and its error (B,), from steps to either side."""
    y = inner(map_, z)[0]
    return of_cells(_cells(map_, y, args), _cells(map_.reversed(), y, args), map_.dt)


def _cells(map_, y, args) -> Cells:
    """Compute the cells of the modified Hamiltonian along the steps from y (B, 2d)."""

    def advance(carry, _):
        y, origin = carry
        image, total = y, jnp.zeros(y.shape[:1], y.dtype)
        for piece in map_.pieces:
            before = image
            image, info = piece.step(before, args)
            failed = (info.status > LEFT_DOMAIN)[:, None]
            image = jnp.where(failed, jnp.nan, image)
            total = total + piece.action(before, image, origin, args)
        near, _, _ = reduced(map_, image, jnp.zeros_like(image))
        return (near, origin + (near - image)), Cells(total, image - y, image - origin)

    return jax.lax.scan(advance, (y, y), length=NUM_STEPS)[1]


@compiled_sooner
@of_one_or_many
def determinant(map_, z, args):
    """Chart determinant (B,), the smallest of all pieces in magnitude; NaN without a chart."""
    y, _, _ = inner(map_, z)
    found = []
    for piece in map_.pieces:
        image, _ = piece.step(y, args)
        if isinstance(piece, Generated):
            found.append(piece.determinant(y, image, args))
        y = image
    if not found:
        return jnp.full(z.shape[0], jnp.nan, z.dtype)
    found = jnp.stack(found, axis=-1)
    smallest = jnp.argmin(jnp.abs(found), axis=-1)
    return jnp.take_along_axis(found, smallest[:, None], axis=-1)[:, 0]
