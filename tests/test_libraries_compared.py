"""The simplest of libraries of H whose held-out errors do not tell them apart."""

import numpy as np
import pytest

from gfnn_jax.dataset.measured_error import Tolerance, one_step_error
from gfnn_jax.models.hamiltonians.fitted_law import FittedLaw
from gfnn_jax.models.hamiltonians.library_search import simplest_where_few_decide
from gfnn_jax.models.hamiltonians.problem import LawProblem

BEST = 3e-12, 1e-9  # of the larger library: at most states, and at one


@pytest.mark.parametrize("relative", [True, False])
@pytest.mark.parametrize(
    ("small", "large", "taken"),
    [
        ((5e-12, 1.2e-9), BEST, "small"),  # one state makes all of both errors
        ((7e-12, 1.2e-9), BEST, "large"),  # the larger library halves the errors at most states
        ((5e-12, 1e-6), BEST, "large"),  # its error at one state is lower than by chance
        ((5e-10, 1.05e-9), (4.9e-10, 1e-9), "large"),  # no few states make the error
    ],
)
def test_few_states_with_large_errors_do_not_decide(small, large, taken, relative):
    asked, spread = Tolerance(1e-11, relative), np.array([2.0, 0.5])

    def law(at_most_states, at_one):
        error = np.full((60, 2), at_most_states)
        error[7] = at_one
        return FittedLaw(None, None, np.arange(3), one_step_error(error, spread, asked), ())

    laws = {"small": law(*small), "large": law(*large)._replace(stalled=True)}
    found = simplest_where_few_decide(LawProblem(None, asked), [*laws.values()], laws["large"])
    assert found.stalled
    assert found.error is laws[taken].error
