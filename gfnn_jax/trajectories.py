"""Reference trajectories of a scene, and the states, pairs and sequences that are drawn from them.

Every key is a ``jax.random.key``; everything is float64 and needs x64 to be on.
"""

from __future__ import annotations

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gfnn_jax.phase_space import Pairs, States, hamiltonian_vector_field, require_x64
from gfnn_jax.scenes.scene import DrawnFrom, Scene

TOLERANCE = 1e-14
MAX_STEPS = 4096  # of the solver between two output times; a state that needs more comes out as NaN


def _integrate(hamiltonian, z0, times, tolerance):
    """Dopri8 from time 0 to each of ``times``, one solve from each to the next; (T, B, 2d)."""
    field = hamiltonian_vector_field(hamiltonian)
    term = diffrax.ODETerm(lambda t, z, _: field(z, t))
    controller = diffrax.PIDController(rtol=tolerance, atol=tolerance)

    def between(z, t0, t1):
        solution = diffrax.diffeqsolve(
            term, diffrax.Dopri8(), t0, t1, None, z,
            stepsize_controller=controller, max_steps=MAX_STEPS, throw=False,
        )  # fmt: skip
        ok = solution.result == diffrax.RESULTS.successful
        return jnp.where(ok, solution.ys[-1], jnp.nan)

    def advance(z, span):
        z = jax.vmap(between, in_axes=(0, None, None))(z, *span)
        return z, z

    starts = jnp.concatenate([jnp.zeros_like(times[:1]), times[:-1]])
    return jax.lax.scan(advance, z0, (starts, times))[1]


@partial(jax.jit, static_argnames=("flow", "step", "hamiltonian", "num_saved"))
def _trajectories(z0, dt, save_every, num_saved, flow, step, hamiltonian):
    if step is not None and flow is None:
        advance = jax.vmap(step)

        def save(z, _):
            z = jax.lax.fori_loop(0, save_every, lambda _, z: advance(z), z)
            return z, z

        saved = jax.lax.scan(save, z0, None, length=num_saved)[1]
    else:
        times = dt * save_every * jnp.arange(1, num_saved + 1, dtype=jnp.float64)
        if flow is not None:
            saved = jax.lax.map(lambda t: jax.vmap(flow, in_axes=(0, None))(z0, t), times)
        else:
            saved = _integrate(hamiltonian, z0, times, TOLERANCE)
    return jnp.moveaxis(jnp.concatenate([z0[None], saved]), 0, 1)


def reference_trajectories(
    scene: Scene, z0: States, num_steps: int, *, save_every: int = 1
) -> Float[Array, "batch saved 2d"]:
    """Reference trajectories from ``z0`` (B, 2d): (B, 1 + num_steps // save_every, 2d), z0 first.

    The scene's exact flow or exact map where it has one, else Dopri8. Time starts at 0. Angles are
    not reduced. From where a state escapes or collides its own row is NaN, and no other lane's.
    """
    require_x64("a reference trajectory")
    z0 = jnp.asarray(z0, jnp.float64)
    return _trajectories(
        z0, scene.dt, save_every, num_steps // save_every, scene.flow, scene.step, scene.hamiltonian
    )


def _reduce_angles(coordinates, z):
    """Angles of z (2d,) brought to [0, 2π)."""
    if not coordinates.angles:
        return z
    y, angles = coordinates.forward(z), jnp.array(coordinates.angles)
    return coordinates.inverse(y.at[angles].set(y[angles] % (2 * jnp.pi)))


def _draw(scene, law, num, key):
    require_x64("drawing states")
    if isinstance(law, DrawnFrom):
        return law.draw(key, num)
    orbit = reference_trajectories(scene, jnp.array([law.start]), law.num_steps)[0]
    key_time, key_noise = jax.random.split(key)
    time = jax.random.randint(key_time, (num,), 0, len(orbit))
    noise = jax.random.normal(key_noise, (num, 2 * scene.dim), jnp.float64)
    return jax.vmap(partial(_reduce_angles, scene.coordinates))(orbit[time] + law.sigma * noise)


def sample_states(scene: Scene, num: int, key) -> States:
    """``num`` states of the scene's training law, (num, 2d)."""
    return _draw(scene, scene.sampling, num, key)


def sample_test_states(scene: Scene, num: int, key) -> States:
    """``num`` states that rollouts start from, (num, 2d): the training law where none is declared."""
    return _draw(scene, scene.test_states or scene.sampling, num, key)


def sample_sequences(scene: Scene, num: int, length: int, key) -> Float[Array, "num length 2d"]:
    """``num`` reference sequences of ``length`` states each, from states of the training law."""
    return reference_trajectories(scene, sample_states(scene, num, key), length - 1)


def sample_pairs(scene: Scene, num_pairs: int, key) -> Pairs:
    """``num_pairs`` states of the training law and their images one ``dt`` later."""
    z = sample_sequences(scene, num_pairs, 2, key)
    return Pairs(z[:, 0], z[:, 1], scene.dt)
