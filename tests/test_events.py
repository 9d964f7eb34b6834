"""Times of events as readings, and channels with a clock and a lag of their own."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn
from gfnn_jax.data.recording import channels_of
from gfnn_jax.maps.observation import Crossing, observed


def swings(omega2, friction, start, seconds):
    def rates(_, z):
        return [z[1], -omega2 * np.sin(z[0]) - friction(z[1])]

    options = {"method": "DOP853", "dense_output": True, "rtol": 1e-10, "atol": 1e-12}
    return solve_ivp(rates, (0, seconds), [start, 0.0], events=lambda _, z: z[0], **options)


def gate(friction, noise=1e-4, start=0.9):
    times = swings(22.0, friction, start, 140.0).t_events[0][:200]
    return times + noise * np.random.default_rng(0).normal(size=len(times))


def fitted(times):
    record = gfnn.Recording(
        {"gate": times}, events={"gate": "theta"}, angles=["theta"], std={"gate": 1e-4}
    )
    return gfnn.fit(record)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("friction", "text"),
    [(lambda v: 0.03 * v, "omega**2"), (lambda v: 0.01 * v * abs(v), "abs(omega)**3")],
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


def two_gates(places, start=0.9, friction=lambda v: 0.02 * v * abs(v), seconds=90.0):
    """Times at which a pendulum of ω₀² = 22 passes gates at these angles."""

    def rates(_, z):
        return [z[1], -22.0 * np.sin(z[0]) - friction(z[1])]

    gates = [lambda _, z, a=a: z[0] - a for a in places]
    options = {"method": "DOP853", "rtol": 1e-10, "atol": 1e-12}
    times = solve_ivp(rates, (0, seconds), [start, 0.0], events=gates, **options).t_events
    rng = np.random.default_rng(0)
    return [x + 1e-4 * rng.normal(size=len(x)) for x in times]


GATES = {"left": "theta - a", "right": "theta - b"}


def named(times):
    """Times of gates in one column, with their names in another."""
    order = np.argsort(np.concatenate(times))
    names = np.repeat([*GATES], [*map(len, times)])
    return {"t": np.concatenate(times)[order], "gate": names[order]}


def test_names_of_gates_stand_beside_their_times(tmp_path):
    times = two_gates((0.2, -0.05), seconds=20.0)
    table, longest = named(times), max(map(len, times))
    columns = [np.append(x, np.full(longest - len(x), np.nan)) for x in times]
    file = tmp_path / "gates.csv"
    rows = zip(table["t"].tolist(), table["gate"], strict=True)
    file.write_text("t,gate\n" + "".join(f"{t!r},{name}\n" for t, name in rows))
    expected = gfnn.Recording(dict(zip(GATES, columns, strict=True)), events=GATES)
    for found in (gfnn.Recording(table, events=GATES), gfnn.read(file, events=GATES)):
        assert found.events == ("left", "right")
        assert not found.notes
        np.testing.assert_array_equal(found.times("0"), expected.times("0"))
        for name in GATES:
            one, other = found.values(name, "0"), expected.values(name, "0")
            np.testing.assert_array_equal(one, other)


def test_swings_start_between_gates():
    """Gates that the swings reach no longer, aside of their middle, tell where they stand."""
    record = gfnn.Recording(named(two_gates((0.2, -0.05))), events=GATES, angles=["theta"])
    known = {"left": "theta - 0.2", "right": "theta + 0.05"}
    for given, expected in ((GATES, (0.2, -0.05)), (known, ())):
        shown = {name: f"crossing({h})" for name, h in given.items()}
        g = observed(shown, ("theta",), ("omega",), {}, columns=("left", "right"))
        y, _ = channels_of(record, g.channels, "0")
        g = g.balanced([(record.times("0"), y)], (0,))
        np.testing.assert_allclose(g.values * np.sign(g.values[:1]), expected, rtol=0.1)
        theta = g.coordinates_of(y, (0,), record.times("0"))[:, 0]
        for k, place in enumerate(expected or (0.2, -0.05)):
            passed = np.isfinite(y[:, k]) & np.isfinite(theta)
            assert abs(np.median(theta[passed]) - place * np.sign(g.values[:1].sum() or 1)) < 0.02


@pytest.mark.slow
def test_two_photogates_tell_a_pendulum_and_where_they_stand():
    record = gfnn.Recording(
        named(two_gates((0.2, -0.05))),
        events=GATES,
        angles=["theta"],
        std=dict.fromkeys(GATES, 1e-4),
    )
    fit = gfnn.fit(record)
    (term,) = [one for one in fit.found.lagrangian.terms if "cos" in one.term]
    assert term.coefficient == pytest.approx(22.0, rel=1e-4)
    assert [one.term for one in fit.found.friction.terms] == ["abs(omega)**3"]
    for name, place in (("a", 0.2), ("b", -0.05)):
        value, std = fit.found.sensors[name]
        assert abs(abs(value) - abs(place)) < 4 * std < 1e-3


def test_times_of_one_period_tell_no_law():
    times = 0.7 * np.arange(100) + 1e-4 * np.random.default_rng(0).normal(size=100)
    with pytest.raises(gfnn.FitError, match="no change of the period"):
        fitted(times)


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
