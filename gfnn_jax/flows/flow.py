"""The piece that a Hamiltonian makes: its flow over dt by Gauss collocation.

    L_i = h b_i J∇H(z + Σ_j μ_ij L_j, t + c_i h),      Z = z + Σ_i L_i,      μ_ij = a_ij / b_j

Symplectic for every H, separable or not, and symmetric in time: the inverse is the same method
with −dt. The stages are solved to roundoff, by fixed point or, where h‖H''‖ is too large for that
to contract, by Newton's method. Their number and the substeps are fixed for a piece: a count that
depended on the state would make the map discontinuous.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from gfnn_jax.arrays import as_row, matmul, pytree
from gfnn_jax.families import as_family
from gfnn_jax.families.family import at_time, form_of, turned, velocity
from gfnn_jax.families.sums import matrix_free
from gfnn_jax.flows.collocation import Steps, images
from gfnn_jax.flows.gauss import gauss
from gfnn_jax.flows.uniform import Uniform, power
from gfnn_jax.generating.generated import two_sum
from gfnn_jax.phase_space import apply_j, area
from gfnn_jax.solve import fixed_point, krylov, newton
from gfnn_jax.solve.linear import small_solve
from gfnn_jax.solve.newton import Evaluation, largest
from gfnn_jax.solve.status import NON_FINITE, NOT_CONVERGED, OK, Info

_MOST, _MOST_NEWTON = 100, 40
# A change of the stages of so many eps of the state is none; one below eps^¾ that no longer halves
# is roundoff. With 2 eps in place of the first, what the iteration leaves is of one sign: the
# energy of Hénon–Heiles at h = 0.5 then drifts by 2.4e-18 of itself per step instead of 1e-18.
_FLOOR_EPS, _SETTLED = 0.05, 0.75
_WHOLE = 1e-12  # of a number of substeps: what rounding adds to a whole one


@dataclasses.dataclass(frozen=True)
class StageEquation:
    """The stages' equation as Newton's method wants it: x is L, (B, s·2d).

    shared = (family, params, h, scale); lanes = (z, args), or (z, args, h (B, 1)) where every lane
    has its own h. Residuals are in units of ``scale``.
    """

    stages: int

    def evaluate(self, shared, lanes, x) -> Evaluation:
        """The residual; aux is nothing."""
        (family, params, h, scale), (z, args, *own) = shared, lanes
        h = own[0] if own else h
        slopes, inside = self._inside(z, x)
        args = _at_stages(family, args, h, self.stages)
        field = _weighted(h, inside) * velocity(family, params, inside, args)
        return self._evaluation(z, slopes, field, scale)

    def linearise(self, shared, lanes, x) -> tuple[Evaluation, Any]:
        """The residual and its Jacobian ∂r/∂x (B, s·2d, s·2d)."""
        (family, params, h, scale), (z, args, *own) = shared, lanes
        h = own[0] if own else h
        slopes, inside = self._inside(z, x)
        args = _at_stages(family, args, h, self.stages)
        gradient, hessian = family.gradient_and_hessian(params, inside, args)
        field = _weighted(h, inside) * turned(family, gradient)
        evaluation = self._evaluation(z, slopes, field, scale)
        unit = jnp.tile(scale, self.stages) / self.stages
        return evaluation, stage_matrix(family, hessian, h, self.stages) / unit[None, :, None]

    def unit(self, shared, lanes):
        """The residual's units (B, s·2d)."""
        unit = jnp.tile(shared[3], self.stages) / self.stages
        return jnp.broadcast_to(unit[None], (len(lanes[0]), unit.size))

    def product(self, shared, lanes, x):
        """v (B, s·2d) -> (∂r/∂x) v in these units, by products with H''."""
        (family, params, h, _), (z, args) = shared, lanes
        _, inside = self._inside(z, x)
        bends = family.curvatures(params, inside, _at_stages(family, args, h, self.stages))
        unit = self.unit(shared, lanes)

        def along(v):
            dot = _of_stages(unit * v, self.stages)
            turned = apply_j(family.hessian_product(bends, _coupled(dot)))
            return _flat(dot - _weighted(h, dot) * turned) / unit

        return along

    def _inside(self, z, x):
        """The slopes L (s, B, 2d), and the states of the stages."""
        slopes = _of_stages(x, self.stages)
        return slopes, z[None] + _coupled(slopes)

    def _evaluation(self, z, slopes, field, scale):
        # As of h K, of which L is about an s-th.
        unit = jax.lax.stop_gradient(as_row(scale, slopes)) / self.stages
        size = jnp.abs(z)[None] / (self.stages * unit) + jnp.abs(field) / unit + 1.0
        flat = (_flat((slopes - field) / unit), _flat(jax.lax.stop_gradient(size)))
        return Evaluation(*flat, jnp.zeros((len(z), 0), z.dtype))


@pytree("stages", "substeps", "newton")
class Flow:
    """The flow of H(params, ·) over dt. A piece: see `maps.piece`. Where H depends on the
    time, the last of the args is that of the state at which a step begins.

    family:   H, a family or a plain ``H(params, z)``; what it holds of the data are leaves.
    dt:       the time of a step, of either sign; a number or a leaf, one for all lanes or (B,).
    scale:    (2d,) sizes of the coordinates, for the roundoff floor.
    stages:   s of each substep; the order is 2s.
    substeps: of dt, equal.
    newton:   whether the stages are solved by Newton's method instead of by fixed point.
    """

    family: Any
    params: Any
    dt: Any
    scale: Any
    stages: int = 6
    substeps: int = 1
    newton: bool = False

    def __post_init__(self):
        object.__setattr__(self, "family", as_family(self.family))
        if isinstance(self.dt, (int, float)):
            object.__setattr__(self, "dt", np.asarray(self.dt, self.scale.dtype))

    def value(self, z, args=None):
        """H at states z (..., 2d), NumPy or JAX."""
        z = z if self._lift is None else self._lift.up(z)
        return self.family.value(self.params, z, args)

    @property
    def _lift(self):
        """The lift of the states of a bracket, of `flows.lifts`; None for (q, p)."""
        return getattr(self.family, "lift", None)

    def image(self, z, args=None):
        """Images of the states z (N, 2d), in NumPy: NaN where a stage has no solution. args: (N, k)
        or None."""
        steps = Steps(self.stages, self.substeps)
        params, dt = jax.tree.map(np.asarray, self.params), float(np.asarray(self.dt))
        lift, scale = self._lift, np.asarray(self.scale)
        if lift is not None:
            z, scale = lift.up(z), lift.sizes(scale)
        states = images(self.family, params, z, dt, steps, args=args, scale=scale).states
        return states if lift is None else lift.down(states)

    def over(self, dt) -> Flow:
        """The flow over another dt, a number or (B,), in substeps that are no longer than those of
        this one: its own error per unit of time stays what it was found to be."""
        substeps = self.substeps
        if not any(isinstance(t, Tracer) for t in (dt, self.dt)):
            parts = np.max(np.abs(np.asarray(dt))) / np.max(np.abs(np.asarray(self.dt)))
            substeps = max(1, int(np.ceil(self.substeps * parts * (1 - _WHOLE))))
        return dataclasses.replace(self, dt=dt, substeps=substeps)

    def step(self, z, args=None, *, unrolled: bool | int = False):
        """(Z, Info) of the states z (B, 2d), by JAX."""

        def substep(z, args):
            moved, info = self._increment(z, args, unrolled)
            return z + moved, info

        if self._lift is None:
            return self._repeated(substep, z, args)
        w, info = self._repeated(substep, self._lift.up(z), args)
        return self._lift.down(w), info

    def compensated_step(self, z, compensation, args=None):
        """(Z, compensation, Info) of z + compensation, which is what rounding has lost so far."""

        def substep(both, args):
            z, lost = both
            moved, info = self._increment(z, args, False)
            return two_sum(z, moved + lost), info

        if self._lift is not None:
            return self._lifted_step(z, compensation, args)
        (z, compensation), info = self._repeated(substep, (z, compensation), args)
        return z, compensation, info

    def _lifted_step(self, z, compensation, args):
        """`compensated_step` of a bracket, which keeps its Casimirs."""
        lift = self.family.lift

        def substep(both, args):
            w, total = both
            moved, info = self._increment(w, args, False)
            return (w + moved, total + lift.moved(w, moved)), info

        (_, total), info = self._repeated(substep, (lift.up(z), jnp.zeros_like(z)), args)
        return *self.family.casimirs.kept(z, compensation, total), info

    def action(self, z, image, origin, args=None):
        """The action (B,) of the step from z (B, 2d) to its image: the method's own sum
        Σ b_i of it, which is exact for a symplectic Runge–Kutta method."""

        def substep(both, args):
            z, total = both
            slopes, info = self._slopes(z, args, False)
            inside = z[None] + _coupled(slopes)
            h = self.dt / self.substeps
            at = _at_stages(self.family, args, h[:, None] if jnp.ndim(h) else h, self.stages)
            energy = self.family.value(self.params, inside, at)
            done = _weighted(h, energy) * energy
            total = total + jnp.sum(area(inside - origin[None], slopes) - done, axis=0)
            return (z + jnp.sum(slopes, axis=0), total), info

        return self._repeated(substep, (z, jnp.zeros(z.shape[:1], z.dtype)), args)[0][1]

    def work(self, z, args=None):
        """(Z, Power) of the step from z (B, 2d): the energy that friction has taken and inputs have
        brought, by the quadrature of the stages, of the order of the step."""

        def substep(both, args):
            z, done = both
            slopes, info = self._slopes(z, args, False)
            h, inside = self._substep, z[None] + _coupled(slopes)
            at = _at_stages(self.family, args, h, self.stages)
            if isinstance(self.family, Uniform):
                since = jnp.asarray(gauss(self.stages).nodes, z.dtype)[:, None, None] * h
                inside = self.family.from_canonical(self.params, inside, since)
            rate = power(self.family, self.params, inside, at)
            more = jax.tree.map(lambda a: jnp.sum(_weighted(h, a) * a, axis=0), rate)
            moved = self._moved(z, slopes)
            return (z + moved, jax.tree.map(jnp.add, done, more)), info

        none = jax.tree.map(jnp.zeros_like, power(self.family, self.params, z, args))
        return self._repeated(substep, (z, none), args)[0]

    def inverse(self) -> Flow:
        """The inverse map: the same flow backwards."""
        return dataclasses.replace(self, dt=-self.dt)

    def multiplier(self, args=None):
        """1.0 without forces, e^(−γ dt) with uniform friction γ, None with others."""
        own = getattr(self.family, "multiplier", None)
        return 1.0 if own is None else own(self.params, self.dt)

    def _repeated(self, substep, carry, args):
        """All substeps of carry, the time among the args going on with them."""
        if self.substeps == 1:
            return substep(carry, args)

        def following(carry, number):
            after = number * (self.dt / self.substeps)
            return substep(carry, at_time(self.family, args, after))

        numbers = jnp.arange(self.substeps, dtype=self.scale.dtype)
        carry, infos = jax.lax.scan(following, carry, numbers)
        return carry, jax.tree.map(lambda a: jnp.max(a, axis=0), infos)

    def _increment(self, z, args, unrolled: bool | int):
        """(Z − z, Info) of one substep."""
        slopes, info = self._slopes(z, args, unrolled)
        return self._moved(z, slopes), info

    def _moved(self, z, slopes):
        """Z − z of one substep."""
        moved = jnp.sum(slopes, axis=0)
        if isinstance(self.family, Uniform):
            moved = self.family.moved(self.params, z, moved, self._substep)
        return moved

    @property
    def _substep(self):
        """The time of a substep as it multiplies states: a number, or (B, 1)."""
        h = self.dt / self.substeps
        return h[:, None] if jnp.ndim(h) else h

    def _slopes(self, z, args, unrolled: bool | int):
        """(L (s, B, 2d), Info) of one substep; with uniform friction in the variables (q, p̃)."""
        h, family = self._substep, self.family
        if isinstance(family, Uniform):
            family, args = family.begun(args, z)
        scale = self.scale if self._lift is None else self._lift.sizes(jnp.asarray(self.scale))
        shared = (family, self.params, h, scale)
        if self.newton:
            equation = StageEquation(self.stages)
            if args is not None:  # open lanes are taken out of the batch, with their own
                args = jnp.broadcast_to(args, (z.shape[0], args.shape[-1]))
            lanes = (z, args, h) if jnp.ndim(h) else (z, args)
            first = h * velocity(family, self.params, z, args)
            weights = np.repeat(gauss(self.stages).weights, first.shape[-1])
            guess = jnp.tile(first, self.stages) * jnp.asarray(weights, first.dtype)[None]
            given = equation, shared, lanes, guess
            x, _, info = newton.solved(*given, _MOST_NEWTON, bool(unrolled))
            return _of_stages(x, self.stages), info
        solve = _fixed_point if unrolled else _stages
        return solve(self.stages, shared, z, args)


def _fixed_point(stages: int, shared, z, args):
    """L (s, B, 2d) and Info, by iterating L_i = h b_i J∇H(z + Σ_j μ_ij L_j) from h b_i J∇H(z).

    A lane that is at roundoff keeps its stages: a slow or bad lane changes no other. Where this
    does not contract and H does without matrices, Newton–Krylov begins again.
    """
    family, params, h, scale = shared
    eps = float(jnp.finfo(z.dtype).eps)
    at = _at_stages(family, args, h, stages)
    # Of h K, of which L is about an s-th.
    size = jax.lax.stop_gradient(jnp.abs(z) + as_row(scale, z))[None] / stages
    like = jnp.broadcast_to(z[None], (stages, *z.shape))
    slopes = _weighted(h, like) * velocity(family, params, z, args)[None]
    lanes = jnp.zeros(z.shape[0], jnp.int32)

    def improve(carry):
        slopes, change, open_, iterations = carry
        inside = z[None] + _coupled(slopes)
        new = _weighted(h, inside) * velocity(family, params, inside, at)
        moved = jax.lax.stop_gradient(largest(_flat(jnp.abs(new - slopes) / size)))
        settled = (moved <= eps**_SETTLED) & (moved > 0.5 * change)
        goes_on = ~((moved <= _FLOOR_EPS * eps) | settled) & jnp.isfinite(moved)
        iterations = iterations + open_.astype(jnp.int32)
        return (
            jnp.where(open_[None, :, None], new, slopes),
            jnp.where(open_, moved, change),
            open_ & goes_on & (iterations < _MOST),
            iterations,
        )

    begun = (slopes, jnp.full(z.shape[0], jnp.inf, z.dtype), lanes < 1, lanes)
    slopes, change, _, iterations = jax.lax.while_loop(
        lambda carry: jnp.any(carry[2]), improve, begun
    )
    failed = jnp.where(jnp.isfinite(change), NOT_CONVERGED, NON_FINITE)
    status = jnp.where(change <= eps**_SETTLED, OK, failed).astype(jnp.int32)
    info = Info(status, iterations, change)
    if matrix_free(family):
        nothing = jnp.zeros((len(z), 0), z.dtype)
        x, _, info = fixed_point.newton_krylov(
            StageEquation(stages),
            shared,
            (z, args),
            (_flat(slopes), nothing, info),
            _flat(begun[0]),
        )
        slopes = _of_stages(x, stages)
    return slopes, info


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _stages(stages: int, shared, z, args):
    """Solve as ``_fixed_point`` does, with derivatives in everything by the implicit function
    theorem."""
    return _fixed_point(stages, shared, z, args)


@_stages.defjvp
def _stages_jvp(stages, primals, tangents):
    shared, z, args = primals
    slopes, info = _stages(stages, shared, z, args)
    family, params, h, _ = shared

    def field(shared, z, args):
        family, params, h, _ = shared
        inside = z[None] + _coupled(slopes)
        at = _at_stages(family, args, h, stages)
        return _weighted(h, inside) * velocity(family, params, inside, at)

    _, field_dot = jax.jvp(field, primals, tangents)
    if matrix_free(family):
        equation, lanes = StageEquation(stages), (z, args)
        unit = equation.unit(shared, lanes)
        product = equation.product(shared, lanes, _flat(slopes))
        solved = unit * krylov.solve_to_roundoff(product, _flat(field_dot) / unit)
    else:
        inside = z[None] + _coupled(slopes)
        at = _at_stages(family, args, h, stages)
        _, hessian = family.gradient_and_hessian(params, inside, at)
        solved = small_solve(stage_matrix(family, hessian, h, stages), _flat(field_dot))
    slopes_dot = _of_stages(solved, stages)
    integer_dot: Any = np.zeros(info.status.shape, jax.dtypes.float0)
    info_dot = Info(integer_dot, integer_dot, jnp.zeros_like(info.residual))
    return (slopes, info), (slopes_dot, info_dot)


def _at_stages(family, args, h, stages: int):
    """args of the stages (s, B, k), h a number or (B, 1): as they are where no time is in them."""
    after = jnp.asarray(gauss(stages).nodes)[:, None] * jnp.reshape(h, (1, -1))
    return at_time(family, args, after.astype(jnp.result_type(h)))


def _weighted(h, like):
    """h b_i as it multiplies an array of stages (s, B, …); h: a number, or one of each lane."""
    weights = jnp.asarray(gauss(len(like)).weights, like.dtype).reshape(-1, *[1] * (like.ndim - 1))
    return weights * (as_row(h, like) if jnp.ndim(h) else h)


def _coupled(slopes):
    """Σ_j μ_ij slopes_j for slopes (s, B, 2d)."""
    matrix = jnp.asarray(gauss(len(slopes)).coupling, slopes.dtype)
    return matmul(matrix, slopes.reshape(len(slopes), -1)).reshape(-1, *slopes.shape[1:])


def _flat(slopes):
    """(s, B, 2d) as (B, s·2d)."""
    return jnp.swapaxes(slopes, 0, 1).reshape(slopes.shape[1], -1)


def _of_stages(x, stages: int):
    """(B, s·2d) as (s, B, 2d)."""
    return jnp.swapaxes(x.reshape(len(x), stages, -1), 0, 1)


def stage_matrix(family, hessian, h, stages: int):
    """1 − h b_i μ_ij JH''_i (B, s·2d, s·2d), from the stages' Hessians (s, B, 2d, 2d).

    h: a number or (B, 1)."""
    _, lanes, width, _ = hessian.shape
    form = jnp.asarray(form_of(family, width), hessian.dtype)
    rule = gauss(stages)
    matrix = jnp.asarray(rule.weights[:, None] * rule.coupling, hessian.dtype)
    # Row (i, a), column (j, b): what a change of the slope j adds to stage i, seen by its field.
    turned = jnp.einsum("ac,ilcb->liab", form, hessian, precision="highest")
    coupled = jnp.einsum("ij,liab->liajb", matrix, turned, precision="highest")
    size = stages * width
    h = h[..., None] if jnp.ndim(h) else h
    return jnp.eye(size, dtype=hessian.dtype)[None] - h * coupled.reshape(lanes, size, size)
