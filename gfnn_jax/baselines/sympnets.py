"""SympNets: networks of which each layer is a symplectic map.

Jin, Zhang, Zhu, Tang & Karniadakis, "SympNets: Intrinsic structure-preserving symplectic networks
for identifying Hamiltonian systems", Neural Networks 132 (2020), and their public code,
jpzxshi/sympnets: sigmoid, Adam at 1e-3, weights drawn with a deviation of 0.01. LA: linear modules
and activations in turn, at the paper's 30 layers × 10 sublayers; G: gradient modules. We add:
batches instead of all pairs at once, and a decay of the rate.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp

from gfnn_jax.baselines.learned import Budget, Learned, Sequences, learn_map
from gfnn_jax.fitting.adam import Recipe
from gfnn_jax.phase_space import split

LAYERS, SUBLAYERS = 30, 10  # sizes of LA, as in the paper
G_LAYERS, G_WIDTH = 20, 50
RECIPE = Recipe(batch_size=200, epochs=1_200, epoch_length=250, rate=1e-3, schedule="cosine")
_DEVIATION = 0.01
UNROLL = 5  # layers compiled in a row; all layers would take four times as long to compile


def la_sympnet(sequences: Sequences, budget: Budget) -> Learned:
    """Learn linear and activation modules in turn, a linear one last."""
    params = la_init(budget.key, sequences.dim, LAYERS, SUBLAYERS)
    label = f"{LAYERS} layers of {SUBLAYERS} sublayers"
    return learn_map(la_step, params, sequences, RECIPE, budget, label)


@partial(jax.jit, static_argnums=(1, 2, 3))
def la_init(key, dim: int, layers: int, sublayers: int):
    """Draw parameters, float32: halves and shifts of the linear modules, activations."""
    linear, active = jax.random.split(key)
    shape = (layers, sublayers, dim, dim)
    return {
        "half": _DEVIATION * jax.random.normal(linear, shape, jnp.float32),
        "shift": jnp.zeros((layers, 2 * dim), jnp.float32),
        "active": _DEVIATION * jax.random.normal(active, (layers - 1, dim), jnp.float32),
    }


def la_step(params, z):
    """Step z (2d,) by LA. The sublayers of a linear module are multiplied into one matrix first."""
    matrices = jax.vmap(partial(_linear, dim=z.shape[0] // 2))(params["half"])

    def layer(z, module):
        matrix, shift, active, even = module
        return _sheared(matrix @ z + shift, even, lambda x: active * jax.nn.sigmoid(x)), None

    active = params["active"]
    modules = (matrices[:-1], params["shift"][:-1], active, _even(len(active)))
    z, _ = jax.lax.scan(layer, z, modules, unroll=UNROLL)
    return matrices[-1] @ z + params["shift"][-1]


def _even(layers: int):
    """Flag (layers, 1), True for the layers that shear p: the first, the third, ..."""
    return jnp.arange(layers)[:, None] % 2 == 0


def _sheared(z, even, shear: Callable):
    """Shear z: p + shear(q) where ``even``, else q + shear(p)."""
    q, p = split(z)
    change = shear(jnp.where(even, q, p))
    zero = jnp.zeros_like(change)
    return z + jnp.concatenate([jnp.where(even, zero, change), jnp.where(even, change, zero)])


def _linear(halves, dim: int):
    """Matrix (2d, 2d) of the shears p += (S + Sᵀ) q and q += (S + Sᵀ) p in turn."""
    q, p = jnp.split(jnp.eye(2 * dim, dtype=halves.dtype), 2)
    for i, half in enumerate(halves):
        symmetric = half + half.T
        if i % 2 == 0:
            p = p + symmetric @ q
        else:
            q = q + symmetric @ p
    return jnp.concatenate([q, p])


def g_sympnet(sequences: Sequences, budget: Budget) -> Learned:
    """Learn gradient modules: shears by the gradient of Σᵢ aᵢ F(kᵢ·q + bᵢ), F' the sigmoid."""
    params = g_init(budget.key, sequences.dim, G_LAYERS, G_WIDTH)
    label = f"{G_LAYERS} layers of width {G_WIDTH}"
    return learn_map(g_step, params, sequences, RECIPE, budget, label)


@partial(jax.jit, static_argnums=(1, 2, 3))
def g_init(key, dim: int, layers: int, width: int):
    """Draw parameters, float32: inner weights, biases, outer weights of each module."""
    inner, outer = jax.random.split(key)
    return {
        "inner": _DEVIATION * jax.random.normal(inner, (layers, width, dim), jnp.float32),
        "bias": jnp.zeros((layers, width), jnp.float32),
        "outer": _DEVIATION * jax.random.normal(outer, (layers, width), jnp.float32),
    }


def g_step(params, z):
    """Step z (2d,) by G: p, q, p, ... are sheared in turn."""

    def layer(z, module):
        inner, bias, outer, even = module

        def shear(x):
            return inner.T @ (outer * jax.nn.sigmoid(inner @ x + bias))

        return _sheared(z, even, shear), None

    inner = params["inner"]
    modules = (inner, params["bias"], params["outer"], _even(len(inner)))
    return jax.lax.scan(layer, z, modules, unroll=UNROLL)[0]
