"""Velocities of a file: used where they are honest, and not where they were made of positions."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn


def swing(end=16.0, dt=0.04):
    t, rng = np.arange(0, end, dt), np.random.default_rng(3)
    found = solve_ivp(
        lambda _, z: [z[1], -4 * np.sin(z[0]) - 0.05 * z[1]], (0, end), [1.4, 0.0], t_eval=t,
        rtol=1e-10, atol=1e-12,
    )  # fmt: skip
    return t, *found.y, lambda size: size * rng.normal(size=len(t))


@pytest.fixture(scope="module")
def record():
    t, theta, omega, noise = swing()
    return {"t": t, "theta": theta + noise(3e-3), "omega": omega + noise(2e-3)}


def fit(table):
    return gfnn.fit(gfnn.Recording(table), terms=["V: cos(theta)", "R: omega**2"])


def test_an_honest_velocity_is_used(record):
    both, alone = fit(record), fit({"t": record["t"], "theta": record["theta"]})
    of = both.velocities["omega"]
    assert of.used
    assert of.white
    assert of.sigma == pytest.approx(2e-3, rel=0.2)
    assert abs(of.scale[0] - 1) < 2e-3  # what the positions' noise leaves open
    assert abs(of.lag[0]) < 2e-3
    assert both.noise["omega"] == pytest.approx(2e-3, rel=0.2)
    (_, more), (_, less) = both.lagrangian.terms, alone.lagrangian.terms
    assert more.std < 0.8 * less.std, (more, less)
    assert abs(more.coefficient - 4) < 4 * more.std
    recording = gfnn.Recording(record)
    past, times = recording.slice(10.0, 14.0), np.array([15.0])
    found = both.map.forecast(past, times)
    assert set(found.values) == {"theta", "omega"}
    blind = gfnn.Recording({name: record[name] for name in ("t", "theta")}).slice(10.0, 14.0)
    assert both.map.forecast(blind, times).std["theta"] > found.std["theta"]


@pytest.mark.parametrize(
    ("made", "what"),
    [
        (lambda t, theta, omega: 0.97 * omega, "scale"),
        (lambda t, theta, omega: np.interp(t - 0.02, t, omega), "lag"),
        (lambda t, theta, omega: omega + 0.05, "bias"),
        (lambda t, theta, omega: np.gradient(theta, t), "colour"),
    ],
)
def test_others_are_not(record, made, what):
    t, _, omega, noise = swing()
    value = made(t, record["theta"], omega) + (noise(2e-3) if what != "colour" else 0)
    of = fit(record | {"omega": value}).velocities["omega"]
    assert not of.used
    if what != "colour":
        right = {"scale": 0.97, "lag": 0.02, "bias": 0.05}[what]
        assert abs(getattr(of, what)[0] - right) < 5 * getattr(of, what)[1]
