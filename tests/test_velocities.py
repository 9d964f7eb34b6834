"""Velocities of a file: used where they are honest, and not where they were made of positions."""

import numpy as np
import pytest
from analytic import states_in_motion

import gfnn_jax as gfnn
from gfnn_jax.signals.splines import with_rates


def swing(end=16.0, dt=0.04):
    t, rng = np.arange(0, end, dt), np.random.default_rng(3)
    found = states_in_motion(lambda q, v: -4 * np.sin(q) - 0.05 * v, [1.4, 0.0], t)
    return t, *found, lambda size: size * rng.normal(size=len(t))


@pytest.fixture(scope="module")
def record():
    t, theta, omega, noise = swing()
    return {"t": t, "theta": theta + noise(3e-3), "omega": omega + noise(2e-3)}


def fit(table):
    return gfnn.fit(gfnn.Recording(table), terms=["V: cos(theta)", "R: omega**2"])


@pytest.mark.slow
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
        pytest.param(lambda t, theta, omega: 0.97 * omega, "scale", marks=pytest.mark.slow),
        pytest.param(
            lambda t, theta, omega: np.interp(t - 0.02, t, omega), "lag", marks=pytest.mark.slow
        ),
        pytest.param(lambda t, theta, omega: omega + 0.05, "bias", marks=pytest.mark.slow),
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


@pytest.fixture(scope="module")
def driven_round():
    """A pendulum that a torque drives round: its angle is read to 0.3 rad, its velocity to 0.05."""
    t, rng = np.arange(0, 12, 0.02), np.random.default_rng(5)
    x, v = states_in_motion(lambda q, v: 1.5 - np.sin(q) - 0.5 * v, [1.3, 0.0], t)
    noise = np.array([0.3, 0.05]) * rng.normal(size=(len(t), 2))
    return x, {"t": t, "x": x + noise[:, 0], "v": v + noise[:, 1]}


def test_positions_by_their_rates(driven_round):
    x, table = driven_round
    readings = np.stack([table["x"], table["v"]], axis=1)
    found = with_rates(table["t"], readings, np.tile([0.3, 0.05], (len(x), 1)))
    assert np.std(found - x) < 0.03  # readings of x alone tell it to 0.3


@pytest.mark.slow
def test_velocities_make_up_for_positions_that_noise_hides(driven_round):
    table = gfnn.Recording(driven_round[1], positions=["x"], velocities=["v"], angles=["x"])
    fit = gfnn.fit(table)
    assert not fit.verdict.startswith("partly")
    found = {term.term: term for term in fit.lagrangian.terms}
    for name, true in (("cos(x)", 1.0), ("x", 1.5)):
        assert abs(found[name].coefficient - true) < 4 * found[name].std, fit.formula
