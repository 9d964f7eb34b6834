"""A network H through its flow: a pendulum, told nothing but the angle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from analytic import map_of

import gfnn_jax as gfnn
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.mlp import Mlp
from gfnn_jax.families.terms import given_terms
from gfnn_jax.flows.collocation import Steps, images
from gfnn_jax.flows.flow import Flow
from gfnn_jax.solve.status import LEFT_DOMAIN

PENDULUM, TRUE = given_terms(1, ["p**2", "cos(q)"]), np.array([0.5, -1.0])
DT, TOLERANCE = 0.3, 1e-3


def states(count, seed):
    return np.random.default_rng(seed).uniform([-3.1, -1.5], [3.1, 1.5], (count, 2))


def moved(z, dt=DT):
    return images(PENDULUM, TRUE, z, dt, Steps(10, 1)).states


@pytest.fixture(scope="module")
def fit():
    z = states(200, 0)
    return gfnn.fit(
        gfnn.Pairs(z, moved(z), DT),
        angles=(0,),
        learn="hamiltonian",
        family="mlp",
        tolerance=TOLERANCE,
    )


@pytest.fixture(scope="module")
def untrained():
    """The map of a network for what holds of every one."""
    z = states(200, 0)
    family = Mlp(box_inputs(z, angles=(0,)), (9, 4))
    params = jax.tree.map(np.asarray, family.init(jax.random.key(0), np.float64))
    return map_of(Flow(family, params, DT, np.ones(2), 6), z)


@pytest.mark.slow
def test_the_flow_of_the_network_is_that_of_the_pendulum(fit):
    """The midpoint rule alone errs by 1e-3 of the spread here: the flow has been fitted."""
    assert fit.met
    assert fit.chosen.family == "mlp"
    assert fit.chosen.learns == "hamiltonian"
    assert fit.symplecticity_defect < 1e-13
    z = states(300, 1)
    error = np.asarray(fit.map.step(z)[0]) - moved(z)
    assert np.sqrt(np.mean(error**2)) < TOLERANCE


@pytest.mark.slow
def test_the_network_is_h_up_to_a_constant_and_holds_at_any_dt(fit):
    z = states(300, 2) * [1, 0.9]
    off = np.asarray(fit.map.hamiltonian(z)) - PENDULUM.value(TRUE, z)
    assert np.std(off) < 3 * TOLERANCE
    error = np.asarray(fit.map.over(0.1).step(z)[0]) - moved(z, 0.1)
    assert np.sqrt(np.mean(error**2)) < TOLERANCE


@pytest.mark.slow
def test_energy_stays(untrained):
    rolled, info = untrained.rollout(jnp.array([[1.0, 0.5]]), 300, save_every=300)
    assert (np.asarray(info.status) <= LEFT_DOMAIN).all()
    energy = np.asarray(untrained.hamiltonian(rolled[0]))
    assert np.ptp(np.asarray(rolled[0]), axis=0).max() > 0.1
    assert abs(energy[-1] - energy[0]) < 1e-10


def test_it_is_saved_to_the_bit(untrained, tmp_path):
    untrained.save(tmp_path / "m")
    jax.tree.map(np.testing.assert_array_equal, gfnn.load(tmp_path / "m").map, untrained)


@pytest.mark.slow
def test_the_flow_in_numpy_is_that_of_the_step(fit):
    """By it the pairs are looked at for gross errors, where a network misses the tolerance."""
    z = states(20, 4)
    images = fit.hamiltonian.flow.image(z)
    np.testing.assert_allclose(images, np.asarray(fit.hamiltonian.flow.step(z)[0]), atol=1e-13)
