"""The noise of the states from the residuals of a map that is known exactly."""

import jax
import numpy as np
import pytest
from analytic import exact_oscillator, generated, map_of, oscillator, rotated

import gfnn_jax as gfnn
from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.rows import of_differences
from gfnn_jax.dataset.runs import identified
from gfnn_jax.diagnosis.residuals import noise_of_sites, state_noise
from gfnn_jax.families.terms import given_terms
from gfnn_jax.flows.flow import Flow
from gfnn_jax.generating.charts import MIDPOINT
from gfnn_jax.models.hamiltonians.covariance import leaves_white
from gfnn_jax.scenes import froeschle
from gfnn_jax.solve.noise import of_residuals, robust


def noisy_turns(angle, sigma, num_steps):
    """1,000 pairs of the oscillator's map and the map, errors of sigma (2,) on all states."""
    rng = np.random.default_rng(0)
    states = [rng.normal(size=(1_000 // num_steps, 2))]
    for _ in range(num_steps):
        states.append(rotated(states[-1], angle))
    states = np.stack(states, axis=1)
    states += sigma * rng.normal(size=states.shape)
    z0, z1 = states[:, :-1].reshape(-1, 2), states[:, 1:].reshape(-1, 2)
    piece = generated(oscillator, exact_oscillator(angle), MIDPOINT, angle)
    return map_of(piece, z0), identified(gfnn.Pairs(z0, z1, angle)).pairs


@pytest.mark.parametrize("num_steps", [1, 50])
@pytest.mark.parametrize("sigma", [(1e-3, 1e-3), (1e-6, 3e-6), (3e-2, 1e-2)])
@pytest.mark.parametrize("angle", [0.1, 1.0])
def test_noise_is_measured_per_coordinate(angle, sigma, num_steps):
    noise = state_noise(*noisy_turns(angle, np.array(sigma), num_steps), taken=0.0)
    np.testing.assert_allclose(noise, sigma, rtol=0.2)


def test_a_quarter_turn_of_single_pairs_tells_the_sum_alone():
    """q and p change places: each is given half, though all of it is in q."""
    sigma = np.array([1e-3, 0.0])
    noise = state_noise(*noisy_turns(np.pi / 2, sigma, 1), taken=0.0)
    np.testing.assert_allclose(noise, np.sqrt(np.mean(sigma**2)), rtol=0.1)
    shared = state_noise(*noisy_turns(np.pi / 2, sigma, 50), taken=0.0)
    assert shared[0] == pytest.approx(1e-3, rel=0.1)
    assert shared[1] < 1e-4


def test_coefficients_take_a_part_of_the_noise():
    map_, pairs = noisy_turns(0.1, np.array([1e-3, 1e-3]), 1)
    ratio = state_noise(map_, pairs, taken=0.36) / state_noise(map_, pairs, taken=0.0)
    np.testing.assert_allclose(ratio, 1.25)


@pytest.mark.parametrize("sigma", [(1e-3, 1e-3), (1e-5, 1e-6), (1e-3, 1e-2)])
def test_noise_of_sites_is_that_of_each_half(sigma):
    """Of oscillators whose maps are known: random directions tell what all derivatives do."""
    rng, angle, dim = np.random.default_rng(1), 0.7, 1
    map_, pairs = noisy_turns(angle, np.zeros(2), 1)
    noise = [np.array(sigma) * rng.normal(size=(1_000, 2 * dim)) for _ in range(2)]
    z0, z1 = (z + e for z, e in zip((pairs.z0, pairs.z1), noise, strict=True))
    found = noise_of_sites(map_, gfnn.Pairs(z0, z1, angle))
    if min(sigma) > 0.2 * max(sigma):
        np.testing.assert_allclose(found, sigma, rtol=0.1)
    else:  # the smaller is hidden by the larger, which a turn mixes into both
        assert found.max() == pytest.approx(max(sigma), rel=0.1)
        assert found.argmax() == np.argmax(sigma)


@pytest.mark.slow
def test_a_fit_with_a_structure_tells_the_noise():
    scene = froeschle(32)
    pairs = gfnn.sample_pairs(scene, 100, jax.random.key(0))
    rng, sigma = np.random.default_rng(0), np.repeat([1e-3, 3e-3], 32)
    z0, z1 = (np.asarray(z) + sigma * rng.normal(size=z.shape) for z in (pairs.z0, pairs.z1))
    with pytest.warns(gfnn.FitWarning, match="noise"):
        fit = gfnn.fit(gfnn.Pairs(z0, z1, pairs.dt), scene, learn="map")
    np.testing.assert_allclose(fit.noise, sigma, rtol=0.1)


def test_differences_of_a_smooth_orbit_leave_the_noise():
    rng, t = np.random.default_rng(0), 0.05 * np.arange(2_000)
    orbit = np.stack([np.cos(t), -np.sin(t)], axis=1)
    noisy = orbit + 1e-3 * rng.normal(size=orbit.shape)
    runs = [np.diff(part, axis=0) for part in np.split(noisy, [4, 700])]  # of the first too few
    assert of_differences(runs, 6, 1.5) == pytest.approx(1e-3, rel=0.05)
    assert of_differences([np.diff(orbit, axis=0)], 3, 1.5) is None  # the orbit's own differences


def test_residuals_tell_the_noise_without_gross_errors():
    rng, sigma = np.random.default_rng(0), np.array([1e-3, 3e-3])
    residual = sigma * rng.normal(size=(5_000, 2))
    residual[::50] = 1.0
    np.testing.assert_allclose(robust(residual, axis=0), sigma, rtol=0.05)
    np.testing.assert_allclose(of_residuals(residual, 1.0, 5.0), sigma, rtol=0.03)
    np.testing.assert_allclose(of_residuals(residual, 0.25, 5.0), 2 * sigma, rtol=0.03)


@pytest.mark.parametrize("num_steps", [1, 50])
@pytest.mark.parametrize(
    ("frequency", "white"), [(1.0, True), (1.0005, True), (1.02, False), (0.9, False)]
)
def test_a_law_is_right_where_it_leaves_white_noise_over(frequency, white, num_steps):
    """Noise of 1e-3 on turns by 0.2; a law of another frequency leaves a rotation over."""
    pairs = noisy_turns(0.2, np.array([1e-3, 1e-3]), num_steps)[1]
    flow = Flow(given_terms(1, ["q1**2", "p1**2"]), 0.5 * frequency * np.ones(2), 0.2, np.ones(2))
    data = Dataset.of(pairs, CARTESIAN).divided(0)
    assert leaves_white(flow, data) == white
