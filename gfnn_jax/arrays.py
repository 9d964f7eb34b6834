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


def beside(first: Any, last: Any) -> Any:
    """Concatenate (..., k) and (..., K) to (..., k + K); their other axes are broadcast."""
    xp = namespace(first, last)
    axes = np.broadcast_shapes(first.shape[:-1], last.shape[:-1])
    both = (xp.broadcast_to(a, (*axes, a.shape[-1])) for a in (first, last))
    return xp.concatenate(list(both), axis=-1)


def as_numbers(values: Any, dtype: Any, what: str) -> Any:
    """Convert a user's values to an array of this dtype; JAX's arrays stay JAX's.

    Raises ValueError, in one line that names ``what`` they are, for values that are no numbers.
    """
    if hasattr(values, "dtype") and namespace(values) is not np:
        return values if values.dtype == dtype else values.astype(dtype)
    try:
        return np.asarray(values, dtype)
    except (TypeError, ValueError):
        raise ValueError(f"expected numbers as {what}, got {values!r}") from None


def matmul(a: Any, b: Any) -> Any:
    """Matrix product a @ b, by JAX at ``precision="highest"``.

    A GPU would otherwise multiply float32 in TF32, with a relative error of 7e-4.
    """
    xp = namespace(a, b)
    return a @ b if xp is np else xp.matmul(a, b, precision="highest")
