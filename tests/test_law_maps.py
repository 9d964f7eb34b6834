"""The map of a law: forecasts with inputs and their gradient, bands, files, the energy's ledger."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from analytic import block_on_a_spring, mechanics

import gfnn_jax as gfnn
from gfnn_jax.families.friction import DRY, LINEAR
from gfnn_jax.maps.energy import ledger
from gfnn_jax.maps.estimates import Window, law_in_use, propagate
from gfnn_jax.maps.inputs import HOLDS, Signals
from gfnn_jax.maps.laws import law_of_map, map_of_law, states_of, velocities_of
from gfnn_jax.maps.sensors import Sensors

# A pendulum whose pivot is driven by a motor.
ROWS = [((2,), (0,), (0,), 0.0, 0.5), ((0,), (0,), (1,), 0.0, 9.0)]
LAW = mechanics(ROWS, [((1,), LINEAR, 0.0, 0.2), ((1,), DRY, 0.3, 0.1)], gains=[[1.5]])
DT, STEPS = 0.05, 30
RNG = np.random.default_rng(0)
Z = np.stack([RNG.uniform(-1, 1, 200), RNG.normal(size=200)], axis=1)
TIMES = DT * np.arange(STEPS + 1)
U = np.sin(3 * TIMES[:, None] + [0.0])


def map_with(hold="linear", **options):
    return map_of_law(LAW, Z, DT, angles=(0,), signals=Signals(("torque",), hold), **options)


MAP = map_with(root=1e-3 * np.eye(5))


def forecast(z, input_at):
    """States (STEPS + 1, 2) by another integrator, step by step."""

    def field(t, y):
        u = np.array([[input_at(t)]])
        return [y[1], LAW.acceleration(y[None, :1], y[None, 1:], u)[0, 0]]

    states = [z]
    for n in range(STEPS):
        span = (n * DT, (n + 1) * DT - 1e-12)
        solved = scipy.integrate.solve_ivp(
            field, span, states[-1], method="DOP853", rtol=1e-12, atol=1e-13
        )
        states.append(solved.y[:, -1])
    return np.array(states)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hold", "input_at"),
    [
        ("hold", lambda t: U[int(t / DT + 1e-6), 0]),
        ("linear", lambda t: np.interp(t, TIMES, U[:, 0])),
    ],
)
def test_inputs_between_their_samples(hold, input_at):
    states, info = map_with(hold).rollout(Z[:2], STEPS, inputs=U)
    assert (np.asarray(info.status) < 3).all()
    np.testing.assert_allclose(states[0], forecast(Z[0], input_at), atol=1e-6)
    if hold == "linear":
        each, _ = MAP.rollout(Z[:2], STEPS, inputs=np.stack([U, 0 * U])[:, :-1])
        none, _ = MAP.rollout(Z[:2], STEPS)
        np.testing.assert_array_equal(each[1], none[1])
        np.testing.assert_allclose(each[0, :-1], states[0, :-1], atol=1e-14)


@pytest.mark.parametrize(("hold", "delay"), [("hold", 0.3), ("linear", 1.4), ("band", 0.6)])
def test_delayed_inputs_keep_their_momentum(hold, delay):
    """The integral of a step's polynomial is that of the input, moved by the delay."""
    u = np.cos(0.4 * np.arange(200) + 1)[:, None]
    coefficients = Signals(("u",), hold, 0.1 * delay).coefficients(u, 0.1)
    powers = np.arange(coefficients.shape[-1])
    found = coefficients @ (0.1 ** (powers + 1) / (powers + 1))
    fine = np.arange(0, 200, 0.01) + 0.005 - delay
    inside = {
        "hold": u[np.clip(np.floor(fine).astype(int), 0, 199), 0],
        "linear": np.interp(fine, np.arange(200), u[:, 0]),
        "band": np.cos(0.4 * fine + 1),
    }
    expected = 0.1 * inside[hold].reshape(200, 100).mean(axis=1)
    np.testing.assert_allclose(found[40:-40], expected[40:-40], atol=1e-5)


@pytest.mark.parametrize("frequency", [0.05, 0.4, 2 / 3, 0.8])
def test_band_limited_inputs(frequency):
    """Waves up to four fifths of the Nyquist rate, away from the ends, to the window's accuracy."""
    n = np.arange(200)
    signals = Signals(("u",), "band")
    coefficients = signals.coefficients(np.cos(np.pi * frequency * n + 1)[:, None], 1.0)
    part = np.linspace(0, 1, 7)
    found = coefficients @ part ** np.arange(10)[:, None]
    expected = np.cos(np.pi * frequency * (n[:, None] + part) + 1)
    np.testing.assert_allclose(found[40:-40], expected[40:-40], atol=5e-8)


@pytest.mark.slow
def test_gradient_of_a_forecast_in_the_inputs():
    @jax.jit
    def cost(u):
        return jnp.sum(MAP.rollout(Z[0], STEPS, inputs=u)[0][-1] ** 2)

    slope = jax.jit(jax.grad(cost))(U)
    for n in (0, 15, STEPS):
        e = np.zeros_like(U)
        e[n] = 1e-5
        expected = (cost(U + e) - cost(U - e)) / 2e-5
        np.testing.assert_allclose(slope[n, 0], expected, atol=1e-8)


@pytest.mark.slow
def test_the_law_beside_its_map(tmp_path):
    """Velocities, the linear map, power, bands; saved and loaded the same."""
    assert MAP.multiplier() is None
    z = Z[:3]
    v = velocities_of(MAP, z)
    np.testing.assert_allclose(states_of(MAP, z[:, :1], v), z, atol=1e-15)
    np.testing.assert_array_equal(law_of_map(MAP).losses, LAW.losses)
    step = MAP.step
    A, B = MAP.linearise(z[0], [0.4])
    for j, e in enumerate(1e-5 * np.eye(2)):
        slope = (step(z[0] + e, inputs=[0.4])[0] - step(z[0] - e, inputs=[0.4])[0]) / 2e-5
        np.testing.assert_allclose(A[:, j], slope, atol=1e-8)
    slope = (step(z[0], inputs=[0.4 + 1e-5])[0] - step(z[0], inputs=[0.4 - 1e-5])[0]) / 2e-5
    np.testing.assert_allclose(B[:, 0], slope, atol=1e-8)
    lost, supplied = MAP.power(z, inputs=U[:3])
    expected = LAW.power(z[:, :1], v, U[:3])
    np.testing.assert_allclose(lost, expected[0][:, :-1], atol=1e-14)
    np.testing.assert_allclose(supplied, expected[1], atol=1e-14)
    _, info = MAP.rollout(z, STEPS, inputs=U, samples=5, key=jax.random.key(0))
    assert 0 < info.bands.std[0, -1, 0] < 0.1
    MAP.save(tmp_path / "m")
    again = gfnn.load(tmp_path / "m").map
    np.testing.assert_array_equal(
        again.rollout(z, STEPS, inputs=U)[0], MAP.rollout(z, STEPS, inputs=U)[0]
    )


@pytest.mark.slow
def test_the_ledger_closes():
    """What is stored is what is supplied less what is lost, to the order of the steps."""
    found = ledger(MAP, Z[:4], STEPS, inputs=U)
    assert found.lost.shape == (4, 2)
    assert (np.asarray(found.lost) > 0).all()
    assert np.abs(found.supplied).min() > 1e-3
    assert np.abs(found.closure).max() < 1e-9


@pytest.mark.slow
def test_uniform_friction_of_a_law_is_conformal():
    law = mechanics(ROWS, uniform=0.3)
    map_ = map_of_law(law, Z, DT)
    assert map_.multiplier() == pytest.approx(np.exp(-0.3 * DT), rel=1e-15)
    assert np.asarray(map_.defect(Z[:20])).max() < 1e-15
    found = ledger(map_, Z[:2], STEPS)
    assert np.abs(found.closure).max() < 1e-9


def test_signals_that_are_not_the_laws():
    with pytest.raises(ValueError, match="got 0"):
        map_of_law(LAW, Z, DT)
    with pytest.raises(ValueError, match="hold"):
        Signals(("u",), "cubic")


def on_a_spring(friction, width):
    """A body on a spring with dry friction of this width."""
    rows = [((2,), (0,), (0,), 0.0, 0.5), ((0,), (2,), (0,), 0.0, -0.5)]
    return mechanics(rows, [((1,), DRY, width, friction)])


def block(turn, friction, time):
    """Positions of a block that is let go at ``turn``, and where it stops."""
    found = block_on_a_spring(turn, 0.0, time, friction)[0]
    return found, found[-1]


def test_a_forecast_and_its_band_across_a_stop():
    """A block that comes to rest, of a start and a friction known to a part in some hundreds: where
    it stops, and how sure that is, are those of the exact motion."""
    time, turn, friction, errors = 0.1 * np.arange(201), 0.42, 0.05, np.array([2e-3, 3e-4])
    law = on_a_spring(friction, 1e-6)
    sigma, ends = np.array([1e-5]), np.array([20.0])
    sensors = Sensors(
        ("x",), (), (), sigma, 1.0, 1.0, "hold", 0.0, ends, np.zeros((1, 1)), creep=1e-6
    )
    root, covariance = np.diag([0.0, 0.0, errors[1]]), np.diag([errors[0] ** 2, 0.0])
    used = law_in_use(law, root, sensors)
    window = Window(time[:1], np.full((1, 1), turn), np.zeros(0), np.zeros((0, 0)))
    start = np.array([[turn, 0.0]]), covariance[None], time[:1]
    found = propagate([used], np.array([0]), [window], *start, time[None, 1:])

    expected, stop = block(turn, friction, time)
    assert abs(stop) < friction  # it has stopped, and not where the spring is slack
    np.testing.assert_allclose(found.values[0, :, 0], expected[1:], atol=1e-8)
    e = 1e-5
    slopes = [
        block(turn + e * a, friction + e * b, time)[0]
        - block(turn - e * a, friction - e * b, time)[0]
        for a, b in np.eye(2)
    ]
    spread = np.linalg.norm(np.stack(slopes) / (2 * e) * errors[:, None], axis=0)
    np.testing.assert_allclose(found.std[0, :, 0], np.hypot(spread[1:], sigma), rtol=1e-3)
    assert found.covariances[0, -1, 1, 1] < 1e-20  # it stands still


CREEP = 1e-4


def learned_block(friction=0.05):
    """The map of the block, as a recording's: dry friction that is smoothed over what no sensor
    sees."""
    law = on_a_spring(friction, CREEP)
    z = np.random.default_rng(0).uniform(-0.6, 0.6, (100, 2))
    map_ = map_of_law(law, z, 0.1, root=np.diag([0.0, 0.0, 1e-3]))
    return dataclasses.replace(map_, sensors=sensors_of(("x",), 1.0))


def sensors_of(positions, omega, inputs=(), angles=(), hold="hold"):
    d = len(positions)
    rest = (1.0, hold, 0.0, np.array([20.0]), np.zeros((1, d)))
    return Sensors(positions, inputs, angles, np.full(d, 1e-5), omega, *rest, creep=CREEP)


def test_a_rollout_across_a_stop():
    """Against the exact motion: it loses energy, stops for ever, and its parts are the same."""
    map_, starts = learned_block(), np.array([0.52, 0.42, 0.03])
    z = np.stack([starts, 0 * starts], axis=1)
    states, info = map_.rollout(z, 300)
    states = np.asarray(states)
    for lane, start in zip(states, starts, strict=True):
        expected, stop = block(start, 0.05, 0.1 * np.arange(301))
        assert abs(stop) < 0.05
        np.testing.assert_allclose(lane[:, 0], expected, atol=1e-8)
        assert np.diff((lane**2).sum(axis=1)).max() < 1e-8  # of the step, at roundoff of none
    np.testing.assert_array_equal(info.status, 0)
    np.testing.assert_array_equal(states[:, -1], states[:, -20])
    np.testing.assert_array_equal(states[2], np.broadcast_to(z[2], (301, 2)))
    np.testing.assert_array_equal(map_.step(z)[0], states[:, 1])
    np.testing.assert_array_equal(map_.step(z[0])[0], states[0, 1])
    np.testing.assert_array_equal(map_.rollout(z, 300, save_every=7)[0], states[:, :300:7])
    lanes, begun = map_.start(z), []
    for _ in range(2):
        lanes, some = map_.advance(lanes, 150)
        begun.append(some)
    np.testing.assert_allclose(np.concatenate(begun, axis=1), states[:, 1:], atol=1e-15)
    held = np.asarray(map_.rollout(z[0], 100_000, save_every=10_000)[0])
    np.testing.assert_array_equal(held[1:], np.broadcast_to(states[0, -1], (10, 2)))


@pytest.mark.slow
def test_a_rollout_under_jit_smooths_dry_friction():
    map_, z = learned_block(), np.array([0.42, 0.0])
    exact = map_.rollout(z, 20)[0]
    for smooth in (
        jax.jit(lambda z: map_.rollout(z, 20)[0])(z),
        jax.vmap(lambda z: map_.rollout(z, 20)[0])(z[None])[0],
        dataclasses.replace(map_, sensors=None).rollout(z, 20)[0],
    ):
        error = np.abs(smooth - exact).max()
        assert 1e-9 < error < CREEP
    assert np.isfinite(jax.grad(lambda z: map_.rollout(z, 20)[0][-1, 0])(z)).all()


def test_rollouts_with_events_that_end():
    """Lanes of which nothing is known, that leave the domain, or stop there."""
    z = np.array([[0.42, 0.0], [np.nan, 0.0], [5.0, 0.0], [np.inf, 0.0]])
    map_ = learned_block()
    states, info = map_.rollout(z, 40)
    np.testing.assert_array_equal(info.status, [0, 4, 1, 4])
    np.testing.assert_array_equal(info.left_at, [-1, -1, 0, -1])
    np.testing.assert_array_equal(map_.step(z)[1].status, info.status)
    assert np.isfinite(states[2]).all()
    stopped, info = map_.rollout(z, 40, stop_outside=True)
    np.testing.assert_array_equal(info.status, [0, 4, 2, 4])
    assert np.isnan(stopped[2, 1:]).all()
    none, info = map_.rollout(z[:1], 0)
    np.testing.assert_array_equal(none[:, 0], z[:1])


@pytest.mark.slow
def test_bodies_that_stick_to_each_other():
    """Two bodies on springs with friction between them: lanes go on from their states as from their
    modes, and lose energy."""
    rows = [((2, 0), (0, 0), (0, 0), 0.0, 0.5), ((0, 2), (0, 0), (0, 0), 0.0, 0.3)]
    rows += [((0, 0), (2, 0), (0, 0), 0.0, -0.5), ((0, 0), (0, 2), (0, 0), 0.0, -0.9)]
    rows += [((1, 1), (0, 0), (0, 0), 0.0, 0.1)]
    law = mechanics(rows, [((1, 0), DRY, CREEP, 0.02), ((-1, 1), DRY, CREEP, 0.2)])
    z = np.random.default_rng(0).normal(size=(40, 4))
    map_ = dataclasses.replace(map_of_law(law, z, 0.05), sensors=sensors_of(("x", "y"), 2.0))
    states, _ = map_.rollout(z, 200)
    lanes, parts = map_.start(z), []
    for _ in range(200):
        lanes, some = map_.advance(lanes, 1)
        parts.append(some)
    np.testing.assert_allclose(np.concatenate(parts, axis=1), states[:, 1:], atol=1e-10)
    v = velocities_of(map_, np.asarray(states[:, 1:]))
    together = np.abs(v[..., 1] - v[..., 0]) < 1e-14
    assert 0.05 < np.mean(together & (np.abs(v[..., 0]) > 1e-3)) < 0.95
    energy = jax.vmap(map_.hamiltonian)(states)
    assert np.diff(energy, axis=1).max() < 1e-7


@pytest.mark.slow
def test_samples_of_a_law_that_sticks():
    map_, z = learned_block(), np.array([[0.42, 0.0], [0.03, 0.0]])
    drawn = map_.sample(jax.random.key(0), 3)
    states, _ = drawn.rollout(z, 200)
    for one, lanes in zip(drawn, states, strict=True):
        np.testing.assert_array_equal(one.rollout(z, 200)[0], lanes)
    lanes, some = drawn.advance(drawn.start(z), 200)
    np.testing.assert_allclose(some, states[:, :, 1:], atol=1e-15)
    bands = map_.rollout(z, 200, samples=3, key=jax.random.key(0))[1].bands
    assert bands.std[0, -1, 0] > 1e-4
    np.testing.assert_array_equal(bands.std[1], 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("hold", HOLDS)
def test_a_rollout_with_inputs_and_turns(hold):
    """A pendulum with dry friction that a motor turns over: what JAX's steps of a narrower width
    tend to, angles counted, inputs by their rule, with parameters of the system."""
    losses = [((1,), DRY, CREEP, 0.1)]
    powers = ((0,), (0,), (0,), (1,))  # the gain of the motor is in proportion to a parameter
    law = mechanics(ROWS, losses, gains=[[1.0]], powers=powers)
    args = np.random.default_rng(1).uniform(1.0, 2.0, (200, 1))
    signals = Signals(("torque",), hold)
    map_ = map_of_law(
        law, Z, DT, angles=(0,), signals=signals, parameters=("gain",), args=args, inputs=args
    )
    own = sensors_of(("x",), 1.0, ("torque",), ("x",), hold)
    exact = dataclasses.replace(map_, sensors=own)
    z, torque = np.array([[0.3, 0.5], [2.0, 5.9]]), 4 * np.sin(3 * DT * np.arange(101))[:, None]
    options = {"params": {"gain": np.array([1.2, 1.9])}, "inputs": torque}
    smooth, _ = map_.rollout(z, 100, **options)
    found, _ = exact.rollout(z, 100, **options)
    np.testing.assert_allclose(found, smooth, atol=2e-3)
    assert np.abs(found[1, -1, 0]) > 2 * np.pi
    lanes, some = exact.advance(exact.start(z, params=options["params"]), 100, **options)
    np.testing.assert_allclose(some, found[:, 1:], atol=1e-13)
    assert abs(int(lanes.winding[1, 0])) > 0
    one = exact.step(z, options["params"], inputs=[1.0])[0]
    np.testing.assert_allclose(one, map_.step(z, options["params"], inputs=[1.0])[0], atol=1e-4)
