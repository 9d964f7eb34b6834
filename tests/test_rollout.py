"""Rollouts: blocks, statuses, turns of angles, lanes apart, plain step functions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from analytic import exact_oscillator, folding, generated, map_of, oscillator, rotated, standard

from gfnn_jax.coordinates import Coordinates
from gfnn_jax.generating.charts import MIDPOINT, TYPE2
from gfnn_jax.maps.rollout import rollout
from gfnn_jax.solve.status import LEFT_DOMAIN, NON_FINITE, NOT_CONVERGED, OK, STOPPED_AT_EDGE

TORUS = Coordinates("torus", angles=(0, 1))
CYLINDER = Coordinates("cylinder", angles=(0,))
KICK = 0.6
DISC = np.random.default_rng(0).uniform(-1, 1, (400, 2))
OSCILLATOR = map_of(generated(oscillator, exact_oscillator(0.2), MIDPOINT, 0.2), DISC)
ROTOR = generated(standard, 0.0, TYPE2, 1.0)  # p constant, q moves by p
Z = 0.5 * DISC[:12]


def test_rollout_of_the_oscillator_is_a_rotation():
    states, info = OSCILLATOR.rollout(Z, 50)
    assert states.shape == (12, 51, 2)
    np.testing.assert_array_equal(states[:, 0], Z)
    expected = rotated(Z[:, None], 0.2 * np.arange(51))
    np.testing.assert_allclose(states, expected, rtol=0, atol=1e-14)
    assert (info.status == OK).all()
    assert (info.left_at == -1).all()
    assert (info.iterations >= 1).all()


@pytest.mark.slow
def test_one_lane_and_saving_every_k():
    states = np.asarray(OSCILLATOR.rollout(Z, 50)[0])
    some, info = OSCILLATOR.rollout(Z, 50, save_every=7)
    assert some.shape == (12, 1 + 50 // 7, 2)
    np.testing.assert_allclose(some, states[:, ::7], rtol=0, atol=1e-15)
    one, alone = OSCILLATOR.rollout(Z[0], 50, save_every=7)
    assert one.shape == (8, 2)
    assert alone.status.shape == alone.left_at.shape == ()
    np.testing.assert_allclose(one, some[0], rtol=0, atol=1e-15)
    assert info.status.shape == (12,)
    none, info = OSCILLATOR.rollout(Z, 0)
    np.testing.assert_array_equal(none, Z[:, None])
    assert (info.iterations == 0).all()


@pytest.mark.slow
def test_blocks_are_the_whole_bit_for_bit():
    learned = map_of(generated(standard, KICK, TYPE2, 1.0), 3 * DISC, coordinates=TORUS)
    z = np.random.default_rng(1).uniform(-3, 3, (6, 2))
    whole, info = learned.rollout(z, 24, save_every=2)
    lanes, saved = learned.start(z), []
    for _ in range(3):
        lanes, block = learned.advance(lanes, 4, save_every=2)
        saved.append(block)
    np.testing.assert_array_equal(np.concatenate(saved, axis=1), whole[:, 1:])
    np.testing.assert_array_equal(lanes.status, info.status)
    np.testing.assert_array_equal(lanes.iterations, info.iterations)
    np.testing.assert_array_equal(lanes.steps, 24)


# Angles.


def standard_map(z, num_steps):
    """The exact map on the plane, its angle reduced for the sine and turns counted apart."""
    theta, p = np.array(z.T, dtype=np.longdouble)
    states = [np.stack([theta, p], axis=1)]
    for _ in range(num_steps):
        p = p + KICK * np.sin(theta)
        theta = theta + p
        states.append(np.stack([theta, p], axis=1))
    return np.stack(states, axis=1)


@pytest.mark.parametrize(
    "coordinates",
    [TORUS, pytest.param(CYLINDER, marks=pytest.mark.slow)],
    ids=["both periodic", "angle only"],
)
def test_rotating_standard_map_agrees_with_the_exact_map(coordinates):
    """Momenta of several 2π: the angle passes through hundreds of turns in a regular orbit."""
    piece = generated(standard, KICK, TYPE2, 1.0)
    learned = map_of(piece, 30 * DISC, coordinates=coordinates)
    z = np.array([[0.3, 2.0], [3.0, 2.2 + 6 * np.pi], [-2.0, -8.5 * np.pi], [1e4, 1.9]])
    states, info = learned.rollout(z, 60)
    exact = standard_map(z, 60)
    assert np.abs(exact[..., 0]).max() > 1e3
    assert (info.status == OK).all()
    error = np.asarray(states) - exact
    if coordinates is TORUS:  # p is reduced, and θ then misses whole turns
        assert np.abs(error[1]).max() > 10
        error[..., 0] -= 2 * np.longdouble(np.pi) * np.round(error[..., 0] / (2 * np.pi))
    # An angle of 1e4 carries 1e-12 of roundoff from the start.
    assert np.abs(error).max() < 5e-11
    assert np.abs(error[0]).max() < 1e-12


@pytest.mark.slow
def test_many_turns_of_a_free_rotor_lose_nothing():
    """θ after 20,000 steps is θ₀ + 20,000 p to a few roundings of p a step, not of θ."""
    learned = map_of(ROTOR, 30 * DISC, coordinates=CYLINDER)
    z = np.array([[0.25, 6.25], [0.5, -20.125], [1.0, 3.0]])
    states, _ = learned.rollout(z, 20_000, save_every=20_000)
    exact = z[:, 0].astype(np.longdouble) + 20_000 * z[:, 1].astype(np.longdouble)
    np.testing.assert_allclose(states[:, -1, 0], exact.astype(float), rtol=0, atol=5e-10)
    np.testing.assert_array_equal(states[:, -1, 1], z[:, 1])


def test_rounding_is_compensated():
    """q moves by p = 1/3 a step: 100,000 roundings of q would make 1e-8 of a drift."""
    learned = map_of(ROTOR, DISC)
    states, _ = learned.rollout(np.array([[0.1, 1 / 3]]), 100_000, save_every=100_000)
    last = np.asarray(states)[0, -1, 0]
    exact = np.longdouble(0.1) + 100_000 * np.longdouble(1 / 3)
    assert abs(float(last - exact)) <= np.spacing(float(exact))


@pytest.mark.slow
def test_float32_turns_do_not_drift():
    """2π in float32 is wrong by 1.7e-7: 3,000 turns of that would be 5e-4."""
    learned = map_of(ROTOR, 30 * DISC, coordinates=CYLINDER)
    learned = jax.tree.map(lambda a: np.asarray(a, np.float32), learned)
    lanes, _ = learned.advance(learned.start(np.array([[0.25, 6.25]])), 1, save_every=3_000)
    assert lanes.y.dtype == jnp.float32
    angle = float(lanes.y[0, 0]) + 2 * np.pi * int(lanes.winding[0, 0])
    assert angle == pytest.approx(0.25 + 3_000 * 6.25, abs=1e-4)


# Statuses.

SHEAR = map_of(ROTOR, DISC)  # leaves any box at a known step


def first_outside(z, num_steps):
    """The first step at which the exact orbit is outside the domain, or -1."""
    path = z + np.arange(num_steps + 1)[:, None] * np.array([[z[1], 0.0]])
    inside = SHEAR.domain.contains(path)
    return int(np.argmin(inside)) if not inside.all() else -1


@pytest.mark.parametrize(
    "stop", [pytest.param(False, marks=pytest.mark.slow), True], ids=["continue", "stop"]
)
def test_leaving_the_domain(stop):
    z = np.array([[0.0, 0.25], [0.0, 0.0], [0.0, 0.5], [9.0, 0.1], [-0.5, 0.125]])
    states, info = SHEAR.rollout(z, 12, stop_outside=stop)
    states = np.asarray(states)
    expected = np.array([first_outside(one, 12) for one in z])
    assert 0 in expected
    assert -1 in expected
    assert max(expected) > 3
    np.testing.assert_array_equal(info.left_at, expected)
    left = expected >= 0
    status = np.where(left, STOPPED_AT_EDGE if stop else LEFT_DOMAIN, OK)
    np.testing.assert_array_equal(info.status, status)
    exact = z[:, None] + np.arange(13)[None, :, None] * np.stack([z[:, 1], 0 * z[:, 1]], 1)[:, None]
    gone = stop & (np.arange(13) >= np.where(left, np.maximum(expected, 1), 99)[:, None])
    np.testing.assert_allclose(states[~gone], exact[~gone], atol=1e-14)
    assert np.isnan(states[gone]).all()
    assert np.isfinite(states[:, 0]).all()  # an initial state is shown, wherever it is


def test_returning_to_the_domain_does_not_mend_the_status():
    wide = map_of(OSCILLATOR.pieces[0], DISC * np.array([0.3, 1.0]))
    z = np.array([[0.0, 0.9]])
    states, info = wide.rollout(z, 40)
    assert bool(wide.domain.contains(np.asarray(states)[0, 31]))
    assert info.status[0] == LEFT_DOMAIN
    assert 0 < info.left_at[0] < 16


FOLDING = map_of(generated(folding, 1.0, TYPE2, 1.0), 10 * DISC)


def test_lanes_that_fail_repeat_nan_and_keep_their_status():
    z = 0.2 * Z
    z[1:4] = [2.0, -2.0], [np.nan, 0.0], [0.2, np.inf]
    states, info = FOLDING.rollout(z, 8)
    states = np.asarray(states)
    expected = [OK, NOT_CONVERGED, NON_FINITE, NON_FINITE, *[OK] * 8]
    np.testing.assert_array_equal(info.status, expected)
    assert np.isfinite(states[[0, *range(4, 12)]]).all()
    assert np.isnan(states[1:4, 1:]).all()
    np.testing.assert_array_equal(states[1, 0], z[1])
    assert (info.left_at == -1).all()
    assert info.iterations.max() <= 40


@pytest.mark.parametrize("stop", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_bad_lane_changes_no_bit_of_the_others(stop):
    z = 0.2 * Z
    good = FOLDING.rollout(z, 8, stop_outside=stop)
    assert (good[1].status == OK).all()
    others = np.arange(12) != 7
    for bad in [(np.nan, 0.0), (9.0, 9.0), (2.0, -2.0), (1e300, 1e300)]:
        z[7] = bad
        mixed = FOLDING.rollout(z, 8, stop_outside=stop)
        for one, other in zip(jax.tree.leaves(good), jax.tree.leaves(mixed), strict=True):
            np.testing.assert_array_equal(np.asarray(one)[others], np.asarray(other)[others])
        assert mixed[1].status[7] != OK


# Plain step functions.


def leapfrog(z, dt=0.1):
    q, p = z
    p = p - 0.5 * dt * jnp.sin(q)
    q = q + dt * p
    return jnp.stack([q, p - 0.5 * dt * jnp.sin(q)])


def test_plain_step_functions(compilations):
    states = rollout(leapfrog, Z, 12, save_every=3)
    assert states.shape == (12, 5, 2)
    (q, p), expected = Z.T, [Z]
    for k in range(1, 13):
        p = p - 0.05 * np.sin(q)
        q = q + 0.1 * p
        p = p - 0.05 * np.sin(q)
        if k % 3 == 0:
            expected.append(np.stack([q, p], axis=1))
    np.testing.assert_allclose(states, np.stack(expected, axis=1), rtol=0, atol=1e-15)
    with compilations() as found:
        rollout(leapfrog, Z + 0.1, 12, save_every=3)
    assert found.count == 0


# Derivatives.


@pytest.mark.slow
def test_initial_state_is_found_through_a_rollout():
    """A few Gauss–Newton steps on the last state of a rollout recover where it began."""

    @jax.jit
    def last_with_slopes(z):
        def last(z):
            lanes = OSCILLATOR.start(z[None])
            return OSCILLATOR.advance(lanes, 1, save_every=20)[0].y[0]

        return last(z), jax.jacfwd(last)(z), jax.jacrev(last)(z)

    target, _, _ = last_with_slopes(np.array([0.3, -0.4]))
    z = np.array([0.0, 0.1])
    for _ in range(3):
        found, forward, reverse = last_with_slopes(z)
        np.testing.assert_allclose(reverse, forward, rtol=0, atol=1e-13)
        z = z - np.linalg.solve(forward, found - target)
    np.testing.assert_allclose(z, [0.3, -0.4], rtol=0, atol=1e-13)


def test_statuses_come_along_with_gradients():
    def size(z):
        states, info = OSCILLATOR.rollout(z, 5)
        return jnp.sum(states[:, -1] ** 2), info.status

    gradient, status = jax.jit(jax.grad(size, has_aux=True))(Z)
    np.testing.assert_allclose(gradient, 2 * Z, rtol=0, atol=1e-13)  # the norm is kept
    assert (status == OK).all()
