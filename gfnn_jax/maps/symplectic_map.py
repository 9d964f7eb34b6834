"""The symplectic map: a composition of small pieces, each symplectic, each with its inverse.

    coordinates⁻¹ ∘ R^½ ∘ generated(S, chart) ∘ R^½ ∘ coordinates

Maps are pytrees: their numbers can be passed through ``jit`` and differentiated; what is static
(the kind of family, chart, coordinates) is a hashable constant, and what is compiled for one map
serves all of its kind.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gfnn_jax.solve import newton as implicit
from gfnn_jax.generating.charts import AnyChart, Chart
from gfnn_jax.coordinates import TWO_PI, Coordinates
from gfnn_jax.maps.symplectic_map.domain import Domain
from gfnn_jax.solve.newton import LEFT_DOMAIN, NON_FINITE, OK, STOPPED_AT_EDGE, Info
from gfnn_jax.phase_space import apply_j, require_x64, symplecticity_defect
from gfnn_jax.maps.symplectic_map.rollout import scan_steps
from gfnn_jax.families import as_pytree

_MOST_NEWTON = 40
_TWO_PI_REST = 2.4492935982947064e-16  # what float64 leaves out of 2π


def _two_pi(dtype):
    """2π as the sum of a number of this dtype and a small rest."""
    near = np.asarray(TWO_PI, dtype)
    return near, TWO_PI - float(near) + _TWO_PI_REST


def _register(data: tuple[str, ...], meta: tuple[str, ...]) -> Callable:
    return partial(jax.tree_util.register_dataclass, data_fields=data, meta_fields=meta)


def _as_leaf(dt, scale):
    """A time step as an array like the others: ``tree.map`` meets nothing but arrays."""
    return jnp.asarray(dt, scale.dtype) if isinstance(dt, int | float) else dt


def _two_sum(a, b):
    """a + b as rounded, and what the rounding lost, exactly (Knuth, TAOCP 2, section 4.2.2)."""
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


@dataclasses.dataclass(frozen=True)
class _Equation:
    """The implicit equation of a chart as the solver wants it: x is the free part of w.

    θ = (scalar, params, z, w where it is known, dt, scale).
    """

    chart: AnyChart

    def point(self, z, x):
        return z.at[np.array(self.chart.free(z.shape[0] // 2))].set(x)

    def __call__(self, theta, x):
        scalar, params, z, known, dt, scale = theta
        w = self.point(known, x)
        gradient = jax.grad(scalar, argnums=1)(params, w)
        residual = self.chart.residual(z, w, gradient, dt)
        unit, size = jax.lax.stop_gradient(self.chart.sizes(scale, z, gradient, dt))
        return residual / unit, size / unit, (w, gradient)


@_register(("scalar", "params", "dt", "scale", "there", "back"), ("chart",))
@dataclasses.dataclass(frozen=True, eq=False)
class Generated:
    """The map that S generates in a chart: Z − z = h J ∇S(w) (paper, eq. (4)).

    scalar: ``S(params, w)``; what it holds of the data are leaves of the map, and a plain function
    is wrapped to have none. scale: (2d,) sizes of the coordinates, for the roundoff floor.
    there, back: where the solve of the map, and of its inverse, starts (a ``starts.Start``); None:
    at the chart's own first guess.
    """

    scalar: Any
    params: Any
    chart: AnyChart
    dt: Any
    scale: Any
    there: Any = None
    back: Any = None

    def __post_init__(self):
        object.__setattr__(self, "scalar", as_pytree(self.scalar))
        object.__setattr__(self, "dt", _as_leaf(self.dt, self.scale))

    def solve(self, z, *, executed: bool = False):
        """w, ∇S(w), Info at the state z (2d,); ``executed`` keeps the iterations' derivative."""
        equation = _Equation(self.chart)
        dim = z.shape[0] // 2
        free = np.array(self.chart.free(dim))
        known = self.chart.start(z)
        guess = known[free] if self.there is None else known[free] + self.there(z)
        theta = (self.scalar, self.params, z, known, self.dt, self.scale)
        if executed:
            _, (w, gradient), info = implicit.iterate(equation, theta, guess, most=_MOST_NEWTON)
        else:
            _, (w, gradient), info = implicit.root(
                equation, theta, jax.lax.stop_gradient(guess), _MOST_NEWTON
            )
        return w, gradient, info

    def __call__(self, z, *, executed: bool = False):
        """(Z, Info) of the state z (2d,)."""
        w, gradient, info = self.solve(z, executed=executed)
        return self.chart.image(z, w, gradient, self.dt), info

    def carried(self, z, rest):
        """(Z, rest, Info) of z + rest, the rest being what rounding has lost so far (compensated
        summation: Hairer, Lubich & Wanner, "Geometric Numerical Integration", section VIII.5)."""
        w, gradient, info = self.solve(z)
        if not isinstance(self.chart, Chart):  # Z is no sum
            return self.chart.image(z, w, gradient, self.dt), jnp.zeros_like(z), info
        return *_two_sum(z, self.dt * apply_j(gradient) + rest), info

    def inverse(self) -> Generated:
        """The inverse map: the same S, the chart read from its other side."""
        chart, dt = self.chart.reverse(self.dt)
        return dataclasses.replace(self, chart=chart, dt=dt, there=self.back, back=self.there)

    def determinant(self, z):
        """det ∂w/∂z at the state z (2d,), which vanishes where the chart is singular.

        Near-identity charts: 1/det(I − (½I + C) h J S''(w)).
        """
        w, _, _ = self.solve(z)
        if not isinstance(self.chart, Chart):
            jacobian = jax.jacfwd(lambda y: self(y)[0])(z)
            return self.chart.determinant(jacobian)
        dim = z.shape[0] // 2
        second = jax.jacfwd(jax.grad(self.scalar, argnums=1), argnums=1)(self.params, w)
        skew = self.chart.skew
        half = jnp.repeat(jnp.array([0.5 + skew, 0.5 - skew], z.dtype), dim)
        eye = jnp.eye(2 * dim, dtype=z.dtype)
        return 1.0 / jnp.linalg.det(eye - half[:, None] * self.dt * apply_j(second.T).T)


@_register(("matrix", "centre", "shift"), ())
@dataclasses.dataclass(frozen=True, eq=False)
class Affine:
    """z -> centre + shift + E (z − centre), E a symplectic matrix: half a base map (design R^½)."""

    matrix: Any
    centre: Any
    shift: Any

    def __call__(self, z, *, executed: bool = False):
        """(Z, Info) of the state z (2d,)."""
        del executed  # nothing is iterated
        image = self.centre + self.shift + self.matrix @ (z - self.centre)
        ok = Info(jnp.int32(OK), jnp.int32(0), jnp.zeros((), z.dtype))
        return image, ok

    def carried(self, z, rest):
        """(Z, rest, Info) of z + rest; a product's rounding is lost, no rest is left."""
        image, ok = self(z)
        return image + self.matrix @ rest, jnp.zeros_like(z), ok

    def inverse(self) -> Affine:
        """E⁻¹, which of a symplectic E is −J Eᵀ J."""
        inverse = apply_j(apply_j(self.matrix).T)
        return Affine(inverse, self.centre + self.shift, -self.shift)


class Lanes(NamedTuple):
    """Where a batch of rollouts stands; the whole state from which it can go on.

    y: inner coordinates with angles reduced (B, 2d). rest: what rounding has lost of them, less
    than their last digit (B, 2d). turns: of the angles (B, a). status, left_at (step at which the
    lane left the domain, −1 if never), iterations (most Newton updates of a step), steps done:
    each (B,).
    """

    y: Float[Array, "*batch phase"]
    rest: Float[Array, "*batch phase"]
    turns: Int[Array, "*batch angles"]
    status: Int[Array, "*batch"]
    left_at: Int[Array, "*batch"]
    iterations: Int[Array, "*batch"]
    steps: Int[Array, "*batch"]


class RolloutInfo(NamedTuple):
    """How each lane of a rollout ended: status, step at which it left the domain (−1 if it never
    did), most Newton updates in a step."""

    status: Int[Array, "*batch"]
    left_at: Int[Array, "*batch"]
    iterations: Int[Array, "*batch"]


@_register(("pieces", "domain", "scale", "cut", "dt"), ("coordinates",))
@dataclasses.dataclass(frozen=True, eq=False)
class SymplecticMap:
    """A learned map and what it knows of its data.

    pieces:      applied in order, in the inner coordinates.
    coordinates: the inner coordinates; the user's are outside.
    domain:      where the data were, in the inner coordinates.
    scale:       (2d,) sizes of the user's coordinates.
    cut:         (a,) centre of the interval of length 2π in which each angle is kept.
    dt:          the time one step takes.
    """

    pieces: tuple
    coordinates: Coordinates
    domain: Domain
    scale: Any
    cut: Any
    dt: Any

    def __post_init__(self):
        object.__setattr__(self, "dt", _as_leaf(self.dt, self.scale))

    @property
    def dim(self) -> int:
        """Degrees of freedom."""
        return self.scale.shape[0] // 2

    def save(self, folder, **options) -> None:
        """Write a model folder, which ``gfnn.load`` reads; see `models.save` for the options."""
        from gfnn_jax import models  # stands after this module: a shorthand for its function

        models.save(self, folder, **options)

    # One state.

    def _angles(self):
        return np.array(self.coordinates.angles, dtype=int)

    def _reduce(self, y, rest):
        """y with its angles inside the cut, the rest, and the turns taken out.

        2π is more than its own digits: what they leave out goes to the rest, so that millions of
        turns add no drift. An angle so large that its last digit is more than a radian has no
        meaning, and becomes NaN.
        """
        angles = self._angles()
        two_pi, beyond = _two_pi(y.dtype)
        turns = jnp.round((y[angles] - self.cut) / TWO_PI)
        reduced, lost = _two_sum(y[angles] - turns * two_pi, rest[angles] - turns * beyond)
        known = jnp.abs(turns) * float(jnp.finfo(y.dtype).eps) < 1.0
        y = y.at[angles].set(jnp.where(known, reduced, jnp.nan))
        return y, rest.at[angles].set(lost), turns

    def _inner(self, z):
        """The reduced y of a user's state, its rest and its turns."""
        y = self.coordinates.forward(z)
        return self._reduce(y, jnp.zeros_like(y))

    def _outer(self, y, turns):
        """The user's state of the reduced y and its turns."""
        angles = self._angles()
        two_pi, beyond = _two_pi(y.dtype)
        whole = (y[angles] + turns * beyond) + turns * two_pi
        return self.coordinates.inverse(y.at[angles].set(whole))

    def _apply(self, y, *, executed: bool = False):
        """All pieces in a row on a reduced y: (Y, Info), the worst of the pieces' infos."""
        infos = []
        for piece in self.pieces:
            y, info = piece(y, executed=executed)
            infos.append(info)
        return y, _worst(infos)

    def _carried(self, y, rest):
        """As ``_apply``, with the rest that rounding leaves: (Y, rest, Info)."""
        infos = []
        for piece in self.pieces:
            y, rest, info = piece.carried(y, rest)
            infos.append(info)
        return y, rest, _worst(infos)

    def apply(self, z, *, executed: bool = False):
        """(Z, Info) of one state z (2d,) in the user's coordinates; for your own transforms."""
        y, _, turns = self._inner(z)
        y1, info = self._apply(y, executed=executed)
        finite = jnp.all(jnp.isfinite(y1))
        left = jnp.where(self.domain.contains(y), OK, LEFT_DOMAIN)
        status = jnp.where(info.status == OK, left, info.status)
        status = jnp.where(finite, status, NON_FINITE).astype(jnp.int32)
        return self._outer(y1, turns), info._replace(status=status)

    def generated_pair(self, z0, z1):
        """A pair (2d,) each as the generated piece sees it: inner coordinates, the angles of z1
        lifted to the nearest image of the map's own prediction, the base map factored out."""
        index = next(i for i, piece in enumerate(self.pieces) if isinstance(piece, Generated))
        angles = self._angles()
        y0, _, _ = self._inner(z0)
        predicted, _ = self._apply(y0)
        y1 = self.coordinates.forward(z1)
        turns = jnp.round((y1[angles] - predicted[angles]) / TWO_PI)
        y1 = y1.at[angles].add(-turns * TWO_PI)
        for piece in self.pieces[:index]:
            y0, _ = piece(y0)
        for piece in reversed(self.pieces[index + 1 :]):
            y1, _ = piece.inverse()(y1)
        return y0, y1

    # Batches.

    def step(self, z):
        """One step: (Z, Info) of z (2d,) or (B, 2d), NumPy or JAX; Info's leaves are () or (B,)."""
        return self._batched(_step, z)

    def inverse(self, z):
        """One step back: (z, Info) of Z (2d,) or (B, 2d)."""
        return self.reversed()._batched(_step, z)

    def reversed(self) -> SymplecticMap:
        """The inverse map, as a map of its own."""
        pieces = tuple(piece.inverse() for piece in reversed(self.pieces))
        return dataclasses.replace(self, pieces=pieces)

    def defect(self, z) -> Float[Array, "*batch"]:
        """Symplecticity defect of the executed step at z (2d,) or (B, 2d), in units of ``scale``.

        By forward differentiation through the iterations that ran, never by the implicit rule,
        which would look symplectic however badly the solve had converged.
        """
        return self._batched(_defect, z)

    def determinant(self, z) -> Float[Array, "*batch"]:
        """Chart determinant at z (2d,) or (B, 2d), of the piece where it is smallest."""
        return self._batched(_determinant, z)

    def start(self, z0, *, stop_outside: bool = False) -> Lanes:
        """Lanes at step 0 from z0 (B, 2d). Initial states outside the domain have that status."""
        return _start(self, self._states(z0), stop_outside)

    def advance(
        self, lanes: Lanes, num_saved: int, *, save_every: int = 1, stop_outside: bool = False
    ) -> tuple[Lanes, Float[Array, "batch saved phase"]]:
        """``num_saved`` blocks of ``save_every`` steps: the lanes after them, the saved states."""
        return _advance(self, lanes, num_saved, save_every, stop_outside)

    def rollout(
        self, z0, num_steps: int, *, save_every: int = 1, stop_outside: bool = False
    ) -> tuple[Float[Array, "*batch saved phase"], RolloutInfo]:
        """Predict ``num_steps`` steps from z0 (2d,) or (B, 2d).

        Returns the states (B, 1 + num_steps // save_every, 2d), the initial ones first, and a
        RolloutInfo. A lane whose step fails, or that leaves the domain with ``stop_outside``,
        repeats NaN from there on.
        """
        if save_every < 1 or num_steps < 0:
            raise ValueError(
                f"expected num_steps >= 0 and save_every >= 1, got {num_steps} and {save_every}"
            )
        z = self._states(z0)
        single = z.ndim == 1
        z = z[None] if single else z
        lanes = self.start(z, stop_outside=stop_outside)
        lanes, saved = self.advance(
            lanes, num_steps // save_every, save_every=save_every, stop_outside=stop_outside
        )
        states = jnp.concatenate([z[:, None], saved], axis=1)
        info = RolloutInfo(lanes.status, lanes.left_at, lanes.iterations)
        if single:
            states, info = jax.tree.map(lambda a: a[0], (states, info))
        return states, info

    def _states(self, z):
        dtype = self.scale.dtype
        if dtype == jnp.float64:
            require_x64("a float64 map")
        z = jnp.asarray(z, dtype)
        if z.ndim not in (1, 2) or z.shape[-1] != 2 * self.dim:
            raise ValueError(
                f"expected states of shape ({2 * self.dim},) or (B, {2 * self.dim}), got {z.shape}"
            )
        return z

    def _batched(self, function, z):
        z = self._states(z)
        out = function(self, z[None] if z.ndim == 1 else z)
        return jax.tree.map(lambda a: a[0], out) if z.ndim == 1 else out


def _worst(infos: list[Info]) -> Info:
    return Info(*(jnp.max(jnp.stack(column)) for column in zip(*infos, strict=True)))


@jax.jit
def _step(map_, z):
    return jax.vmap(map_.apply)(z)


@jax.jit
def _defect(map_, z):
    def jacobian(z):
        return jax.jacfwd(lambda x: map_.apply(x, executed=True)[0])(z)

    return symplecticity_defect(jax.vmap(jacobian)(z), map_.scale)


@jax.jit
def _determinant(map_, z):
    def smallest(z):
        y, _, _ = map_._inner(z)
        found = []
        for piece in map_.pieces:
            if isinstance(piece, Generated):
                found.append(piece.determinant(y))
            y, _ = piece(y)
        found = jnp.stack(found)
        return found[jnp.argmin(jnp.abs(found))]

    return jax.vmap(smallest)(z)


def _judge(status, inside, stop_outside: bool):
    """Status after looking at the domain; only lanes that go on are looked at."""
    outside = STOPPED_AT_EDGE if stop_outside else LEFT_DOMAIN
    return jnp.where((status <= LEFT_DOMAIN) & ~inside, outside, status)


@partial(jax.jit, static_argnums=2)
def _start(map_, z, stop_outside):
    def lane(z):
        y, rest, turns = map_._inner(z)
        inside: Bool[Array, ""] = map_.domain.contains(y)
        finite = jnp.all(jnp.isfinite(y))
        status = _judge(jnp.where(finite, OK, NON_FINITE), inside, stop_outside)
        zero = jnp.zeros((), jnp.result_type(int))
        left_at = jnp.where(inside | ~finite, zero - 1, zero)
        return Lanes(y, rest, turns.astype(zero.dtype), status.astype(jnp.int32), left_at,
                     jnp.zeros((), jnp.int32), zero)  # fmt: skip

    return jax.vmap(lane)(z)


@partial(jax.jit, static_argnums=(2, 3, 4))
def _advance(map_, lanes, num_saved, save_every, stop_outside):
    def step(lane: Lanes) -> Lanes:
        going = lane.status <= LEFT_DOMAIN
        y, rest, info = map_._carried(jnp.where(going, lane.y, jnp.nan), lane.rest)
        y, rest, turns = map_._reduce(y, rest)
        inside = map_.domain.contains(y)
        failed = jnp.where(jnp.all(jnp.isfinite(y)), info.status, NON_FINITE)
        status = jnp.where(failed == OK, _judge(lane.status, inside, stop_outside), failed)
        status = jnp.where(going, status, lane.status).astype(jnp.int32)
        leaves = going & (failed == OK) & ~inside & (lane.left_at < 0)
        return Lanes(
            jnp.where(status <= LEFT_DOMAIN, y, jnp.nan),
            rest,
            lane.turns + jnp.where(jnp.isfinite(turns), turns, 0).astype(lane.turns.dtype),
            status,
            jnp.where(leaves, lane.steps + 1, lane.left_at),
            jnp.maximum(lane.iterations, jnp.where(going, info.iterations, 0)),
            lane.steps + 1,
        )

    def observe(lane: Lanes):
        return map_._outer(lane.y, lane.turns.astype(lane.y.dtype))

    def run(lane):
        return scan_steps(step, lane, num_saved, save_every=save_every, observe=observe)

    return jax.vmap(run)(lanes)
