"""SympNets: networks of which each layer is a symplectic map.

Jin, Zhang, Zhu, Tang & Karniadakis, "SympNets: Intrinsic structure-preserving symplectic networks
for identifying Hamiltonian systems", Neural Networks 132 (2020), and their public code,
jpzxshi/sympnets: sigmoid, Adam at 1e-3, weights drawn with a deviation of 0.01. LA: linear modules
and activations in turn, at the paper's 30 layers × 10 sublayers; G: gradient modules. We add:
batches instead of all pairs at once, and a decay of the rate.

P-SympNet, a row of exact flows of ridge polynomials, each layer's H = f(w·z): Tapley, "Symplectic
Neural Networks Based on Dynamical Systems" (arXiv:2408.09821, 2024), and the public code
bentaps/strupnet, method P. A layer conserves its own w·z, so that

    z + dt f'(w·z) J w

is the exact flow. Any linear symplectic map is such a row with quadratic f.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.baselines.learned import Budget, Learned, Sequences, learn_map
from gfnn_jax.fitting.adam import Recipe
from gfnn_jax.phase_space import apply_j, split


class _Options:
    """Sizes, of LA as in the paper. deviation: of the first weights. unroll: layers
    compiled in a row; all layers would take four times as long to compile."""

    layers: int = 30
    sublayers: int = 10
    g_layers: int = 20
    g_width: int = 50
    p_layers: int = 24
    p_degree: int = 6
    deviation: float = 0.01
    unroll: int = 5
    p_unroll: int = 6


def _recipe(epoch_length: int = 250, rate: float = 1e-3) -> Recipe:
    return Recipe(
        batch_size=200, epochs=1_200, epoch_length=epoch_length, rate=rate, schedule="cosine"
    )


def la_sympnet(sequences: Sequences, budget: Budget) -> Learned:
    """Learn linear and activation modules in turn, a linear one last."""
    params = la_init(budget.key, sequences.dim, _Options.layers, _Options.sublayers)
    label = f"{_Options.layers} layers of {_Options.sublayers} sublayers"
    return learn_map(la_step, params, sequences, _recipe(), budget, label)


@partial(jax.jit, static_argnums=(1, 2, 3))
def la_init(key, dim: int, layers: int, sublayers: int):
    """Draw parameters, float32: halves and shifts of the linear modules, activations."""
    linear, active = jax.random.split(key)
    shape = (layers, sublayers, dim, dim)
    return {
        "half": _Options.deviation * jax.random.normal(linear, shape, jnp.float32),
        "shift": jnp.zeros((layers, 2 * dim), jnp.float32),
        "active": _Options.deviation * jax.random.normal(active, (layers - 1, dim), jnp.float32),
    }


def la_step(params, z):
    """Step z (2d,) by LA. The sublayers of a linear module are multiplied into one matrix first."""
    matrices = jax.vmap(partial(_linear, dim=z.shape[0] // 2))(params["half"])

    def layer(z, module):
        matrix, shift, active, even = module
        return _sheared(matrix @ z + shift, even, lambda x: active * jax.nn.sigmoid(x)), None

    active = params["active"]
    modules = (matrices[:-1], params["shift"][:-1], active, _even(len(active)))
    z, _ = jax.lax.scan(layer, z, modules, unroll=_Options.unroll)
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
    params = g_init(budget.key, sequences.dim, _Options.g_layers, _Options.g_width)
    label = f"{_Options.g_layers} layers of width {_Options.g_width}"
    return learn_map(g_step, params, sequences, _recipe(), budget, label)


@partial(jax.jit, static_argnums=(1, 2, 3))
def g_init(key, dim: int, layers: int, width: int):
    """Draw parameters, float32: inner weights, biases, outer weights of each module."""
    inner, outer = jax.random.split(key)
    return {
        "inner": _Options.deviation * jax.random.normal(inner, (layers, width, dim), jnp.float32),
        "bias": jnp.zeros((layers, width), jnp.float32),
        "outer": _Options.deviation * jax.random.normal(outer, (layers, width), jnp.float32),
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
    return jax.lax.scan(layer, z, modules, unroll=_Options.unroll)[0]


def p_sympnet(sequences: Sequences, budget: Budget) -> Learned:
    """Learn ridge polynomials of the degrees 2 to 6."""
    largest = float(np.max(np.sqrt(np.mean(sequences.z**2, axis=(0, 1)))))
    params = p_init(budget.key, sequences.dim, _Options.p_layers, _Options.p_degree)
    # High powers of states much larger than 1 would overflow before the training begins.
    direction = np.asarray(params["direction"])
    params["direction"] = direction / np.float32(max(1.0, largest))
    label = f"{_Options.p_layers} ridge polynomials of degree {_Options.p_degree}"

    def step(params, z):
        return p_step(params, z, sequences.dt)

    return learn_map(step, params, sequences, _recipe(500, 1e-2), budget, label)


@partial(jax.jit, static_argnums=(1, 2, 3))
def p_init(key, dim: int, layers: int, degree: int):
    """Draw parameters, float32: unit-sized directions, small coefficients of degrees 2, 3, ..."""
    directions, coefficients = jax.random.split(key)
    size = (2 * dim) ** -0.5
    return {
        "direction": size * jax.random.normal(directions, (layers, 2 * dim), jnp.float32),
        "coefficient": 0.01 * jax.random.normal(coefficients, (layers, degree - 1), jnp.float32),
    }


def p_step(params, z, dt: float):
    """Apply all layers in a row to z (2d,)."""

    def layer(z, ridge):
        direction, coefficients = ridge
        at = direction @ z
        slope = jnp.zeros_like(at)
        for power in range(coefficients.shape[0], 0, -1):  # Horner: of degree power + 1
            slope = (slope + (power + 1) * coefficients[power - 1]) * at
        return z + dt * slope * apply_j(direction), None

    layers = (params["direction"], params["coefficient"])
    return jax.lax.scan(layer, z, layers, unroll=_Options.p_unroll)[0]
