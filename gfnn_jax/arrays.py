"""Array namespaces: the same source lines run in NumPy and are traced by JAX.

Functions here and in the families ask an array for its namespace. In a fit arrays are NumPy's and
nothing is compiled. Inside a step they are traced by JAX.
"""

from __future__ import annotations

from typing import Any

import numpy as np


def namespace(*arrays: Any) -> Any:
    """Return ``numpy`` where all arrays are NumPy's or plain numbers, else ``jax.numpy``."""
    for array in arrays:
        if not isinstance(array, (np.ndarray, np.generic, int, float)):
            import jax.numpy as jnp  # loaded when first used

            return jnp
    return np


def as_row(array: Any, like: Any) -> Any:
    """Reshape ``array`` with leading axes of length 1 to as many axes as ``like`` has."""
    return array.reshape((1,) * (like.ndim - array.ndim) + array.shape)


def matmul(a: Any, b: Any) -> Any:
    """Matrix product a @ b, by JAX at ``precision="highest"``.

    A GPU would otherwise multiply float32 in TF32, with a relative error of 7e-4.
    """
    xp = namespace(a, b)
    return a @ b if xp is np else xp.matmul(a, b, precision="highest")
