"""S as a function of the time step: one generated map for pairs of several dt."""

import dataclasses

import jax
import numpy as np
import pytest

import gfnn_jax as gfnn
from gfnn_jax import cli
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products
from gfnn_jax.families.terms import given_terms
from gfnn_jax.families.time_step import OfTimeStep
from gfnn_jax.flows.collocation import Steps, images

LAW = given_terms(1, ["p**2/2 - 2*cos(q)"])


def image(z, dt):
    return images(LAW, np.ones(1), z, dt, Steps(8, 4)).states


def sampled(count, seed=0):
    rng = np.random.default_rng(seed)
    z0, dt = rng.uniform(-1, 1, (count, 2)), rng.uniform(0.1, 0.6, count)
    return gfnn.Pairs(z0, image(z0, dt), dt)


@pytest.fixture(scope="module")
def learned():
    return gfnn.fit(sampled(1_000), learn="map", tolerance=1e-5)


@pytest.mark.slow
def test_derivatives_are_those_of_jax():
    rng = np.random.default_rng(0)
    w, dt = rng.uniform(-1, 1, (7, 4)), rng.uniform(0.1, 1, (7, 1))
    family = OfTimeStep(Products(box_inputs(w, args=dt**2), 3))
    c = rng.normal(size=family.num_parameters)
    params = family.unflatten(c)
    gradient, hessian = family.gradient_and_hessian(params, w, dt)
    of_jax = jax.jit(
        lambda w, dt: (
            jax.vmap(jax.grad(family, 1), (None, 0, 0))(params, w, dt),
            jax.vmap(jax.hessian(family, 1), (None, 0, 0))(params, w, dt),
        )
    )
    for found, expected in zip((gradient, hessian), of_jax(w, dt), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-12)
    terms = family.term_gradients(w, dt)
    np.testing.assert_allclose(terms @ c, gradient, atol=1e-12)
    np.testing.assert_array_equal(family.gradient(params, w, -dt), family.gradient(params, w, dt))
    assert np.linalg.matrix_rank(terms.reshape(-1, len(c))) == min(28, len(c))  # none of dt alone
    assert np.abs(terms).max(axis=(0, 1)).min() > 0


@pytest.mark.slow
def test_any_step_of_the_range(learned):
    assert (learned.chosen.learns, learned.chosen.chart) == ("map", "midpoint")
    assert learned.chosen.validation_relative < 1e-5
    new = sampled(300, seed=1)
    states, info = learned.map.step(new.z0, dt=new.dt)  # each lane its own
    assert np.sqrt(np.mean((np.asarray(states) - new.z1) ** 2)) < 1e-5
    assert np.asarray(info.iterations).max() <= 2  # the predictor knows dt
    alone, _ = learned.map.step(new.z0[4], dt=float(new.dt[4]))
    np.testing.assert_allclose(alone, states[4], atol=1e-15)
    back, _ = learned.map.over(new.dt, (300,)).inverse(states)
    np.testing.assert_allclose(back, new.z0, atol=1e-14)
    assert learned.symplecticity_defect < 1e-13
    rolled, _ = learned.map.rollout(new.z0[:20], 40, dt=0.2)
    np.testing.assert_allclose(rolled[:, -1], image(new.z0[:20], 8.0), atol=1e-4)
    assert learned.model_determinant_min > 0.5


@pytest.mark.slow
def test_a_step_that_was_not_sampled_has_a_status(learned):
    z = np.full((1, 2), 0.1)
    for dt, status in ((0.05, 1), (0.3, 0), (0.7, 1)):
        assert learned.map.step(z, dt=dt)[1].status.tolist() == [status]
        assert learned.map.rollout(z, 3, dt=dt)[1].status.tolist() == [status]


@pytest.mark.slow
def test_a_step_after_another_is_within_the_range_of_both(learned):
    z = np.full((1, 2), 0.1)
    for dts, status in (((0.4, 0.5), 0), ((0.6, 0.7), 1)):
        one, other = (learned.map.over(dt) for dt in dts)
        state, info = one.then(other).step(z)
        assert info.status.tolist() == [status]
        np.testing.assert_allclose(state, other.step(one.step(z)[0])[0], atol=1e-15)


def test_the_derivative_in_dt_is_the_velocity(learned):
    z = np.array([0.5, 0.3])
    ahead, behind = (np.asarray(learned.map.step(z, dt=0.4 + h)[0]) for h in (1e-5, -1e-5))
    velocity = (ahead - behind) / 2e-5
    q, p = learned.map.step(z, dt=0.4)[0]
    np.testing.assert_allclose(velocity, [p, -2 * np.sin(q)], atol=1e-4)


@pytest.mark.slow
def test_saved_and_predicted_at_any_dt(learned, tmp_path, capsys):
    learned.map.save(tmp_path / "m")
    z, dt = sampled(3, seed=2).z0, np.array([0.2, 0.3, 0.5])
    loaded = gfnn.load(tmp_path / "m").map
    np.testing.assert_array_equal(loaded.step(z, dt=dt)[0], learned.map.step(z, dt=dt)[0])
    assert loaded.step(z, dt=0.9)[1].status.tolist() == [1, 1, 1]
    np.save(tmp_path / "z.npy", z)
    given = ["predict", str(tmp_path / "m"), "--initial", str(tmp_path / "z.npy"), "--dt", "0.25"]
    given += ["--num-steps", "5", "--out", str(tmp_path / "p.npz")]
    assert cli.main(given) == 0
    predicted = np.load(tmp_path / "p.npz")
    assert predicted["dt"] == 0.25
    np.testing.assert_array_equal(predicted["trajectories"], loaded.rollout(z, 5, dt=0.25)[0])
    capsys.readouterr()


@pytest.mark.slow
def test_bands_of_samples(learned):
    """Check bands at every dt, for S of few and noisy pairs."""
    pairs = sampled(300, seed=3)
    noise = 1e-4 * np.random.default_rng(4).normal(size=(300, 2))
    noisy = gfnn.Pairs(pairs.z0, pairs.z1 + noise, pairs.dt)
    with pytest.warns(gfnn.FitWarning):
        fit = gfnn.fit(noisy, learn="map", tolerance=1e-8)
    new, drawn = sampled(100, seed=5), fit.sample(jax.random.key(0), 20)
    guess = 0.5 * (new.z0 + new.z1)

    def stepped(map_):  # in NumPy: nothing is compiled
        piece = jax.tree.map(np.asarray, map_.pieces[0])
        return dataclasses.replace(piece, dt=new.dt).refined_step(new.z0, guess)[0]

    wrong = stepped(fit.map) - new.z1
    spread = np.sqrt(np.mean(np.var([stepped(m) for m in drawn], axis=0)))
    assert 1 / 3 < np.sqrt(np.mean(wrong**2)) / spread < 3
