"""States, parameters, pairs and sequences that are drawn from a scene.

Every key is a ``jax.random.key``; everything is float64 and needs x64 to be on. A draw by a scene's
own function is one program for each number of states.
"""

import numbers
from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gfnn_jax.coordinates import TWO_PI, to_inner, to_user
from gfnn_jax.phase_space import Pairs, require_x64
from gfnn_jax.scenes.scene import AroundOrbit, DrawnFrom, Scene
from gfnn_jax.scenes.trajectories import Reference, reference_trajectories, with_params

Drawn = Float[np.ndarray, "num phase"]


@partial(jax.jit, static_argnames=("draw", "num"))
def _drawn(key, *, draw, num):
    return draw(key, num)


def _enough(num: int) -> int:
    """Number of rows that are drawn where ``num`` are wanted, so that few programs are compiled.

    JAX draws each entry from its index alone: the first rows of more are the same bits."""
    return max(1024, 1 << (num - 1).bit_length())


@partial(jax.jit, static_argnames=("shape",))
def _perturbations(key, *, length, shape):
    """Random indices (num,) of states of an orbit, and standard normal noise (num, 2d)."""
    key_time, key_noise = jax.random.split(key)
    time = jax.random.randint(key_time, shape[:1], 0, length)
    return time, jax.random.normal(key_noise, shape, jnp.float64)


@lru_cache(maxsize=8)
def _orbit(law: AroundOrbit, reference: Reference):
    """States (num_steps + 1, 2d) of the law's orbit."""
    start = np.array([law.start])
    return np.concatenate([start, reference.trajectories(start, 1, law.num_steps)[:, 0]])


def _reduce_angles(coordinates, z):
    """Bring the angles of z (num, 2d) to [0, 2π)."""
    if not coordinates.angles:
        return z
    y, angles = to_inner(coordinates, z), list(coordinates.angles)
    y[:, angles] = np.mod(y[:, angles], TWO_PI)
    return to_user(coordinates, y)


def _check_drawn(scene, num, key) -> None:
    if not isinstance(scene, Scene):
        raise ValueError(f"expected a scene, e.g. gfnn.scenes.make('two-body'), got {scene!r}")
    if not isinstance(num, numbers.Integral) or num < 1:
        raise ValueError(f"expected a whole number of states ≥ 1, got {num!r}")
    if not isinstance(key, (jax.Array, np.ndarray)):
        raise ValueError(f"expected a key, e.g. jax.random.key(0), got {key!r}")


def _draw(scene, law, num, key):
    _check_drawn(scene, num, key)
    require_x64("drawing states")
    if isinstance(law, DrawnFrom):
        return np.asarray(_drawn(key, draw=law.draw, num=num), np.float64)
    orbit = _orbit(law, Reference.of(scene))
    time, noise = _perturbations(key, length=len(orbit), shape=(_enough(num), 2 * scene.dim))
    z = orbit[np.asarray(time)[:num]] + law.sigma * np.asarray(noise)[:num]
    return _reduce_angles(scene.coordinates, z)


def sample_states(scene: Scene, num: int, key) -> Drawn:
    """Draw ``num`` states of the scene's training law, (num, 2d)."""
    return _draw(scene, scene.sampling, num, key)[:, : 2 * scene.dim]


def sample_params(
    scene: Scene, num: int, key, *, test: bool = False
) -> Float[np.ndarray, "num params"] | None:
    """Draw the parameters (num, k) that belong to `sample_states` with the same key.

    With ``test`` they belong to `sample_test_states`. None where the scene has no parameters.
    """
    if not scene.parameters:
        return None
    law = (scene.test_states if test else None) or scene.sampling
    return _draw(scene, law, num, key)[:, 2 * scene.dim :]


def sample_t0(scene: Scene, num: int, key) -> Float[np.ndarray, "num"] | None:  # noqa: F821
    """Draw the times of the drive (num,), uniform over its period, of states drawn with this key.

    None where the scene does not begin at any phase.
    """
    if not scene.any_phase:
        return None
    assert scene.period is not None
    return scene.period * _uniform(jax.random.fold_in(key, 2), num)


def sample_test_states(scene: Scene, num: int, key) -> Drawn:
    """Draw ``num`` states (num, 2d) for rollouts, of the scene's test law or else training law."""
    return _draw(scene, scene.test_states or scene.sampling, num, key)[:, : 2 * scene.dim]


def sample_sequences(
    scene: Scene, num: int, length: int, key
) -> Float[np.ndarray, "num length phase"]:
    """Draw ``num`` reference sequences of ``length`` states, which start with the training law."""
    params, t0 = sample_params(scene, num, key), sample_t0(scene, num, key)
    z0 = sample_states(scene, num, key)
    return reference_trajectories(scene, z0, length - 1, params=params, t0=t0)


def sample_pairs(
    scene: Scene, num_pairs: int, key, *, dt_range: tuple[float, float] | None = None
) -> Pairs:
    """Draw ``num_pairs`` states of the training law, and their images one ``dt`` later.

    dt_range: the shortest and the longest time step, between which one is drawn uniformly for each
    pair: irregular sampling. Raises ValueError where the scene has no autonomous flow.
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
            f"expected 0 < shortest < longest dt, and a scene with a flow; got dt from {low:g} to "
            f"{high:g} for the scene {scene.name}"
        )
    z0 = sample_states(scene, num_pairs, key)
    dt = low + (high - low) * _uniform(jax.random.fold_in(key, 1), num_pairs)
    z1 = Reference.of(scene).after(with_params(scene, z0, params, t0), dt)
    return Pairs(z0, z1[:, : z0.shape[1]], dt, args, t0, period)


def _uniform(key, num) -> Float[np.ndarray, "num"]:  # noqa: F821
    return np.asarray(_uniform_rows(key, num=_enough(num)))[:num]


@partial(jax.jit, static_argnames=("num",))
def _uniform_rows(key, *, num):
    return jax.random.uniform(key, (num,), jnp.float64)
