"""The search's policy, on sweeps that are made up: what is tried, in what order, what is chosen."""

import dataclasses
from typing import NamedTuple

import numpy as np
import pytest

from gfnn_jax.budget import Budget
from gfnn_jax.candidates.assemble import Candidate
from gfnn_jax.search.search import Search

WORK = 1_000  # operations that a made-up size takes, and its steps


class Size(NamedTuple):
    operations: float
    estimate: float
    error: float
    order: float


class Sweep:
    """Sizes with an estimate and an error each; it notes what it is asked."""

    def __init__(self, sizes, family="polynomial", chart="midpoint"):
        self.sizes = [Size(float(s[0]), s[1], s[-1], float(n)) for n, s in enumerate(sizes, 2)]
        self.short_of_pairs = True
        self.family, self.chart = family, chart
        self.judged, self.validated = [], []

    def named(self, size):
        return f"{self.family} {size.operations:g}"

    def work(self, size):
        return WORK

    def work_of_steps(self, size):
        return WORK

    def estimate(self, size, budget, on_progress):
        self.judged.append(size.operations)
        about = (self.named(size), self.family, self.chart, 3, size.operations)
        return Candidate(*about, *[size.estimate] * 3, np.ones(2), size.estimate, 0.0)

    def at(self, order):
        return f"{self.family} {order:g}"

    def validate(self, size, judged, budget, say):
        self.validated.append(size.operations)
        told = dict.fromkeys(
            ("validation_rms", "validation_relative", "validation_bound"), size.error
        )
        return dataclasses.replace(judged, **told, validated=True)


def found_in(*sweeps, bound=1e-6, budget=None, told=None, on_validated=None):
    tell = (lambda c: None) if told is None else told.append
    given = bound, budget or Budget(), lambda message: None, tell, on_validated
    return Search(sweeps, *given).to_its_end()


def order(found):
    return [e.candidate.operations for e in found.ranking]


FALLING = [(10.0**k, 10.0 ** (-2 * k)) for k in range(1, 7)]  # 1e-2 at 10, 1e-4 at 100, ...


def test_the_cheapest_that_is_accurate_enough_is_chosen_and_nothing_dearer_is_tried():
    sweep, told = Sweep(FALLING), []
    found = found_in(sweep, bound=1e-6, told=told)
    assert order(found)[0] == 1e3
    assert sweep.judged == [10, 100, 1000]
    assert found.ended == "the tolerance is met"
    assert [c.operations for c in told] == sweep.judged
    assert [e.candidate.operations for e in found.entries] == sweep.judged


def test_only_hopeful_sizes_are_validated():
    """One to learn how estimates relate to errors, then those that may be accurate enough."""
    sweep = Sweep(FALLING)
    found_in(sweep, bound=1e-10)
    assert sweep.judged == [10, 100, 1e3, 1e4, 1e5]
    assert sweep.validated == [1e4, 1e5]


@pytest.mark.parametrize("ratio", [0.02, 50.0])
def test_how_far_estimates_are_off_is_learned(ratio):
    """Estimates need only rise and fall with the errors."""
    sweep = Sweep([(o, ratio * e, e) for o, e in FALLING])
    found = found_in(sweep, bound=1e-6)
    assert order(found)[0] == 1e3
    assert found.ranking[0].candidate.validation_bound == pytest.approx(1e-6)


def test_sweeps_are_climbed_together_by_rising_operations():
    one = Sweep([(10, 1e-2), (30, 1e-3), (90, 1e-4)])
    other = Sweep([(20, 1e-3), (60, 1e-7), (200, 1e-9)], chart="type2")
    told = []
    found = found_in(one, other, told=told)
    assert [c.operations for c in told] == [10, 20, 30, 60]
    assert order(found)[0] == 60
    assert found.ranking[0].sweep is other


def test_a_sweep_that_no_longer_gains_is_left():
    sweep = Sweep([(10, 1e-2), *((20 + n, 0.99e-2) for n in range(8))])
    found = found_in(sweep)
    assert len(sweep.judged) == 4
    assert "no more accurate" in found.ended
    assert found.stalled == {("midpoint", "polynomial")}


def test_a_sweep_that_another_keeps_beating_is_left():
    worse = Sweep([(10.0 + n, 10.0 ** -(2 + 0.2 * n)) for n in range(12)], chart="type2")
    better = Sweep([(10.0 + n, 10.0 ** -(3 + 0.5 * n)) for n in range(12)])
    found = found_in(better, worse, bound=1e-8)
    assert len(worse.judged) <= 4
    assert found.ranking[0].sweep is better
    # Of other functions, which may gain faster later, only where far better ones are as cheap.
    later = Sweep([(10.0 + n, 10.0 ** -(2.5 + 0.5 * n)) for n in range(12)], family="sines")
    better = Sweep([(10.0 + n, 10.0 ** -(3 + 0.5 * n)) for n in range(12)])
    found_in(better, later, bound=1e-8)
    assert len(later.judged) > 8


def test_where_nothing_meets_the_tolerance_the_few_best_are_validated():
    sizes = [(10.0 * 2**n, 10.0**-n, 2 * 10.0**-n) for n in range(1, 7)]
    sweep = Sweep(sizes)
    found = found_in(sweep, bound=1e-20)
    assert sorted(sweep.validated) == [160, 320, 640]
    assert order(found) == [640, 320, 160]
    assert "more pairs would help" in found.ended
    sweep.short_of_pairs = False
    assert "no larger model to try" in found_in(sweep, bound=1e-20).ended
    assert len(found.entries) == 6


def test_of_maps_that_are_as_good_the_cheaper_is_chosen():
    sweep = Sweep([(10, 1e-1), (20, 1.02e-2), (40, 1.01e-2), (80, 1e-2)])
    assert order(found_in(sweep, bound=1e-20)) == [20, 40, 80]


def test_a_finalist_whose_steps_fail_is_ranked_last():
    sweep = Sweep([(10, 1e-1), (20, 1e-2), (40, 1e-3, np.inf)])
    found = found_in(sweep, bound=1e-20)
    assert order(found) == [20, 10, 40]


def test_steps_that_belie_the_estimate_let_the_search_go_on():
    """A size whose steps fail is no reason to stop, whatever its estimate says."""
    sweep = Sweep([(10, 1e-3), (20, 1e-7, np.inf), (40, 1e-8)])
    found = found_in(sweep, bound=1e-6)
    assert order(found)[0] == 40
    assert sweep.judged == [10, 20, 40]


def test_what_was_found_before_the_budget_was_spent_stands():
    sweep = Sweep(FALLING)
    found = found_in(sweep, bound=1e-9, budget=Budget(max_operations=2 * WORK))
    assert sweep.judged == [10, 100]
    assert order(found) == [100]
    assert found.ended.startswith(
        "there were no operations for more after step 2 of the search (polynomial 100): polynomial "
        "1000 needs"
    )


def test_a_climb_in_parts_finds_what_one_in_one_go_does():
    class Dearer(Sweep):
        def work(self, size):
            return size.operations

    one, other = Dearer(FALLING), Dearer(FALLING)
    whole = found_in(one, bound=1e-9)
    parts = Search([other], 1e-9, Budget(), lambda message: None, lambda candidate: None)
    parts.climb(most=500.0)
    assert other.judged == [10, 100]
    parts.climb()
    assert other.judged == one.judged
    assert order(parts.found()) == order(whole)


# What errors lead to


def geometric(first, rate, count, operations=10.0, every=1):
    """Sizes whose error falls by the factor ``rate`` with every so many of them."""
    return [(operations * 2**n, first * rate ** (n // every)) for n in range(count)]


def test_a_sweep_that_leads_to_less_than_another_has_is_left():
    """Sines, four orders worse than a polynomial of the same cost, are tried no further."""
    sines = Sweep(geometric(2e-1, 0.5, 8), family="sines")
    products = Sweep(geometric(1e-2, 1e-3, 3, operations=15.0, every=2), family="polynomial")
    found_in(products, sines)
    assert len(sines.judged) == 3  # the third is where its decay shows
    assert len(products.judged) == 3


def test_a_sweep_that_gains_with_every_other_size_is_not_given_up():
    """An even S: what looks slow over one size is fast over two."""
    even = Sweep(geometric(1e-1, 1e-2, 9, every=2))
    other = Sweep(geometric(1e-1, 0.3, 9, operations=11.0), family="sines")
    found = found_in(even, other, bound=1e-9)
    assert found.ranking[0].sweep is even
    assert found.ended == "the tolerance is met"


@pytest.mark.parametrize(
    ("sizes", "said"),
    [
        (geometric(1e-1, 1e-1, 4), "extrapolated, polynomial 7 would meet the tolerance"),
        # Degrees 2 to 5 of an even S: 1e-1, 1e-1, 1e-3, 1e-3. The sixth has 1e-5, the eighth 1e-7.
        (geometric(1e-1, 1e-2, 4, every=2), "extrapolated, polynomial 8 would meet the tolerance"),
        (geometric(1e-1, 0.79, 5), "too slowly"),
    ],
)
def test_what_would_be_needed_is_said(sizes, said):
    assert said in found_in(Sweep(sizes), bound=1e-6).ended
