"""The fast part of the hard cases: what is lost must be flagged or refused, never silent."""

import dataclasses
import math
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from analytic import disc, leapfrog, rms, rotated

import gfnn_jax as gfnn
from gfnn_jax.coordinates import Coordinates
from gfnn_jax.evaluate import metrics
from gfnn_jax.generating.charts import TYPE2
from gfnn_jax.generating.generated import Generated
from gfnn_jax.maps.domain import covering
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.scenes import standard_map
from gfnn_jax.solve.status import OK

DT, K = 0.4, 0.6


def fit(z0, z1, dt=DT, *, tolerance, **options):
    """(fit to an absolute tolerance, its messages as one text)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        fitted = gfnn.fit(
            gfnn.Pairs(z0, z1, dt), family="polynomial", absolute_tolerance=tolerance, **options
        )
    return fitted, "; ".join(fitted.messages)


@pytest.fixture(scope="module")
def clean():
    z0 = disc(400)
    return fit(z0, leapfrog(z0, DT), chart="midpoint", tolerance=1e-6)[0].map


@pytest.fixture(scope="module")
def exact():
    """The standard map by its exact generating function S(θ, P) = P²/2 + K cos θ, in type 2."""

    def generating_function(k, w):
        return w[1] ** 2 / 2 + k * jnp.cos(w[0])

    generated = Generated(generating_function, np.float64(K), TYPE2, 1.0, np.ones(2))
    coordinates = Coordinates("angles", angles=(0, 1))
    domain = covering(disc(100), ignore=(0, 1))
    return SymplecticMap((generated,), coordinates, domain, np.ones(2), np.zeros(2), 1.0)


# Bad conditions for the solver


@pytest.mark.slow
@pytest.mark.parametrize("factor", [3.0, 100.0, 1e6, 1e150, 1e300])
def test_no_start_far_outside_is_ok(clean, factor):
    states, info = clean.rollout(factor * disc(30, seed=1) / 0.5, 20)
    far = np.linalg.norm(factor * disc(30, seed=1) / 0.5, axis=1) > 2
    status = np.asarray(info.status)
    assert (status[far] != OK).all()
    lost = np.isnan(np.asarray(states)[:, -1]).any(axis=1)
    np.testing.assert_array_equal(lost, status > 1)


# Bad data


# Long times


@pytest.mark.slow
def test_standard_map_stays_on_its_curve_and_comes_back(exact):
    """Rounding does not add up: a plain sum would be 2e-12 away by then, and ten times the steps
    ten times as far."""
    curve = np.empty((3_000, 2))
    theta, p, pi = np.longdouble(0), np.longdouble(4), 4 * np.arctan(np.longdouble(1))
    for i in range(len(curve)):
        curve[i] = theta, p
        p += K * np.sin(theta)
        theta = (theta + p) % (2 * pi)
    lanes, reached = exact.start(curve[:1]), []
    for _ in range(20):  # the reduced angle: beside the turns it would lose its last digits
        lanes, _ = exact.advance(lanes, 1, save_every=10_000)
        reached.append(np.asarray(lanes.y)[0] % (2 * np.pi))
    assert lanes.status[0] == OK
    assert metrics.curve_distance(np.array(reached), curve).max() < 2e-13
    beside = np.array(reached) + np.array([0, 1e-6])
    assert metrics.curve_distance(beside, curve).min() > 1e-7
    start = jnp.asarray(curve[:1])
    states, _ = exact.rollout(start, 5_000, save_every=5_000)
    returned, _ = exact.reversed().rollout(states[:, -1], 5_000, save_every=5_000)
    np.testing.assert_allclose(returned[:, -1], start, rtol=0, atol=1e-9)


# Large steps


def oscillated(angle, chart):
    """Fit of the oscillator's map at dt = ``angle``: (error on fresh states, fit, messages)."""
    z0, z = disc(300, seed=9), disc(100, seed=10)
    fitted, said = fit(z0, rotated(z0, angle), angle, chart=chart, tolerance=1e-8)
    return rms(fitted.map, z, rotated(z, angle)), fitted, said


@pytest.mark.slow
def test_half_a_period_has_no_base_map_and_is_learned_beyond_the_fold():
    error, fitted, said = oscillated(np.pi, "auto")
    assert error < 1e-8
    assert not fitted.base_map
    assert "beyond a fold" in said


@pytest.mark.slow
def test_midpoint_close_to_half_a_period_is_learned_about_its_linear_map():
    error, fitted, said = oscillated(3.0, "midpoint")
    assert error < 1e-8
    assert fitted.base_map
    assert fitted.model_determinant_min > 0.9
    assert not said


# Chaos


@pytest.mark.slow
@pytest.mark.parametrize("k", [0.9716, 2.0, 5.0])
def test_chaotic_statistics_are_those_of_the_exact_map(exact, k):
    generated = dataclasses.replace(exact.pieces[0], params=np.float64(k))
    ours = dataclasses.replace(exact, pieces=(generated,))
    theirs = standard_map(k).step
    z0 = jnp.asarray(np.random.default_rng(11).uniform(0, 2 * np.pi, (100, 2)))

    def exponents(step):
        return np.asarray(jax.jit(jax.vmap(lambda z: metrics.lyapunov_exponent(step, z, 300)))(z0))

    mine, reference = exponents(lambda z: ours.step(z)[0]), exponents(theirs)
    scatter = math.hypot(mine.std(), reference.std()) / math.sqrt(len(z0))
    assert abs(mine.mean() - reference.mean()) < 4 * scatter
    if k == 5.0:  # ln(K/2) in the fully chaotic limit (Chirikov 1979)
        assert mine.mean() == pytest.approx(math.log(k / 2), rel=0.1)
