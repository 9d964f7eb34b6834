"""The simplest of libraries of H whose held-out errors do not tell them apart."""

import numpy as np
import pytest

from gfnn_jax.dataset.measured_error import Tolerance, one_step_error
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw
from gfnn_jax.models.hamiltonians.library_search import simplest_that_errs_least


@pytest.mark.parametrize("relative", [True, False])
@pytest.mark.parametrize(
    ("at_most_states", "at_one", "simplest"),
    [
        (1e-12, 1.2e-9, True),  # one state makes all of both errors
        (4e-12, 1.2e-9, False),  # the larger library errs less at most states
        (1e-12, 1e-6, False),  # and here so much less at one that no chance makes it
    ],
)
def test_few_states_with_large_errors_do_not_decide(relative, at_most_states, at_one, simplest):
    asked, spread = Tolerance(1e-11, relative), np.array([2.0, 0.5])

    def law(typical, largest):
        error = np.full((60, 2), typical)
        error[7] = largest
        return FittedLaw(None, None, np.arange(3), one_step_error(error, spread, asked), ())

    small, large = law(at_most_states, at_one), law(3e-12, 1e-9)._replace(stalled=True)
    found = simplest_that_errs_least([small, large], large, asked)
    assert found.stalled
    assert found.error is (small if simplest else large).error
