"""Compiled programs of one step of a map: the step, its derivatives, its Hamiltonian.

Each takes states z (B, 2d) or one state (2d,), in the user's coordinates, and the args of a step.
"""

from __future__ import annotations

from functools import partial, wraps

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.brackets import poisson_defect
from gfnn_jax.compiling import compiled_sooner
from gfnn_jax.generating.generated import Generated
from gfnn_jax.maps.inner import applied, inner, reduced
from gfnn_jax.maps.modified_hamiltonian import NUM_STEPS, Cells, of_cells
from gfnn_jax.phase_space import defect_of_pairs, symplecticity_defect
from gfnn_jax.solve.status import LEFT_DOMAIN

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
