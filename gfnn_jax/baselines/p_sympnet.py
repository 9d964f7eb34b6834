"""P-SympNet: a row of exact flows of ridge polynomials, each layer's H = f(w·z).

Tapley, "Symplectic Neural Networks Based on Dynamical Systems" (arXiv:2408.09821, 2024), and the
public code bentaps/strupnet, method P. A layer conserves its own w·z, so that

    z + dt f'(w·z) J w

is the exact flow. Any linear symplectic map is such a row with quadratic f.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.baselines.learned import Budget, Learned, Sequences, learn_map
from gfnn_jax.fitting.adam import Recipe
from gfnn_jax.phase_space import apply_j

LAYERS, DEGREE = 24, 6
UNROLL = 6  # layers that are compiled in a row
RECIPE = Recipe(batch_size=200, epochs=1_200, epoch_length=500, rate=1e-2, schedule="cosine")


def p_sympnet(sequences: Sequences, budget: Budget) -> Learned:
    """Learn ``LAYERS`` ridge polynomials of the degrees 2 to ``DEGREE``."""
    largest = float(np.max(np.sqrt(np.mean(sequences.z**2, axis=(0, 1)))))
    params = p_init(budget.key, sequences.dim, LAYERS, DEGREE)
    # High powers of states much larger than 1 would overflow before the training begins.
    direction = np.asarray(params["direction"])
    params["direction"] = direction / np.float32(max(1.0, largest))
    label = f"{LAYERS} ridge polynomials of degree {DEGREE}"

    def step(params, z):
        return p_step(params, z, sequences.dt)

    return learn_map(step, params, sequences, RECIPE, budget, label)


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
    return jax.lax.scan(layer, z, layers, unroll=UNROLL)[0]
