"""Benchmark of a new user: each case ends with a verdict that is true."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

import as_a_user as benchmark

# Cases of a second or two; the others take up to their budget of two minutes, or are much alike.
SHORT = {
    "single-orbit",
    "twenty-pairs",
    "friction",
    "degrees",
    "copies",
    *benchmark.REFUSED,
}


def long_ones_slow(name):
    return name if name in SHORT else pytest.param(name, marks=pytest.mark.slow)


@pytest.mark.slow
@pytest.mark.usefixtures("as_a_user")
@pytest.mark.parametrize("name", [long_ones_slow(name) for name in benchmark.CASES])
def test_what_is_said_is_true(name):
    measured = benchmark.measure(name)
    assert measured["wrong"] == [], measured["messages"]


@pytest.mark.slow
def test_the_quick_cases_write_their_result(tmp_path, monkeypatch):
    monkeypatch.setattr(benchmark, "measure", lambda name: MEASURED | {"messages": [name]})
    benchmark.main(["--quick", "--out", str(tmp_path)])
    found = benchmark.read({"": tmp_path / "as-a-user.json"})[""]
    assert list(found["measured"]) == [n for n in benchmark.CASES if n in benchmark.QUICK]
    table = benchmark.table(found["measured"])
    assert "| friction | 9 | 1 (10) |" in table
    assert "| 1.00, 1.04 |" in table


MEASURED = {
    "seconds": 1.0,
    "in_time": True,
    "budget": 10.0,
    "pairs": 9,
    "model": "midpoint polynomial 2",
    "claimed": 1e-7,
    "true_error": 1e-7,
    "met": True,
    "messages": [],
    "noise_ratio": [1.0, 1.04],
    "ended": "the tolerance is met",
    "truthful": False,
    "wrong": ["met"],
}
