"""Reference trajectories of a scene, and the states, pairs and sequences that are drawn from them.

Every key is a ``jax.random.key``; everything is float64 and needs x64 to be on. States come out as
NumPy arrays: each function here compiles one program per scene and shape, and nothing beside it.
"""

from __future__ import annotations

import dataclasses
import numbers
from collections.abc import Callable
from functools import lru_cache, partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gfnn_jax.coordinates import TWO_PI, to_inner, to_user
from gfnn_jax.phase_space import Pairs, hamiltonian_vector_field, require_x64
from gfnn_jax.scenes.scene import AroundOrbit, DrawnFrom, Scene

States = Float[Array | np.ndarray, "batch phase"]
Drawn = Float[np.ndarray, "num phase"]

TOLERANCE = 1e-15  # 1e-14 costs 15 % less and drifts ten times more in energy
MAX_SOLVER_STEPS = 1024  # for one dt; a state that needs more is about to collide
KEPT_ORBITS = 8  # orbits that states are drawn around, so that the next draw has them
LONGEST_RETURN = 1e6  # to a section: what does not come back uses up its steps before


def _solve(field, start, end, z, until=None):
    """z (2d,) carried by Dopri8 along dz/dt = field(z, t), from time ``start`` to ``end``, or with
    ``until`` to the end of the first step after which ``until(z)`` holds. NaN where that fails.

    The solver stops exactly there and never interpolates.
    """
    event = None if until is None else diffrax.Event(lambda t, y, args, **_: until(y))
    # A dead lane gets an interval of length zero, so that the others do not wait for it.
    end = jnp.where(jnp.all(jnp.isfinite(z)), end, start)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, z, _: field(z, t)),
        diffrax.Dopri8(),
        start,
        end,
        None,
        z,
        stepsize_controller=diffrax.PIDController(rtol=TOLERANCE, atol=TOLERANCE),
        max_steps=MAX_SOLVER_STEPS,
        event=event,
        throw=False,
    )
    assert solution.ys is not None  # saved at its end
    results = diffrax.RESULTS
    wanted = results.successful if until is None else results.event_occurred
    return jnp.where(solution.result == wanted, solution.ys[-1], jnp.nan)


@dataclasses.dataclass(frozen=True)
class _WithArgs:
    """The vector field of a Hamiltonian with parameters: ``field(x, t)`` for x = (z, args), z of
    ``width``, along which args stay as they are. begins: whether the last of them is the time at
    which t = 0."""

    hamiltonian: Callable
    width: int
    begins: bool = False

    def field(self, x, t=0.0):
        z, args = x[: self.width], x[self.width :]
        begin, own = (args[-1], args[:-1]) if self.begins else (0.0, args)
        given = (own,) if own.size else ()
        along = hamiltonian_vector_field(lambda z, t: self.hamiltonian(z, t, *given))
        return jnp.concatenate([along(z, begin + t), jnp.zeros_like(args)])


def _field(hamiltonian):
    given = isinstance(hamiltonian, _WithArgs)
    return hamiltonian.field if given else hamiltonian_vector_field(hamiltonian)


def _integrator(hamiltonian, dt):
    """``advance(t, z)`` by one ``dt``, for z (B, 2d); what fails becomes NaN for good.

    One solve for every dt: a trajectory does not depend on which of its states are saved.
    """
    field = _field(hamiltonian)
    return jax.vmap(lambda t, z: _solve(field, t, t + dt, z), in_axes=(None, 0))


def _stroboscopic(hamiltonian, period, dt):
    """The same for a Hamiltonian of this period in t, dt a whole number of them: one solve for
    every period, from time 0, which therefore never grows so large that its digits are missed."""
    one = _integrator(hamiltonian, period)
    periods = jnp.round(dt / period).astype(int)
    return lambda t, z: jax.lax.fori_loop(0, periods, lambda _, z: one(0.0, z), z)


def _return_map(section):
    """``step(z)``: the next crossing of the section, to roundoff, from z (2d,).

    The orbit is followed to below the section and to beyond it; then back onto it with the
    section's own coordinate as the independent variable (Hénon, Physica D 5, 1982).
    """
    field, i = hamiltonian_vector_field(section.hamiltonian), section.index

    def by_coordinate(x, _):
        rate = field(x)
        return rate / rate[i]

    def step(z):
        x = section.lift(z)
        x = _solve(field, 0.0, LONGEST_RETURN, x, until=lambda x: x[i] < 0)
        x = _solve(field, 0.0, LONGEST_RETURN, x, until=lambda x: x[i] > 0)
        return section.coordinates(_solve(by_coordinate, x[i], 0.0, x))

    return step


@partial(jax.jit, static_argnames=("num_saved", "flow", "step", "section", "hamiltonian", "period"))
def _trajectories(z0, save_every, num_saved, dt, flow, step, section, hamiltonian, period):
    """States after save_every, 2 save_every, ... steps: (num_saved, B, 2d)."""
    if flow is not None:
        times = dt * (save_every * jnp.arange(1, num_saved + 1)).astype(float)
        return jax.lax.map(lambda t: jax.vmap(flow, in_axes=(0, None))(z0, t), times)
    if step is not None or section is not None:
        lanes = jax.vmap(step or _return_map(section))

        def advance(t, z):
            return lanes(z)

    elif period is not None:
        advance = _stroboscopic(hamiltonian, period, dt)
    else:
        advance = _integrator(hamiltonian, dt)

    def save(z, first):
        z = jax.lax.fori_loop(
            first, first + save_every, lambda i, z: advance(dt * i.astype(float), z), z
        )
        return z, z

    return jax.lax.scan(save, z0, save_every * jnp.arange(num_saved))[1]


def _reference(scene: Scene) -> tuple:
    """What a trajectory of the scene depends on."""
    hamiltonian = scene.hamiltonian
    if scene.parameters or scene.any_phase:
        assert hamiltonian is not None
        hamiltonian = _WithArgs(hamiltonian, 2 * scene.dim, scene.any_phase)
    period = None if scene.any_phase else scene.period
    return scene.dt, scene.flow, scene.step, scene.section, hamiltonian, period


def reference_trajectories(
    scene: Scene, z0: States, num_steps: int, *, save_every: int = 1, params=None, t0=None
) -> Float[np.ndarray, "batch saved phase"]:
    """Reference trajectories from ``z0`` (B, 2d): (B, 1 + num_steps // save_every, 2d), z0 first.

    The scene's exact flow or exact map where it has one, else Dopri8, to its section where it has
    one. Time starts at 0, or at t0 (B,) where the scene has any phase. params: (k,) or (B, k),
    where the scene has parameters. Angles are not reduced. From where a state escapes or collides
    its own row is NaN, and no other lane's.
    """
    require_x64("a reference trajectory")
    z0 = np.asarray(z0, np.float64)
    x0 = _with_params(scene, z0, params, t0)
    saved = _trajectories(x0, save_every, num_steps // save_every, *_reference(scene))
    saved = np.moveaxis(np.asarray(saved), 0, 1)[..., : z0.shape[1]]
    return np.concatenate([z0[:, None], saved], axis=1)


def _with_params(scene: Scene, z0, params, t0=None):
    """States, parameters and the time at which they begin, beside each other (B, 2d + k)."""
    if (t0 is not None) != scene.any_phase:
        wanted = "t0, the time of the drive" if scene.any_phase else "no t0"
        raise ValueError(f"expected {wanted} for the scene {scene.name}")
    count = len(scene.parameters)
    if (params is not None) != bool(count):
        wanted = f"params {', '.join(scene.parameters)}" if count else "no params"
        raise ValueError(f"expected {wanted} for the scene {scene.name}")
    if count:
        z0 = np.concatenate([z0, np.broadcast_to(params, (len(z0), count))], axis=1)
    if t0 is not None:
        z0 = np.concatenate([z0, np.broadcast_to(t0, len(z0))[:, None]], axis=1)
    return z0


def flow_step(field: Callable, dt: float, tolerance: float) -> Callable:
    """``step(z)``: the state (2d,) one ``dt`` later along ż = field(z), by an adaptive Runge–Kutta
    method of orders 5 and 4 (Dopri5, also known as RK45).

    What a learned vector field predicts; no reference. Not symplectic beyond ``tolerance``, the
    local error allowed, absolute and relative. Where it fails the state becomes NaN. Can be
    differentiated forwards, through the steps that ran.
    """
    term = diffrax.ODETerm(lambda t, z, _: field(z))
    controller = diffrax.PIDController(rtol=tolerance, atol=tolerance)

    def step(z):
        solution = diffrax.diffeqsolve(
            term,
            diffrax.Dopri5(),
            0.0,
            dt,
            None,
            z,
            stepsize_controller=controller,
            max_steps=MAX_SOLVER_STEPS,
            adjoint=diffrax.ForwardMode(),
            throw=False,
        )
        assert solution.ys is not None  # saved at its end
        return jnp.where(solution.result == diffrax.RESULTS.successful, solution.ys[-1], jnp.nan)

    return step


def reference_error(scene: Scene, z0: States, num_steps: int) -> float:
    """Measured error of the reference: the largest distance, over ``num_steps`` steps from z0,
    to a second reference that differs from it by errors only. z0 has shape (B, 2d).

    For an integrated scene that second one takes every solve as two, so that both its steps and
    its roundoff differ. An exact flow or map errs by roundoff only, as does a return to a section:
    there the initial state is moved by one unit of it. Lanes that do not stay finite are left out;
    NaN where none does. A scene of any phase begins at the drive's time 0.
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


@partial(jax.jit, static_argnames=("draw", "num"))
def _drawn(key, *, draw, num):
    return draw(key, num)


@partial(jax.jit, static_argnames=("length", "shape"))
def _perturbations(key, *, length, shape):
    """Which states of an orbit of this length (num,), and standard normal noise (num, 2d)."""
    key_time, key_noise = jax.random.split(key)
    time = jax.random.randint(key_time, shape[:1], 0, length)
    return time, jax.random.normal(key_noise, shape, jnp.float64)


@lru_cache(maxsize=KEPT_ORBITS)
def _orbit(law: AroundOrbit, *reference):
    """The states (num_steps + 1, 2d) of the law's orbit."""
    start = np.array([law.start])
    states = np.asarray(_trajectories(start, 1, law.num_steps, *reference))
    return np.concatenate([start, states[:, 0]])


def _reduce_angles(coordinates, z):
    """Angles of z (num, 2d) brought to [0, 2π)."""
    if not coordinates.angles:
        return z
    y, angles = to_inner(coordinates, z), list(coordinates.angles)
    y[:, angles] = np.mod(y[:, angles], TWO_PI)
    return to_user(coordinates, y)


def _check_drawn(scene, num, key) -> None:
    if not isinstance(scene, Scene):
        raise ValueError(f"expected a scene, as gfnn.scenes.make('two-body'), got {scene!r}")
    if not isinstance(num, numbers.Integral) or num < 1:
        raise ValueError(f"expected a whole number of states from 1 on, got {num!r}")
    if not isinstance(key, (jax.Array, np.ndarray)):
        raise ValueError(f"expected a key, as jax.random.key(0), got {key!r}")


def _draw(scene, law, num, key):
    _check_drawn(scene, num, key)
    require_x64("drawing states")
    if isinstance(law, DrawnFrom):
        return np.asarray(_drawn(key, draw=law.draw, num=num), np.float64)
    orbit = _orbit(law, *_reference(scene))
    time, noise = _perturbations(key, length=len(orbit), shape=(num, 2 * scene.dim))
    return _reduce_angles(
        scene.coordinates, orbit[np.asarray(time)] + law.sigma * np.asarray(noise)
    )


def sample_states(scene: Scene, num: int, key) -> Drawn:
    """``num`` states of the scene's training law, (num, 2d)."""
    return _draw(scene, scene.sampling, num, key)[:, : 2 * scene.dim]


def sample_params(
    scene: Scene, num: int, key, *, test: bool = False
) -> Float[np.ndarray, "num params"] | None:
    """The parameters (num, k) of the states that `sample_states`, or with ``test``
    `sample_test_states`, draws with the same key; None where the scene has none."""
    if not scene.parameters:
        return None
    law = (scene.test_states if test else None) or scene.sampling
    return _draw(scene, law, num, key)[:, 2 * scene.dim :]


def sample_t0(scene: Scene, num: int, key) -> Float[np.ndarray, "num"] | None:
    """Times of the drive (num,), uniform over its period, at which the states drawn with the same
    key begin; None where the scene has not any phase."""
    if not scene.any_phase:
        return None
    assert scene.period is not None
    return scene.period * np.asarray(_uniform(jax.random.fold_in(key, 2), num=num))


def sample_test_states(scene: Scene, num: int, key) -> Drawn:
    """``num`` states for rollouts to start from, (num, 2d): the training law unless declared."""
    return _draw(scene, scene.test_states or scene.sampling, num, key)[:, : 2 * scene.dim]


def sample_sequences(
    scene: Scene, num: int, length: int, key
) -> Float[np.ndarray, "num length phase"]:
    """``num`` reference sequences of ``length`` states each, from states of the training law."""
    return reference_trajectories(
        scene, sample_states(scene, num, key), length - 1, params=sample_params(scene, num, key),
        t0=sample_t0(scene, num, key),
    )  # fmt: skip


def sample_pairs(
    scene: Scene, num_pairs: int, key, *, dt_range: tuple[float, float] | None = None
) -> Pairs:
    """``num_pairs`` states of the training law and their images one ``dt`` later.

    dt_range: the shortest and the longest time between the states of a pair, which is then drawn
    uniformly for each: irregular sampling. Raises ValueError where the scene has no flow.
    """
    _check_drawn(scene, num_pairs, key)
    params = sample_params(scene, num_pairs, key)
    args = None if params is None else dict(zip(scene.parameters, params.T, strict=True))
    t0 = sample_t0(scene, num_pairs, key)
    period = None if t0 is None else scene.period
    if dt_range is None:
        z = sample_sequences(scene, num_pairs, 2, key)
        return Pairs(z[:, 0], z[:, 1], scene.dt, args, t0, period)
    low, high = dt_range
    stroboscopic = scene.period is not None and not scene.any_phase
    if scene.timeless or stroboscopic or not 0 < low < high < np.inf:
        raise ValueError(
            f"expected 0 < shortest < longest dt, of an autonomous flow; got {low:g} and {high:g} "
            f"for the scene {scene.name}"
        )
    z0 = sample_states(scene, num_pairs, key)
    dt = low + (high - low) * np.asarray(_uniform(jax.random.fold_in(key, 1), num=num_pairs))
    reference = _reference(scene)
    x0 = _with_params(scene, z0, params, t0)
    z1 = _after(x0, dt, flow=reference[1], hamiltonian=reference[4])
    return Pairs(z0, np.asarray(z1)[:, : z0.shape[1]], dt, args, t0, period)


@partial(jax.jit, static_argnames=("num",))
def _uniform(key, *, num):
    return jax.random.uniform(key, (num,), jnp.float64)


@partial(jax.jit, static_argnames=("flow", "hamiltonian"))
def _after(x, dt, *, flow, hamiltonian):
    """States x (B, ...) each a time dt (B,) later."""
    if flow is not None:
        return jax.vmap(flow)(x, dt)
    field = _field(hamiltonian)
    return jax.vmap(lambda x, dt: _solve(field, 0.0, dt, x))(x, dt)
