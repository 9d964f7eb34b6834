"""Rows of a least-squares problem, evaluated and folded on an accelerator.

There the rows are made where they are used, and ``jnp.linalg.qr`` is the vendor's own. On a CPU
the same program takes a tenth more processor time than NumPy with LAPACK's ``tpqrt``, its QR a
fifth more (494 terms, one thread), and it is compiled for each size of a family and each device.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.families.products import Products
from gfnn_jax.families.sines import Sines


def takes(family: Any) -> bool:
    """Return whether the gradients of its terms can be traced by JAX."""
    return isinstance(family, (Products, Sines))


def factor(family: Any, rows: Sequence[np.ndarray], weight, pairs: int, device) -> np.ndarray:
    """R of [A b] of rows (w, target_gradient), and args, filled up to so many pairs: one shape, one
    program."""
    count = len(rows[0])
    taken = np.minimum(np.arange(max(pairs, count)), count - 1)
    weights = (taken == np.arange(len(taken)))[:, None] * np.asarray(weight)
    filled = tuple(array[taken] for array in rows)
    return np.asfortranarray(_factor(*jax.device_put((family, filled, weights), device)))


def merged(one: np.ndarray, other: np.ndarray, device) -> np.ndarray:
    """R of the stacked [one; other]."""
    return np.asfortranarray(_merged(*jax.device_put((one, other), device)))


@jax.jit
def _factor(family, rows, weights):
    w, target, *args = rows
    gradients = family.term_gradients(w, *args) * weights[..., None]
    block = jnp.concatenate([gradients, (target * weights)[..., None]], axis=-1)
    return jnp.linalg.qr(block.reshape(-1, block.shape[-1]), mode="r")


@jax.jit
def _merged(one, other):
    return jnp.linalg.qr(jnp.concatenate([one, other]), mode="r")
