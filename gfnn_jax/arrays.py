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


def as_row(array: Any, like: Any) -> Any:
    """array with leading axes of length 1, as many axes in all as ``like`` has."""
    return array.reshape((1,) * (like.ndim - array.ndim) + array.shape)


def matmul(a: Any, b: Any) -> Any:
    """a @ b; by JAX in full precision: a GPU would multiply float32 in TF32, 7e-4 of error."""
    xp = namespace(a, b)
    return a @ b if xp is np else xp.matmul(a, b, precision="highest")
