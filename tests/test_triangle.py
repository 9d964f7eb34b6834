"""The triangle of a least-squares problem against NumPy's solutions of all of its rows."""

import subprocess
import sys

import numpy as np
import pytest

from gfnn_jax.fitting.triangle import Triangle, folded

RNG = np.random.default_rng(0)
SCALES = 10.0 ** np.linspace(-3, 3, 7)  # of the columns, which the solution does not see
A, C = RNG.normal(size=(90, 7)) * SCALES, np.arange(1.0, 8.0) / SCALES
B = A @ C + 0.1 * RNG.normal(size=90)
ROWS = np.column_stack([A, B])


def lstsq(a, b):
    return np.linalg.lstsq(a, b, rcond=None)[0]


def plain(triangle, size=None):
    spectrum = triangle.spectrum(size)
    return spectrum.solution(spectrum.inverse)


def same(one, other):
    """Of the same rows, up to the signs of its own."""
    np.testing.assert_allclose(
        one.factor.T @ one.factor, other.factor.T @ other.factor, rtol=1e-12, atol=1e-12
    )
    assert one.rows == other.rows


def test_rows_in_any_parts_make_one_triangle():
    whole = Triangle.of(ROWS)
    blocks = (np.array(ROWS[i:j], order="F") for i, j in ((0, 3), (3, 3), (3, 60), (60, 90)))
    same(Triangle.of_blocks(blocks, 7), whole)
    grown = Triangle.empty(7)
    for part in (ROWS[:4], ROWS[4:50], ROWS[50:]):
        grown = grown.stacked(part)
    parts = [Triangle.of(part) for part in (ROWS[:5], ROWS[5:])]  # of the first, rank 5
    for found in (grown, parts[0].merge(parts[1]), whole.merge(Triangle.empty(7))):
        same(found, whole)
        assert np.array_equal(found.factor, np.triu(found.factor))


def test_solutions_of_all_leading_and_pruned_terms():
    triangle, kept = Triangle.of(ROWS), np.array([5, 0, 3])
    np.testing.assert_allclose(plain(triangle), lstsq(A, B), rtol=1e-10)
    for size in (1, 4, 7):
        c = lstsq(A[:, :size], B)
        np.testing.assert_allclose(plain(triangle, size), c, rtol=1e-10)
        rest = np.linalg.norm(A[:, :size] @ c - B)
        assert triangle.residual_norm(size) == pytest.approx(rest, rel=1e-12)
        assert triangle.missed(c) == pytest.approx(rest, rel=1e-12)
        assert triangle.spectrum(size).residual_norm == pytest.approx(rest, abs=1e-5)
    assert triangle.spectrum().residual_norm == pytest.approx(rest, abs=1e-5)
    np.testing.assert_allclose(plain(triangle.pruned(kept)), lstsq(A[:, kept], B), rtol=1e-10)
    off = np.array([C, np.zeros(7), 2 * C]).T
    expected = np.linalg.norm(A @ off - B[:, None], axis=0)
    np.testing.assert_allclose(triangle.missed(off), expected, rtol=1e-12)
    assert triangle.image_norm(C[:4]) == pytest.approx(np.linalg.norm(A[:, :4] @ C[:4]), rel=1e-12)
    assert triangle.norm == pytest.approx(np.linalg.norm(B), rel=1e-12)


def test_a_ridge_damps_columns_scaled_to_one():
    spectrum, column = Triangle.of(ROWS).spectrum(), np.linalg.norm(A, axis=0)
    scaled, ridge = A / column, 0.2
    size = ridge * np.linalg.svd(scaled, compute_uv=False)[0]
    damped = np.vstack([scaled, size * np.eye(7)])
    c = lstsq(damped, np.append(B, np.zeros(7))) / column
    both = spectrum.solution(np.stack([spectrum.inverse, spectrum.ridged(ridge)]))
    np.testing.assert_allclose(both.T, [lstsq(A, B), c], rtol=1e-10)
    hat = damped[:90] @ np.linalg.inv(damped.T @ damped) @ damped[:90].T
    assert spectrum.degrees_of_freedom(ridge) == pytest.approx(np.trace(hat), rel=1e-12)
    assert spectrum.degrees_of_freedom() == pytest.approx(7)
    root = spectrum.root(ridge) * column[:, None]
    np.testing.assert_allclose(root @ root.T, np.linalg.inv(damped.T @ damped), atol=1e-14)


def test_the_covariance_and_what_the_rows_do_not_tell():
    spectrum = Triangle.of(ROWS).spectrum()
    covariance = np.linalg.inv(A.T @ A)
    scale = np.outer(SCALES, SCALES)
    root = spectrum.root()
    np.testing.assert_allclose(root @ root.T * scale, covariance * scale, atol=1e-14)
    np.testing.assert_allclose(spectrum.deviations(), np.sqrt(np.diag(covariance)), rtol=1e-10)
    assert spectrum.rank == 7
    assert spectrum.condition == pytest.approx(np.linalg.cond(A / np.linalg.norm(A, axis=0)))
    twice = Triangle.of(np.column_stack([A, A[:, 2], B])).spectrum()
    assert twice.rank == 7
    assert twice.condition > 1e14
    difference = np.eye(8)[2] - np.eye(8)[7]
    assert np.abs(difference @ twice.root()).max() < 1e-12
    np.testing.assert_allclose(
        plain(Triangle.of(np.column_stack([A, A[:, 2], B])))[2], lstsq(A, B)[2] / 2
    )
    assert (twice.deviations()[[2, 7]] > 1e10 * spectrum.deviations()[2]).all()
    assert np.isfinite(twice.deviations()).all()
    assert Triangle.empty(2).spectrum().rank == 0
    assert (plain(Triangle.empty(2)) == 0).all()


def test_a_step_becomes_a_solution():
    """Gauss–Newton's b is the residual at c₀, and its solution is what c₀ is off by."""
    start = C + 0.3
    step = Triangle.of(np.column_stack([A, A @ start - B]))
    np.testing.assert_allclose(start - plain(step), lstsq(A, B), rtol=1e-9)
    np.testing.assert_allclose(plain(step.rebased(start)), lstsq(A, B), rtol=1e-9)


def test_a_row_that_failed_outweighs_all():
    spoilt = Triangle.of(ROWS).spoilt()
    assert spoilt.norm == np.inf
    assert spoilt.merge(Triangle.of(ROWS)).norm == np.inf
    assert spoilt.spectrum().rank == 7
    assert not spoilt.finite


WRONG = {
    "the factor is (3, 3) of rows of 4": (np.zeros((3, 3), order="F"), np.zeros((5, 4), order="F")),
    "rows in C's order": (np.zeros((4, 4), order="F"), np.zeros((5, 4))),
    "single precision": (np.zeros((4, 4), "f", order="F"), np.zeros((5, 4), "f", order="F")),
    "a view with gaps": (np.zeros((4, 4), order="F"), np.zeros((10, 4), order="F")[::2]),
}


def refused() -> int:
    """Number of the wrong arguments that are refused before LAPACK sees their addresses."""
    count = 0
    for factor, rows in WRONG.values():
        try:
            folded(factor, rows)
        except ValueError:
            count += 1
    return count


def test_lapack_is_never_given_arrays_of_another_shape():
    assert refused() == len(WRONG)
    with pytest.raises(ValueError, match="expected a factor"):
        folded(np.zeros((4, 4), order="F"), np.zeros((5, 4), order="F"), triangular=True)


@pytest.mark.slow
def test_nor_where_python_leaves_out_assertions():
    """``python -O``."""
    code = "import test_triangle as t; assert False; raise SystemExit(t.refused() - len(t.WRONG))"
    path = [__file__.rpartition("/")[0], *filter(None, sys.path)]
    run = [sys.executable, "-O", "-c", f"import sys; sys.path[:0] = {path!r}; {code}"]
    assert subprocess.run(run, check=False).returncode == 0
