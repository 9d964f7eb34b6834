"""Benchmark of a new user: each case ends with a verdict that is true."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

import as_a_user as benchmark

# Cases of a second or two; the others take up to their budget of two minutes, or are much alike.
SHORT = {"single-orbit", "twenty-pairs", "friction", "degrees", "copies", *benchmark.REFUSED}


def long_ones_slow(name):
    return name if name in SHORT else pytest.param(name, marks=pytest.mark.slow)


@pytest.mark.slow
@pytest.mark.usefixtures("as_a_user")
@pytest.mark.parametrize("name", [long_ones_slow(name) for name in benchmark.CASES])
def test_what_is_said_is_true(name):
    measured = benchmark.measure(name)
    assert measured["wrong"] == [], measured["messages"]
