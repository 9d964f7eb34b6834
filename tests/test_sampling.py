"""Uneven, incomplete and short recordings, and sensors that show no position."""

import numpy as np
import pytest
from analytic import states_in_motion

import gfnn_jax as gfnn
from gfnn_jax.dataset.stretches import measure, nodes_of, stretches
from gfnn_jax.errors import InputError
from gfnn_jax.models.lagrangians import windows as windows_module
from gfnn_jax.models.lagrangians.recordings import samples_of
from gfnn_jax.signals.short_runs import noise_of_one_law
from gfnn_jax.signals.splines import splines

NOISE = 1e-3


def swing(times, start=(1.2, 0.0), friction=0.05):
    """States (n, 2) of θ̈ = −9 sin θ − friction θ̇ at these times, by SciPy."""
    return states_in_motion(lambda q, v: -9 * np.sin(q) - friction * v, start, times).T


def law_is_right(fit):
    values = {term.term: (term.coefficient, term.std) for term in fit.lagrangian.terms}
    assert {*values} == {"omega**2", "cos(theta)"}
    assert values["cos(theta)"][0] == pytest.approx(9, abs=max(5 * values["cos(theta)"][1], 0.01))
    (lost,) = fit.friction.terms
    assert lost.term == "omega**2"
    assert lost.coefficient == pytest.approx(0.025, abs=4 * lost.std)


@pytest.mark.parametrize(("count", "noise"), [(400, 1e-3), (400, 0.03), (150, 1e-3)])
def test_splines_tell_the_noise_and_the_derivatives(count, noise):
    rng = np.random.default_rng(0)
    t = np.sort(rng.uniform(0, 16, count))
    y = np.stack([np.cos(3 * t), np.sin(2 * t)], axis=1)
    read = np.where(rng.uniform(size=y.shape) < 0.2, np.nan, y + noise * rng.normal(size=y.shape))
    found = splines([(t, read)])
    np.testing.assert_allclose(found.sigma, noise, rtol=0.5 if count < 200 else 0.15)
    at = np.linspace(1, 15, 50)
    curves = found.smooth(t, read, at)
    error = max(3 * noise, 0.02)
    np.testing.assert_allclose(curves.q[:, 0], np.cos(3 * at), atol=error)
    np.testing.assert_allclose(curves.v[:, 0] / 3, -np.sin(3 * at), atol=2 * error)
    np.testing.assert_allclose(curves.a[:, 1] / 4, -np.sin(2 * at), atol=5 * error)


def test_runs_share_the_noise():
    rng = np.random.default_rng(1)
    runs = []
    for _ in range(60):
        t = 0.2 * np.arange(rng.integers(6, 11))
        y = np.cos(3 * t + rng.uniform(0, 6))[:, None]
        runs.append((t, y + NOISE * rng.normal(size=y.shape)))
    assert splines(runs).sigma[0] == pytest.approx(NOISE, rel=0.3)


def short_runs_of_two_carts(rng, count=120):
    """Runs (t, x (n, 2)) of 6 to 10 readings, and the noise in them: about ten readings in a period
    of the faster of two modes, in units that differ."""
    shape = np.linalg.qr(rng.normal(size=(2, 2)))[0] * [[1.0], [rng.choice([1.0, 1e3])]]
    omega, step = np.array([1.0, rng.uniform(1.5, 2.5)]), rng.uniform(0.2, 0.4)
    runs = []
    for _ in range(count):
        t = step * np.arange(rng.integers(6, 11))
        sizes, phases = rng.uniform(0.3, 1, 2), rng.uniform(0, 2 * np.pi, 2)
        runs.append((t, (sizes * np.cos(np.outer(t, omega) + phases)) @ shape.T))
    sigma = 10 ** rng.uniform(-4, -2) * np.std(np.concatenate([x for _, x in runs]), axis=0)
    return [(t, x + sigma * rng.normal(size=x.shape)) for t, x in runs], sigma


def short_runs_of_a_spring(rng, count=120):
    """The same of one that hardens."""
    cubic, step = rng.uniform(0.5, 3), rng.uniform(0.25, 0.45)
    runs = []
    for _ in range(count):
        t = step * np.arange(rng.integers(6, 11))
        start, motion = rng.uniform(-1, 1, 2), lambda q, v: -q - cubic * q**3 - 0.02 * v
        runs.append((t, states_in_motion(motion, start, t)[:1].T))
    sigma = 10 ** rng.uniform(-4, -2) * np.std(np.concatenate([x for _, x in runs]), axis=0)
    return [(t, x + sigma * rng.normal(size=x.shape)) for t, x in runs], sigma


@pytest.mark.parametrize("draw", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2, 3))])
@pytest.mark.parametrize("make", [short_runs_of_two_carts, short_runs_of_a_spring])
def test_the_law_of_short_runs_tells_their_noise(make, draw):
    runs, sigma = make(np.random.default_rng(draw))
    tables = [{"t": t, **{f"x{k}": x for k, x in enumerate(y.T)}} for t, y in runs]
    recording = gfnn.Recording(tables, positions=[*tables[0]][1:], angles=[])
    np.testing.assert_allclose(measure(stretches(recording)).sigma, sigma, rtol=0.15)


def test_a_coordinate_that_does_not_show_is_not_taken_for_noise():
    runs, _ = short_runs_of_two_carts(np.random.default_rng(0))
    assert noise_of_one_law([(t, x[:, :1], x[:, :0]) for t, x in runs]) is None
    assert noise_of_one_law([(t, x, x[:, :0]) for t, x in runs]) is not None
    apart = [(t + 0.1 * np.sin(7 * t), x, x[:, :0]) for t, x in runs]
    assert noise_of_one_law(apart) is None  # at uneven times


def test_windows_of_parts_of_the_nodes_add_up(monkeypatch):
    runs, _ = short_runs_of_two_carts(np.random.default_rng(0), 40)
    tables = [{"t": t, "x1": x[:, 0], "x2": x[:, 1]} for t, x in runs]
    recording = gfnn.Recording(tables, positions=["x1", "x2"], angles=[])
    windows = samples_of(recording).problem.windows
    monkeypatch.setattr(windows_module.Options, "most", 100)
    parts = list(windows.parts(4))
    assert len(parts) > 1
    np.testing.assert_allclose(
        sum(part.along(part.x) for part in parts), windows.along(windows.x), rtol=1e-9, atol=1e-12
    )


def test_runs_whose_readings_nearly_coincide_have_splines():
    rng = np.random.default_rng(0)
    runs = []
    for _ in range(60):
        t = np.sort(np.append(rng.uniform(0, 2, 3), 0.6 + 1e-4 * np.arange(3)))
        runs.append((t, np.cos(3 * t)[:, None] + NOISE * rng.normal(size=(len(t), 1))))
    assert np.isfinite(splines(runs).sigma).all()


def test_every_reading_is_used_and_nodes_stand_between():
    """A stretch of a pendulum at random times, with a gap of a fifth of a period and cells that are
    missing: one row of nodes, each near the truth."""
    rng = np.random.default_rng(2)
    t = np.sort(rng.uniform(0, 20, 500))
    t = t[(t < 8) | (t > 8.4)]
    theta, omega = swing(t).T
    seen = np.where(rng.uniform(size=len(t)) < 0.3, np.nan, theta + NOISE * rng.normal(size=len(t)))
    recording = gfnn.Recording({"t": t, "theta": seen}, positions=["theta"])
    (one,) = stretches(recording)
    assert np.isfinite(one.y).sum() == np.isfinite(seen).sum()
    scales = measure([one])
    assert scales.uneven
    assert scales.period == pytest.approx(2.1, rel=0.2)
    assert scales.sigma[0] == pytest.approx(NOISE, rel=0.2)
    (nodes,) = nodes_of([one], scales)
    assert np.max(np.diff(nodes.t)) < 2.3 * scales.spacing
    assert np.isnan(nodes.y[(nodes.t > 8) & (nodes.t < 8.4)]).all()
    near = [np.argmin(np.abs(t - at)) for at in nodes.t[np.isfinite(nodes.y[:, 0])]]
    found = nodes.x[np.isfinite(nodes.y[:, 0])]
    np.testing.assert_allclose(found[:, 0], theta[near], atol=4 * NOISE)
    np.testing.assert_allclose(found[3:-3, 1], omega[near][3:-3], atol=0.1)


@pytest.mark.slow
def test_a_law_of_random_times_and_missing_cells():
    rng = np.random.default_rng(3)
    t = np.sort(rng.uniform(0, 30, 500))
    seen = swing(t)[:, 0] + NOISE * rng.normal(size=len(t))
    seen = np.where(rng.uniform(size=len(t)) < 0.3, np.nan, seen)
    recording = gfnn.Recording({"t": t, "theta": seen}, positions=["theta"])
    fit = gfnn.fit(recording)
    law_is_right(fit)
    assert fit.verdict == "identified"
    ahead = fit.map.forecast(recording, t[-1] + np.array([0.5, 1.0]))
    true = swing(np.append(t, t[-1] + np.array([0.5, 1.0])))[-2:, 0]
    np.testing.assert_allclose(ahead.values["theta"][0], true, atol=5e-3)


def test_a_law_of_many_short_runs():
    rng, runs = np.random.default_rng(4), []
    for _ in range(24):
        t = 0.15 * np.arange(rng.integers(6, 11))
        start = rng.uniform(-1.2, 1.2), rng.uniform(-2, 2)
        seen = swing(np.append(t, 2.0), start)[:-1, 0] + NOISE * rng.normal(size=len(t))
        runs.append({"t": t, "theta": seen})
    law_is_right(gfnn.fit(gfnn.Recording(runs, positions=["theta"])))


@pytest.fixture(scope="module")
def gyroscope():
    rng, t = np.random.default_rng(5), np.arange(0, 20, 0.02)
    omega = swing(t, (0.8, 0.0))[:, 1]
    return {"t": t, "gyro": omega + 0.05 + 5e-3 * rng.normal(size=len(t))}


@pytest.mark.slow
def test_a_gyroscope_alone(gyroscope):
    """θ is seen by no sensor; the bias is fitted."""
    recording = gfnn.Recording(gyroscope, observe={"gyro": "omega + b"})
    assert recording.coordinates == ("theta",)
    fit = gfnn.fit(recording)
    law_is_right(fit)
    bias, std = fit.sensors["b"]
    assert abs(bias - 0.05) < 4 * std < 4e-3
    assert "no sensor shows theta" in fit.gauge
    ahead = fit.map.forecast(recording, [21.0, 22.0])
    np.testing.assert_allclose(
        ahead.values["gyro"][0],
        swing(np.array([0, 21.0, 22.0]), (0.8, 0.0))[1:, 1] + 0.05,
        atol=0.02,
    )


PHONE = {"y": "A*omega**2 + G*cos(theta)", "x": "A*theta_ddot + G*sin(theta)"}


@pytest.mark.slow
def test_an_accelerometer_alone(tmp_path):
    """Of unknown scale on the bob, where the axis across the rod shows friction alone."""
    rng, t = np.random.default_rng(6), np.arange(0, 16, 0.02)
    theta, omega = swing(t, (0.8, 0.0)).T
    turning, A, G = -9 * np.sin(theta) - 0.05 * omega, 1.1 * 9.81 / 9, 1.1 * 9.81
    y, x = A * omega**2 + G * np.cos(theta), A * turning + G * np.sin(theta)
    table = {"t": t, **{n: c + 0.03 * rng.normal(size=len(t)) for n, c in (("y", y), ("x", x))}}
    fit = gfnn.fit(gfnn.Recording(table, observe=PHONE))
    law_is_right(fit)
    for name, true in (("A", A), ("G", G)):
        value, std = fit.sensors[name]
        assert abs(value - true) < 4 * std < 0.005 * true
    fit.save(tmp_path / "model")
    part = gfnn.Recording({n: c[:700] for n, c in table.items()}, observe=PHONE)
    ahead = gfnn.load(tmp_path / "model").map.forecast(part, t[[710, 760]])
    np.testing.assert_allclose(ahead.values["y"][0], y[[710, 760]], atol=0.1)


def test_what_an_accelerometer_does_not_tell_is_named():
    t = np.arange(0, 10, 0.02)
    shown = {"y": "kappa*(l*omega**2 + g*cos(theta))"}
    recording = gfnn.Recording({"t": t, "y": np.cos(6 * t) + 9.8}, observe=shown)
    with pytest.raises(InputError, match=r"kappa\*l, kappa\*g, l/g are.*1\*\(l\*omega"):
        gfnn.fit(recording)


@pytest.mark.slow
def test_runs_of_different_intervals_are_one_data_set():
    """The stiffness of ẍ = −x, by a short run of many readings and a long one of few: its standard
    error is that of all readings of the long run, by least squares."""
    rng, runs, information = np.random.default_rng(0), [], 0.0
    for run, (count, dt, used) in enumerate(((200, 0.05, 3), (120, 0.6, 1))):
        t = dt * np.arange(count)
        x = np.cos(t) + NOISE * rng.normal(size=count)
        runs.append({"run": np.full(count, run), "t": t, "x": x})
        t = t[::used]
        free, moved = np.stack([np.cos(t), np.sin(t)], axis=1), -0.5 * t * np.sin(t)
        left = moved - free @ np.linalg.lstsq(free, moved)[0]
        information += left @ left / NOISE**2
    fit = gfnn.fit(gfnn.Recording(runs, positions=["x"]), terms=["v**2", "x**2"])
    (spring,) = [term for term in fit.lagrangian.terms if term.term == "x**2"]
    assert spring.std == pytest.approx(0.5 / np.sqrt(information), rel=0.2)
    assert spring.coefficient == pytest.approx(-0.5, abs=4 * spring.std)
