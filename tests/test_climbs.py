"""Data flow one way through a fit: `benchmarks.climbs` counts where a room calls a later one."""

import pytest

from benchmarks.climbs import climbs_of

# What stays are protocols of the solvers: Newton's method calls a residual, Gauss–Newton over arcs
# its defects.
MOST = 15
SLOW = [pytest.param(case, marks=pytest.mark.slow) for case in ("pairs", "sequences")]


@pytest.mark.parametrize("case", ["map", *SLOW])
def test_a_fit_hardly_climbs(case):
    found = climbs_of(case).found
    assert 0 < len(found) <= MOST, sorted(found)
