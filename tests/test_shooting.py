"""H from whole noisy sequences, and gross errors among measured states and pairs."""

import re

import jax
import numpy as np
import pytest

import gfnn_jax as gfnn
from gfnn_jax.families.terms import given_terms
from gfnn_jax.fitting import least_squares
from gfnn_jax.fitting.shooting import Shooting, arcs_of, longest_arc
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.flows.collocation import Steps, images
from gfnn_jax.scenes import henon_heiles

NOISE, DT, STEPS = 1e-3, 0.3, Steps(3, 1)
OSCILLATOR = given_terms(1, ("q1**2", "p1**2", "q1**4"))
TRUE = np.array([0.5, 0.5, 0.1])


def measured(seed, sequences=20, length=11, outliers=0.0, noise=NOISE):
    """(B, length, 2) states of sequences with noise, and which of them are gross errors."""
    rng = np.random.default_rng(seed)
    states = [rng.normal(size=(sequences, 2))]
    for _ in range(length - 1):
        states.append(images(OSCILLATOR, TRUE, states[-1], DT, STEPS).states)
    states = np.stack(states, axis=1) + noise * rng.normal(size=(sequences, length, 2))
    wrong = rng.random(states.shape[:2]) < outliers
    return states + wrong[..., None] * rng.normal(size=states.shape), wrong


def pairs_of(states):
    width = states.shape[-1]
    return states[:, :-1].reshape(-1, width), states[:, 1:].reshape(-1, width)


def shot(states, longest=100):
    arcs = arcs_of(*pairs_of(states), longest)
    assert arcs is not None
    found = Shooting(arcs, DT, STEPS, np.ones(2)).fit(OSCILLATOR, 1.01 * TRUE)
    assert found is not None
    return found


def test_arcs_are_the_sequences_in_parts():
    states = np.random.default_rng(0).normal(size=(3, 8, 2))
    arcs = arcs_of(*pairs_of(states), 5)  # 7 steps each: 5 and 2
    assert arcs is not None
    np.testing.assert_array_equal(arcs.measured.sum(axis=1), [6, 3, 6, 3, 6, 3])
    np.testing.assert_array_equal(arcs.states[2], states[1, :6])
    np.testing.assert_array_equal(arcs.states[3, :3], states[1, 5:])
    assert arcs_of(states[0, :0], states[0, :0], 5) is None


def test_errors_are_those_that_the_covariance_says():
    """Of 8 sets of data, the squares of error ÷ deviation: chi squared of 24, 12 to 39 in 95 %."""
    squares = noise = 0.0
    for seed in range(8):
        found = shot(measured(seed)[0])
        covariance = found.root.T @ found.root
        off = found.coefficients - TRUE
        squares += float(off @ np.linalg.solve(covariance, off))
        noise += found.noise / 8
    assert 10 < squares < 42
    np.testing.assert_allclose(noise, NOISE, rtol=0.06)


def test_gross_errors_change_nothing_and_are_counted():
    clean, spoilt = shot(measured(0)[0]), measured(0, outliers=0.05)
    found = shot(spoilt[0])
    deviation = np.linalg.norm(clean.root, axis=0)
    assert np.all(np.abs(found.coefficients - TRUE) < 4 * deviation)
    assert found.outlying == pytest.approx(spoilt[1].sum(), abs=1)
    np.testing.assert_allclose(found.noise, NOISE, rtol=0.15)


def test_a_coordinate_without_noise_has_no_outliers():
    """What the steps' own error leaves of it is no noise, beside which others would be gross."""
    arcs = arcs_of(*pairs_of(measured(0, length=40, noise=np.array([NOISE, 0.0]))[0]), 100)
    assert arcs is not None
    steps = Steps(2, 1)  # off by 3e-4 in a step
    found = Shooting(arcs, DT, steps, np.ones(2), resolved=3e-4).fit(OSCILLATOR, TRUE)
    assert found is not None
    assert found.outlying == 0
    np.testing.assert_allclose(found.noise[0], NOISE, rtol=0.06)
    assert found.noise[1] < 0.5 * NOISE


def test_an_arc_ends_before_noise_has_grown():
    unstable = given_terms(1, ("p1**2", "q1**2"))
    z = np.random.default_rng(0).normal(size=(20, 2))
    steps = longest_arc(unstable, np.array([0.5, -0.5]), z, DT, STEPS, 1e-3)
    # Noise of 1e-3 grows to 0.1 of the spread as cosh t: at t = 5, 17 steps.
    assert 14 <= steps <= 19
    assert longest_arc(OSCILLATOR, TRUE, z, DT, STEPS, 1e-6) == 100


def test_a_ridge_is_taken_for_more_than_chance_alone():
    terms = 30

    def ridge(rows, seed):
        rng = np.random.default_rng(seed)

        def reduced(n):
            a = rng.normal(size=(n, terms))
            b = 0.05 * a.sum(axis=1) + rng.normal(size=n)
            return Triangle.of(np.column_stack([a, b]))

        return least_squares.solve(reduced(rows), reduced(rows // 9), terms).ridge

    many, few = (np.array([ridge(n, seed) for seed in range(20)]) for n in (9_000, 36))
    assert np.sum(many > 1e-4) <= 2  # chance takes one of 7 in 10 where the least error decides
    assert np.sum(few > 1e-4) >= 1


@pytest.fixture(scope="module")
def spoilt():
    """300 pairs, six of whose images are gross errors: 0.05 beside noise of 1e-4."""
    pairs = gfnn.sample_pairs(henon_heiles(), 300, jax.random.key(0))
    rng = np.random.default_rng(0)
    z0, z1 = (np.asarray(z) + 1e-4 * rng.normal(size=z.shape) for z in (pairs.z0, pairs.z1))
    rows = np.sort(rng.choice(300, 6, replace=False))
    z1[rows] += 0.05 * rng.normal(size=(6, 4))
    with pytest.warns(gfnn.FitWarning):
        fit = gfnn.fit(gfnn.Pairs(z0, z1, pairs.dt), learn="hamiltonian", tolerance=1e-3)
    return rows, fit


def test_gross_errors_among_pairs_do_not_spoil_the_law(spoilt):
    rows, fit = spoilt
    assert fit.num_pairs == 300 - len(rows)
    assert fit.chosen.num_parameters == 6
    found = {term.term: term.coefficient for term in fit.hamiltonian.terms}
    assert found["q1² q2"] == pytest.approx(1.0, abs=3e-3)
    assert fit.met
    told = " ".join(fit.messages)
    assert "gross errors" in told
    named = [
        int(n) for part in re.findall(r"rows ([\d, ]+)", told) for n in part.split(",") if n.strip()
    ]
    assert sorted(named) == rows.tolist()


def test_maps_are_drawn_of_an_s_of_sites():
    """Of kicked rotors in a ring, noise of 1e-3: coefficients within their deviations."""
    scene = gfnn.scenes.froeschle(20)
    pairs = gfnn.sample_pairs(scene, 60, jax.random.key(0))
    rng = np.random.default_rng(0)
    z0, z1 = (np.asarray(z) + 1e-3 * rng.normal(size=z.shape) for z in (pairs.z0, pairs.z1))
    with pytest.warns(gfnn.FitWarning):
        fit = gfnn.fit(gfnn.Pairs(z0, z1, pairs.dt), scene)
    assert fit.chosen.learns == "map"
    drawn = np.asarray(fit.sample(jax.random.key(0), 200).params)
    clean = gfnn.fit(pairs, scene).map.pieces[0].params
    assert drawn.shape[1:] == np.shape(clean)
    off = (drawn.mean(axis=0) - np.asarray(clean)) / drawn.std(axis=0)
    assert np.all(np.abs(off) < 4)
    assert np.all(drawn.std(axis=0) < 1e-3)
