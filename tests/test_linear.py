"""Small linear systems of a batch: solutions, signs, transposes, singular lanes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gfnn_jax.solve.linear import covariance_root, small_solve, solve_and_sign

both = jax.jit(solve_and_sign)


def systems(n, batch=(20,)):
    rng = np.random.default_rng(n)
    matrix, rhs = rng.standard_normal((*batch, n, n)), rng.standard_normal((*batch, n))
    matrix[..., 0, 0] = 0.0 if n > 1 else matrix[..., 0, 0]  # needs pivoting
    return matrix, rhs


def solvers(n):
    """NumPy's, and JAX's where it compiles in a second."""
    return (solve_and_sign, both) if n not in (6, 7, 8) else (solve_and_sign,)


@pytest.mark.parametrize("n", range(1, 10))
def test_solutions_and_signs_are_numpys(n):
    matrix, rhs = systems(n)
    expected = np.linalg.solve(matrix, rhs[..., None])[..., 0]
    signs = np.linalg.slogdet(matrix)[0]
    assert {-1.0, 1.0} == set(signs)
    for x, sign in (solve(matrix, rhs) for solve in solvers(n)):
        np.testing.assert_allclose(x, expected, rtol=1e-9, atol=1e-9)
        assert np.abs(np.sum(matrix * np.asarray(x)[:, None], axis=-1) - rhs).max() < 1e-11
        np.testing.assert_array_equal(sign, signs)


@pytest.mark.parametrize("n", [2, 6])
def test_any_leading_axes(n):
    matrix, rhs = systems(n, (2, 3))
    x = small_solve(matrix, rhs)
    np.testing.assert_allclose(np.sum(matrix * x[..., None, :], axis=-1), rhs, atol=1e-12)
    np.testing.assert_allclose(small_solve(matrix[0, 0], rhs[0, 0]), x[0, 0], rtol=1e-13)


@pytest.mark.parametrize("n", [3, 5, 9])
def test_linear_in_the_right_side_so_that_it_transposes(n):
    matrix, rhs = systems(n, ())
    transposed = jax.jit(jax.grad(lambda b: jnp.sum(b0 * small_solve(matrix, b))))
    b0 = rhs[::-1].copy()
    np.testing.assert_allclose(transposed(rhs), np.linalg.solve(matrix.T, b0), rtol=1e-9)


@pytest.mark.parametrize("n", [1, 2, 5, 9])
def test_a_singular_lane_spoils_no_other(n):
    matrix, rhs = systems(n)
    good = small_solve(matrix, rhs)
    matrix[5] = 0.0
    others = np.arange(20) != 5
    with np.errstate(all="ignore"):
        found = small_solve(matrix, rhs)
    np.testing.assert_allclose(found[others], good[others], rtol=1e-8)
    traced, sign = both(matrix, rhs)
    assert not np.isfinite(traced[5]).all()
    assert not abs(sign[5]) > 0
    np.testing.assert_allclose(np.asarray(traced)[others], good[others], rtol=1e-8)


def test_a_singular_lane_of_many_is_not_finite_and_spoils_no_other():
    """Nine unknowns are LAPACK's: NumPy's raises for the whole batch."""
    matrix = np.random.default_rng(3).normal(size=(3, 9, 9))
    matrix[1, 4] = matrix[1, 5]
    x = small_solve(matrix, np.ones((3, 9)))
    assert np.isnan(x[1]).all()
    expected = np.linalg.solve(matrix[[0, 2]], np.ones((2, 9, 1)))[..., 0]
    np.testing.assert_allclose(x[[0, 2]], expected, rtol=1e-10)


@pytest.mark.parametrize("rank", [0, 2, 5])
def test_the_root_of_a_covariance_whose_units_differ_and_which_may_be_singular(rank):
    rng = np.random.default_rng(rank)
    factor = rng.standard_normal((7, rank, 5)) * np.array([1e-9, 1.0, 1e6, 0.0, 1e-3])
    covariance = factor.swapaxes(1, 2) @ factor
    root = covariance_root(covariance)
    size = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    room = 1e-14 * size[:, :, None] * size[:, None, :]
    assert np.all(np.abs(root.swapaxes(1, 2) @ root - covariance) <= room)
