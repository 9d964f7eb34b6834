"""Each metric against a case whose answer is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from analytic import kepler
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.special import jv

from gfnn_jax.evaluate import metrics


def test_position_errors_are_euclidean():
    reference = np.zeros((2, 3, 4))
    predicted = reference + np.array([3.0, 4.0, 5.0, 12.0])
    np.testing.assert_allclose(metrics.position_error(predicted, reference), 5.0)


@given(st.integers(-1000, 1000), st.floats(-3.1, 3.1))
def test_angles_are_compared_to_the_nearest_image(turns, difference):
    reference = np.full((1, 1, 2), 0.3)
    predicted = reference.copy()
    predicted[..., 0] += difference + 2 * np.pi * turns
    measured = metrics.position_error(predicted, reference, angles=(0,))
    np.testing.assert_allclose(measured, abs(difference), atol=1e-11)
    if turns:
        assert metrics.position_error(predicted, reference)[0, 0] > 3.0


def test_lost_predictions_count_and_missing_references_do_not():
    reference = np.zeros((4, 3, 2))
    predicted = reference + np.array([1.0, 0.0])
    predicted[0] *= 3
    predicted[1, 2:] = np.nan  # lost at the last step
    reference[3, 1:] = np.nan  # escaped
    error = metrics.position_error(predicted, reference)
    assert np.isinf(error[1, 2])
    assert np.isnan(error[3, 1])
    statistics = metrics.error_statistics(error)
    assert (statistics.num_excluded, statistics.num_lost) == (1, 1)
    np.testing.assert_allclose(statistics.mean, [5 / 3, 5 / 3, np.inf])
    np.testing.assert_allclose(statistics.std[:2], np.std([3, 1, 1]))
    assert statistics.std[2] == np.inf
    np.testing.assert_allclose(statistics.median, [1, 1, 3])
    np.testing.assert_array_equal(metrics.absolute_error([1.0, np.nan], [3.0, 1.0]), [2, np.inf])


def test_one_step_rms_is_per_component_and_modulo_two_pi():
    reference = np.zeros((2, 2))
    predicted = np.array([[2 * np.pi + 0.3, 0.1], [-0.3, -0.1]])
    rms = np.sqrt((0.09 + 0.01) / 2)
    assert metrics.one_step_rms(predicted, reference, angles=(0,)) == pytest.approx(rms)
    assert metrics.one_step_rms(predicted, reference) > 3
    predicted[0, 1] = np.nan
    assert metrics.one_step_rms(predicted, reference) == np.inf


def test_statistics_of_nothing_and_of_lost_majorities():
    nothing = metrics.error_statistics(np.full((2, 3), np.nan))
    assert np.isnan(nothing.mean).all()
    assert nothing.num_excluded == 2
    assert metrics.error_statistics(np.full((2, 1), np.inf)).median == np.inf


@pytest.mark.parametrize("exponent", [0.5, 1.0, 2.0])
def test_growth_exponent_of_power_laws(exponent):
    rng = np.random.default_rng(0)
    steps = np.arange(10_001)
    size = rng.lognormal(size=(32, 1))
    clean = metrics.growth_exponent(steps, 1e-6 * size * steps**exponent)
    assert clean.value == pytest.approx(exponent, abs=1e-12)
    assert (clean.first, clean.last, clean.num_trajectories) == (10, 10_000, 32)
    # Each trajectory has its own exponent: the interval holds the common one, and says how well.
    scattered = 1e-6 * steps ** (exponent + 0.1 * rng.normal(size=(32, 1)))
    estimate = metrics.growth_exponent(steps, scattered)
    assert estimate.interval[0] < exponent + 0.06
    assert estimate.interval[1] > exponent
    assert 0.005 < estimate.standard_error < 0.05


def test_growth_exponent_is_even_in_log_step_and_states_its_range():
    steps = np.arange(100_001)
    # Slope 1 over three of four decades: evenly thinned points see it, all points would not.
    saturated = np.minimum(steps, 10_000.0)
    assert metrics.growth_exponent(steps, saturated).value > 0.8
    limited = metrics.growth_exponent(steps, saturated, last=10_000)
    assert limited.value == pytest.approx(1.0)
    assert limited.last == 10_000
    plateau = np.maximum(1e-15 * steps, 1e-14)
    above = metrics.growth_exponent(steps, plateau, floor=2.05e-14)
    assert above.value == pytest.approx(1.0)
    assert above.first == 21


def test_growth_exponent_stops_where_a_prediction_is_lost():
    steps = np.arange(1001)
    error = np.tile(1e-3 * steps, (3, 1))
    error[0, 500:] = np.inf
    error[1] = np.nan
    estimate = metrics.growth_exponent(steps, error)
    assert estimate.value == pytest.approx(1.0)
    assert estimate.last <= 499
    assert estimate.num_trajectories == 2
    assert np.isnan(metrics.growth_exponent(steps, np.zeros(1001)).value)


def test_intervals_cover_at_their_rate():
    rng = np.random.default_rng(1)
    steps = np.arange(401)
    walks = rng.normal(size=(200, 12, 401)).cumsum(axis=-1)
    covered = 0
    for lanes in walks:
        low, high = metrics.energy_drift(steps, lanes + 0.01 * steps).interval
        covered += low < 0.01 < high
    assert 0.90 <= covered / 200 <= 0.99


def test_energy_error_and_drift():
    steps = np.arange(0, 1000, 10)
    values = -2.0 + 1e-6 * steps * np.ones((3, 1))
    error = metrics.energy_error(values)
    np.testing.assert_allclose(error[:, -1], 990e-6 / 2)
    drift = metrics.energy_drift(steps, error)
    assert drift.value == pytest.approx(5e-7, rel=1e-6)
    error[0, 5] = np.nan
    assert metrics.energy_drift(steps, error).num_trajectories == 2


def test_drift_exponent_tells_a_random_walk_from_a_trend_under_an_oscillation():
    rng = np.random.default_rng(2)
    steps = np.arange(40_000)
    oscillation = 1e-9 * np.sin(steps * 2 * np.pi / 12.5 + rng.uniform(0, 6, (64, 1)))
    walk = 1e-9 * rng.normal(size=(64, 40_000)).cumsum(axis=1)
    brouwer = metrics.drift_exponent(steps, oscillation + walk, window=100)
    assert abs(brouwer.value - 0.5) < 0.1
    assert (brouwer.first, brouwer.last) == (1000, 39_900)
    assert brouwer.interval[0] < 0.5 < brouwer.interval[1] + 0.05
    trend = metrics.drift_exponent(steps, oscillation + 1e-9 * steps, window=100)
    assert trend.value == pytest.approx(1.0, abs=1e-3)


@settings(deadline=None)  # the first call compiles
@given(st.floats(0.1, 10), st.floats(1e-6, 0.95), st.floats(0, 6.28), st.floats(0, 6.28))
def test_orbital_elements_of_constructed_orbits(a, e, anomaly, perihelion):
    z = kepler(a, e, anomaly, perihelion)
    batch = np.stack([z, z])[None]
    np.testing.assert_allclose(metrics.semi_major_axis(batch), np.full((1, 2), a), rtol=1e-11)
    # To roundoff also near e = 0, where a formula through energy and angular momentum is not.
    np.testing.assert_allclose(metrics.eccentricity(batch), np.full((1, 2), e), atol=1e-12)


def test_orbital_elements_jit_and_differentiate():
    z = kepler(1.1, 0.03, 1.0, 2.0)
    assert jax.jit(metrics.semi_major_axis)(z) == pytest.approx(1.1)
    assert np.isfinite(jax.jit(jax.grad(metrics.eccentricity))(z)).all()


def test_kl_divergence_of_gaussians_and_its_direction():
    rng = np.random.default_rng(3)
    # D(N(m, s) ‖ N(0, 1)) = −log s + (s² + m²)/2 − ½
    narrow, wide = 0.2 + 0.7 * rng.normal(size=400_000), rng.normal(size=400_000)
    exact = -np.log(0.7) + (0.49 + 0.04) / 2 - 0.5
    backward = np.log(0.7) + (1 + 0.04) / (2 * 0.49) - 0.5
    assert metrics.kl_divergence(narrow, wide, 80, (-5, 5)) == pytest.approx(exact, abs=0.006)
    assert metrics.kl_divergence(wide, narrow, 80, (-5, 5)) == pytest.approx(backward, abs=0.03)


def test_kl_divergence_by_hand():
    # One bin each and the outside: counts (2, 1, 1) and (1, 3, 0), with half a count each.
    predicted, reference = [0.1, 0.2, 1.5, np.nan], [0.1, 1.1, 1.2, 1.9]
    p, r = np.array([2.5, 1.5, 1.5]) / 5.5, np.array([1.5, 3.5, 0.5]) / 5.5
    expected = np.sum(p * np.log(p / r))
    assert metrics.kl_divergence(predicted, reference, 2, (0, 2)) == pytest.approx(expected)
    assert metrics.kl_divergence(reference, reference, 2, (0, 2)) == 0


def test_kl_divergence_of_one_law_is_at_its_stated_floor():
    rng = np.random.default_rng(4)
    scores = [
        metrics.kl_divergence(rng.random(4000), rng.random(2000), 50, (0, 1)) for _ in range(40)
    ]
    assert np.mean(scores) == pytest.approx(49 / 2 * (1 / 4000 + 1 / 2000), rel=0.2)


def test_section_crossings_of_an_oscillator():
    times = 0.1 * np.arange(1000)
    omega = np.sqrt(2)
    orbit = np.stack(
        [np.sin(times), np.cos(omega * times), np.cos(times), -omega * np.sin(omega * times)], 1
    )
    for direction, phase in ((1, 0.0), (-1, np.pi)):
        crossings = metrics.section_crossings(orbit, index=0, direction=direction)
        exact = phase + 2 * np.pi * np.arange(17)
        exact = exact[(exact > 0.8) & (exact < 99.1)]
        expected = np.stack(
            [
                0 * exact,
                np.cos(omega * exact),
                direction + 0 * exact,
                -omega * np.sin(omega * exact),
            ],
            1,
        )
        assert crossings.shape == expected.shape
        np.testing.assert_allclose(crossings, expected, atol=1e-12)


def test_a_crossing_at_a_saved_state_counts_once_and_lost_states_give_none():
    orbit = np.stack([np.arange(-50.0, 50.0), np.ones(100)], 1)
    np.testing.assert_allclose(metrics.section_crossings(orbit, 0), [[0.0, 1.0]], atol=1e-12)
    assert metrics.section_crossings(orbit, 0, direction=-1).shape == (0, 2)
    orbit[52:] = np.nan
    assert metrics.section_crossings(orbit, 0).shape == (0, 2)


@pytest.mark.parametrize(("energy", "bound"), [(1 / 12, 1e-5), (0.1666, 3e-5)])
def test_section_crossings_of_henon_heiles_saved_coarsely(energy, bound):
    def field(_, z):
        x, y, px, py = z
        return [px, py, -x - 2 * x * y, -y - x * x + y * y]

    def on_section(_, z):
        return z[0]

    on_section.direction = 1
    start = [0, 0.1, np.sqrt(2 * (energy - 0.1**2 / 2 + 0.1**3 / 3)), 0]
    times = 0.5 * np.arange(601)
    options = {"rtol": 1e-12, "atol": 1e-13, "events": on_section}
    solution = solve_ivp(field, (0, 300), start, "DOP853", times, **options)
    crossing_times = solution.t_events[0]
    inside = (crossing_times > times[7]) & (crossing_times < times[-8])
    crossings = metrics.section_crossings(solution.y.T, index=0)
    assert len(crossings) == inside.sum() > 30
    np.testing.assert_allclose(crossings, solution.y_events[0][inside], atol=bound)


def test_lyapunov_exponent_of_the_cat_map_and_of_a_rotation():
    def cat(z):
        return (jnp.array([[1.0, 1.0], [1.0, 2.0]]) @ z) % (2 * jnp.pi)

    def rotation(z):
        return jnp.array([[0.0, 1.0], [-1.0, 0.0]]) @ z

    exact = np.log((3 + np.sqrt(5)) / 2)
    z0 = jnp.array([[0.1, 0.2], [1.0, 2.0]])
    exponents = jax.jit(jax.vmap(lambda z: metrics.lyapunov_exponent(cat, z, 2000)))(z0)
    np.testing.assert_allclose(exponents, exact, atol=1e-3)
    assert metrics.lyapunov_exponent(rotation, z0[0], 1000) == pytest.approx(0, abs=1e-12)


def test_diffusion_coefficient_of_a_random_walk_and_of_the_standard_map():
    rng = np.random.default_rng(5)
    walk = 0.3 * rng.normal(size=(4000, 60)).cumsum(axis=1)
    estimate = metrics.diffusion_coefficient(walk)
    assert estimate.interval[0] < 0.045 < estimate.interval[1]
    assert estimate.value == pytest.approx(0.045, rel=0.1)
    kick = 10 * np.pi  # far above 1, where the corrections left out are small
    theta, p = rng.uniform(0, 2 * np.pi, (2, 20_000))
    momenta = [p]
    for _ in range(50):
        p = p + kick * np.sin(theta)
        theta = theta + p
        momenta.append(p)
    estimate = metrics.diffusion_coefficient(np.stack(momenta, axis=1))
    expected = kick**2 / 4 * (1 - 2 * jv(2, kick) + 2 * jv(2, kick) ** 2)
    assert estimate.value == pytest.approx(expected, rel=0.06)


def test_curve_distance_of_points_beside_a_known_curve():
    theta = np.linspace(0, 2 * np.pi, 500)
    height = lambda t: 3 + 0.4 * np.sin(t) + 0.1 * np.cos(3 * t)  # noqa: E731
    curve = np.stack([theta, height(theta)], axis=1)
    away, at = 1e-5, np.linspace(-4, 20, 50)
    slope = 0.4 * np.cos(at) - 0.3 * np.sin(3 * at)
    normal = np.stack([-slope, np.ones_like(at)]) / np.sqrt(1 + slope**2)
    points = np.stack([at, height(at)]) + away * normal
    np.testing.assert_allclose(metrics.curve_distance(points.T, curve, 8), away, rtol=1e-4)
    on_it = np.stack([at, height(at)], axis=1).reshape(5, 10, 2)
    assert metrics.curve_distance(on_it, curve, 8).shape == (5, 10)
    assert metrics.curve_distance(on_it, curve, 8).max() < 1e-13
