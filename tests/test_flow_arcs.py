"""H from whole noisy sequences, and gross errors among measured states and pairs."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

import gfnn_jax as gfnn
from gfnn_jax.dataset.runs import arcs_of_pairs
from gfnn_jax.families.terms import given_terms
from gfnn_jax.fitting import least_squares
from gfnn_jax.fitting.linearised import Linearised
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.flows.collocation import Steps, images
from gfnn_jax.models.hamiltonians.sequences import (
    FlowOnArcs,
    Measured,
    about_outliers,
    covariance_root_of,
    lacks_terms,
    longest_arc,
    triangle_of,
)
from gfnn_jax.solve.latent_arcs import OUTLYING

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


def shot(states, start=1.01 * TRUE, steps=STEPS, least=1e-15, angles=()):
    arcs = arcs_of_pairs(*pairs_of(states), 100)
    assert arcs is not None
    model = FlowOnArcs(OSCILLATOR, DT, steps, arcs.moves)
    found = Measured(arcs, np.full(2, least), angles).fit(model, start)
    assert found is not None
    assert found.converged
    return found


def outliers(found):
    return int(np.any(np.abs(found.residuals) > OUTLYING, axis=-1).sum())


def test_arcs_are_the_sequences_in_parts():
    states = np.random.default_rng(0).normal(size=(3, 8, 2))
    arcs = arcs_of_pairs(*pairs_of(states), 5)  # 7 steps each: 5 and 2
    assert arcs is not None
    np.testing.assert_array_equal(arcs.measured.sum(axis=1), [6, 3, 6, 3, 6, 3])
    np.testing.assert_array_equal(arcs.moves.sum(axis=1), [5, 2, 5, 2, 5, 2])
    np.testing.assert_array_equal(arcs.states[2], states[1, :6])
    np.testing.assert_array_equal(arcs.states[3, :3], states[1, 5:])
    assert arcs_of_pairs(states[0, :0], states[0, :0], 5) is None


def test_errors_are_those_that_the_covariance_says():
    """In 8 sets of data, the squares of error ÷ deviation: chi squared of 24, 12 to 39 in 95 %."""
    squares = noise = 0.0
    for seed in range(8):
        found = shot(measured(seed)[0])
        off = found.p - TRUE
        squares += float(off @ np.linalg.solve(Linearised.of_arcs(found).covariance, off))
        noise += found.sigma / 8
    assert 10 < squares < 42
    np.testing.assert_allclose(noise, NOISE, rtol=0.04)


@pytest.mark.slow
def test_a_pair_is_an_arc_of_two_states():
    """Noise of 3e-3 on q and 1e-3 on p, told from single pairs, of which a state is latent."""
    squares, noise = 0.0, 0.0
    for seed in range(4):
        found = shot(measured(seed, 1_000, 2, noise=np.array([3e-3, 1e-3]))[0])
        off = found.p - TRUE
        squares += float(off @ np.linalg.solve(Linearised.of_arcs(found).covariance, off))
        noise += found.sigma / 4
    assert 4 < squares < 24  # chi squared of 12
    np.testing.assert_allclose(noise, [3e-3, 1e-3], rtol=0.08)


@pytest.mark.parametrize("length", [2, 11])
def test_residuals_are_as_many_as_latent_states_leave(length):
    """What is left is noise of variance 1 by that count: it is what terms are told from. Of pairs,
    half of whose numbers their latent states follow, it would be ½ by the numbers measured."""
    triangle = triangle_of(shot(measured(3, 600 // length, length)[0]))
    variance = triangle.residual_norm(len(TRUE)) ** 2 / (triangle.rows - len(TRUE))
    assert 0.85 < variance < 1.15  # outlying ones have less weight


def test_gross_errors_change_nothing_and_are_counted():
    clean, spoilt = shot(measured(0)[0]), measured(0, outliers=0.05)
    found = shot(spoilt[0])
    deviation = Linearised.of_arcs(clean).errors
    assert np.all(np.abs(found.p - TRUE) < 4 * deviation)
    assert outliers(found) == pytest.approx(spoilt[1].sum(), abs=1)
    np.testing.assert_allclose(found.sigma, NOISE, rtol=0.15)


def test_a_coordinate_without_noise_has_no_outliers():
    """The steps' own error is no noise, beside which others would be gross."""
    states = measured(0, length=40, noise=np.array([NOISE, 0.0]))[0]
    found = shot(states, TRUE, Steps(2, 1), least=3e-4)  # off by 3e-4 in a step
    assert outliers(found) == 0
    np.testing.assert_allclose(found.sigma[0], NOISE, rtol=0.06)
    assert found.sigma[1] < 0.5 * NOISE


def test_states_that_are_missing_are_bridged():
    states = measured(0, 8, 12)[0]
    z0, z1 = pairs_of(states)
    place = np.arange(len(z0)) % 11
    keep = (place != 4) & (place != 5)  # the pairs that have state 5
    arcs = arcs_of_pairs(z0[keep], z1[keep], 100, np.diff(place[keep]).clip(0))
    assert arcs is not None
    assert not arcs.measured[:, 5].any()
    model = FlowOnArcs(OSCILLATOR, DT, STEPS, arcs.moves)
    found = Measured(arcs, np.full(2, 1e-15)).fit(model, TRUE)
    assert found is not None
    assert np.isnan(found.residuals[:, 5]).all()
    np.testing.assert_allclose(found.x, states, atol=5 * NOISE)


def test_angles_go_on_over_turns():
    """A pendulum that turns over, its angle measured in [−π, π)."""
    family, true, dt = given_terms(1, ("p1**2", "cos(q1)")), np.array([0.5, -1.0]), 0.4
    rng = np.random.default_rng(0)
    states = [np.column_stack([np.zeros(6), rng.uniform(2.2, 3.0, 6)])]
    for _ in range(30):
        states.append(images(family, true, states[-1], dt, Steps(4, 1)).states)
    states = np.stack(states, axis=1)
    seen = states + NOISE * rng.normal(size=states.shape)
    seen[..., 0] = np.remainder(seen[..., 0] + np.pi, 2 * np.pi) - np.pi
    arcs = arcs_of_pairs(*pairs_of(seen), 100)
    assert arcs is not None
    model = FlowOnArcs(family, dt, Steps(4, 1), arcs.moves)
    found = Measured(arcs, np.full(2, 1e-15), (0,)).fit(model, 1.002 * true)
    assert found is not None
    np.testing.assert_allclose(found.x, states, atol=3 * NOISE)
    np.testing.assert_allclose(found.p, true, atol=5e-4)


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


@pytest.mark.slow
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


@pytest.mark.parametrize(
    ("beside", "says"), [(0.0, "outliers"), (4.0, "the law misses 2 of 100 measured states")]
)
def test_states_in_a_row_are_no_outliers(beside, says):
    residuals = np.random.default_rng(0).uniform(-1, 1, (5, 20, 2))
    residuals[[1, 3], [4, 19], 0] = 6.0
    residuals[[1, 3], [5, 18], 1] = beside
    (told,) = about_outliers(residuals)
    assert says in told


@pytest.mark.parametrize("misfit", [0.0, 1.0])
def test_a_misfit_that_is_alike_along_an_arc_does_not_average_away(misfit):
    """Of a constant through measured numbers, to which every arc adds one of its own: the next arc
    is off by as much as those, however many there are; by noise alone the mean is known better."""
    arcs, length = 40, 20
    rng = np.random.default_rng(3)
    y = misfit * rng.normal(size=(arcs, 1, 1)) + rng.normal(size=(arcs, length, 1))
    left = y - y.mean()
    whole = np.concatenate([np.ones((y.size, 1)), left.reshape(-1, 1)], axis=1)
    found = SimpleNamespace(
        factor=np.linalg.qr(whole, mode="r"),
        residuals=left,
        scores=left.sum(axis=1),
        x=np.zeros((*left.shape[:2], 0)),
    )
    deviation = abs(covariance_root_of(found)[0, 0])
    expected = misfit or 1 / np.sqrt(y.size)
    assert 0.7 * expected < deviation < 1.4 * expected
    assert lacks_terms(found) == bool(misfit)
