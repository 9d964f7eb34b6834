"""Small dense linear systems, one for each lane of a batch."""

import numpy as np

from gfnn_jax.arrays import namespace

# Up to the first size by cofactors, up to the second by unrolled elimination, beyond by LAPACK.
# A batch of 1,000 systems of size 4: 0.08, 0.14, 0.8 µs each; seconds to compile 0.3, 1.2, 0.7.
# Of size 8, unrolled: 1.6 µs and 8 s; by LAPACK: 2.6 µs and 0.5 s.
COFACTORS_UP_TO, _UNROLL_UP_TO = 4, 8


def small_solve(matrix, rhs):
    """Solve matrix @ x = rhs for matrix (..., n, n) and rhs (..., n), NumPy or JAX.

    Small systems are solved by cofactors, or by unrolled elimination with partial pivoting: a few
    fused loops over the batch, many times faster than a batched LAPACK call at these sizes.
    Cofactors lose a factor of the condition number in the residual; an iteration that judges its
    own residual makes up for that. The solution is linear in ``rhs`` and can be transposed. A
    singular system gives non-finite numbers.
    """
    if rhs.shape[-1] <= COFACTORS_UP_TO:
        return by_cofactors(matrix, rhs)[0]
    return solve_and_sign(matrix, rhs)[0]


def solve_and_sign(matrix, rhs):
    """Solve as `small_solve`; return the solution (..., n) and sign (...) of the determinant."""
    n = rhs.shape[-1]
    if n <= COFACTORS_UP_TO:
        x, determinant = by_cofactors(matrix, rhs)
        return x, namespace(matrix).sign(determinant)
    if n <= _UNROLL_UP_TO:
        return _by_elimination(matrix, rhs)
    return _by_lapack(matrix, rhs), namespace(matrix).linalg.slogdet(matrix)[0]


def by_cofactors(matrix, rhs):
    """Solve by cofactors; return the solution (..., n) and the determinant (...)."""
    xp, n = namespace(matrix, rhs), rhs.shape[-1]
    # Taken out once: an index costs JAX more time to trace than the arithmetic.
    entries = [[matrix[..., i, j] for j in range(n)] for i in range(n)]
    right = [rhs[..., i] for i in range(n)]

    known = {}
    everything = tuple(range(n))
    without = [tuple(k for k in everything if k != i) for i in everything]
    determinant = _minor(entries, everything, everything, known)
    x = []
    for j in everything:
        total = _alternating(
            _minor(entries, without[i], without[j], known) * right[i] for i in everything
        )
        x.append((total if j % 2 == 0 else -total) / determinant)
    return xp.stack(x, axis=-1), determinant


def _minor(entries, rows, columns, known):
    """Determinant of these rows and columns, expanded along the first row. known: those of others.
    No closure of `by_cofactors`: a function that names itself is a cycle, which keeps what it
    holds until garbage is collected."""
    if not rows:
        return 1.0
    if len(rows) == 1:
        return entries[rows[0]][columns[0]]
    if (rows, columns) not in known:
        known[rows, columns] = _alternating(
            entries[rows[0]][j]
            * _minor(entries, rows[1:], tuple(k for k in columns if k != j), known)
            for j in columns
        )
    return known[rows, columns]


def _alternating(terms):
    """a − b + c − …"""
    total, *others = terms
    for i, term in enumerate(others):
        total = total + term if i % 2 else total - term
    return total


def _by_elimination(matrix, rhs):
    xp, n = namespace(matrix, rhs), rhs.shape[-1]
    rows = [[matrix[..., i, j] for j in range(n)] for i in range(n)]
    x = [rhs[..., i] for i in range(n)]  # apart from the rows: only so is all this linear in it
    sign = 1.0
    for k in range(n):
        for i in range(k + 1, n):  # bubble the largest pivot up
            swap = xp.abs(rows[i][k]) > xp.abs(rows[k][k])
            for pair in ((rows[k], rows[i], j) for j in range(k, n)):
                _exchange(xp, swap, *pair)
            x[k], x[i] = xp.where(swap, x[i], x[k]), xp.where(swap, x[k], x[i])
            sign = xp.where(swap, -1.0, 1.0) * sign
        pivot = rows[k][k]
        sign = xp.sign(pivot) * sign
        for i in range(k + 1, n):
            factor = rows[i][k] / pivot
            for j in range(k + 1, n):
                rows[i][j] = rows[i][j] - factor * rows[k][j]
            x[i] = x[i] - factor * x[k]
    for k in reversed(range(n)):
        for j in range(k + 1, n):
            x[k] = x[k] - rows[k][j] * x[j]
        x[k] = x[k] / rows[k][k]
    return xp.stack(x, axis=-1), sign


def _exchange(xp, swap, one, other, j):
    one[j], other[j] = xp.where(swap, other[j], one[j]), xp.where(swap, one[j], other[j])


def _by_lapack(matrix, rhs):
    try:
        return namespace(matrix, rhs).linalg.solve(matrix, rhs[..., None])[..., 0]
    except np.linalg.LinAlgError:  # one singular lane: NumPy would answer none
        regular = np.linalg.matrix_rank(matrix) == matrix.shape[-1]
        x = (np.linalg.pinv(matrix) @ rhs[..., None])[..., 0]
        return np.where(regular[..., None], x, np.nan)


def covariance_root(covariance: np.ndarray) -> np.ndarray:
    """root (..., n, n), rootᵀ root = covariance (..., n, n), which may be singular.

    Of the matrix of correlations, whose units are one: eigenvalues that roundoff made negative
    are zero.
    """
    deviations = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1).clip(0.0))
    scale = np.where(deviations > 0, deviations, 1.0)
    correlations = covariance / (scale[..., :, None] * scale[..., None, :])
    values, vectors = np.linalg.eigh(correlations)
    root = np.sqrt(values.clip(0.0))[..., :, None] * np.swapaxes(vectors, -1, -2)
    return root * deviations[..., None, :]


def non_negative(matrix: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The x ≥ 0 (n,) of the least ‖A x − b‖, A (N, n)."""
    from scipy.optimize import nnls  # takes a quarter of a second: loaded when first used

    return nnls(matrix, target)[0]
