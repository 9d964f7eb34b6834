"""Orbits of maps: rotation numbers, and periodic orbits with their stability."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.coordinates import nearest_image, whole_turns


class RotationNumber(NamedTuple):
    """Turns per step, (...,), and how far that of all steps is from that of their first half: an
    upper estimate of the error where the orbit is quasi-periodic or settles to a period."""

    value: Any
    error: Any


def rotation_number(angle) -> RotationNumber:
    """Turns per step of an angle (..., L) along orbits, not reduced modulo 2π.

    The weighted Birkhoff average Σ w(n/L) (θ_{n+1} − θ_n) / 2π Σ w, w(t) = exp(−1/(t(1 − t))),
    which converges faster than any power of 1/L where the orbit is quasi-periodic, θ_L − θ_0
    over L as 1/L (Das, Saiki, Sander & Yorke, Nonlinearity 30 (2017) 4111). NumPy. Of a map that
    loses area leave the steps out that lead to its attractor.
    """
    moves = np.diff(np.asarray(angle, float), axis=-1)
    whole, half = (_average(part) for part in (moves, moves[..., : moves.shape[-1] // 2]))
    return RotationNumber(whole, np.abs(whole - half))


def _average(moves):
    t = np.arange(1, moves.shape[-1] + 1) / (moves.shape[-1] + 1)
    weight = np.exp(-1 / (t * (1 - t)))
    return moves @ (weight / weight.sum()) / (2 * np.pi)


class PeriodicOrbit(NamedTuple):
    """The states of one period (n, 2d), the eigenvalues of its return map (2d,), complex, and how
    far it misses closing: stable where all eigenvalues are less than 1 in magnitude."""

    states: np.ndarray
    eigenvalues: np.ndarray
    residual: float


def periodic_orbit(map_: Any, z, period: int, angles: tuple[int, ...] = ()) -> PeriodicOrbit:
    """The orbit of so many steps that closes near the state z (2d,), by Newton's method.

    map_: a pytree with ``step(z) -> (Z, info)``. angles: indices that close modulo 2π.
    Raises ValueError where Newton's method does not converge from z.
    """
    z, turning = np.array(z, float), list(angles)
    for _ in range(30):  # Newton's method converges in five or six updates
        z[turning] -= whole_turns(z[turning])
        states, jacobian = (np.asarray(a) for a in _returned(map_, z, period))
        missed = nearest_image(states[-1] - z, angles)
        size = float(np.abs(missed).max())
        if not np.isfinite(size):
            break
        if size <= 1e-13 * (1 + np.abs(z).max()):
            return PeriodicOrbit(states[:-1], np.linalg.eigvals(jacobian), size)
        z = z - np.linalg.lstsq(jacobian - np.eye(len(z)), missed, rcond=None)[0]
    raise ValueError(f"expected an orbit of {period} steps near the state, found none")


@partial(jax.jit, static_argnums=2)
def _returned(map_, z, period):
    """The orbit (period + 1, 2d) of z and the Jacobian of its last state."""

    def orbit(z):
        def step(z, _):
            image = map_.step(z)[0]
            return image, image

        last, images = jax.lax.scan(step, z, length=period)
        return last, jnp.concatenate([z[None], images])

    jacobian, states = jax.jacfwd(orbit, has_aux=True)(jnp.asarray(z))
    return states, jacobian
