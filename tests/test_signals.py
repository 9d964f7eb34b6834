"""What series tell by themselves, against what they were made of."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gfnn_jax.signals import energy
from gfnn_jax.signals.derivatives import derivatives, difference
from gfnn_jax.signals.local_polynomials import local_fits
from gfnn_jax.signals.noise import noise, resolution
from gfnn_jax.signals.steps import dominant_frequencies, drift, even_runs, gaps, median_step
from gfnn_jax.signals.wrong_values import wrong_at_jumps, wrong_values

RNG = np.random.default_rng(0)
T = np.arange(0, 20, 0.01)
UNEVEN = np.sort(RNG.uniform(0, 20, 2000))


def swing(t):
    """A motion of two frequencies, its first and second derivative."""
    x = np.sin(3 * t) + 0.3 * np.cos(7 * t)
    return x, 3 * np.cos(3 * t) - 2.1 * np.sin(7 * t), -9 * np.sin(3 * t) - 14.7 * np.cos(7 * t)


# Local polynomials


def test_polynomials_are_fitted_exactly_at_uneven_times():
    t = UNEVEN
    fits = local_fits([t], np.array([t**3 - 4 * t]), 15, 3)
    c = fits.centres
    np.testing.assert_allclose(fits.values[0], c**3 - 4 * c, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(fits.slopes[0], 3 * c**2 - 4, rtol=1e-7, atol=1e-6)
    np.testing.assert_allclose(fits.curvatures[0], 6 * c, rtol=1e-4, atol=1e-3)
    assert np.abs(fits.residuals).max() < 1e-8


def test_no_window_holds_a_gap_or_two_runs():
    times = [np.concatenate([T[:50], 5 + T[:50]]), T[:40]]
    fits = local_fits(times, np.zeros((1, 140)), 9, 3)
    t = np.concatenate(times)
    assert len(fits.rows) == 2 * 42 + 32
    assert np.ptp(t[fits.rows], axis=1).max() < 0.09
    np.testing.assert_array_equal(np.unique(fits.run), [0, 1])


def test_gains_are_the_errors_that_white_noise_makes():
    x = RNG.standard_normal((1, len(T)))
    fits = local_fits([T], x, 21, 4)
    for found, gain in ((fits.slopes, fits.slope_gain), (fits.curvatures, fits.curvature_gain)):
        assert np.std(found / gain) == pytest.approx(1, rel=0.1)


# Noise


@pytest.mark.parametrize("sigma", [1e-6, 1e-3, 3e-2])
@pytest.mark.parametrize("t", [T, UNEVEN])
def test_white_noise(t, sigma):
    (found,) = noise([t], swing(t)[:1] + sigma * RNG.standard_normal((1, len(t))))
    assert found.sigma == pytest.approx(sigma, rel=0.15)
    assert found.white


def test_noise_of_a_quantised_sensor():
    step = 0.02
    x = step * np.round(swing(T)[0] / step)
    (found,) = noise([T], x[None])
    assert found.sigma == pytest.approx(step / np.sqrt(12), rel=0.2)
    assert resolution(x) == pytest.approx(step, rel=1e-6)


def test_correlated_noise_is_told_and_not_lost():
    white = 1e-3 * RNG.standard_normal(len(T) + 8)
    correlated = np.convolve(white, np.ones(5), "valid")[: len(T)]
    (found,) = noise([T], swing(T)[0][None] + correlated)
    assert not found.white
    assert found.sigma == pytest.approx(np.sqrt(5) * 1e-3, rel=0.3)


def test_noise_of_few_samples_a_period_is_what_cannot_be_predicted():
    t = np.arange(4000.0)
    x = np.sin(2.1 * t) + 1e-2 * RNG.standard_normal(len(t))  # three samples a period
    (found,) = noise([t], x[None])
    assert found.sigma == pytest.approx(1e-2, rel=0.3)


def test_outliers_do_not_make_the_noise():
    x = swing(T)[0] + 1e-3 * RNG.standard_normal(len(T))
    x[[300, 901, 1500]] += [0.05, -0.03, 0.4]
    (found,) = noise([T], x[None])
    assert found.sigma == pytest.approx(1e-3, rel=0.2)


def test_missing_values_and_short_columns():
    x = swing(T)[0] + 1e-3 * RNG.standard_normal(len(T))
    x[::50] = np.nan
    (found,) = noise([T], x[None])
    assert found.sigma == pytest.approx(1e-3, rel=0.15)
    assert noise([T[:6]], x[None, :6])[0].sigma is None


# Wrong values


def found_in(x, resolution=0.0):
    """(begin, end) of the stretches of a stuck sensor, and of outliers in what is left."""
    found = wrong_values([0.01 * np.arange(len(x))], [x], resolution)
    ends = [(w.off is None, (int(w.rows[0]), int(w.rows[-1]) + 1)) for w in found]
    return [e for held, e in ends if held], [e for held, e in ends if not held]


def test_spikes_and_a_burst_are_found_sample_by_sample():
    x = swing(T)[0] + 1e-3 * RNG.standard_normal(len(T))
    x[[200, 215, 901, 1500]] += [0.05, -0.05, -0.03, 0.4]
    x[1200:1215] += 0.2 * (-1.0) ** np.arange(15)
    assert found_in(x) == ([], [(200, 201), (215, 216), (901, 902), (1200, 1215), (1500, 1501)])


def test_a_stretch_that_is_shifted_as_a_whole_is_found():
    x = swing(T)[0] + 1e-3 * RNG.standard_normal(len(T))
    x[1200:1220] += 0.4
    assert found_in(x) == ([], [(1200, 1220)])


def test_a_sensor_that_is_stuck_at_speed_is_found():
    x = swing(T)[0] + 1e-3 * RNG.standard_normal(len(T))
    fast = int(np.abs(np.gradient(x)[100:300]).argmax()) + 100
    x[fast : fast + 25] = x[fast]
    assert found_in(x) == ([(fast + 1, fast + 25)], [])


@pytest.mark.parametrize(("at", "wrong"), [(1.5, [100]), (-1.5, []), (0.7, []), (-1.8, [])])
def test_a_sample_beyond_both_sides_of_a_jump_of_an_input(at, wrong):
    """Not one that is of a side, between both, or overshoots."""
    t = 0.02 * np.arange(200)
    u = 1.5 * np.exp(-4 * (t % 2)) * np.sign(1.99 - t)
    u[100] = at
    found = wrong_at_jumps([t], [np.round(u, 4)], 1e-4)
    assert [row for one in found for row in one.rows] == wrong


def stick_slip():
    """Positions of a body on a belt: it rests, and slips within a sample."""
    return np.repeat(np.cumsum(RNG.uniform(0.5, 1, 60)), 20)


def falling_to_rest():
    """A swing that dry friction ends, and rest."""
    t = 0.01 * np.arange(1200)
    turns = np.floor(t / 0.5)
    size = np.maximum(1.0 - 0.1 * turns, 0)
    offset = 0.05 * np.where(size > 0, (-1.0) ** turns, 0)
    return np.where(size > 0, (size - 0.05) * np.cos(2 * np.pi * t) + offset, 0)


CLEAN = {
    "rest": lambda: np.where(np.abs(T - 6) < 3, np.cos(np.pi * (T - 6) / 3), -1.0),
    "counts": lambda: 0.02 * np.round(swing(T)[0] / 0.02),
    "counts with noise": lambda: (
        2e-3 * np.round((swing(T)[0] + 1e-3 * RNG.standard_normal(len(T))) / 2e-3)
    ),
    "dry friction": falling_to_rest,
    "stick and slip": stick_slip,
    "a slower sensor, held": lambda: np.repeat(swing(T)[0][::5], 5)[: len(T)],
    "impacts": lambda: np.abs(np.sin(4 * T)),
    "stops": lambda: np.maximum(np.sin(4 * T), 0.0),
    "steps": lambda: np.sign(np.sin(4 * T)),
    "fast steps": lambda: np.sign(np.sin(16 * T)) + 1e-3 * RNG.standard_normal(len(T)),
    "long tails": lambda: swing(T)[0] + 1e-3 * RNG.laplace(size=len(T)),
    "no noise": lambda: swing(T)[0],
    "few samples a period": lambda: np.sin(1.3 * np.arange(900.0)) + np.sin(0.9 * np.arange(900)),
}


@pytest.mark.parametrize("name", CLEAN)
def test_rest_counts_friction_and_impacts_are_no_wrong_values(name):
    x = CLEAN[name]()
    assert found_in(x, resolution(x) or 0.0) == ([], [])


# Derivatives


@pytest.mark.parametrize("t", [T, UNEVEN])
def test_factor_and_lag_of_a_velocity(t):
    x, v = swing(t)[0], 0.9 * swing(t - 0.02)[1]
    columns = np.array([x, v]) + 1e-4 * RNG.standard_normal((2, len(t)))
    found = derivatives([t], columns, 15, [1e-4, 1e-4]).relation(0, 1)
    assert found.factor == pytest.approx(0.9, rel=5e-3)
    assert found.lag == pytest.approx(0.02, rel=0.1)
    assert derivatives([t], columns, 15, [1e-4] * 2).relation(1, 0).explained < 0.98


def test_what_is_no_derivative():
    columns = np.array([swing(T)[0], np.cos(11 * T)])
    assert derivatives([T], columns, 15, [None, None]).relation(0, 1).explained < 0.05


def test_differences_are_recognised():
    x = swing(T)[0]
    steps = np.diff(x) / 0.01
    assert difference([T], x, np.append(steps, 0)) == "forward"
    assert difference([T], x, np.insert(steps, 0, 0)) == "backward"
    assert difference([T], x, np.gradient(x, T)) == "central"
    assert difference([T], x, swing(T)[1] + 1e-2 * RNG.standard_normal(len(T))) is None


# Energy


def motion(force, start, t, sigma=1e-4):
    rates = lambda _, z: [*z[len(z) // 2 :], *force(z)]  # noqa: E731
    z = solve_ivp(rates, (0, t[-1]), start, "DOP853", t, rtol=1e-10, atol=1e-12).y
    q = z[: len(z) // 2]
    fits = local_fits([t], q + sigma * RNG.standard_normal(q.shape), 21, 4)
    period = energy.mean_period(fits, 1)
    return fits, period


def friction(kind, c):
    rates = {
        "linear": lambda v: c * v,
        "dry": lambda v: c * np.tanh(v / 1e-3),
        "quadratic": lambda v: c * v * abs(v),
    }
    return rates[kind]


@pytest.mark.parametrize("kind", ["linear", "dry", "quadratic"])
def test_the_kind_of_friction(kind):
    rate = friction(kind, 0.05)
    fits, period = motion(lambda z: [-9 * np.sin(z[0]) - rate(z[1])], [1.2, 0.0], T)
    found = energy.loss(fits, [True], np.empty((0, len(fits.centres))), period)
    assert found.significant
    assert found.kind == kind


def test_the_loss_of_a_linear_oscillator():
    """ẍ = −ω²x − cẋ loses c T of its energy a period, T = 2π/ω, to first order."""
    fits, period = motion(lambda z: [-9 * z[0] - 0.02 * z[1]], [1.0, 0.0], T)
    found = energy.loss(fits, [False], np.empty((0, len(fits.centres))), period)
    assert period == pytest.approx(2 * np.pi / 3, rel=0.02)
    assert found.per_period == pytest.approx(0.02 * 2 * np.pi / 3, rel=0.03)


def double_pendulum(z):
    a, b, u, v = z
    s, c = np.sin(a - b), np.cos(a - b)
    f, g = -s * v * v - 20 * np.sin(a), s * u * u - 10 * np.sin(b)
    return [(f - c * g) / (2 - c * c), (2 * g - c * f) / (2 - c * c)]


@pytest.mark.parametrize(
    ("force", "start", "angle"),
    [
        (lambda z: [-9 * np.sin(z[0])], [2.5, 0.0], True),
        (lambda z: [-4 * z[0] - 3 * z[0] ** 3], [1.0, 0.0], False),
        (lambda z: [-8 * z[0] + 3 * z[1], 3 * z[0] - 5 * z[1]], [1.0, 0, 0, 0], False),
        (double_pendulum, [1.8, 1.0, 0, 0], True),
    ],
)
def test_no_friction_is_seen_where_there_is_none(force, start, angle):
    fits, period = motion(force, start, T[:1200], 1e-3)
    none = np.empty((0, len(fits.centres)))
    assert not energy.loss(fits, [angle] * len(fits.values), none, period).significant


def test_what_an_input_supplies_is_no_gain():
    def driven(t, z):
        return [z[1], -9 * z[0] - 0.3 * z[1] + np.sin(2.5 * t)]

    x = solve_ivp(driven, (0, 20), [0, 0], "DOP853", T, rtol=1e-10).y[:1]
    fits = local_fits([T], x, 21, 4)
    period = energy.mean_period(fits, 1)
    assert period is not None
    found = energy.loss(fits, [False], np.sin(2.5 * fits.centres)[None], period)
    assert found.per_period == pytest.approx(0.3 * period, rel=0.05)


# Frequencies and steps


def test_frequencies_of_a_beat():
    x = np.sin(2 * np.pi * 1.3 * T) + 0.4 * np.sin(2 * np.pi * 4.1 * T)
    np.testing.assert_allclose(dominant_frequencies([T], x), [1.3, 4.1], atol=0.01)


def test_gaps_and_steps():
    t = np.delete(T, slice(500, 530))
    assert gaps([T, t]) == [(1, pytest.approx(4.99), pytest.approx(5.3))]
    assert median_step([t]) == pytest.approx(0.01)
    assert even_runs([T, t]) == [0]


def test_a_clock_that_drifts():
    assert drift(T * (1 + 0.01 * T / T[-1])) == pytest.approx(0.02, rel=0.05)
    jitter = 0.003 * RNG.uniform(-1, 1, len(T))
    assert drift(T + jitter) == 0
    assert drift(np.cumsum(RNG.uniform(0.005, 0.015, 2000))) == 0
    late = T * (1 + 0.01 * T / T[-1])
    assert drift(np.delete(late + 0.1 * jitter, slice(700, 760))) == pytest.approx(0.02, rel=0.1)
