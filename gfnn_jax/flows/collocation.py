"""One step of Gauss collocation for a batch of states in NumPy: what fits through a flow run.

Stage by stage, K_i = J∇H(z + h Σ_j a_ij K_j, t + c_i h), then Z = z + h Σ_i b_i K_i. Arrays of
stages have shape (s, B, 2d): a sum over stages is then one matrix product.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.families.family import at_time, form_of, parameter_gradients, turned, velocity
from gfnn_jax.families.sums import matrix_free
from gfnn_jax.flows.gauss import gauss
from gfnn_jax.flows.uniform import Uniform
from gfnn_jax.phase_space import apply_j

_EPS = float(np.finfo(np.float64).eps)
_FLOOR = 4 * _EPS  # of a state's size: a change of the stages that small is roundoff
_SETTLED = 1e-12  # of it: what no longer shrinks below this is roundoff too
# Iterations; a lane that contracts by less after the first few is given to Newton's method, an
# iteration of which costs as much as ten to thirty of these.
_MOST, _SLOW, _FIRST = 60, 0.8, 4
_MOST_NEWTON = 12
_USUAL = 25  # iterations, where their number is not known yet


@dataclasses.dataclass(frozen=True)
class Steps:
    """Steps by which a flow over dt is computed: ``substeps`` of collocation with ``stages`` stages
    each, and whether lanes in which the fixed point does not contract are given to Newton's method.
    """

    stages: int
    substeps: int
    newton: bool = True


class Images(NamedTuple):
    """Z (B, 2d); whether the stages were solved (B,); and, where asked for, ∂Z/∂z (B, 2d, 2d), or
    None where the family does without matrices, and ∂Z/∂c (B, 2d, terms)."""

    states: np.ndarray
    solved: np.ndarray
    by_state: Any = None
    by_coefficient: Any = None


def of_lanes(value, lanes):
    """Take these lanes of what differs between lanes; a number, or None, is that of all of them."""
    return value[lanes] if np.ndim(value) else value


def images(
    family,
    params,
    z,
    dt,
    steps: Steps,
    *,
    args=None,
    derivatives: bool = False,
    along: Any = None,
    scale=None,
    on_substep: Callable[[], Any] = lambda: None,
):
    """Images of the states z (B, 2d) after dt, in NumPy. Lanes that fail are not finite.

    dt: a number, or one of each lane (B,). args: of each lane, (B, k), or None; the time among
    them is that of z.
    derivatives: the exact ones of the collocation, in the state and in the coefficients of a
    linear family. along: another one, in whose coefficients they are instead, these 0.
    scale: (2d,) sizes of the coordinates, of whose parts stages are solved to roundoff; None: the
    coordinates are of one size. on_substep: called before each substep; it may raise to stop.
    """
    rule, h = gauss(steps.stages), dt / steps.substeps
    h = h[:, None] if np.ndim(h) else h  # (B, 1) beside coordinates
    width = z.shape[1]
    solved = np.ones(len(z), bool)
    free = matrix_free(family)
    by_state: Any = None if free else np.broadcast_to(np.eye(width), (len(z), width, width))
    by_coefficient: Any = 0.0
    with np.errstate(all="ignore"):
        for _ in range(steps.substeps):
            on_substep()
            newton = steps.newton and not free
            damped = isinstance(family, Uniform)
            stepped, own = family.begun(args, z) if damped else (family, args)
            slopes, done = solve_stages(
                stepped, params, z, h, rule, own, newton=newton, scale=scale
            )
            solved = solved & done
            inside = z + h * _summed(rule.matrix, slopes) if derivatives else z
            moved = h * _summed(rule.weights[None, :], slopes)[0]
            z = z + (family.moved(params, z, moved, h) if damped else moved)
            if derivatives and free:
                by_coefficient = _carried(
                    family, params, inside, h, rule, args, along or family, by_coefficient
                )
            elif derivatives:
                by_z, by_c = _derivatives(stepped, params, inside, h, rule, own, along)
                if damped:
                    by_z, by_c = family.moved_derivatives(params, z, by_z, by_c, h)
                by_state = by_z @ by_state
                by_coefficient = by_z @ by_coefficient + by_c if np.ndim(by_coefficient) else by_c
            args = at_time(family, args, h[:, 0] if np.ndim(h) else h)
    z = np.where(solved[:, None], z, np.nan)
    return Images(z, solved, *((by_state, by_coefficient) if derivatives else ()))


def operations(family, width: int, steps: Steps, along: Any = None) -> float:
    """Floating-point operations of the image of one state (2d,), width 2d, by iterations that
    contract by a quarter. along: the family in whose coefficients it is differentiated, too."""
    gradient, with_hessian = family.operations
    s = steps.stages
    count = _USUAL * s * (gradient + 2 * s * width)
    if along is not None:
        terms, size = along.num_parameters, s * width
        count += s * (with_hessian + 2 * width * terms)
        # By fixed point where there are no matrices: of each term at once.
        count += 2 * size * (s * terms if matrix_free(family) else size * (size / 3 + terms))
    return float(steps.substeps * count)


def _summed(matrix, slopes):
    """Σ_j matrix_ij slopes_j for slopes (s, B, 2d)."""
    return (matrix @ slopes.reshape(len(slopes), -1)).reshape(len(matrix), *slopes.shape[1:])


def at_stages(family, args, h, rule):
    """args of the stages (s, B, k), h a number or (B, 1): (B, k) where no time is among them."""
    after = h[:, 0] if np.ndim(h) else h
    return at_time(family, args, np.multiply.outer(rule.nodes, np.reshape(after, -1)))


def solve_stages(family, params, z, h, rule, args=None, *, newton: bool = True, scale=None):
    """The slopes K (s, B, 2d) at states z (B, 2d), and which lanes were solved to roundoff (B,).

    h: a number or (B, 1). By fixed point; with ``newton``, lanes in which that hardly contracts by
    Newton's method. scale: as of `images`.
    """
    size = np.abs(z) + (np.abs(z).mean(axis=1, keepdims=True) if scale is None else scale)
    slopes = np.repeat(velocity(family, params, z, args)[None], len(rule.weights), axis=0)
    change, earlier = np.full((2, len(z)), np.inf)
    free = matrix_free(family)
    open_, slow = np.ones(len(z), bool), np.zeros(len(z), bool)
    for n in range(_MOST):
        lanes = np.flatnonzero(open_)
        step, given = of_lanes(h, lanes), of_lanes(args, lanes)
        inside = z[lanes] + step * _summed(rule.matrix, slopes[:, lanes])
        given = at_stages(family, given, step, rule)
        new = velocity(family, params, inside, given)
        moved = abs(step) * np.abs(new - slopes[:, lanes])
        slopes[:, lanes] = new
        relative = np.max(moved / (size[lanes] + abs(step) * np.abs(new)), axis=(0, 2))
        ratio = relative / change[lanes]
        closed = (relative <= _FLOOR) | ((relative <= _SETTLED) & (ratio > 0.5))
        if free:  # q moves p and p moves q: changes shrink two iterations at a time
            ratio = np.sqrt(relative / earlier[lanes])
        given_up = ~closed & ~(ratio < _SLOW) & (n > _FIRST)
        earlier[lanes], change[lanes] = change[lanes], relative
        slow[lanes[given_up]] = True
        open_[lanes[closed | given_up]] = False
        if not open_.any():
            break
    left = np.flatnonzero(open_ | slow)
    solved = ~(open_ | slow)
    if left.size and newton:
        slopes[:, left], solved[left] = _newton(
            family, params, z[left], of_lanes(h, left), rule, of_lanes(args, left)
        )
    return slopes, solved


def _newton(family, params, z, h, rule, args):
    """Newton's method on the stages from constant slopes, each step halved until the residual is
    smaller."""
    count, (lanes, width) = len(rule.weights), z.shape
    form = form_of(family, width)
    slopes = np.repeat(velocity(family, params, z, args)[None], count, axis=0)
    args = at_stages(family, args, h, rule)

    def residual(slopes):
        inside = z + h * _summed(rule.matrix, slopes)
        gradient, hessian = family.gradient_and_hessian(params, inside, args)
        return slopes - turned(family, gradient), hessian

    error, hessian = residual(slopes)
    norm = _largest(error)
    factor, step = np.ones(lanes), np.zeros_like(slopes)
    fresh = np.ones(lanes, bool)
    for _ in range(3 * _MOST_NEWTON):
        if fresh.any():
            matrix = stage_matrix(form, hessian[:, fresh], of_lanes(h, fresh), rule)
            flat = error[:, fresh].transpose(1, 0, 2).reshape(fresh.sum(), -1)
            step[:, fresh] = (
                solve(matrix, flat[..., None])[..., 0].reshape(-1, count, width).transpose(1, 0, 2)
            )
        tried = slopes - factor[:, None] * step
        new_error, new_hessian = residual(tried)
        new_norm = _largest(new_error)
        better = new_norm < norm
        slopes = np.where(better[:, None], tried, slopes)
        error = np.where(better[:, None], new_error, error)
        hessian = np.where(better[:, None, None], new_hessian, hessian)
        fresh = better & (new_norm > 0)
        floor = _SETTLED * _largest(slopes)
        at_floor = np.where(better, new_norm, norm) <= floor
        factor = np.where(better, 1.0, 0.5 * factor)
        done = (at_floor & ~(better & (new_norm < 0.5 * norm))) | (factor < 1e-3)
        norm = np.where(better, new_norm, norm)
        if (done | (norm == 0)).all():
            break
    return slopes, norm <= _SETTLED * np.maximum(_largest(slopes), 1e-300)


def _largest(slopes):
    largest = np.abs(slopes).max(axis=(0, 2))
    return np.where(np.isfinite(largest), largest, np.inf)


def stage_matrix(form, hessian, h, rule):
    """I − h A ⊗ JH'' (B, s·2d, s·2d) from J and the stages' Hessians (s, B, 2d, 2d): what a change
    of the slopes K is multiplied by in their equation. h: a number or (B, 1)."""
    count, lanes, width = hessian.shape[:3]
    bent = form @ hessian
    if np.ndim(h):
        bent, h = h[None, :, :, None] * bent, 1.0
    coupled = np.einsum("ij,ibkl->bikjl", -h * rule.matrix, bent, optimize=False)
    coupled = coupled.reshape(lanes, count * width, count * width)
    coupled[:, np.arange(count * width), np.arange(count * width)] += 1.0
    return coupled


def solve(matrix, rhs):
    """Batched solve; lanes that are not finite or singular give NaN."""
    good = np.isfinite(matrix).all(axis=(1, 2)) & np.isfinite(rhs).all(axis=(1, 2))
    out = np.full_like(rhs, np.nan)
    try:
        out[good] = np.linalg.solve(matrix[good], rhs[good])
    except np.linalg.LinAlgError:
        out[good] = np.linalg.pinv(matrix[good]) @ rhs[good]
    return out


def truncation(
    family,
    params,
    z,
    dt,
    steps: Steps,
    *,
    args=None,
    scale=None,
    on_substep: Callable[[], Any] = lambda: None,
) -> np.ndarray:
    """Differences of the images of states z (B, 2d) from those of twice the substeps, (B, 2d): not
    finite where one of them fails."""
    finer = dataclasses.replace(steps, substeps=2 * steps.substeps)
    one, other = (
        images(family, params, z, dt, s, args=args, scale=scale, on_substep=on_substep).states
        for s in (steps, finer)
    )
    return one - other


def _carried(family, params, inside, h, rule, args, along, before):
    """∂Z/∂c (B, 2d, terms) of one step from its stage states (s, B, 2d) and ∂z/∂c before it, 0 or
    of the same shape: by fixed point, with products H'' v alone.

    dK = JH'' (dz + h A dK) + J∇φ dc. The iteration ends at a relative change of 1e-6.
    """
    bends = family.curvatures(params, inside, args)
    before = np.moveaxis(before, -1, 0)[:, None] if np.ndim(before) else 0.0
    explicit = apply_j(np.moveaxis(along.term_gradients(inside, args), -1, 0))
    slopes = explicit
    for _ in range(_MOST):
        turned = np.stack([_summed(rule.matrix, of_term) for of_term in slopes])
        new = explicit + apply_j(family.hessian_product(bends, before + h * turned))
        change = np.abs(new - slopes).max(initial=0.0)
        slopes = new
        # Gauss–Newton steps need no more of it.
        if not change > 1e-6 * np.abs(new).max(initial=0.0):
            break
    moved = np.stack([_summed(rule.weights[None, :], of_term) for of_term in slopes])
    return np.moveaxis((before + h * moved)[:, 0], 0, -1)


def _derivatives(family, params, inside, h, rule, args, along):
    """∂Z/∂z (B, 2d, 2d) and ∂Z/∂c (B, 2d, terms) of one step, its stage states (s, B, 2d).

    N dK = JH'' dz + J∇φ dc with N the stage matrix and φ the terms, of ``along`` if given, and
    dZ = dz + h Σ b_i dK_i: the rows h bᵀ N⁻¹ are solved for once, whatever the number of terms.
    """
    count, lanes, width = inside.shape
    form = form_of(family, width)
    args = at_stages(family, args, h, rule)
    _, hessian = family.gradient_and_hessian(params, inside, args)
    transposed = stage_matrix(form, hessian, h, rule).swapaxes(1, 2)
    weights = np.kron(rule.weights[:, None], np.eye(width))
    weights = h[:, :, None] * weights if np.ndim(h) else h * weights
    adjoint = solve(transposed, np.broadcast_to(weights, (lanes, *weights.shape[-2:])))
    rows = (
        adjoint.reshape(lanes, count, width, width).transpose(0, 3, 1, 2) @ form
    )  # (B, 2d, s, 2d)
    rows = rows.reshape(lanes, width, count * width)
    bent = hessian.transpose(1, 0, 2, 3).reshape(lanes, count * width, width)
    by_state = np.eye(width) + rows @ bent
    terms = parameter_gradients(family, params, inside, args, along).transpose(1, 0, 2, 3)
    return by_state, rows @ terms.reshape(lanes, count * width, -1)
