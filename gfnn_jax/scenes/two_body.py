"""The two-body problem: relative motion on a Kepler ellipse (paper, section 4.1)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from gfnn_jax.coordinates import polar, whole_turns
from gfnn_jax.phase_space import Scalar, State, split
from gfnn_jax.scenes.scene import DrawnFrom, Scene

SEMI_MAJOR_AXIS = (0.8, 1.2)
ECCENTRICITY = (0.0, 0.05)


def hamiltonian(z: State, t=0.0) -> Scalar:
    """‖p‖²/2 − 1/‖q‖."""
    q, p = split(z)
    return p @ p / 2 - 1 / jnp.sqrt(q @ q)


def angular_momentum(z: State) -> Scalar:
    """q₁p₂ − q₂p₁."""
    q, p = split(z)
    return q[0] * p[1] - q[1] * p[0]


def kepler_flow(z: State, t) -> State:
    """The exact solution at any time t, of either sign, of a bound orbit (energy < 0), else NaN.

    With x the eccentric anomaly gained since t = 0, Kepler's equation reads

        n t = x − (1 − r/a) sin x + (q·p/√a) (1 − cos x),    n = a^(−3/2),

    which stays regular on a circle. Whole revolutions are removed first; x is found by Laguerre's
    iteration (Conway, Celest. Mech. 39, 1986), and the state follows by Gauss' f and g, written so
    that nothing cancels. Accurate to roundoff times n t / (1 − e).
    """
    q, p = split(z)
    r = jnp.sqrt(q @ q)
    a = 1 / (2 / r - p @ p)
    root_a = jnp.sqrt(a)
    radial = q @ p
    e_cos, e_sin = 1 - r / a, radial / root_a

    mean = t / (a * root_a)
    mean = mean - whole_turns(mean)

    def laguerre(_, x):
        sin, cos = jnp.sin(x), jnp.cos(x)
        value = x - e_cos * sin + e_sin * (1 - cos) - mean
        slope = 1 - e_cos * cos + e_sin * sin
        curvature = e_cos * sin + e_sin * cos
        return x - 5 * value / (slope + 2 * jnp.sqrt(jnp.abs(4 * slope**2 - 5 * value * curvature)))

    x = jax.lax.fori_loop(0, 8, laguerre, mean)
    sin, versine = jnp.sin(x), 2 * jnp.sin(x / 2) ** 2  # versine = 1 − cos x
    r_end = r + a * e_cos * versine + root_a * radial * sin
    f, g = 1 - a / r * versine, root_a * r * sin + a * radial * versine
    f_dot, g_dot = -root_a * sin / (r * r_end), 1 - a / r_end * versine
    return jnp.concatenate([f * q + g * p, f_dot * q + g_dot * p])


def _draw(key, num):
    """Paper, Experimental Details: uniform in a and e; uniform mean anomaly and orientation."""
    ranges = jnp.array([SEMI_MAJOR_AXIS, ECCENTRICITY, (0.0, 2 * jnp.pi), (0.0, 2 * jnp.pi)])

    def uniform(key, range_):
        return jax.random.uniform(key, (num,), jnp.float64, range_[0], range_[1])

    # One program for the four of them, which takes most of the time to compile.
    a, e, mean_anomaly, turn = jax.vmap(uniform)(jax.random.split(key, 4), ranges)

    zero = jnp.zeros_like(a)
    periapsis = jnp.stack([a * (1 - e), zero, zero, jnp.sqrt((1 + e) / (a * (1 - e)))], axis=-1)
    z = jax.vmap(kepler_flow)(periapsis, mean_anomaly * a**1.5)
    cos, sin = jnp.cos(turn), jnp.sin(turn)
    x, y, p_x, p_y = z.T
    return jnp.stack(
        [cos * x - sin * y, sin * x + cos * y, cos * p_x - sin * p_y, sin * p_x + cos * p_y],
        axis=-1,
    )


def two_body(dt: float = 0.1) -> Scene:
    """H = ‖p‖²/2 − 1/‖q‖, counterclockwise near-circular orbits: a in (0.8, 1.2), e in (0, 0.05).

    a and e are uniform, and so are the mean anomaly and the direction of the periapsis. The
    reference is Kepler's exact solution. Learned in polar coordinates, where the angle is cyclic.
    """
    return Scene(
        name="two-body",
        purpose="Kepler ellipses, integrable: orbital elements over long times",
        dim=2,
        dt=dt,
        sampling=DrawnFrom(_draw),
        flow=kepler_flow,
        hamiltonian=hamiltonian,
        invariants={"energy": hamiltonian, "angular momentum": angular_momentum},
        coordinates=polar(cyclic=True),
        reversor=(1, -1, -1, 1),
        tolerance=1.4e-10,
    )


SCENES = {"two-body": two_body}
