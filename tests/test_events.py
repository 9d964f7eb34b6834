"""Times of events as readings, and channels with a clock and a lag of their own."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn
from gfnn_jax.maps.observation import Crossing


def swings(omega2, friction, start, seconds):
    def rates(_, z):
        return [z[1], -omega2 * np.sin(z[0]) - friction(z[1])]

    return solve_ivp(
        rates,
        (0, seconds),
        [start, 0.0],
        method="DOP853",
        events=lambda _, z: z[0],
        dense_output=True,
        rtol=1e-10,
        atol=1e-12,
    )


def gate(friction, noise=1e-4, start=0.9):
    times = swings(22.0, friction, start, 140.0).t_events[0][:200]
    return times + noise * np.random.default_rng(0).normal(size=len(times))


def fitted(times):
    record = gfnn.Recording(
        {"gate": times}, events={"gate": "theta"}, angles=["theta"], std={"gate": 1e-4}
    )
    return gfnn.fit(record)


@pytest.mark.parametrize(
    ("friction", "text"),
    [
        (lambda v: 0.03 * v, "omega**2"),
        pytest.param(lambda v: 0.01 * v * abs(v), "abs(omega)**3", marks=pytest.mark.slow),
    ],
)
def test_a_photogate_tells_a_pendulum_and_its_friction(friction, text):
    fit = fitted(gate(friction))
    (term,) = [one for one in fit.found.lagrangian.terms if "cos" in one.term]
    assert term.coefficient == pytest.approx(22.0, rel=1e-3)
    assert abs(term.coefficient - 22.0) < 4 * term.std
    assert [one.term for one in fit.found.friction.terms] == [text]
    assert fit.verdict == "identified"
    with pytest.raises(gfnn.InputError, match="no state is estimated"):
        fit.forecast(np.array([200.0]))


def test_times_of_one_period_tell_no_law():
    times = 0.7 * np.arange(100) + 1e-4 * np.random.default_rng(0).normal(size=100)
    with pytest.raises(gfnn.FitError, match="no change of the period"):
        fitted(times)


def test_the_noise_of_times_has_to_be_given():
    with pytest.raises(gfnn.InputError, match="std="):
        gfnn.fit(
            gfnn.Recording(
                {"gate": np.arange(60) - 0.1 * np.exp(-np.arange(60) / 20)},
                observe={"gate": "crossing(theta)"},
                angles=["theta"],
            )
        )


def test_events_stand_between_samples():
    """Rows of both, each with what was read; a time of the file's clock."""
    t = np.arange(5.0)
    record = gfnn.Recording(
        {"t": t, "x": t**2, "gate": [0.5, 2.0, np.nan, np.nan, np.nan]},
        positions=["x"],
        events={"gate": "x - 2*a"},
    )
    np.testing.assert_array_equal(record.times("0"), [0, 0.5, 1, 2, 3, 4])
    np.testing.assert_array_equal(
        record.values("gate", "0"), [np.nan, 0, np.nan, 0, np.nan, np.nan]
    )
    assert record.values("x", "0")[3] == 4


def test_derivatives_of_a_crossing():
    sensor = Crossing.of("sin(a)*b - c", ("a", "b"))
    assert sensor.parameters == {"c": 0.0}
    rng = np.random.default_rng(0)
    at = rng.normal(size=5)

    def value(z):
        return sensor(z[:2], z[2:4], z[4:])[0]

    found = np.concatenate(sensor(at[:2], at[2:4], at[4:])[1:])
    near = [(value(at + h) - value(at - h)) / 2e-6 for h in 1e-6 * np.eye(5)]
    np.testing.assert_allclose(found, near, rtol=1e-6)


@pytest.mark.slow
def test_a_lag_of_a_channel_with_a_clock_of_its_own():
    rng, every = np.random.default_rng(1), 0.07
    motion = swings(12.0, lambda v: 0.1 * v, 1.0, 45.0).sol
    one, two = every * (1 + np.arange(600)), 1.03 * every * (1 + np.arange(550))
    t = np.concatenate([one, two])
    shown = np.concatenate([motion(one)[0], motion(two - 0.7 * every)[0]])
    shown += 1e-3 * shown.std() * rng.normal(size=len(t))
    own = np.arange(len(t)) < len(one)
    order = np.argsort(t)
    columns = {"theta": np.where(own, shown, np.nan), "late": np.where(own, np.nan, shown)}
    fit = gfnn.fit(
        gfnn.Recording(
            {"t": t[order]} | {name: x[order] for name, x in columns.items()},
            positions=["theta"],
            angles=["theta"],
            observe={"late": "theta - lag*omega + lag**2/2*theta_ddot"},
            guess={"lag": 0.0},
        )
    )
    assert fit.found.sensors["lag"][0] == pytest.approx(0.7 * every, abs=0.05 * every)
    assert "cos(theta)" in str(fit.formula)
