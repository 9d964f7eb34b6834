"""Rollouts of a step function: scan over steps, save every K-th state.

This module knows nothing of generating functions. Any ``step(carry) -> carry`` will do, so that
every method that ends in a step function is rolled out, timed and judged by the same code.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def scan_steps(
    step: Callable, carry: Any, num_saved: int, *, save_every: int = 1, observe: Callable
) -> tuple[Any, Any]:
    """Scan ``num_saved`` blocks of ``save_every`` steps, with ``observe(carry)`` after each block.

    Returns the last carry and the stacked observations (num_saved, ...). Memory grows with the
    observations only, not with the number of steps.
    """

    def block(carry, _):
        if save_every == 1:
            carry = step(carry)
        else:
            carry, _ = jax.lax.scan(lambda c, _: (step(c), None), carry, None, length=save_every)
        return carry, observe(carry)

    return jax.lax.scan(block, carry, None, length=num_saved)


def rollout(step: Callable, z0, num_steps: int, *, save_every: int = 1):
    """Roll out a plain step function z -> z of one state (2d,) from a batch of initial states.

    z0: (B, 2d), NumPy or JAX. Returns the states (B, 1 + num_steps // save_every, 2d), the initial
    ones first. Compiled once for each ``step``: pass the same function again, not a new lambda.
    """
    z0 = z0 if isinstance(z0, jax.Array) else np.asarray(z0)
    return _rollout(step, z0, num_steps // save_every, save_every)


@partial(jax.jit, static_argnums=(0, 2, 3))
def _rollout(step, z0, num_saved, save_every):
    def lane(z):
        _, saved = scan_steps(step, z, num_saved, save_every=save_every, observe=lambda z: z)
        return jnp.concatenate([z[None], saved])

    return jax.vmap(lane)(z0)
