"""One symmetric chart for every Lie algebra and constant bracket, and the steps made of it.

    z = φ(−M) x,   Z = φ(M) x,   φ(s) = s / (1 − e^(−s)),   M y = h B(y) ∇S(x)

so that Z = e^M z moves along a coadjoint orbit, exactly, and Z − z = h B(x) ∇S(x), as in the
midpoint chart, which it is where B is constant. A step solves x = ψ(M) z, ψ(s) = (e^s − 1) / s: x
is the mean of e^(sM) z over 0 ≤ s ≤ 1. The map is Poisson for every S. With S = H it is of order 2
and symmetric; composed with itself it is a law's flow, also in algebras without a lift.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.arrays import as_row, matmul, namespace, pytree
from gfnn_jax.brackets import Bracket, Constant, LieAlgebra, Log
from gfnn_jax.errors import FitError
from gfnn_jax.families import as_family
from gfnn_jax.families.family import (
    at_time,
    symmetric_gradient,
    symmetric_gradient_and_hessian,
)
from gfnn_jax.flows.collective import Casimirs, casimirs_of, collective
from gfnn_jax.flows.damped import DampedFlow, Dilations, InRestingFrame
from gfnn_jax.flows.flow import Flow
from gfnn_jax.phase_space import sizes
from gfnn_jax.solve import newton
from gfnn_jax.solve.newton import Evaluation
from gfnn_jax.solve.status import OK, Info

_MOST = 40  # Newton updates
# Of the series of ψ(M): to roundoff for ‖M‖ ≤ π, beyond which the chart ends.
_TERMS = 32
# States, largest number of substeps, and the change in units of the coordinates' sizes by which
# they are judged: roundoff of the largest of a few hundred numbers.
_PROBES, _MOST_SUBSTEPS, _RESOLVED = 64, 64, 4e-15
_STAGES = 8  # of a law's step, of order 16, as compiled rollouts have them (`flows.compiled_steps`)
# The symmetric composition of 17 steps and order 8 of W. Kahan & R.-C. Li, Math. Comp. 66 (1997),
# 1089: the first nine of its weights.
_WEIGHTS = (
    0.13020248308889008088,
    0.56116298177510838456,
    -0.38947496264484728641,
    0.15884190655515560090,
    -0.39590389413323757734,
    0.18453964097831570709,
    0.25837438768632204729,
    0.29501172360931029887,
    -0.60550853383003451170,
)
COMPOSITION = np.array([*_WEIGHTS, *_WEIGHTS[-2::-1]])


def mean_of_arc(bracket: Constant | LieAlgebra, z, xi, slopes: bool = False):
    """ψ(M) z (..., n), M y = B(y) ξ, for ξ (..., n); with ``slopes`` its derivative in ξ too (...,
    n, n). NumPy or JAX."""
    xp = namespace(z, xi)
    form = bracket.matrix(z)
    if isinstance(bracket, Constant):
        x = z + 0.5 * bracket.apply(z, xi)
        return (x, 0.5 * form) if slopes else x
    n = z.shape[-1]
    across = bracket.constants.transpose(0, 2, 1).reshape(n * n, n)
    by = matmul(xi, across.T).reshape(form.shape)  # M

    def more(carry, k):
        x, term, slope, bent = carry
        if slopes:
            bent = (matmul(by, bent) + bracket.matrix(term)) / (k + 2.0)
            slope = slope + bent
        term = matmul(by, term[..., None])[..., 0] / (k + 2.0)
        return (x + term, term, slope, bent), None

    none = xp.zeros_like(form) if slopes else xp.zeros(())
    carry = (z, z, none, none)
    if xp is np:
        for k in range(_TERMS):
            carry, _ = more(carry, k)
    else:
        carry, _ = jax.lax.scan(more, carry, jnp.arange(_TERMS, dtype=z.dtype))
    return (carry[0], carry[2]) if slopes else carry[0]


@dataclasses.dataclass(frozen=True)
class ArcEquation:
    """x = ψ(M) z for Newton's method. shared = (family, params, bracket, scale); lanes = (z, args,
    h (B, 1)). Residuals are in units of ``scale``; aux is ∇S(x)."""

    def evaluate(self, shared, lanes, x) -> Evaluation:
        """Residual at x."""
        (family, params, bracket, scale), (z, args, h) = shared, lanes
        gradient = symmetric_gradient(family, params, x, args)
        return self._evaluation(z, x, mean_of_arc(bracket, z, h * gradient), gradient, scale)

    def linearise(self, shared, lanes, x) -> tuple[Evaluation, Any]:
        """Residual and its Jacobian (B, n, n)."""
        (family, params, bracket, scale), (z, args, h) = shared, lanes
        gradient, hessian = symmetric_gradient_and_hessian(family, params, x, args)
        mean, slope = mean_of_arc(bracket, z, h * gradient, slopes=True)
        jacobian = jnp.eye(x.shape[1], dtype=x.dtype)[None] - h[..., None] * matmul(slope, hessian)
        unit = as_row(scale, x)
        return self._evaluation(z, x, mean, gradient, scale), jacobian / unit[..., None]

    def _evaluation(self, z, x, mean, gradient, scale):
        unit = as_row(scale, x)
        size = jax.lax.stop_gradient((jnp.abs(x) + jnp.abs(mean - z)) / unit + 1.0)
        return Evaluation((x - mean) / unit, size, gradient)


@pytree()
class LieGenerated:
    """Poisson map that S(params, ·) generates in the chart of a Lie algebra or constant bracket. A
    piece: see `maps.piece`.

    family: S, a family or a plain ``S(params, x)``. dt: h, a number or a leaf, or one per lane
    (B,). scale: (n,) sizes of the coordinates. casimirs: those that rollouts keep.
    Made by `lie_generated`.
    """

    family: Any
    params: Any
    bracket: Constant | LieAlgebra
    dt: Any
    scale: Any
    casimirs: Casimirs

    def step(self, z, args=None, *, unrolled: bool | int = False):
        """Step the states z (B, n): (Z, Info), by JAX."""
        moved, info = self._moved(z, args, unrolled)
        return z + moved, info

    def compensated_step(self, z, compensation, args=None):
        """Step z + compensation (B, n), with the Casimirs kept: (Z, compensation, Info)."""
        moved, info = self._moved(z, args, False)
        return *self.casimirs.kept(z, compensation, moved), info

    def inverse(self) -> LieGenerated:
        """The inverse map: the chart is symmetric."""
        return dataclasses.replace(self, dt=-self.dt)

    def multiplier(self, args=None) -> float:
        """1.0: the piece is Poisson."""
        return 1.0

    def _moved(self, z, args, unrolled: bool | int):
        """(Z − z, Info)."""
        shape = (z.shape[0], 1)
        h = jnp.broadcast_to(self.dt[:, None] if jnp.ndim(self.dt) else self.dt, shape)
        args = at_time(self.family, args, 0.5 * self.dt)
        if args is not None:  # open lanes are taken out of the batch, with their own
            args = jnp.broadcast_to(args, (z.shape[0], args.shape[-1]))
        shared = (self.family, self.params, self.bracket, self.scale)
        guess = jax.lax.stop_gradient(z)
        given = ArcEquation(), shared, (z, args, h), guess
        x, gradient, info = newton.solved(*given, _MOST, unrolled)
        return h * self.bracket.apply(x, gradient), info


@jax.jit
def _step(piece, z, args):
    return piece.step(z, args)


def chart_of(bracket: Bracket) -> Constant | LieAlgebra:
    """The bracket of the states that the chart is one of: of log z where it is log-canonical.
    Raises FitError for a bracket that is neither constant, log-canonical nor a Lie algebra."""
    if isinstance(bracket, Log):
        return Constant(bracket.form)
    if not isinstance(bracket, (Constant, LieAlgebra)):
        raise FitError(
            f"expected a Lie algebra, a constant or a log-canonical bracket, got one {bracket.name}"
        )
    return bracket


def lie_generated(family, params, bracket: Bracket, dt, scale) -> LieGenerated:
    """`LieGenerated` with the bracket's Casimirs; of log z where it is log-canonical. Raises
    FitError as `chart_of` does."""
    bracket = chart_of(bracket)
    dt = np.asarray(dt, float) if isinstance(dt, (int, float)) else dt
    return LieGenerated(as_family(family), params, bracket, dt, scale, casimirs_of(bracket))


def law_flow(
    family, params, bracket: Bracket, dt: float, z, friction: Dilations | None = None
) -> Flow | LieFlow | DampedFlow:
    """The piece that H makes with a bracket: on its lift where it has one, else `LieFlow`.

        piece = law_flow(H, params, gfnn.Bracket.se3(), 0.1, z)

    z: states of the flow (log z of a log-canonical bracket) and the args of H behind them (N, n +
    k), at which the substeps are halved until the step changes no more. friction: uniform, its
    coefficients behind those of H.
    """
    if friction is not None:
        frame = InRestingFrame(as_family(family), friction)
        since = np.zeros((len(z), 1))
        return DampedFlow(
            law_flow(frame, params, bracket, dt, np.concatenate([z, since], axis=1)), frame
        )
    z = np.asarray(z, float)
    z, args = np.split(z, [bracket.size], axis=1)
    scale, some = sizes(z), slice(None, None, -(-len(z) // _PROBES))
    z, args = z[some], args[some] if args.size else None
    lifted = not isinstance(bracket, LieAlgebra) or bool(bracket.blocks)
    if lifted:
        piece = Flow(collective(family, bracket), params, dt, scale, _STAGES)
    else:
        piece = LieFlow(lie_generated(family, params, bracket, dt, scale))
    image, before = piece.image(z, args), np.inf
    while piece.substeps < _MOST_SUBSTEPS:
        finer = dataclasses.replace(piece, substeps=2 * piece.substeps)
        closer = finer.image(z, args)
        change = np.nanmax(np.abs(closer - image) / scale, initial=0.0)
        if np.isfinite(image).all() and (change <= _RESOLVED or change > 0.5 * before):
            break  # to roundoff, or no better by more
        piece, image, before = finer, closer, change
    return piece


class InARow:
    """Base of a piece that is others in a row: ``_row(one, carry, args)`` is the carry after
    ``one(piece, carry, args)`` of each, and the largest Info."""

    _row: Any

    def step(self, z, args=None, *, unrolled: bool | int = False):
        """Step the states z (B, n): (Z, Info), by JAX."""
        return self._row(lambda piece, z, at: piece.step(z, at, unrolled=unrolled), z, args)

    def compensated_step(self, z, compensation, args=None):
        """Step z + compensation (B, n): (Z, compensation, Info)."""

        def one(piece, both, at):
            *both, info = piece.compensated_step(*both, at)
            return tuple(both), info

        both, info = self._row(one, (z, compensation), args)
        return *both, info


@pytree("substeps")
class LieFlow(InARow):
    """The flow of H over dt in any Lie algebra, of order 8: 17 maps of `LieGenerated` with S = H a
    substep. A piece for the algebras that have no lift."""

    short: LieGenerated
    substeps: int = 1

    @property
    def family(self):
        """H."""
        return self.short.family

    @property
    def params(self):
        """Coefficients of H."""
        return self.short.params

    @property
    def dt(self):
        """Time of a step."""
        return self.short.dt

    def value(self, z, args=None):
        """H (...) at states z (..., n)."""
        return self.short.family.value(self.short.params, z, args)

    def over(self, dt) -> LieFlow:
        """The flow over another dt, in the same number of substeps."""
        return dataclasses.replace(self, short=dataclasses.replace(self.short, dt=dt))

    def image(self, z, args=None):
        """Images (N, n) of states z, as an array of NumPy; NaN where a step fails."""
        h, states = self.dt / self.substeps, np.asarray(z)
        one = dataclasses.replace(self, substeps=1).over(h)  # one program for any number of them
        for k in range(self.substeps):
            states, info = _step(one, states, at_time(self.family, args, k * h))
            states = np.where(np.asarray(info.status)[:, None] == OK, states, np.nan)
        return states

    def inverse(self) -> LieFlow:
        """The same flow backwards."""
        return self.over(-self.dt)

    def multiplier(self, args=None) -> float:
        """1.0: the piece is Poisson."""
        return 1.0

    def _row(self, one, carry, args):
        """All maps of the composition, in a row; compensated steps keep the Casimirs."""
        weights = jnp.asarray(np.tile(COMPOSITION, self.substeps) / self.substeps)
        begun = jnp.cumsum(weights) - weights

        def following(carry, both):
            weight, before = both
            short = dataclasses.replace(self.short, dt=weight * self.dt)
            now = at_time(short.family, args, before * self.dt)
            return one(short, carry, now)

        carry, infos = jax.lax.scan(following, carry, (weights, begun))
        return carry, Info(*(jnp.max(of, axis=0) for of in infos))
