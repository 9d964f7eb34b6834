"""Reference trajectories of a scene: its exact flow or map, else Dopri8 close to roundoff.

Everything is float64 and needs x64 to be on. States come out as NumPy arrays. The reference of a
scene is one program for any number of states and steps, which solves a few states at a time.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gfnn_jax.errors import InputError
from gfnn_jax.phase_space import hamiltonian_vector_field, require_x64
from gfnn_jax.scenes.scene import Scene, Section

States = Float[Array | np.ndarray, "batch phase"]


class Options:
    """Numbers of a reference."""

    tolerance: float = 1e-15  # 1e-14 costs 15 % less and drifts ten times more in energy
    max_solver_steps: int = 1024  # for one dt; a state that needs more is about to collide
    # solved together: more take hardly less time each, and one alone half that of 8
    lanes_on_cpu: int = 8
    lanes_on_accelerator: int = 4096
    saved_at_once: int = 64  # states of a trajectory that one call of the program returns
    longest_return: float = (
        1e6  # time of a return to a section; lost orbits run out of steps before
    )


def _solve(field, span, z, until=None, *, tolerance=Options.tolerance, predicts=False):
    """Integrate dz/dt = field(z, t) from z (2d,) over the times ``span``, (start, end): by Dopri8,
    or where it ``predicts`` by Dopri5, which is then differentiated forwards.

    With ``until`` the solver stops at the end of the first step after which ``until(z)`` holds. It
    never interpolates. The result is NaN where the solver fails."""
    import diffrax  # takes half a second: loaded when first used

    start, end = span
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, z, _: field(z, t)),
        diffrax.Dopri5() if predicts else diffrax.Dopri8(),
        start,
        # A dead lane gets an interval of length zero, so that the others do not wait for it.
        jnp.where(jnp.all(jnp.isfinite(z)), end, start),
        None,
        z,
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        max_steps=Options.max_solver_steps,
        event=None if until is None else diffrax.Event(lambda t, y, args, **_: until(y)),
        adjoint=diffrax.ForwardMode() if predicts else diffrax.RecursiveCheckpointAdjoint(),
        throw=False,
    )
    assert solution.ys is not None  # saved at its end
    results = diffrax.RESULTS
    wanted = results.successful if until is None else results.event_occurred
    return jnp.where(solution.result == wanted, solution.ys[-1], jnp.nan)


@dataclasses.dataclass(frozen=True)
class _Dynamics:
    """All of a scene that a compiled program depends on: what moves x = (z, parameters, time of the
    drive at t = 0), z of ``width`` entries. begins: True where x has that time."""

    flow: Callable | None
    step: Callable | None
    section: Section | None
    hamiltonian: Callable | None
    width: int
    begins: bool

    def field(self, x, t=0.0):
        """Vector field of the Hamiltonian; parameters are constant in time."""
        hamiltonian = self.hamiltonian
        assert hamiltonian is not None
        z, args = x[: self.width], x[self.width :]
        begin, own = (args[-1], args[:-1]) if self.begins else (0.0, args)
        given = (own,) if own.size else ()
        along = hamiltonian_vector_field(lambda z, t: hamiltonian(z, t, *given))
        rate = along(z, begin + t if self.begins else t)
        return jnp.concatenate([rate, jnp.zeros_like(args)]) if args.size else rate

    def integrated(self, dt):
        """Make ``advance(t, x)`` by one ``dt``, for x (B, ...). A state that fails becomes NaN for
        good. Each dt is one solve, so that a trajectory does not depend on which of its states are
        saved."""
        return jax.vmap(lambda t, x: _solve(self.field, (t, t + dt), x), in_axes=(None, 0))

    def advance(self, dt, period):
        """Make ``advance(t, x)``, x (B, ...) one dt or one step of the map later.

        With a period dt is a whole number of them. Each is one solve from time 0, so that the time
        never grows and loses digits.
        """
        if self.step is not None or self.section is not None:
            step: Callable = self.step or self._returned
            lanes = jax.vmap(step)
            return lambda t, x: lanes(x)
        if period is None:
            return self.integrated(dt)
        one, periods = self.integrated(period), jnp.round(dt / period).astype(int)
        return lambda t, x: jax.lax.fori_loop(0, periods, lambda _, x: one(0.0, x), x)

    def _returned(self, z):
        """The next crossing of the section, to roundoff, from z (2d,).

        The orbit is followed to below the section and then to beyond it. It is brought back onto it
        with the section's own coordinate as the independent variable (Hénon, Physica D 5, 1982)."""
        assert self.section is not None
        field, i = hamiltonian_vector_field(self.section.hamiltonian), self.section.index

        def by_coordinate(x, _):
            rate = field(x)
            return rate / rate[i]

        x, within = self.section.lift(z), (0.0, Options.longest_return)
        x = _solve(field, within, x, until=lambda x: x[i] < 0)
        x = _solve(field, within, x, until=lambda x: x[i] > 0)
        return self.section.coordinates(_solve(by_coordinate, (x[i], 0.0), x))

    @partial(jax.jit, static_argnames=("self",))
    def continued(self, start, x0, first, count, every, times):
        """States after ``every``, 2 every, ..., count every steps, from step ``first`` on.

        Returns (saved_at_once, B, ...), of which the first ``count`` rows count. start: the states
        at step 0, for an exact flow; x0: those at step ``first``. times: dt, and the period.
        """
        (dt, period), flow = times, self.flow
        advance: Any = None if flow is not None else self.advance(dt, period)

        def ahead(x, i):
            if flow is not None:
                return jax.vmap(flow, (0, None))(start, dt * (i + every).astype(float))
            return jax.lax.fori_loop(i, i + every, lambda i, x: advance(dt * i.astype(float), x), x)

        def save(k, carry):
            x, saved = carry
            x = ahead(x, first + every * k)
            return x, saved.at[k].set(x)

        saved = jnp.zeros((Options.saved_at_once, *x0.shape))
        return jax.lax.fori_loop(0, count, save, (x0, saved))[1]

    @partial(jax.jit, static_argnames=("self",))
    def after(self, x, dt):
        """Advance states x (B, ...), each by its own time dt (B,)."""
        if self.flow is not None:
            return jax.vmap(self.flow)(x, dt)
        return jax.vmap(lambda x, dt: _solve(self.field, (0.0, dt), x))(x, dt)


def _blocks(num):
    """Yield ``rows``, the numbers of the states that are solved together, all of one length.

    The last state fills up the last block. A state has the same bits beside any others, for the
    solver controls the steps of each lane alone."""
    lanes = Options.lanes_on_cpu if jax.default_backend() == "cpu" else Options.lanes_on_accelerator
    for first in range(0, num, lanes):
        yield np.minimum(np.arange(first, first + lanes), num - 1)


@dataclasses.dataclass(frozen=True)
class Reference:
    """Everything that a trajectory of a scene depends on; it compares by value."""

    dynamics: _Dynamics
    dt: float
    period: float | None

    @classmethod
    def of(cls, scene: Scene) -> Reference:
        """Raises InputError where the scene's flow, map or Hamiltonian is written with NumPy."""
        z, t = jax.ShapeDtypeStruct((2 * scene.dim,), jnp.float64), 0.0
        args = [jax.ShapeDtypeStruct((n,), jnp.float64) for n in [len(scene.parameters)] if n]
        for name, given in (("flow", (z, t)), ("step", (z,)), ("hamiltonian", (z, t, *args))):
            function = getattr(scene, name)
            try:
                _ = None if function is None else jax.eval_shape(function, *given)
            except jax.errors.TracerArrayConversionError:
                raise InputError(
                    f"expected the {name} of the scene {scene.name} written with jax.numpy, which "
                    "JAX can trace; it uses NumPy's functions"
                ) from None
        parts = scene.flow, scene.step, scene.section, scene.hamiltonian
        dynamics = _Dynamics(*parts, 2 * scene.dim, scene.any_phase)
        return cls(dynamics, scene.dt, None if scene.any_phase else scene.period)

    def trajectories(self, x0, save_every: int, num_saved: int) -> np.ndarray:
        """States after save_every, 2 save_every, ... steps: (num_saved, B, ...)."""
        saved, times = np.empty((num_saved, *x0.shape)), (self.dt, self.period)
        for rows in _blocks(len(x0)):
            start = x = x0[rows]
            for done in range(0, num_saved, Options.saved_at_once):
                count, first = min(Options.saved_at_once, num_saved - done), done * save_every
                part = self.dynamics.continued(start, x, first, count, save_every, times)
                saved[done : done + count, rows] = np.asarray(part)[:count]
                x = saved[done + count - 1, rows]
        return saved

    def after(self, x0, dt) -> np.ndarray:
        """States (B, ...) each its own time dt (B,) later."""
        x1 = np.empty_like(x0)
        for rows in _blocks(len(x0)):
            x1[rows] = self.dynamics.after(x0[rows], dt[rows])
        return x1


def reference_trajectories(
    scene: Scene, z0: States, num_steps: int, *, save_every: int = 1, params=None, t0=None
) -> Float[np.ndarray, "batch saved phase"]:
    """Reference trajectories from ``z0`` (B, 2d): (B, 1 + num_steps // save_every, 2d), z0 first.

    The reference is the scene's exact flow or exact map where it has one, else Dopri8; to its
    section where it has one. Time starts at 0, or at t0 (B,) where the scene has any phase. params:
    (k,) or (B, k), where the scene has parameters. Angles are not reduced. A lane is NaN from where
    its state escapes or collides; other lanes are unaffected. Raises RuntimeError where x64 is off,
    ValueError where params or t0 do not fit the scene.
    """
    require_x64("a reference trajectory")
    z0 = np.asarray(z0, np.float64)
    x0 = with_params(scene, z0, params, t0)
    saved = Reference.of(scene).trajectories(x0, save_every, num_steps // save_every)
    saved = np.moveaxis(saved, 0, 1)[..., : z0.shape[1]]
    return np.concatenate([z0[:, None], saved], axis=1)


def with_params(scene: Scene, z0, params, t0=None):
    """Concatenate states, parameters and initial times of the drive (B, 2d + k). Raises ValueError
    where they do not fit the scene."""
    names, num = scene.parameters, len(z0)
    phase, known = "t0, the time of the drive", f"params {', '.join(names)}"
    for given, needed, what in ((params, bool(names), known), (t0, scene.any_phase, phase)):
        if (given is not None) != needed:
            what = what if needed else f"no {what.split()[0].strip(',')}"
            raise ValueError(f"expected {what} for the scene {scene.name}")
    more = [] if params is None else [np.broadcast_to(params, (num, len(names)))]
    more += [] if t0 is None else [np.broadcast_to(t0, num)[:, None]]
    return np.concatenate([z0, *more], axis=1)


def flow_step(field: Callable, dt: float, tolerance: float) -> Callable:
    """Make ``step(z)``, the state (2d,) one ``dt`` later along ż = field(z), by Dopri5 (RK45).

    It predicts with a learned vector field and is no reference. The step is symplectic only to
    ``tolerance``, the allowed local error, absolute and relative. Where the solver fails the state
    becomes NaN. The step can be differentiated forwards, through the solver's steps that ran.
    """

    def along(z, t):
        return field(z)

    return lambda z: _solve(along, (0.0, dt), z, tolerance=tolerance, predicts=True)


def reference_error(scene: Scene, z0: States, num_steps: int) -> float:
    """Measured error of the reference: its largest distance to a second one over ``num_steps``.

    Both start from z0 (B, 2d) and differ by numerical errors only. For an integrated scene the
    second reference does each solve as two, so that both its steps and its roundoff differ. An
    exact flow or map, and a return to a section, err by roundoff only; there the initial state is
    moved by one unit of roundoff. Lanes that do not stay finite are left out; the result is NaN
    where none does. A scene of any phase begins at the drive's time 0.
    """
    t0 = 0.0 if scene.any_phase else None
    first = reference_trajectories(scene, z0, num_steps, t0=t0)
    if scene.flow is None and not scene.timeless:
        period = None if scene.any_phase else scene.period
        halves = 2 if period is None else 2 * round(scene.dt / period)
        own = scene.period if scene.any_phase else None
        halved = dataclasses.replace(scene, dt=scene.dt / halves, period=own)
        second = reference_trajectories(halved, z0, halves * num_steps, save_every=halves, t0=t0)
    else:
        moved = np.asarray(z0, np.float64) * (1 + np.finfo(np.float64).eps)
        second = reference_trajectories(scene, moved, num_steps)
    error = np.max(np.linalg.norm(second - first, axis=-1), axis=-1)
    return float(np.nanmax(error)) if not np.isnan(error).all() else float("nan")
