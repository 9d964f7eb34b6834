"""One filter of all columns: phases against waves, and laws against systems behind a filter."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

import gfnn_jax as gfnn
from gfnn_jax.errors import InputError
from gfnn_jax.signals.filters import mixed, turned

STEP, PHASE = 0.35, 0.06  # s, s³


def test_a_filter_turns_each_wave_by_the_cube_of_its_frequency():
    t = 0.1 * np.arange(2000)
    omega = np.array([0.7, 2.0, 5.0])
    waves = np.cos(t[:, None] * omega)
    behind = np.cos(t[:, None] * omega - 0.01 * omega**3)
    inside = slice(300, -300)
    np.testing.assert_allclose(turned(waves, 0.1, 0.01)[inside], behind[inside], atol=1e-3)
    again = turned(turned(waves, 0.1, 0.01), 0.1, -0.01)
    np.testing.assert_allclose(again[inside], waves[inside], atol=1e-3)


def test_ends_err_no_longer_than_a_filter_mixes():
    rng, t = np.random.default_rng(0), 0.4 * np.arange(2500)
    omega, at = rng.uniform(0.3, 2.2, 300), rng.uniform(0, 2 * np.pi, 300)
    x = np.cos(np.multiply.outer(t, omega) + at).sum(axis=1) / np.sqrt(150)
    last = int(mixed(0.4, PHASE) / 0.4) + 1
    for end in (1200, 1357, 1811):
        left = turned(x[:end], 0.4, -PHASE) - turned(x, 0.4, -PHASE)[:end]
        assert np.abs(left[200:-last]).max() < 5e-3


@pytest.mark.parametrize("broken", ["angles", "uneven", "missing"])
def test_a_filter_needs_even_whole_columns_that_do_not_turn(broken):
    t, x = 0.1 * np.arange(50), np.sin(0.1 * np.arange(50))
    if broken == "uneven":
        t = t + 0.01 * np.sin(t)
    if broken == "missing":
        x[7] = np.nan
    angles = ["x"] if broken == "angles" else []
    made = gfnn.Recording({"t": t, "x": x}, positions=["x"], angles=angles)
    with pytest.raises(InputError):
        made.behind_filter(1e-3)


def behind_a_filter(phase, count=3000, noise=1e-3):
    """x'' = −x − 0.2 x² − 0.6 x³ − 0.1 x' + u of a multisine, behind a filter."""
    rng, t = np.random.default_rng(5), STEP * np.arange(count)
    omega = 2 * np.pi / t[-1] * np.arange(1, int(t[-1] * 0.35))
    at = rng.uniform(0, 2 * np.pi, len(omega))

    def force(time):
        return 0.35 / np.sqrt(len(omega) / 2) * np.cos(np.multiply.outer(time, omega) + at).sum(-1)

    known = force(0.05 * np.arange(7 * count + 1))  # as often as the solver steps
    smooth = CubicSpline(0.05 * np.arange(7 * count + 1), known)

    def rates(time, x):
        return [x[1], -x[0] - 0.2 * x[0] ** 2 - 0.6 * x[0] ** 3 - 0.1 * x[1] + smooth(time)]

    x = solve_ivp(rates, (0, t[-1]), [0, 0], "DOP853", t, rtol=1e-8, atol=1e-10).y[0]
    x = x + noise * x.std() * rng.normal(size=count)
    columns = {"t": t, "u": turned(force(t), STEP, phase), "x": turned(x, STEP, phase)}
    return gfnn.Recording(columns, positions=["x"], inputs=["u"], angles=[])


@pytest.fixture(scope="module")
def logged():
    made = behind_a_filter(PHASE)
    return made, gfnn.fit(made.slice(stop=2500 * STEP))


@pytest.mark.slow
def test_a_law_of_what_moves_before_a_filter_is_found(logged):
    _, fit = logged
    true = {"x**2": -0.5, "x**3": -0.2 / 3, "x**4": -0.15}
    found = {term.term: term for term in fit.lagrangian.terms if term.term in true}
    assert found.keys() == true.keys()
    for name, value in true.items():
        assert found[name].coefficient == pytest.approx(value, abs=max(5 * found[name].std, 1e-4))
    assert fit.verdict == "identified"
    assert fit.map.sensors.phase == pytest.approx(PHASE, rel=0.01)


@pytest.mark.slow
def test_forecasts_are_of_the_columns_behind_the_filter(logged, tmp_path):
    made, fit = logged
    fit.save(tmp_path / "model")
    start, ahead = made.slice(2000 * STEP, 2500 * STEP), made.slice(2500.5 * STEP, 2900 * STEP)
    times, x = ahead.times("0"), ahead.values("x", "0")
    for one in (fit, gfnn.load(tmp_path / "model")):
        found = one.map.forecast(start, times, made, coverage=0.95)
        left = np.abs(found.values["x"][0] - x)
        assert np.sqrt(np.mean(left**2)) < 0.01 * x.std()
        assert found.band is not None
        assert np.mean(left < found.band["x"][0]) > 0.85
    few = fit.map.forecast(start.slice(2480 * STEP), times, made)
    assert any("few" in line for line in few.outside)
    short = fit.map.forecast(start, times, ahead)  # the inputs end with it
    assert not any("few" in line for line in short.outside)
    assert any("inputs end" in line for line in short.outside)
    late = fit.map.forecast(start, times[:-1] + 0.4 * STEP, made).values["x"][0]
    np.testing.assert_allclose(late, CubicSpline(times, x)(times[:-1] + 0.4 * STEP), atol=0.02)


@pytest.mark.slow
def test_a_record_that_no_filter_saw_has_none():
    fit = gfnn.fit(behind_a_filter(0.0, count=1500))
    assert fit.map.sensors is not None
    assert (fit.map.sensors.phase, fit.verdict) == (0.0, "identified")
