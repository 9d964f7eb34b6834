"""Zeros of sensors that wander: whitened residuals, estimates of states and zeros, a whole fit."""

import dataclasses

import numpy as np
import pytest
from analytic import mechanics
from test_law_fits import pendulum

import gfnn_jax as gfnn
from gfnn_jax.families.friction import DRY, LINEAR
from gfnn_jax.maps.estimates import Window, estimates_of, law_in_use, propagate
from gfnn_jax.maps.observation import Observation
from gfnn_jax.maps.sensors import Sensors
from gfnn_jax.solve.noise import SoftL1, Wander

WANDER = Wander(2.0, 1.5)


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def wandering(t, rng, wander=WANDER, noise=1.0):
    """A path of noise at even times: white, on the process step by step."""
    fade = np.exp(-(t[1] - t[0]) / wander.time)
    b = np.zeros(len(t))
    b[0] = wander.size * rng.normal()
    for n in range(1, len(t)):
        b[n] = fade * b[n - 1] + wander.size * np.sqrt(1 - fade**2) * rng.normal()
    return noise * (b + rng.normal(size=len(t)))


def test_whitened_noise_is_white(rng):
    """Samples of the process, built step by step, and one of them unseen."""
    t = np.arange(8) * 0.4
    paths = np.array([wandering(t, rng) for _ in range(6_000)])
    noise = np.ones((1, 8, 1))
    noise[0, 3] = np.inf
    paths[:, 3] = 0.0
    white = WANDER.whitening(t[None], noise)[0, 0]
    covariance = np.cov(paths @ white.T, rowvar=False)
    expected = np.diag(np.arange(8) != 3).astype(float)
    np.testing.assert_allclose(covariance, expected, atol=0.08)
    noisier = WANDER.whitening(t[None], np.concatenate([noise, 2 * noise], axis=2))
    alike = WANDER.whitening(t[None], np.concatenate([noise, noise], axis=2))
    np.testing.assert_array_equal(alike, np.broadcast_to(white, (1, 2, 8, 8)))
    np.testing.assert_array_equal(noisier[0, 0], white)
    assert np.abs(noisier[0, 1] - white).max() > 0.1


def test_innovations_whiten_as_the_matrix_does(rng):
    t = np.sort(rng.uniform(0, 8, (3, 20)), axis=1)
    noise, rows = rng.uniform(0.5, 2.0, (3, 20, 2)), rng.normal(size=(3, 20, 2, 4))
    noise[1, 4:7, 0] = np.inf
    matrix = WANDER.whitening(t, noise)
    whitened, logs = WANDER.whitened(t, noise, rows)
    np.testing.assert_allclose(whitened, np.einsum("akij,ajkw->aikw", matrix, rows), atol=1e-12)
    diagonals = np.diagonal(matrix, axis1=2, axis2=3)
    assert logs == pytest.approx(np.log(diagonals).sum(), abs=1e-10)


def free_body(sigma, wander):
    """A law without forces, known exactly, q = q0 + v t; residuals of any size count in full."""
    law = mechanics([((2,), (0,), (0,), 0.0, 0.5)])
    seen = dataclasses.replace(Observation.plain(["x"]), loss=SoftL1(1e6))
    rest = (1.0, 10.0, "hold", 0.0, np.array([1.0]), np.zeros((1, 1)), seen, wander)
    sensors = Sensors(("x",), (), (), np.array([sigma]), *rest)
    return law_in_use(law, None, sensors)


@pytest.mark.parametrize("size", [0.3, 2.0])
def test_a_state_and_its_zero_are_those_of_the_normal_distribution(rng, size):
    """The joint normal distribution of samples, zeros and a later sample, with a flat prior of the
    state, conditioned by its precision matrix."""
    sigma, wander = 0.01, Wander(size, 1.5)
    t, ahead = np.arange(20) * 0.1, np.array([0.3, 2.0])
    y = 1.0 + 0.5 * t + wandering(t, rng, wander, sigma)
    law = free_body(sigma, wander)
    window = Window(t, y[:, None], t, np.zeros((20, 0)))
    x, covariance = estimates_of([law], np.array([0]), [window])
    orbits = propagate([law], np.array([0]), [window], x, covariance, t[-1:], t[-1] + ahead[None])

    times = np.append(t, t[-1] + ahead)
    every = np.stack([np.ones_like(times), times - t[-1]], axis=1)
    K = sigma**2 * wander.covariance(times[:, None] - times)
    C, c, X = K[:20, :20] + sigma**2 * np.eye(20), K[20:, :20], every[:20]
    P = np.linalg.inv(X.T @ np.linalg.solve(C, X))
    state = P @ X.T @ np.linalg.solve(C, y)
    np.testing.assert_allclose(x[0, :2], state, rtol=1e-6)
    np.testing.assert_allclose(covariance[0, :2, :2], P, rtol=1e-6)
    mean = every[20:] @ state + c @ np.linalg.solve(C, y - X @ state)
    rest = every[20:] - c @ np.linalg.solve(C, X)
    cov = K[20:, 20:] + sigma**2 * np.eye(2) - c @ np.linalg.solve(C, c.T) + rest @ P @ rest.T
    np.testing.assert_allclose(orbits.values[0, :, 0], mean, atol=1e-6 * sigma)
    np.testing.assert_allclose(orbits.std[0, :, 0], np.sqrt(np.diag(cov)), rtol=1e-6)


def sliding_body(level, friction, sigma=1e-4):
    """A body, driven, with dry and viscous friction that are known but for their level."""
    losses = [((1,), kind, 0.0, c) for kind, c in zip((LINEAR, DRY), friction, strict=True)]
    law = mechanics([((2,), (0,), (0,), 0.0, 0.5)], losses, gains=[[1.0]])
    own = free_body(sigma, None).sensors
    return law_in_use(law, None, dataclasses.replace(own, inputs=("F",), level=level, window=2.0))


def test_the_level_of_friction_is_that_of_the_window():
    """Friction is 5 % stronger than the law has it: a window shows it, and the forecast goes by it;
    its deviation is that of scattered windows."""
    t = np.arange(0, 4, 0.02)
    u, friction = 2 * np.sin(3 * t)[:, None], np.array([0.4, 0.3])
    true = sliding_body(0.0, 1.05 * friction)
    x = np.array([[0.2, 0.5]])
    drive = Window(t, np.zeros((len(t), 1)), t, u)
    covariance = np.zeros((1, 2, 2))
    path = propagate([true], np.array([0]), [drive], x, covariance, t[:1], t[None, 1:]).values[
        0, :, 0
    ]
    path = np.append(x[0, 0], path)
    rng, end, found = np.random.default_rng(0), 120, []
    windows = [
        Window(t[:end], (path[:end] + 1e-4 * rng.normal(size=end))[:, None], t, u) for _ in range(8)
    ]
    law, stiff = sliding_body(0.1, friction), sliding_body(0.0, friction)
    x, covariance = estimates_of([law], np.zeros(8, int), windows)
    assert x.shape == (8, 3)
    std = np.sqrt(covariance[:, 2, 2])
    assert np.abs((x[:, 2] - 0.05) / std).max() < 3
    assert 0.5 < np.std(x[:, 2]) / std.mean() < 2
    last, ahead = np.full(8, t[end - 1]), np.broadcast_to(t[end:], (8, len(t) - end))
    errors = []
    for one in (law, stiff):
        given = [one], np.zeros(8, int), windows
        orbits = propagate(*given, *estimates_of(*given), last, ahead)
        errors.append(orbits.values[..., 0] - path[end:])
        found.append(orbits.std[..., 0])
    assert np.abs(errors[0]).max() < 0.1 * np.abs(errors[1]).max()
    assert np.sqrt(np.mean((errors[0] / found[0]) ** 2)) < 1.5


@pytest.fixture(scope="module")
def swing():
    """A pendulum whose zero wanders by twice the noise, and its law without the last part."""
    t, theta = pendulum(gamma=0.02, noise=0.0, end=80.0, dt=0.1)
    theta = theta + wandering(t, np.random.default_rng(3), noise=5e-3)
    recording = gfnn.Recording({"t": t, "theta": theta}, positions=["theta"], angles=["theta"])
    return recording, gfnn.fit(recording.slice(stop=55.0), friction="linear")


@pytest.mark.slow
def test_a_fit_finds_how_a_zero_wanders(swing, tmp_path):
    _, fit = swing
    found = fit.map.sensors.wander
    assert found is not None
    assert 0.5 < found.size * fit.noise["theta"] / (2.0 * 5e-3) < 2
    assert 0.4 < found.time / 1.5 < 2.5
    assert fit.noise["theta"] == pytest.approx(5e-3, rel=0.25)
    for term, true in zip(fit.lagrangian.terms[1:], [2.0], strict=True):
        assert abs(term.coefficient - true) < 3 * term.std
    fit.map.save(tmp_path / "map")
    assert gfnn.load(tmp_path / "map").map.sensors.wander == found


@pytest.mark.slow
def test_a_map_takes_the_level_of_friction_from_the_samples(swing):
    recording, fit = swing
    warm = fit.map.with_friction_level(0.1)
    z, covariance = warm.estimate(recording)
    assert z.shape == (1, 2)
    plain = fit.map.estimate(recording)[0]
    assert np.abs(z - plain).max() < 5 * np.sqrt(np.diagonal(covariance[0]).max())
    with pytest.raises(ValueError, match="size > 0"):
        fit.map.with_friction_level(0.0)


@pytest.mark.slow
def test_forecasts_on_a_zero_that_wanders(swing):
    """Smaller errors than without it, and bands that hold them."""
    recording, fit = swing
    sensors = fit.map.sensors
    steady = dataclasses.replace(fit.map, sensors=dataclasses.replace(sensors, wander=None))
    errors, inside = [], []
    for map_ in (fit.map, steady):
        own = []
        for start in np.arange(56.0, 78.0, 1.0):
            later = recording.slice(start + 1e-9, start + 1.5)
            found = map_.forecast(recording.slice(start - 3.0, start), later.times("0"))
            own.append(found.values["theta"][0] - later.values("theta", "0"))
            inside.append(np.abs(own[-1]) <= 2 * found.std["theta"][0])
        errors.append(np.sqrt(np.mean(np.concatenate(own) ** 2)))
    assert errors[0] < 0.95 * errors[1]
    assert 0.88 < np.mean(np.concatenate(inside[: len(inside) // 2])) <= 1.0
