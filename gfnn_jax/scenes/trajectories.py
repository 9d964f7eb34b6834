"""Reference trajectories of a scene: its exact flow or map, else Dopri8 close to roundoff.

Everything is float64 and needs x64 to be on. States come out as NumPy arrays. The reference of a
scene is one program for any number of states and steps, which solves a few states at a time.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gfnn_jax.errors import InputError
from gfnn_jax.phase_space import hamiltonian_vector_field, require_x64
from gfnn_jax.scenes.scene import Scene

States = Float[Array | np.ndarray, "batch phase"]

TOLERANCE = 1e-15  # 1e-14 costs 15 % less and drifts ten times more in energy
MAX_SOLVER_STEPS = 1024  # for one dt; a state that needs more is about to collide
# States solved together: on a CPU more take hardly less time each, and one alone half that of 8.
LANES_ON_CPU = 8
LANES_ON_ACCELERATOR = 4096
SAVED_AT_ONCE = 64  # states of a trajectory that one call of the program returns
LONGEST_RETURN = 1e6  # time allowed for a return to a section; lost orbits run out of steps before


def _solve(field, start, end, z, until=None):
    """Integrate dz/dt = field(z, t) by Dopri8 from z (2d,) at time ``start`` to time ``end``.

    With ``until`` the solver stops at the end of the first step after which ``until(z)`` holds. It
    never interpolates. The result is NaN where the solver fails.
    """
    import diffrax  # takes half a second: loaded when first used

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
    """Vector field of a Hamiltonian with parameters: ``field(x, t)`` for x = (z, args).

    z has ``width`` entries; args are constant in time. begins: True where the last of the args is
    the time of the drive at t = 0.
    """

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
    """Make ``advance(t, z)`` by one ``dt``, for z (B, 2d). A state that fails becomes NaN for good.

    Each dt is one solve, so that a trajectory does not depend on which of its states are saved.
    """
    field = _field(hamiltonian)
    return jax.vmap(lambda t, z: _solve(field, t, t + dt, z), in_axes=(None, 0))


def _stroboscopic(hamiltonian, period, dt):
    """Make ``advance(t, z)`` by ``dt``, a whole number of periods of the Hamiltonian in t.

    Each period is one solve from time 0, so that the time never grows and loses digits.
    """
    one = _integrator(hamiltonian, period)
    periods = jnp.round(dt / period).astype(int)
    return lambda t, z: jax.lax.fori_loop(0, periods, lambda _, z: one(0.0, z), z)


def _return_map(section):
    """Make ``step(z)``, the next crossing of the section, to roundoff, from z (2d,).

    The orbit is followed to below the section and then to beyond it. It is brought back onto it
    with the section's own coordinate as the independent variable (Hénon, Physica D 5, 1982).
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


@partial(jax.jit, static_argnames=("flow", "step", "section", "hamiltonian", "period"))
def _continued(start, z0, first, count, every, dt, flow, step, section, hamiltonian, period):
    """States after ``every``, 2 every, ..., count every steps, from step ``first`` on.

    Returns (SAVED_AT_ONCE, B, 2d), of which the first ``count`` rows count. start: the states at
    step 0, for an exact flow; z0: those at step ``first``.
    """
    if flow is not None:
        lanes = jax.vmap(flow, in_axes=(0, None))

        def ahead(z, i):
            return lanes(start, dt * (i + every).astype(float))

    else:
        advance = _advance(dt, step, section, hamiltonian, period)

        def ahead(z, i):
            return jax.lax.fori_loop(i, i + every, lambda i, z: advance(dt * i.astype(float), z), z)

    def save(k, carry):
        z, saved = carry
        z = ahead(z, first + every * k)
        return z, saved.at[k].set(z)

    saved = jnp.zeros((SAVED_AT_ONCE, *z0.shape))
    return jax.lax.fori_loop(0, count, save, (z0, saved))[1]


def _advance(dt, step, section, hamiltonian, period):
    """Make ``advance(t, z)``, z (B, 2d) one dt or one step of the map later."""
    if step is not None or section is not None:
        lanes = jax.vmap(step or _return_map(section))
        return lambda t, z: lanes(z)
    if period is not None:
        return _stroboscopic(hamiltonian, period, dt)
    return _integrator(hamiltonian, dt)


def blocks(num):
    """Yield ``rows``, the numbers of the states that are solved together, all of one length.

    The last state fills up the last block. A state has the same bits beside any others, for the
    solver controls the steps of each lane alone.
    """
    lanes = LANES_ON_CPU if jax.default_backend() == "cpu" else LANES_ON_ACCELERATOR
    for first in range(0, num, lanes):
        yield np.minimum(np.arange(first, first + lanes), num - 1)


def trajectories_from(z0, save_every: int, num_saved: int, *reference) -> np.ndarray:
    """States after save_every, 2 save_every, ... steps: (num_saved, B, 2d)."""
    saved = np.empty((num_saved, *z0.shape))
    for rows in blocks(len(z0)):
        start = z = z0[rows]
        for done in range(0, num_saved, SAVED_AT_ONCE):
            count = min(SAVED_AT_ONCE, num_saved - done)
            part = _continued(start, z, done * save_every, count, save_every, *reference)
            saved[done : done + count, rows] = np.asarray(part)[:count]
            z = saved[done + count - 1, rows]
    return saved


def _check_traceable(scene: Scene) -> None:
    z, t = jax.ShapeDtypeStruct((2 * scene.dim,), jnp.float64), 0.0
    given = tuple(jax.ShapeDtypeStruct((n,), jnp.float64) for n in [len(scene.parameters)] if n)
    for name, function, arguments in (
        ("flow", scene.flow, (z, t)),
        ("step", scene.step, (z,)),
        ("hamiltonian", scene.hamiltonian, (z, t, *given)),
    ):
        try:
            _ = None if function is None else jax.eval_shape(function, *arguments)
        except jax.errors.TracerArrayConversionError:
            raise InputError(
                f"expected the {name} of the scene {scene.name} written with jax.numpy, which JAX "
                "can trace; it uses NumPy's functions"
            ) from None


def reference_of(scene: Scene) -> tuple:
    """Everything that a trajectory of the scene depends on, as arguments of `trajectories_from`.

    Raises InputError where the scene's flow, map or Hamiltonian is written with NumPy.
    """
    _check_traceable(scene)
    hamiltonian = scene.hamiltonian
    if scene.parameters or scene.any_phase:
        assert hamiltonian is not None
        hamiltonian = _WithArgs(hamiltonian, 2 * scene.dim, scene.any_phase)
    period = None if scene.any_phase else scene.period
    return scene.dt, scene.flow, scene.step, scene.section, hamiltonian, period


@partial(jax.jit, static_argnames=("flow", "hamiltonian"))
def after_own_dt(x, dt, *, flow, hamiltonian):
    """Advance states x (B, ...), each by its own time dt (B,)."""
    if flow is not None:
        return jax.vmap(flow)(x, dt)
    field = _field(hamiltonian)
    return jax.vmap(lambda x, dt: _solve(field, 0.0, dt, x))(x, dt)


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
    saved = trajectories_from(x0, save_every, num_steps // save_every, *reference_of(scene))
    saved = np.moveaxis(saved, 0, 1)[..., : z0.shape[1]]
    return np.concatenate([z0[:, None], saved], axis=1)


def with_params(scene: Scene, z0, params, t0=None):
    """Concatenate states, parameters and initial times of the drive (B, 2d + k)."""
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
    """Make ``step(z)``, the state (2d,) one ``dt`` later along ż = field(z), by Dopri5 (RK45).

    It predicts with a learned vector field and is no reference. The step is symplectic only to
    ``tolerance``, the allowed local error, absolute and relative. Where the solver fails the state
    becomes NaN. The step can be differentiated forwards, through the solver's steps that ran.
    """
    import diffrax

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
