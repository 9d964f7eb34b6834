"""Budgets: decisions that count operations, and a clock that only says how many fit."""

import contextlib
import itertools
import time
import warnings
from functools import partial

import jax
import numpy as np
import pytest
import scipy.linalg
from analytic import turning

import gfnn_jax as gfnn
from gfnn_jax.budget import COMPILE, FLOW, ROWS, Budget
from gfnn_jax.errors import OutOfTime
from gfnn_jax.families.terms import given_terms
from gfnn_jax.flows.collocation import Steps, images
from gfnn_jax.learn import request as of_pairs

QUIETLY = pytest.mark.filterwarnings("ignore::gfnn_jax.FitWarning")
LARGE = 10**10  # operations whose time tells the rate of their kind: a second, by default


class Hand:
    """A clock that stands still until it is moved."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


def moved(budget, hand, operations, seconds, name="a size"):
    """A unit of so many operations that takes so many seconds."""
    with budget.unit(name, ROWS, operations):
        hand.now += seconds


# The budget by itself.


def test_without_a_budget_every_unit_fits_whatever_the_clock():
    hand = Hand()
    budget = Budget(clock=hand)
    for _ in range(3):
        moved(budget, hand, LARGE, 1e9)
    assert not budget.over
    assert budget.operations == 3 * LARGE


def test_a_unit_that_does_not_fit_is_not_begun_nor_anything_smaller_in_its_stead():
    hand = Hand()
    budget = Budget(max_seconds=10.0, clock=hand)
    moved(budget, hand, LARGE, 2.0, "degree 3")
    with pytest.raises(OutOfTime):
        moved(budget, hand, 5 * LARGE, 0.0, "degree 4")  # of 10 s, at 2 s each
    assert budget.ended == (
        "there was no time for more after step 1 of the search (degree 3): degree 4 needs about 10 "
        "s with what must follow it, and 8 of 10 s are left (--max-seconds)"
    )
    with pytest.raises(OutOfTime):
        moved(budget, hand, 1, 0.0)
    assert budget.operations == LARGE


def test_time_is_that_of_the_operations_that_were_made():
    """A unit that makes ten times the operations predicted does not make operations slow: as many
    as it made take as long again, not ten times as long."""
    hand, made = Hand(), [0.0]
    budget = Budget(max_seconds=40.0, clock=hand)
    with budget.unit("a library", FLOW, LARGE, made=lambda: made[0]):
        hand.now += 10.0
        made[0] += 10 * LARGE
    with budget.unit("the next", FLOW, 10 * LARGE):
        hand.now += 10.0
    with pytest.raises(OutOfTime), budget.unit("the last", FLOW, 21 * LARGE):
        pass  # of 20 s that are left


def test_what_must_follow_the_last_unit_is_reserved():
    hand = Hand()
    budget = Budget(max_seconds=10.0, clock=hand)
    with pytest.raises(OutOfTime), budget.unit("a size", ROWS, LARGE, then=(ROWS, 9.5 * LARGE)):
        pass
    compiling = Budget(max_seconds=20.0, clock=hand, dim=3)
    with pytest.raises(OutOfTime), compiling.unit("a size", ROWS, 17 * LARGE):
        pass  # of 20 s a fifth is for compiling, which would take 9 s


def test_the_number_of_operations_gives_the_same_units_again():
    """A clock ends the search somewhere; its count of operations ends it there without a clock."""
    work = [3 * LARGE, LARGE, 7 * LARGE, 2 * LARGE, LARGE]

    def done(**options):
        hand = Hand()
        budget = Budget(clock=hand, **options)
        try:
            for number, operations in enumerate(work):
                moved(budget, hand, operations, operations / 1e9, f"size {number}")
        except OutOfTime:
            pass
        return budget

    for seconds in (35.0, 45.0, 115.0, 135.0, 1e4):
        first = done(max_seconds=seconds)
        again = done(max_operations=first.operations)
        assert again.operations == first.operations
        assert again._last == first._last


def test_what_follows_the_search_takes_the_place_of_no_unit():
    hand = Hand()
    first = Budget(max_seconds=10.0, clock=hand)
    moved(first, hand, LARGE, 1.0)
    with pytest.raises(OutOfTime):
        moved(first, hand, 20 * LARGE, 0.0)
    with first.last("the compiled step", COMPILE, 5.0, decides=True):
        hand.now += 5.0
    with pytest.raises(OutOfTime), first.last("its derivative", COMPILE, 7.0):
        pass
    with pytest.raises(OutOfTime), first.last("a figure", COMPILE, 1.0):
        pass
    assert first.left_out == [
        f"left out: {what} (no time)" for what in ("its derivative", "a figure")
    ]
    again = Budget(max_operations=first.operations)
    with again.unit("the same", ROWS, LARGE):
        pass
    with pytest.raises(OutOfTime), again.unit("the next", ROWS, 2):
        pass
    with again.last("the compiled step", COMPILE, 5.0, decides=True):
        pass
    with pytest.raises(OutOfTime), again.last("that of the next", COMPILE, 5.0, decides=True):
        pass
    assert again.left_out == ["left out: that of the next (no operations)"]
    with again.last("its derivative", COMPILE, 7.0):  # changes nothing that is chosen
        pass


def test_a_unit_that_takes_longer_than_foretold_leaves_nothing_behind():
    hand = Hand()
    budget = Budget(max_seconds=10.0, clock=hand)

    def slow_unit():
        with budget.unit("a size", ROWS, LARGE):
            budget.check()
            hand.now += 11.0
            budget.check()

    with pytest.raises(OutOfTime):
        slow_unit()
    assert budget.operations == 0
    assert budget.over


def test_what_a_fit_rests_on_is_paid_for_by_seconds_of_a_quiet_core():
    """Whether it is told by the seconds or by the operations that were done."""
    for seconds, paid in ((9.0, False), (10.0, True)):
        hand = Hand()
        first = Budget(max_seconds=seconds, clock=hand)
        hand.now = 1e9  # a busy machine
        assert first.pays_for(10 * LARGE) == paid
        hand.now = 0.0
        with contextlib.suppress(OutOfTime):
            while True:
                moved(first, hand, 2 * LARGE, 0.1)
        again = Budget(max_operations=first.operations)
        assert again.pays_for(10 * LARGE) == paid
        with contextlib.suppress(OutOfTime):
            while True:
                moved(again, hand, 2 * LARGE, 0.1)
        assert again.operations == first.operations
        assert (first.operations >= 10 * LARGE) == paid
    assert Budget().pays_for(1e30)


# Fits.


def kepler(num_pairs=150):
    """Cartesian pairs of two bodies: no H of few terms, and an S of many."""
    scene = gfnn.scenes.two_body()
    pairs = gfnn.sample_pairs(scene, num_pairs, jax.random.key(0))
    return gfnn.Pairs(np.asarray(pairs.z0), np.asarray(pairs.z1), pairs.dt)


def leaves(fit):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(fit.map)]


def same_bits(one, other):
    assert one.chosen.label == other.chosen.label
    for a, b in zip(leaves(one), leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


class Jumping:
    """A clock that jumps by up to a thousand seconds whenever it is looked at."""

    def __init__(self, seed):
        self._random, self._now = np.random.default_rng(seed), 0.0

    def __call__(self):
        self._now += self._random.uniform(0, 1_000)
        return self._now


def oscillators(num_pairs=60, dt=0.5, noise=0.0):
    """Pairs of single steps, of one dt or of each its own."""
    rng = np.random.default_rng(0)
    z0 = rng.uniform(-1, 1, (num_pairs, 2))
    z0, z1 = (z + noise * rng.normal(size=z.shape) for z in (z0, turning(z0, dt)))
    return gfnn.Pairs(z0, z1, dt)


def sequences(num=6, length=20, noise=1e-3):
    """Pairs of noisy sequences, which continue each other."""
    rng, states = np.random.default_rng(0), []
    z = rng.uniform(-1, 1, (num, 2))
    for _ in range(length + 1):
        states.append(z + noise * rng.normal(size=z.shape))
        z = turning(z, 0.5)
    seen = np.stack(states, axis=1)
    run = np.repeat(np.arange(num), length)
    return gfnn.Pairs(seen[:, :-1].reshape(-1, 2), seen[:, 1:].reshape(-1, 2), 0.5, run=run)


def ring(dim=6, num_pairs=30):
    """Sites between springs, by the exponential of their linear equations."""
    springs = 2 * np.eye(dim) - np.roll(np.eye(dim), 1, axis=0) - np.roll(np.eye(dim), -1, axis=0)
    rates = np.block([[np.zeros((dim, dim)), np.eye(dim)], [-springs, np.zeros((dim, dim))]])
    z0 = np.random.default_rng(0).normal(size=(num_pairs, 2 * dim))
    return gfnn.Pairs(z0, z0 @ scipy.linalg.expm(0.1 * rates).T, 0.1)


def pendulums(num_pairs=80):
    """Pendulums of different lengths: the length is a parameter."""
    rng = np.random.default_rng(0)
    z0, length = rng.uniform(-1, 1, (num_pairs, 2)), rng.uniform(0.5, 2, num_pairs)
    law, args = given_terms(1, PENDULUM_TERMS, ("l",)), length[:, None]
    z1 = images(law, np.array([0.5, -1.0]), z0, 0.1, Steps(8, 1), args=args).states
    return gfnn.Pairs(z0, z1, 0.1, {"l": length})


SEVERAL = np.tile([0.3, 0.5, 0.7], 20)
NETWORK = {"family": "mlp", "chart": "midpoint", "max_iterations": 3}
PENDULUM_TERMS = ["p1**2/l**2", "l*cos(q1)"]
QUICK = {
    "S or H": (kepler, {"tolerance": 1e-4}),
    "S of several dt": (partial(oscillators, dt=SEVERAL), {"learn": "map"}),
    "H of a ring": (ring, {"learn": "hamiltonian", "structure": "ring"}),
    "H of a parameter": (pendulums, {"learn": "hamiltonian", "terms": PENDULUM_TERMS}),
    "S of noisy sequences": (sequences, {"learn": "map"}),
}
SLOW = {  # much like those
    "H of noisy sequences": (sequences, {"learn": "hamiltonian"}),
    "S of sines": (partial(oscillators, 400), {"learn": "map", "family": "sines"}),
    "a network S": (oscillators, NETWORK),
}
FITS = QUICK | SLOW


@pytest.mark.slow
@QUIETLY
@pytest.mark.parametrize("what", [*QUICK, *SLOW])
def test_without_a_budget_no_decision_looks_at_a_clock(what, monkeypatch):
    """Neither at the budget's, nor past it at the machine's."""
    data, options = FITS[what]
    pairs, found = data(), []
    for seed in (1, 2):
        monkeypatch.setattr(time, "perf_counter", Jumping(10 + seed))
        found.append(gfnn.fit(pairs, clock=Jumping(seed), max_seconds=None, **options))
    one, other = found
    same_bits(one, other)
    assert one.formula == other.formula
    assert (one.ended, one.operations) == (other.ended, other.operations)


@pytest.mark.slow
@QUIETLY
@pytest.mark.parametrize("learn", ["map", "auto"])
def test_a_faster_clock_ends_at_an_earlier_unit_which_operations_reproduce(learn):
    """A clock that ticks at every look at it: so many looks fit, whatever the machine does."""
    pairs, found = kepler(), []
    for tick in (1e-3, 4.0, 12.0, 1e4):
        looks = itertools.count()
        fit = gfnn.fit(
            pairs,
            tolerance=1e-9,
            learn=learn,
            max_seconds=100.0,
            clock=lambda looks=looks, tick=tick: tick * next(looks),
        )
        found.append(fit)
        again = gfnn.fit(
            pairs, tolerance=1e-9, learn=learn, max_seconds=None, max_operations=fit.operations
        )
        same_bits(fit, again)
        assert again.operations == fit.operations
        assert ("there was no time" in fit.ended) == (tick > 1)
        assert fit.budget.ended.partition(" (")[0] in fit.ended
    operations = [fit.operations for fit in found]
    assert operations == sorted(operations, reverse=True)
    assert len(set(operations)) == len(operations)


@pytest.mark.slow
@QUIETLY
def test_where_the_budget_does_not_pay_for_all_pairs_a_sample_is_fitted(monkeypatch):
    """The seconds and operations of the budget tell, not the clock."""
    monkeypatch.setattr(of_pairs.Options, "of_pair", 10**9)
    monkeypatch.setattr(of_pairs.Options, "fewest", 200)
    pairs, work = kepler(300), 300 * 16 * 10**9
    seconds = work / 1e10
    for allowed, tick, num_pairs in ((0.9, 4.0, 200), (0.9, 1e-3, 200), (1.1, 4.0, 300)):
        looks = itertools.count()
        options = {"tolerance": 1e-9, "learn": "map"}
        fit = gfnn.fit(
            pairs,
            max_seconds=allowed * seconds,
            clock=lambda looks=looks, tick=tick: tick * next(looks),
            **options,
        )
        again = gfnn.fit(pairs, max_operations=fit.max_operations, **options)
        assert fit.num_pairs == again.num_pairs == num_pairs
        same_bits(fit, again)
        assert again.operations == fit.operations
        assert (fit.operations >= work) == (num_pairs == 300)
        sample = "the budget pays for a sample; max_seconds=480 pays for all"
        said = f"left out: 100 of 300 pairs ({sample})"
        assert (said in fit.messages) == (num_pairs == 200)
    whole = gfnn.fit(pairs, max_seconds=None, **options)
    assert whole.num_pairs == 300


@pytest.mark.slow
@QUIETLY
def test_a_fit_leaves_some_map_whatever_its_budget():
    pairs = kepler()
    for options in ({}, {"learn": "hamiltonian"}, {"learn": "map"}):
        fit = gfnn.fit(pairs, max_seconds=1e-6, **options)
        assert fit.chosen.family == "linear"
        states, _ = fit.map.rollout(np.asarray(pairs.z0[:5]), 3)
        assert np.isfinite(np.asarray(states)).all()
        assert fit.symplecticity_defect < 1e-12
        assert "there was no time" in fit.ended
        moved = np.asarray(pairs.z1) - np.asarray(pairs.z0)
        assert fit.chosen.validation_rms < 0.5 * np.sqrt(np.mean(moved**2))


def test_seconds_that_are_gone_already_count():
    hand = Hand()
    budget = Budget(max_seconds=10.0, clock=hand, spent=9.5)
    assert budget.seconds == 9.5
    with pytest.raises(OutOfTime):
        moved(budget, hand, LARGE, 1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        fit = gfnn.fit(kepler(), max_seconds=10.0, clock=hand, spent=9.9)
    assert fit.chosen.family == "linear"
    assert "there was no time for a first model" in fit.ended
