"""A user's own module: a scene, a family, a piece and a model that the package has never seen."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import gfnn_jax as gfnn
from gfnn_jax.arrays import namespace
from gfnn_jax.families.inputs import Inputs
from gfnn_jax.solve.status import Info


def hamiltonian(z, t=0.0):
    """p²/2 − q²/2 + q⁴/4: a particle in a double well."""
    q, p = z
    return p**2 / 2 - q**2 / 2 + q**4 / 4


def draw(key, num):
    """States of the right-hand well."""
    unit = jax.random.uniform(key, (num, 2), jnp.float64, -1, 1)
    return jnp.array([[1.0, 0.0]]) + jnp.array([[0.3, 0.2]]) * unit


def double_well(dt=0.3):
    return gfnn.Scene(
        name="double-well",
        purpose="two wells",
        dim=1,
        dt=dt,
        sampling=gfnn.scenes.DrawnFrom(draw),
        hamiltonian=hamiltonian,
    )


@gfnn.register
@partial(
    jax.tree_util.register_dataclass,
    data_fields=("inputs",),
    meta_fields=("num_parameters", "width"),
)
@dataclasses.dataclass(frozen=True, eq=False)
class RadialBumps:
    """S(c, w) = Σ c_j exp(−|x − a_j|²/2s²), x the variables of w scaled to [−1, 1]."""

    inputs: Inputs
    num_parameters: int
    width: float = 1.0

    name = "bumps"

    @property
    def label(self):
        return f"bumps {self.num_parameters}"

    @property
    def operations(self):
        n = self.inputs.num_variables
        return 5 * self.num_parameters * n, 2 * self.num_parameters * n * (n + 1)

    def _bumps(self, w):
        x, n = self.inputs(w), self.inputs.num_variables
        centres = np.random.default_rng(0).uniform(-1.2, 1.2, (n, self.num_parameters))
        centres = namespace(x).asarray(centres.reshape((1,) * (x.ndim - 1) + centres.shape))
        away = (centres - x[..., None]) / self.width**2
        return namespace(x).exp(-(self.width**2) * (away**2).sum(-2) / 2), away

    def unflatten(self, coefficients):
        return coefficients

    def __call__(self, params, w, args=None):
        return self.value(params, w)

    def value(self, params, w, args=None):
        return self._bumps(w)[0] @ params

    def gradient(self, params, w, args=None):
        return self.term_gradients(w) @ params

    def gradient_and_hessian(self, params, w, args=None):
        bumps, away = self._bumps(w)
        weighted = (bumps * params.reshape((1,) * (bumps.ndim - 1) + params.shape))[..., None, :]
        hessian = (away * weighted) @ away.swapaxes(-1, -2)
        eye = namespace(w).eye(away.shape[-2]) / self.width**2
        hessian = hessian - weighted.sum(-1)[..., None] * eye.reshape(
            (1,) * (hessian.ndim - 2) + eye.shape
        )
        gradient = (away * weighted).sum(-1)
        return (
            self.inputs.pull_back_gradient(gradient, None),
            self.inputs.pull_back_hessian(hessian, gradient, None, None),
        )

    def term_gradients(self, w, args=None):
        bumps, away = self._bumps(w)
        return self.inputs.pull_back_terms(away * bumps[..., None, :], None)


@gfnn.register
@partial(jax.tree_util.register_dataclass, data_fields=("params", "dt"), meta_fields=())
@dataclasses.dataclass(frozen=True, eq=False)
class Verlet:
    """A step of Störmer and Verlet, of order 2: half a kick, a drift, half a kick. The force is a
    polynomial Σ params_k q^k of one coordinate."""

    params: jax.Array
    dt: float

    def _kicked(self, q, p):
        return p + self.dt / 2 * jnp.polyval(self.params[::-1], q)

    def step(self, z, args=None, *, unrolled=False):
        q, p = z[..., 0], z[..., 1]
        p = self._kicked(q, p)
        q = q + self.dt * p
        info = Info(*(jnp.zeros(z.shape[:-1], kind) for kind in (jnp.int32, jnp.int32, z.dtype)))
        return jnp.stack([q, self._kicked(q, p)], axis=-1), info

    def compensated_step(self, z, compensation, args=None):
        image, info = self.step(z + compensation, args)
        return image, jnp.zeros_like(image), info

    def multiplier(self, args=None):
        return 1.0

    def inverse(self):
        return dataclasses.replace(self, dt=-self.dt)  # it is symmetric in time


class Kicks:
    """A model: the force of a leapfrog step, of rising degree, by least squares."""

    name = "kicks"

    def sizes(self, data):
        return (1, 3, 5)

    def fit(self, data, size):
        (q0, p0), (q1, p1) = data.y0.T, data.y1.T
        powers = np.arange(size + 1)
        design = data.dt / 2 * (q0[:, None] ** powers + q1[:, None] ** powers)
        force, left, _, _ = np.linalg.lstsq(design, p1 - p0, rcond=None)
        variance = left.item() / (len(q0) - size - 1)
        root = np.sqrt(variance) * np.linalg.inv(np.linalg.qr(design, mode="r")).T
        piece = Verlet(force, float(data.dt))
        return gfnn.Fitted(piece, f"kicks {size}", size + 1, 8.0 * size, root)


@gfnn.register
@dataclasses.dataclass(frozen=True)
class HeavyTails:
    """ν log(1 + r²/ν): noise of Student's t with ν degrees of freedom."""

    nu: float = 2.0

    def of(self, residuals):
        return self.nu * np.log1p(residuals**2 / self.nu)

    def weights(self, residuals):
        return 1 / (1 + residuals**2 / self.nu)


@gfnn.register
@dataclasses.dataclass(frozen=True)
class Normal:
    """r²: normal noise, least squares."""

    def of(self, residuals):
        return residuals**2

    def weights(self, residuals):
        return np.ones_like(residuals)


@gfnn.register
@dataclasses.dataclass(frozen=True)
class Tilted:
    """What a camera below an angle sees: scale * tan(½ (theta − tilt))."""

    @property
    def parameters(self):
        return {"scale": 1.0, "tilt": 0.0}

    def __call__(self, q, v, c):
        half = (q[..., 0] - c[..., 1]) / 2
        slope = c[..., 0] / (2 * np.cos(half) ** 2)
        by_c = np.stack([np.tan(half), -slope], axis=-1)
        return c[..., 0] * np.tan(half), slope[..., None], np.zeros_like(v), by_c


class Wall:
    """A soft wall: the square of what x is beyond 1, where it is."""

    name = "wall"

    def derivatives(self, x):
        beyond = namespace(x).maximum(x - 1.0, 0.0)
        return beyond**2, 2 * beyond, namespace(x).where(x > 1.0, 2.0, 0.0)


wall = gfnn.register_function(Wall())
