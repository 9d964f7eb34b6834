"""Maps whose generating functions are known in closed form: tests of what is done with a map need
no fit. And motion by SciPy's integrators, pairs of Hénon and Heiles among it."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.families import from_function
from gfnn_jax.families.family import DifferentiatedByJax
from gfnn_jax.families.friction import Friction
from gfnn_jax.families.lagrangian import Lagrangian, Terms
from gfnn_jax.generating.generated import Generated
from gfnn_jax.maps.domain import covering
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import Pairs


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


def mechanics(rows, losses=(), uniform=0.0, gains=None, powers=None):
    """L of rows (speeds, powers, modes, phase, coefficient, perhaps a formula), and R of rows
    (direction, kind, width, coefficient)."""
    dim = len(rows[0][0])
    return Lagrangian(
        Terms.of([(*row[:4], *row[5:]) for row in rows], dim),
        np.array([row[4] for row in rows], float),
        Friction.of([row[:3] for row in losses], dim),
        np.array([row[3] for row in losses], float),
        uniform,
        np.zeros((dim, 0)) if gains is None else np.array(gains, float),
        powers,
    )


def generated(family, params, chart, dt, dim=1):
    """A piece whose solves start at the state itself."""
    params = params if params is None else np.float64(params)
    return Generated(family, params, chart, dt, np.ones(2 * dim))


def map_of(piece, data, *, coordinates=CARTESIAN, around=(), scale=None):
    """A map with this piece whose domain is that of the data (N, 2d), in inner coordinates."""
    width = data.shape[1]
    return SymplecticMap(
        (*around, piece, *around),
        coordinates,
        covering(data, ignore=coordinates.angles),
        np.ones(width) if scale is None else np.asarray(scale),
        np.zeros(len(coordinates.angles)),
        piece.dt,
    )


def rotated(z, angle):
    """States (..., 2) turned by an angle, clockwise: the flow of the oscillator."""
    q, p = z[..., 0], z[..., 1]
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([q * c + p * s, p * c - q * s], axis=-1)


def turning(z, dt):
    """The exact flow over dt of oscillators whose frequency depends on their energy."""
    q, p = np.split(z, 2, axis=1)
    turn = np.reshape(dt, (-1, 1)) * (1 + 0.2 * (q**2 + p**2))
    cos, sin = np.cos(turn), np.sin(turn)
    return np.concatenate([cos * q + sin * p, cos * p - sin * q], axis=1)


def standard_map(z, k):
    """Images of states (N, 2) under the standard map of strength k, a number or one of each."""
    p = z[:, 1] + k * np.sin(z[:, 0])
    return np.stack([z[:, 0] + p, p], axis=1)


def leapfrog(z, dt, steps=1):
    """A map that is exactly symplectic, of states (N, 2) of a pendulum: half a kick, a drift, half
    a kick, and this so many times."""
    (q, p), h = np.asarray(z).T, dt / steps
    for _ in range(steps):
        p = p - h / 2 * np.sin(q)
        q = q + h * p
        p = p - h / 2 * np.sin(q)
    return np.stack([q, p], axis=1)


def kepler(a, e, mean, turn=0.0):
    """States (..., 4) of ellipses about the centre, by bisection of Kepler's equation for the mean
    anomalies; their periapses turned by ``turn``."""
    a, e, mean, turn = np.broadcast_arrays(a, e, mean, turn)
    low, high = mean - 1.0, mean + 1.0
    for _ in range(60):
        middle = (low + high) / 2
        late = middle - e * np.sin(middle) > mean
        low, high = np.where(late, low, middle), np.where(late, middle, high)
    c, s, minor = np.cos(low), np.sin(low), np.sqrt(1 - e**2)
    speed = a**-0.5 / (1 - e * c)
    q = np.exp(1j * turn) * a * (c - e + 1j * minor * s)
    p = np.exp(1j * turn) * speed * (-s + 1j * minor * c)
    return np.stack([q.real, q.imag, p.real, p.imag], axis=-1)


def henon_heiles(gammas=(0.0, 0.0)):
    """The field of Hénon and Heiles, with friction."""

    def field(_, z):
        q1, q2, p1, p2 = z
        return [p1, p2, -q1 - 2 * q1 * q2 - gammas[0] * p1, -q2 - q1**2 + q2**2 - gammas[1] * p2]

    return field


def henon_heiles_pairs(num, seed=0, radius=0.4, dt=0.5):
    """Pairs of states that are uniform in a box."""
    z0 = np.random.default_rng(seed).uniform(-radius, radius, (num, 4))
    return Pairs(z0, moved(henon_heiles(), z0, dt, rtol=2.3e-14, atol=1e-16), dt)


def moved(field, z0, dt, rtol=1e-13, atol=1e-14):
    """States z0 (N, 2d) a time dt later by ż = field(t, z), z (2d, N), of SciPy's in one
    integration: many share the tolerance of a step, and each is closer than alone."""
    shape = z0.T.shape

    def flat(t, z):
        return np.ravel(field(t, z.reshape(shape)))

    found = solve_ivp(flat, (0, dt), z0.T.ravel(), "DOP853", rtol=rtol, atol=atol)
    return found.y[:, -1].reshape(shape).T


def motion(acceleration, start, t, **options):
    """Positions (d, T) of `states_in_motion`."""
    return states_in_motion(acceleration, start, t, **options)[: len(start) // 2]


def states_in_motion(acceleration, start, t, **options):
    """(2d, T) at times t of q̈ = acceleration(q, v) from ``start`` (2d,), by SciPy."""
    d, options = len(start) // 2, {"rtol": 1e-10, "atol": 1e-12, **options}

    def rates(_, z):
        return np.concatenate([z[d:], acceleration(z[:d], z[d:])])

    return solve_ivp(rates, (t[0], t[-1]), start, t_eval=t, **options).y


@partial(jax.tree_util.register_dataclass, data_fields=("amplitude",), meta_fields=())
@dataclasses.dataclass(frozen=True)
class Network(DifferentiatedByJax):
    """Network of one hidden layer of tanh, with its gradient in closed form."""

    amplitude: float = 1.0
    name = label = "tanh"
    operations = (0, 0)

    def value(self, params, w, args=None):
        return self.amplitude * (self._hidden(params, w) @ params["outer"])

    def gradient(self, params, w, args=None):
        slope = (1 - self._hidden(params, w) ** 2) * self._row(params["outer"], w)
        return self.amplitude * (slope @ params["inner"].T)

    def _hidden(self, params, w):
        inner = w.astype(params["inner"].dtype) @ params["inner"]
        return jnp.tanh(inner + self._row(params["bias"], w))

    def _row(self, vector, w):
        return vector.reshape((1,) * (w.ndim - 1) + vector.shape)


def network_params(seed=0, width=11, size=None):
    """Weights of a ``Network``, those of its last layer divided by a size."""
    rng = np.random.default_rng(seed)
    inner, bias, outer = (rng.standard_normal(shape) for shape in ((2, width), width, width))
    return {"inner": inner, "bias": bias, "outer": outer / (size or np.sqrt(width))}


def gradient_data(function, num, seed):
    """(w, ∇function(w)) for num points of the square (−1, 1)²."""
    w = np.random.default_rng(seed).uniform(-1, 1, (num, 2))
    return w, np.asarray(jax.jit(jax.vmap(jax.grad(function)))(w))


def steep_pendulum(w):
    return 0.5 * w[1] ** 2 - jnp.cos(2 * w[0])


def disc(num, radius=1.0, seed=0):
    """States (num, 2), uniform in a disc."""
    rng = np.random.default_rng(seed)
    r, angle = radius * np.sqrt(rng.uniform(size=num)), rng.uniform(0, 2 * np.pi, num)
    return np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)


def rms(map_, z0, z1):
    """RMS error of the images of a map."""
    return float(np.sqrt(np.mean((np.asarray(map_.step(z0)[0]) - np.asarray(z1)) ** 2)))


def block_on_a_spring(q, v, t, held):
    """Positions and velocities (2, T) of q̈ = −q − held sgn q̇ in closed form: half turns about
    ±held, until it stops."""
    found, begun = np.full((2, len(t)), np.nan), 0.0
    while side := np.sign(v) or -np.sign(q) * (abs(q) > held):
        about = -side * held
        size, angle = np.hypot(q - about, v), np.arctan2(-v, q - about)
        left = ((0.0 if side > 0 else np.pi) - angle) % (2 * np.pi)  # until it turns
        now = (t >= begun) & (t <= begun + left)
        phase = angle + t[now] - begun
        found[:, now] = about + size * np.cos(phase), -size * np.sin(phase)
        q, v, begun = about + size * np.cos(angle + left), 0.0, begun + left
    return np.where(np.isnan(found), [[q], [0.0]], found)
