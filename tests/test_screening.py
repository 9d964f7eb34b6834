"""Gross errors that are many are found before a fit, and honest pairs never are."""

import itertools

import numpy as np
import pytest
from analytic import kepler, standard_map

import gfnn_jax as gfnn
from gfnn_jax.coordinates import Coordinates
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.runs import arcs_of_pairs, identified, steps_between
from gfnn_jax.diagnosis.outliers import clean, gross_errors
from gfnn_jax.families.terms import given_terms
from gfnn_jax.flows.collocation import Steps, images

NOISE, DT = 1e-3, 0.5
HENON_HEILES = given_terms(2, ("q1**2 + q2**2 + p1**2 + p2**2", "q1**2*q2 - q2**3/3"))
TRUE = np.array([0.5, 1.0])
SWING = given_terms(1, ("p1**2", "cos(q1)"))


def recorded(family, coefficients, start, length, dt, noise=NOISE, seed=0):
    """(B, length, 2d) sequences from these states, with noise."""
    states = [start]
    for _ in range(length - 1):
        states.append(images(family, coefficients, states[-1], dt, Steps(4, 4)).states)
    states = np.stack(states, axis=1)
    return states + noise * np.random.default_rng(seed).normal(size=states.shape)


def henon_heiles(length):
    start = np.random.default_rng(0).uniform(-0.25, 0.25, (2_000 // length, 4))
    return recorded(HENON_HEILES, TRUE, start, length, DT)


def swings(length):
    start = np.random.default_rng(0).uniform(-1, 1, (2_000 // length, 2))
    return recorded(SWING, np.array([0.5, -1.0]), start, length, 0.2)


def spoilt(states, part, size, seed=1):
    """The states, of which a part is drawn anew from the box of all, or moved by 20 to 200 times
    the noise, and (B, L) which."""
    rng, width = np.random.default_rng(seed), states.shape[-1]
    if states.shape[1] == 2:  # one state of a pair
        wrong = np.zeros(states.shape[:2], bool)
        rows = rng.choice(len(states), round(part * len(states)), replace=False)
        wrong[rows, rng.integers(0, 2, len(rows))] = True
    else:
        wrong = rng.permutation(states[..., 0].size) < part * states[..., 0].size
        wrong = wrong.reshape(states.shape[:2])
    every = states.reshape(-1, width)
    other = rng.uniform(every.min(axis=0), every.max(axis=0), states.shape)
    if size == "noise":
        way = rng.normal(size=states.shape)
        way /= np.linalg.norm(way, axis=-1, keepdims=True)
        other = states + way * np.sqrt(width) * NOISE * np.exp(
            rng.uniform(np.log(20), np.log(200), (*states.shape[:2], 1))
        )
    return np.where(wrong[..., None], other, states), wrong


def pairs_of(states, dt=DT):
    width = states.shape[-1]
    return gfnn.Pairs(states[:, :-1].reshape(-1, width), states[:, 1:].reshape(-1, width), dt)


def named(pairs, angles=()):
    """Rows that are named, with nothing left out before."""
    data = Dataset.of(pairs, Coordinates("cartesian", angles=angles))
    return gross_errors(data, steps_between(identified(pairs).pairs) > 0, np.zeros(len(data), bool))


@pytest.mark.parametrize(
    ("make", "angles", "length", "part", "size"),
    [
        pytest.param(make, angles, length, 0.1, size, marks=pytest.mark.slow if slow else ())
        for make, angles, alike in ((henon_heiles, (), "noise"), (swings, (0,), "box"))
        for length, size in itertools.product((50, 2), ("box", "noise"))
        for slow in [length == 50 and size == alike]
    ],
)
def test_gross_errors_are_named_and_no_others(make, angles, length, part, size):
    """Of 20 to 200 times the noise, or as large as the data; two in a hundred may stay."""
    states, wrong = spoilt(make(length), part, size)
    rows = named(pairs_of(states), angles)
    bad = np.flatnonzero((wrong[:, :-1] | wrong[:, 1:]).ravel())
    assert np.isin(rows, bad).all()
    assert len(rows) >= 0.98 * len(bad)


def kepler_passages():
    """20 orbits of eccentricity 0.5 to 0.95: a step of 0.5 takes a close passage at once."""
    rng = np.random.default_rng(0)
    e, turn = rng.uniform(0.5, 0.95, (20, 1)), rng.uniform(0, 2 * np.pi, (20, 1))
    return kepler(1.0, e, rng.uniform(0, 2 * np.pi, (20, 1)) + 0.5 * np.arange(51), turn)


def pairs_of_kicks(k):
    z = np.random.default_rng(0).uniform(0, 2 * np.pi, (2_000, 2))
    return gfnn.Pairs(z, standard_map(z, k), 1.0)


HONEST = {
    "passages": lambda: pairs_of(kepler_passages()),
    "few": lambda: pairs_of(kepler_passages()[:, :2]),
    "map-2": lambda: pairs_of_kicks(2.0),
    "map-10": lambda: pairs_of_kicks(10.0),
    "noisy": lambda: pairs_of(henon_heiles(50)),
    "columns": lambda: pairs_of(henon_heiles(50)[..., [0, 2, 1, 3]]),
    "swings": lambda: pairs_of(swings(50)),
}


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(make, id=name, marks=pytest.mark.slow if name in ("columns", "swings") else ())
        for name, make in HONEST.items()
    ],
)
def test_honest_pairs_are_all_kept(make):
    assert len(named(make())) == 0


@pytest.mark.slow
def test_a_jump_that_stays_is_no_gross_error_of_a_state():
    """Ten sequences are kicked once: the states before do not lead to those after."""
    states = henon_heiles(50)
    states[:10, 25:] = henon_heiles(50)[10:20, :25]
    assert len(named(pairs_of(states))) == 0


@pytest.mark.slow
def test_what_was_left_out_is_bridged():
    states = henon_heiles(50)[:2, :8]
    kept = np.setdiff1d(np.arange(14), [2, 3])  # the state 3 of the first sequence
    few = identified(pairs_of(states)).pairs.take(kept)
    steps = steps_between(few)
    assert steps.tolist() == [1, 3, 1, 1, 0, *[1] * 6]
    arcs = arcs_of_pairs(few.z0, few.z1, 100, steps)
    assert arcs is not None
    assert arcs.measured.sum(axis=1).tolist() == [7, 8]
    assert not arcs.measured[0, 3]
    for n, measured in enumerate(arcs.measured):
        np.testing.assert_array_equal(arcs.states[n, measured], states[n, measured])


@pytest.mark.slow
def test_sequences_are_held_out_whole_where_pairs_were_left_out():
    states, _ = spoilt(henon_heiles(50), 0.05, "box")
    data = clean(identified(pairs_of(states)), Coordinates("cartesian"))[0].divided(0)
    assert len(data) < 1_850
    runs = [set(data.run[rows]) for rows in data.split[:3]]
    assert not any(one & other for one, other in itertools.combinations(runs, 2))


@pytest.mark.slow
@pytest.mark.parametrize("length", [50, 2])
def test_a_fit_is_not_spoilt(length):
    """A twentieth of states, or of pairs, as large as the data: errors within a factor of two."""
    clean_states = henon_heiles(length)
    states, wrong = spoilt(clean_states, 0.05, "box")
    test = np.random.default_rng(2).uniform(-0.2, 0.2, (200, 4))
    true = images(HENON_HEILES, TRUE, test, DT, Steps(4, 4)).states
    errors = []
    for part in (clean_states, states):
        with pytest.warns(gfnn.FitWarning):
            fit = gfnn.fit(pairs_of(part), learn="hamiltonian", max_seconds=None)
        found = np.asarray(fit.map.rollout(test, 1)[0])[:, 1]
        errors.append(np.sqrt(np.mean((found - true) ** 2)))
    assert errors[1] < 2 * errors[0] + 1e-5
    assert fit.num_pairs == np.sum(~(wrong[:, :-1] | wrong[:, 1:]))


def test_an_angle_that_jumps_makes_no_errors():
    """Rotors whose angle is wrapped and not named: where it jumps a pair contradicts the others."""
    z = np.array([0.0, 2.8]) + np.random.default_rng(0).uniform(-1, 1, (1_000, 2)) * [np.pi, 0.6]
    z1 = images(SWING, np.array([0.5, -1.0]), z, 0.1, Steps(4, 2)).states
    z1[:, 0] = np.remainder(z1[:, 0] + np.pi, 2 * np.pi) - np.pi
    pairs = gfnn.Pairs(z, z1, 0.1)
    kept, told = (
        clean(identified(pairs), Coordinates("cartesian"), jumps=jumps) for jumps in (True, False)
    )
    assert len(kept[0]) == len(pairs)
    assert kept[1] == []
    assert told[1]  # nothing but the jumps is wrong with them
