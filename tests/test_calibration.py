"""Statistics in benchmarks/bands.py of errors and bands of several data sets."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

from posteriors.calibration import FAR, STATES, STEPS, Cell, cells, pooled

SHAPE = (STATES, len(STEPS), 4)


def data_sets(count, error_of, band=2.0):
    """(error, band) of each; at the last step only the first FAR states go on."""
    found = []
    for k in range(count):
        error = np.broadcast_to(error_of(k), SHAPE).copy()
        error[FAR:, -1] = np.nan
        found.append((error, np.full(SHAPE, band)))
    return found


def row(found, **others):
    return {**pooled(found, np.ones(4)), **others}


def test_normal_errors_are_covered_as_they_should_be():
    rng = np.random.default_rng(0)
    found = row(data_sets(200, lambda k: rng.normal(size=SHAPE)))
    np.testing.assert_allclose(found["coverage"], 0.9545, atol=0.01)
    np.testing.assert_allclose(found["width"], 2.0, rtol=0.02)
    np.testing.assert_allclose(found["rms"], 1.0, rtol=0.02)
    assert all(isinstance(c, Cell) and c.covers for c in cells(found)[:-1])
    assert cells(found)[-1] == "large"


def test_chance_is_that_of_data_sets_and_not_of_their_errors():
    """All errors of one data set lie inside together, those of one in four outside."""
    found = row(data_sets(8, lambda k: 3.0 if k % 4 == 0 else 1.0))
    assert found["coverage"] == [0.75] * len(STEPS)
    expected = np.std([0, 1, 1, 1] * 2, ddof=1) / np.sqrt(8)
    np.testing.assert_allclose(found["coverage_error"], expected)
    assert row(data_sets(1, lambda k: 1.0))["coverage_error"] == [None] * len(STEPS)


def test_a_lost_prediction_lies_outside():
    found = row(data_sets(2, lambda k: np.nan if k else 1.0))
    assert found["coverage"] == [0.5] * len(STEPS)
    assert found["lost"] == [STATES] * (len(STEPS) - 1) + [FAR]
    np.testing.assert_allclose(found["rms"], 1.0)


@pytest.mark.parametrize(("outside", "decided"), [(0, True), (3, False), (5, True)])
def test_chance_decides_within_one_standard_error_only(outside, decided):
    """Of twenty data sets none, three or five lie outside: 100, 85 ± 8, 75 ± 10 %."""
    found = row(data_sets(20, lambda k: 3.0 if k < outside else 0.01))
    assert [cell.decided for cell in cells(found) if isinstance(cell, Cell)] == (
        [decided] * (len(STEPS) - (outside > 0))
    )
