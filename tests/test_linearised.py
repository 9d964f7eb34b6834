"""What a linearised problem says of a fit, against fits."""

import numpy as np
import pytest

from gfnn_jax.fitting.linearised import Linearised, without_each
from gfnn_jax.fitting.triangle import Triangle


def problem(seed=0, rows=60, terms=5):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(rows, terms)) * np.logspace(0, 4, terms)
    b = A @ np.arange(1.0, terms + 1) + rng.normal(size=rows)
    return np.column_stack([A, b])


def solved(rows, kept):
    c, rest, *_ = np.linalg.lstsq(rows[:, kept], rows[:, -1], rcond=None)
    return c, float(rest[0])


def test_covariance_step_and_significance_are_those_of_least_squares():
    rows = problem()
    one = Linearised.of_rows(rows, variance=3.0)
    c, _ = solved(rows, range(5))
    np.testing.assert_allclose(one.step(), c, rtol=1e-10)
    inverse = np.linalg.inv(rows[:, :-1].T @ rows[:, :-1])
    np.testing.assert_allclose(one.covariance, 3 * inverse, rtol=1e-8, atol=1e-16)
    there = Linearised(c, one.triangle, 3.0)
    expected = np.abs(c) / np.sqrt(3 * np.diag(inverse))
    np.testing.assert_allclose(there.significance, expected, rtol=1e-8)
    signs = np.array([-1.0, -1, -1, -1, -1, 1])  # of derivatives of the residuals themselves
    same = Linearised.of_derivatives(np.zeros(5), Triangle.of(rows * signs))
    np.testing.assert_allclose(same.step(), c, rtol=1e-10)


def test_added_coefficients_are_those_of_larger_fits():
    rows = problem()
    one = Linearised.of_rows(rows)
    found = one.added([0, 2], [1, 4])
    before = solved(rows, [0, 2])[1]
    for i, k in enumerate((1, 4)):
        c, rest = solved(rows, [0, 2, k])
        assert found.value[i] == pytest.approx(c[-1])
        assert found.left[i] ** 2 == pytest.approx(rest)
        expected = np.sqrt((before - rest) / (rest / before))
        assert found.scores(1.0, 0.0, 1e-12)[i] == pytest.approx(expected)
    assert found.rest**2 == pytest.approx(before)
    assert one.among([3, 1]).step() == pytest.approx(solved(rows, [3, 1])[0])
    half = np.array([[1.0, 0], [0, 2.0], [0, 0], [0, 0], [0, 0]])
    assert one.combined(half).step() == pytest.approx(solved(rows, [0, 1])[0] / [1, 2])


def test_what_others_imitate_is_not_identifiable():
    rows = problem()
    one = Linearised.of_rows(rows)
    assert min(map(one.unimitated, range(5))) > 0.5
    assert not one.null_direction().any()
    rows[:, 3] = 2 * rows[:, 0] - rows[:, 1]
    same = Linearised.of_rows(rows)
    assert same.unimitated(3) < 1e-12
    assert same.added([0, 1], [3]).scores(1.0, 0.03, 1e-4)[0] == 0
    null = same.null_direction()
    np.testing.assert_allclose(null / null[3], [-2, 1, 0, 1, 0], atol=1e-8)
    assert same.collinear(0.2)


def test_parts_that_are_left_out_and_rows_to_come():
    rows = problem()
    parts = np.split(rows, 3)
    p = np.linspace(0, 1, 5)
    at = np.column_stack([rows[:, :-1], rows[:, -1] - rows[:, :-1] @ p])
    found = without_each(p, [Triangle.of(part) for part in np.split(at, 3)])
    for k, c in enumerate(found):
        others = np.concatenate([part for i, part in enumerate(parts) if i != k])
        np.testing.assert_allclose(c, solved(others, range(5))[0], rtol=1e-9)
    one = Linearised.of_rows(rows)
    shifted = rows.copy()
    shifted[:, -1] += rows[:, 2]
    size = np.linalg.norm(rows[:, 2])
    assert one.moved_by(Linearised.of_rows(shifted)) == pytest.approx(size)
