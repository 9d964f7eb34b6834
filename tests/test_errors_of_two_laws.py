"""Two laws by the errors of their forecasts, against chance."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gfnn_jax.models.lagrangians.calibration import Calibration


def calibration(errors: np.ndarray) -> Calibration:
    """Of errors (8, n) of forecasts from the parts of a record, 1, 2, … s ahead."""
    parts = np.stack([np.median(np.delete(errors, k, axis=0), axis=0) for k in range(8)])
    law: Any = SimpleNamespace(sensors=SimpleNamespace(leads=1.0 + np.arange(errors.shape[1])))
    return Calibration(law, [], np.median(errors, axis=0)[:, None], parts[..., None])


def errs_more(one: Calibration, other: Calibration) -> bool:
    return one.against(other).is_higher(1.0)


@pytest.mark.parametrize("more", [1.3, 1.02, 0.8])
def test_a_law_errs_more_where_its_errors_are_larger_beyond_their_scatter(more):
    """Errors in eight parts of a record at five times ahead: of either law by itself they scatter
    alike by a third; of one to the other by a twentieth."""
    rng = np.random.default_rng(1)
    one = np.exp(rng.normal(size=(8, 5)) / 3)
    other = one * more * np.exp(rng.normal(size=(8, 5)) / 20)
    assert errs_more(calibration(other), calibration(one)) == (more > 1.1)
    assert errs_more(calibration(one), calibration(other)) == (more < 0.9)


def test_errors_at_times_that_one_part_alone_shows_say_nothing_of_chance():
    one, other = calibration(np.full((8, 3), 1.0)), calibration(np.full((8, 3), 1.2))
    other.parts[0, 2] = np.nan
    assert errs_more(other, one)
    assert not errs_more(one, other)
    assert not errs_more(calibration(np.zeros((8, 0))), calibration(np.zeros((8, 0))))


def test_errors_soon_after_the_start_count_only_where_they_are_asked_for():
    """Half as large at two times ahead, where they are the state's, larger at three later ones."""
    one = np.ones((8, 5))
    other = one * [0.5, 0.5, 1.1, 1.1, 1.1]
    assert calibration(other).against(calibration(one)).cost == pytest.approx(0.8, rel=0.01)
    assert calibration(other).against(calibration(one), 3.0).cost == pytest.approx(1.1)
    assert calibration(other).against(calibration(one), 6.0).cost == 1.0
