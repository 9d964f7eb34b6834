"""Maps whose generating functions are known in closed form: tests of what is done with a map need
no fit."""

import jax.numpy as jnp
import numpy as np

from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.families import from_function
from gfnn_jax.generating.generated import Generated
from gfnn_jax.maps.domain import covering
from gfnn_jax.maps.symplectic_map import SymplecticMap


@from_function
def standard(kick, w):
    """Type 2, h = 1: P = p + K sin θ, Θ = θ + P."""
    return 0.5 * w[1] ** 2 + kick * jnp.cos(w[0])


@from_function
def oscillator(strength, w):
    """Midpoint: turns (q, p) by 2 arctan(h · strength / 2)."""
    return 0.5 * strength * jnp.sum(w**2)


@from_function
def pendulum(strength, w):
    """Midpoint: the implicit midpoint rule of a pendulum."""
    return 0.5 * w[1] ** 2 - strength * jnp.cos(w[0])


@from_function
def folding(strength, w):
    """Type 2, h = 1: P + 3 s q² P² = p, which has no solution beyond a fold."""
    return strength * w[0] ** 3 * w[1] ** 2


def exact_oscillator(dt):
    """The strength with which ``oscillator`` turns by dt, the exact flow."""
    return 2 / dt * np.tan(dt / 2)


def generated(family, params, chart, dt, dim=1):
    """A piece whose solves start at the state itself."""
    params = params if params is None else np.float64(params)
    return Generated(family, params, chart, dt, np.ones(2 * dim))


def map_of(piece, data, *, coordinates=CARTESIAN, around=(), scale=None):
    """A map with this piece whose domain is that of the data (N, 2d), in inner coordinates."""
    width = data.shape[1]
    return SymplecticMap(
        (*around, piece, *around), coordinates, covering(data, ignore=coordinates.angles),
        np.ones(width) if scale is None else np.asarray(scale),
        np.zeros(len(coordinates.angles)), piece.dt,
    )  # fmt: skip


def rotated(z, angle):
    """States (..., 2) turned by an angle, clockwise: the flow of the oscillator."""
    q, p = z[..., 0], z[..., 1]
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([q * c + p * s, p * c - q * s], axis=-1)
