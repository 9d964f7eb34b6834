"""One source for NumPy and JAX: functions here and in the families ask an array for its namespace.

In a fit arrays are NumPy's and nothing is compiled; inside a step they are traced by JAX.
"""

from __future__ import annotations

from typing import Any

import numpy as np


def namespace(*arrays: Any) -> Any:
    """``numpy`` where all of these arrays are NumPy's (or plain numbers), else ``jax.numpy``."""
    for array in arrays:
        if not isinstance(array, (np.ndarray, np.generic, int, float)):
            import jax.numpy as jnp  # loaded when first used

            return jnp
    return np


def as_row(vector: Any, like: Any) -> Any:
    """vector (k,) with as many leading axes of length 1 as ``like`` (..., k') has."""
    return vector.reshape((1,) * (like.ndim - 1) + vector.shape)
