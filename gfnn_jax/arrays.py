"""Array namespaces: the same source lines run in NumPy and are traced by JAX.

Functions here and in the families ask an array for its namespace. In a fit arrays are NumPy's and
nothing is compiled. Inside a step they are traced by JAX.
"""

import dataclasses
from collections.abc import Callable
from itertools import combinations_with_replacement
from typing import Any, dataclass_transform

import numpy as np


@dataclass_transform(frozen_default=True, eq_default=False)
def pytree(
    *static: str, dropped: tuple[str, ...] = (), eq: bool = False, repr: bool = True
) -> Callable:
    """Make a class a frozen dataclass and a pytree of JAX.

    Its fields are leaves, or trees of these. Those of the names ``static`` are hashable constants
    of compiled code; those that are ``dropped`` are lost where a tree is rebuilt. eq: compared by
    its fields; else by identity.
    """

    def registered(kind: type) -> type:
        import jax  # loaded when first used

        kind = dataclasses.dataclass(frozen=True, eq=eq, repr=repr)(kind)
        names = [f.name for f in dataclasses.fields(kind) if f.name not in (*static, *dropped)]
        return jax.tree_util.register_dataclass(kind, names, static, dropped)

    return registered


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


def stretches_of(mask: Any) -> list[tuple[int, int]]:
    """[a, b) of each run of True in a mask (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def products(x: np.ndarray, degree: int) -> np.ndarray:
    """Products (N, m) of the columns of x (N, k), of degrees 0 to ``degree`` in turn."""
    found: dict[tuple[int, ...], np.ndarray] = {(): np.ones(len(x))}
    for n in range(1, degree + 1):
        for term in combinations_with_replacement(range(x.shape[1]), n):
            found[term] = found[term[:-1]] * x[:, term[-1]]
    return np.stack(list(found.values()), axis=1)
