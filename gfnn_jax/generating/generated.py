"""Piece of a map that a generating function makes: Z − z = h J ∇S(w) (paper, eq. (4)).

The implicit equation for w is solved to roundoff by Newton's method, or by a fixed point and
Newton–Krylov where S has too many degrees of freedom for matrices. Derivatives in the state, the
parameters and dt come from the implicit function theorem.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.arrays import namespace, pytree
from gfnn_jax.families import as_family
from gfnn_jax.families.family import (
    at_time,
    symmetric_gradient,
    symmetric_gradient_and_hessian,
)
from gfnn_jax.families.sums import matrix_free
from gfnn_jax.families.time_step import OfTimeStep
from gfnn_jax.generating.charts import AnyChart, Chart
from gfnn_jax.phase_space import apply_j
from gfnn_jax.solve import fixed_point, newton
from gfnn_jax.solve.newton import Evaluation

MOST_UPDATES = 40


@dataclasses.dataclass(frozen=True)
class ImplicitStep:
    """Implicit equation of a chart for the solver; its unknown x is the free part of w.

    shared = (family, params, dt, scale). lanes = (z, w where it is known, args), followed by a dt
    of each lane (B, 1) where shared has None. The residual is in units of the coordinates' sizes,
    so that its roundoff floor is one number.
    """

    chart: AnyChart

    def evaluate(self, shared, lanes, x) -> Evaluation:
        """Residual; aux is ∇S(w), (B, 2d)."""
        (family, params, dt, scale), (z, known, args, *own_dt) = shared, lanes
        w = self.chart.complete(known, x)
        gradient = symmetric_gradient(family, params, w, args)
        return self._evaluation(z, w, gradient, own_dt[0] if own_dt else dt, scale)[0]

    def linearise(self, shared, lanes, x) -> tuple[Evaluation, Any]:
        """Residual, and its Jacobian ∂r/∂x (B, n, n)."""
        (family, params, dt, scale), (z, known, args, *own_dt) = shared, lanes
        w = self.chart.complete(known, x)
        gradient, hessian = symmetric_gradient_and_hessian(family, params, w, args)
        h = own_dt[0] if own_dt else dt
        evaluation, unit = self._evaluation(z, w, gradient, h, scale)
        matrix = self.chart.residual_jacobian(hessian, h[..., None] if own_dt else h)
        return evaluation, matrix / unit[..., None]

    def unit(self, shared, lanes):
        """Units (B, n) of the residual; residual times unit is the update of a fixed point."""
        (_, _, dt, scale), (z, *_) = shared, lanes
        unit, _ = self.chart.sizes(scale, z, namespace(z).zeros_like(z), dt)
        return jax.lax.stop_gradient(unit) if namespace(z) is jnp else unit

    def product(self, shared, lanes, x):
        """Linear map v (B, n) -> (∂r/∂x) v in the residual's units, by products with S''.

        It serves matrix-free families.
        """
        (family, params, dt, _), (z, known, args) = shared, lanes
        bends = family.curvatures(params, self.chart.complete(known, x), args)
        unit, nothing = self.unit(shared, lanes), namespace(z).zeros_like(z)

        def along(v):
            moved = self.chart.complete(nothing, unit * v)
            turned = family.hessian_product(bends, moved)
            return self.chart.residual(nothing, moved, turned, dt) / unit

        return along

    def _evaluation(self, z, w, gradient, dt, scale):
        unit, size = self.chart.sizes(scale, z, gradient, dt)
        if namespace(z) is jnp:
            unit, size = jax.lax.stop_gradient((unit, size))
        residual = self.chart.residual(z, w, gradient, dt)
        return Evaluation(residual / unit, size / unit, gradient), unit


@pytree("chart")
class Generated:
    """Map that S(params, ·) generates in a chart. A piece: see `maps.piece`.

    An S that depends on time is taken at the time of the middle of the step, forward and backward.

    family: S, a family or a plain ``S(params, w)``; its numbers from the data are leaves.
    dt:     the time step h, a number or a leaf of the map; one per lane (B,) for an S of dt.
    scale:  (2d,) sizes of the coordinates, for the roundoff floor.
    predictor: first guesses of the solves; with None the chart's own first guess.
    """

    family: Any
    params: Any
    chart: AnyChart
    dt: Any
    scale: Any
    predictor: Any = None

    def __post_init__(self):
        object.__setattr__(self, "family", as_family(self.family))
        if isinstance(self.dt, (int, float)):
            object.__setattr__(self, "dt", np.asarray(self.dt, self.scale.dtype))

    def solve(self, z, args=None, *, unrolled: bool | int = False):
        """Solve for w: (w, ∇S(w), Info) at the states z (B, 2d).

        unrolled: True makes derivatives those of the iterations that ran instead of those of the
        implicit function; a number also bounds the number of updates.
        """
        known = self.chart.first_guess(z)
        guess = known[:, self.chart.free(z.shape[1] // 2)]
        args = self._midway(args)
        if args is not None:  # open lanes are taken out of the batch, with their own
            args = jnp.broadcast_to(args, (z.shape[0], args.shape[-1]))
        if self.predictor is not None:
            guess = guess + self.predictor.forward(z, args)
        shared, lanes = self._shared_and_lanes(z, known, args)
        equation = ImplicitStep(self.chart)
        given = equation, shared, lanes
        if not matrix_free(self.family):
            x, gradient, info = newton.solved(*given, guess, MOST_UPDATES, unrolled)
        elif unrolled:
            most = fixed_point.MOST if unrolled is True else unrolled
            x, gradient, info = fixed_point.iterate(*given, guess, most=most)
        else:
            x, gradient, info = fixed_point.root(*given, jax.lax.stop_gradient(guess))
        return self.chart.complete(known, x), gradient, info

    def step(self, z, args=None, *, unrolled: bool | int = False):
        """Step the states z (B, 2d): (Z, Info), by JAX."""
        w, gradient, info = self.solve(z, args, unrolled=unrolled)
        return self.chart.image(z, w, gradient, self._by_lane), info

    def compensated_step(self, z, compensation, args=None):
        """Step z + compensation (B, 2d): (Z, compensation, Info).

        The compensation is what rounding has lost so far (compensated summation: Hairer, Lubich &
        Wanner, "Geometric Numerical Integration", section VIII.5).
        """
        w, gradient, info = self.solve(z, args)
        if not isinstance(self.chart, Chart):  # Z is no sum
            return self.chart.image(z, w, gradient, self.dt), jnp.zeros_like(z), info
        return *two_sum(z, self._by_lane * apply_j(gradient) + compensation), info

    def refined_step(self, z, guess, args=None):
        """Step z (B, 2d) in NumPy from evaluation points w (B, 2d) that are close: (Z, error (B,)).

        See `solve.newton.refine`. Nothing is compiled.
        """
        refine = fixed_point.refine if matrix_free(self.family) else newton.refine
        dim = z.shape[1] // 2
        x = guess[:, self.chart.free(dim)]
        known, args = self.chart.first_guess(z), self._midway(args)
        shared, lanes = self._shared_and_lanes(z, known, args)
        x, gradient, error = refine(ImplicitStep(self.chart), shared, lanes, x)
        return self.chart.image(z, self.chart.complete(known, x), gradient, self._by_lane), error

    def action(self, z, image, origin, args=None):
        """Action (B,) of the step from z (B, 2d) to its image about the origin, by S at their w.

        NumPy or JAX.
        """
        w = self.chart.evaluation_point(z, image)
        generated = self.dt * self.family.value(self.params, w, self._midway(args))
        return self.chart.action(z, image, origin, generated)

    def inverse(self) -> Generated:
        """Make the inverse map: the same S, with the chart read from its other side."""
        chart, dt = self.chart.reverse(self.dt)
        predictor = self.predictor.reverse() if self.predictor is not None else None
        return dataclasses.replace(self, chart=chart, dt=dt, predictor=predictor)

    def multiplier(self, args=None) -> float:
        """1.0: the piece is symplectic."""
        return 1.0

    def determinant(self, z0, z1, args=None):
        """Determinant det ∂w/∂z (B,) at states z0 (B, 2d) with images z1, NumPy or JAX.

        It vanishes where the chart is singular. It is NaN for a matrix-free S.
        """
        if matrix_free(self.family):
            return namespace(z0).full(z0.shape[0], np.nan, z0.dtype)
        w = self.chart.evaluation_point(z0, z1)
        _, hessian = self.family.gradient_and_hessian(self.params, w, self._midway(args))
        h = self._by_lane
        return self.chart.determinant_of(hessian, h[..., None] if np.ndim(h) else h)

    @property
    def serves_any_dt(self) -> bool:
        """True where S was learned as a function of dt."""
        return isinstance(self.family, OfTimeStep)

    def over(self, dt) -> Generated:
        """Make the map over another dt, a number or (B,), from an S of dt."""
        return dataclasses.replace(self, dt=dt)

    @property
    def _by_lane(self):
        """Time step in the shape that multiplies states: a number, or (B, 1)."""
        return self.dt[:, None] if np.ndim(self.dt) else self.dt

    def _shared_and_lanes(self, z, known, args) -> tuple[tuple, tuple]:
        """Arguments ``shared`` and ``lanes`` of `ImplicitStep`."""
        if np.ndim(self.dt):
            return (self.family, self.params, None, self.scale), (z, known, args, self._by_lane)
        return (self.family, self.params, self.dt, self.scale), (z, known, args)

    def _midway(self, args):
        """Args of S: those in the middle of the step that begins with ``args``, or dt itself."""
        if self.serves_any_dt:
            return self._by_lane if np.ndim(self.dt) else self.dt[None]
        return at_time(self.family, args, 0.5 * self.dt)


def two_sum(a, b):
    """Return a + b as rounded, and the exact rounding error (Knuth, TAOCP 2, section 4.2.2)."""
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)
