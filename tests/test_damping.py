"""Maps that lose area: the factor, the map behind it, and what its orbits tend to."""

import warnings

import numpy as np
import pytest
from analytic import moved
from scipy.linalg import expm

import gfnn_jax as gfnn
from gfnn_jax.coordinates import CARTESIAN, nearest_image
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.diagnosis import damping
from gfnn_jax.evaluate.orbits import periodic_orbit, rotation_number
from gfnn_jax.evaluate.report import assemble
from gfnn_jax.phase_space import Pairs, symplectic_form

B, K, DRIFT = 0.9, 0.6, 0.2


def damped_standard_map(z):
    q, p = np.asarray(z).T
    p = B * p + DRIFT + K * np.sin(q)
    return np.stack([q + p, p], axis=-1)


def states_of(number, seed):
    return np.random.default_rng(seed).uniform([0, -2], [2 * np.pi, 4], (number, 2))


@pytest.fixture(scope="module")
def learned():
    z = states_of(1_000, 0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return gfnn.fit(Pairs(z, damped_standard_map(z), 1.0), angles=(0,), learn="map")


@pytest.mark.slow
def test_the_factor_and_the_drift_are_learned(learned):
    assert learned.met
    assert abs(learned.damping.factor - B) < 1e-12
    assert np.abs(learned.damping.shift - DRIFT).max() < 1e-12
    assert 0 < learned.damping.std < 1e-12
    assert abs(learned.map.multiplier() - B) < 1e-12
    assert "multiplies areas by 0.9" in str(learned.damping)


@pytest.mark.slow
def test_a_step_is_the_maps_and_conformally_symplectic(learned):
    z, near = states_of(300, 1), 1e-6 * np.eye(2)
    z[1:3], z[3:5] = z[0] + near, z[0] - near
    image = np.asarray(learned.map.step(z)[0])
    assert np.abs(nearest_image(image - damped_standard_map(z), (0,))).max() < 1e-12
    assert learned.symplecticity_defect < 1e-14
    up, down = image[1:3], image[3:5]  # the executed step, by differences
    jacobian, form = (up - down).T / 2e-6, symplectic_form(1)
    assert np.abs(jacobian.T @ form @ jacobian - B * form).max() < 1e-8
    back = np.asarray(learned.map.inverse(image)[0])
    assert np.abs(nearest_image(back - z, (0,))).max() < 1e-12


@pytest.mark.slow
def test_the_rotation_number_of_its_attractor_is_the_maps(learned):
    states, _ = learned.map.rollout(np.array([1.0, 0.5]), 12_000)
    true = [np.array([1.0, 0.5])]
    for _ in range(12_000):
        true.append(damped_standard_map(true[-1]))
    predicted, expected = (
        rotation_number(np.asarray(angle)[2_000:, 0]) for angle in (states, np.array(true))
    )
    assert expected.error < 1e-10
    assert abs(predicted.value - expected.value) < 1e-10


@pytest.mark.slow
def test_oscillators_of_different_friction_keep_no_multiple_of_the_form():
    """Their determinant is the same everywhere, which would pass for one factor."""
    rates = np.array([0.1, 0.3])
    field = np.zeros((4, 4))
    field[[0, 1], [2, 3]], field[[2, 3], [0, 1]] = 1.0, [-1.0, -2.0]
    field[[2, 3], [2, 3]] = -rates
    z = np.random.default_rng(0).normal(size=(600, 4))
    learned = gfnn.fit(Pairs(z, z @ expm(0.5 * field).T, 0.5), learn="map")
    assert np.abs(learned.damping.factor - np.exp(-0.5 * rates)).max() < 1e-12
    assert learned.map.multiplier() is None
    assert "no multiple of the symplectic form" in str(learned.damping)
    fresh = np.random.default_rng(1).normal(size=(50, 4))
    error = np.asarray(learned.map.step(fresh)[0]) - fresh @ expm(0.5 * field).T
    assert np.abs(error).max() < 1e-12


@pytest.mark.parametrize("share", [0.0, 0.05])
def test_a_factor_that_differs_over_phase_space_is_a_mean(share):
    """Of p a step keeps b + share sin q, which is by what it multiplies areas."""
    z = states_of(600, 0)
    q, p = z.T
    p = (B + share * np.sin(q)) * p + K * np.sin(q)
    data = Dataset.of(Pairs(z, np.stack([q + p, p], axis=-1), 1.0), CARTESIAN).divided(0)
    found = damping.diagnosed(data, "auto", None, 0, may_lose=True).damping
    assert found is not None
    assert abs(found.factor - B) < (0.02 if share else 1e-12)
    assert ("at q1" in found.differs) == (share > 0)
    assert ("one factor for all states" in str(found)) == (share == 0)


# A factor that depends on a parameter


def damped_by(parameter, z):
    """The damped standard map of this b in every pair."""
    q, p = np.asarray(z).T
    p = parameter * p + DRIFT + K * np.sin(q)
    return np.stack([q + p, p], axis=-1)


def pairs_by(number, seed):
    z, rng = states_of(number, seed), np.random.default_rng([seed, 1])
    decay = rng.uniform(0.05, 0.3, number)
    return Pairs(z, damped_by(np.exp(-decay), z), 1.0, args={"decay": decay})


@pytest.fixture(scope="module")
def of_decay():
    return gfnn.fit(pairs_by(900, 0), angles=(0,), tolerance=1e-9)


@pytest.mark.slow
def test_a_factor_that_depends_on_a_parameter_is_learned(of_decay):
    assert of_decay.met
    given = np.array([0.07, 0.15, 0.28])
    found = of_decay.map.multiplier({"decay": given})
    assert np.abs(found - np.exp(-given)).max() < 1e-9
    assert abs(of_decay.map.multiplier({"decay": 0.15}) - found[1]) < 1e-15
    assert of_decay.map.multiplier() is None  # of no parameter in particular
    assert "depending on decay, one factor for all states" in str(of_decay.damping)
    test = pairs_by(200, 1)
    error = np.asarray(of_decay.map.step(test.z0, test.args)[0]) - test.z1
    assert np.abs(nearest_image(error, (0,))).max() < 1e-7
    assert of_decay.symplecticity_defect < 1e-14


@pytest.mark.slow
def test_a_map_of_such_a_factor_goes_back_and_is_saved(of_decay, tmp_path):
    test = pairs_by(200, 2)
    image = of_decay.map.step(test.z0, test.args)[0]
    back = np.asarray(of_decay.map.inverse(image, test.args)[0])
    assert np.abs(nearest_image(back - test.z0, (0,))).max() < 1e-11
    of_decay.map.save(tmp_path / "model")
    assert np.array_equal(gfnn.load(tmp_path / "model").map.step(test.z0, test.args)[0], image)
    report = assemble(of_decay)["map"]
    assert report["multiplier"] is None
    assert report["damping"]["parameters"] == ("decay",)
    low, high = report["damping"]["low"], report["damping"]["high"]
    assert abs(low - np.exp(-0.3)) < 1e-3
    assert abs(high - np.exp(-0.05)) < 1e-3


@pytest.mark.slow
def test_a_factor_that_no_parameter_changes_is_one_number():
    """K is the parameter: b is the same for all, and told as one."""
    z, rng = states_of(900, 3), np.random.default_rng(4)
    strength = rng.uniform(0.3, 0.9, 900)
    p = B * z[:, 1] + DRIFT + strength * np.sin(z[:, 0])
    pairs = Pairs(z, np.stack([z[:, 0] + p, p], 1), 1.0, args={"strength": strength})
    learned = gfnn.fit(pairs, angles=(0,), tolerance=1e-10)
    assert learned.met
    assert learned.damping.functions is None
    assert abs(learned.damping.factor - B) < 1e-12
    assert learned.map.multiplier({"strength": 0.5}) == learned.damping.factor


@pytest.mark.slow
def test_two_factors_that_depend_on_a_parameter():
    """Two oscillators whose frictions are of a parameter: none of them has a multiple of J."""
    rng = np.random.default_rng(0)
    z, rate = rng.normal(size=(600, 4)), rng.uniform(0.05, 0.1, 600)

    def image(z, rate):
        p = np.stack([(1 - rate) * z[:, 2], (1 - 2 * rate) * z[:, 3]], 1) - 0.3 * z[:, :2]
        return np.concatenate([z[:, :2] + p, p], axis=1)

    learned = gfnn.fit(Pairs(z, image(z, rate), 1.0, args={"rate": rate}), tolerance=1e-6)
    assert learned.met
    assert learned.map.multiplier({"rate": 0.08}) is None
    piece = learned.damping.piece
    assert np.abs(piece.of(np.array([0.08]))[0] - [0.92, 0.84]).max() < 1e-6
    assert " in (q1, p1), " in str(learned.damping)


@pytest.mark.slow
def test_friction_that_differs_over_phase_space_is_said_to():
    z = np.random.default_rng(0).normal(size=(600, 2))
    pairs = Pairs(z, moved(lambda _, z: [z[1], -z[0] - 0.3 * z[0] ** 2 * z[1]], z, 0.3), 0.3)
    with pytest.warns(gfnn.FitWarning) as told:
        learned = gfnn.fit(pairs, family="polynomial")
    assert learned.damping is None
    assert any("differs over phase space, from" in str(w.message) for w in told)
    assert any(" at q1 = " in str(w.message) for w in told)


@pytest.mark.slow  # two seconds of reference, five of fitting
def test_a_damped_driven_pendulum_by_its_period():
    rate, period = 0.02, 2 * np.pi
    rng = np.random.default_rng(0)

    def pairs_of(number):
        radius, angle = 0.8 * np.sqrt(rng.uniform(size=number)), rng.uniform(0, 2 * np.pi, number)
        z = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)

        def field(t, z):
            return [z[1], -np.sin(z[0]) - rate * z[1] + 0.15 * np.cos(t)]

        return Pairs(z, moved(field, z, period), period)

    learned, test = gfnn.fit(pairs_of(3_000), tolerance=1e-10), pairs_of(300)
    assert abs(learned.damping.factor / np.exp(-rate * period) - 1) < 1e-10
    error = np.asarray(learned.map.step(test.z0)[0]) - test.z1
    assert np.sqrt(np.mean(error**2)) < 1e-9
    assert learned.symplecticity_defect < 1e-14


def test_a_rotation_number_is_the_golden_mean():
    golden = (np.sqrt(5) - 1) / 2
    steps = np.arange(4_001)
    phase = 2 * np.pi * golden * steps
    found = rotation_number(phase + 0.3 * np.sin(phase) + 0.1 * np.cos(3 * phase))
    assert abs(found.value - golden) < 1e-13
    assert found.error < 1e-10


@pytest.mark.slow
def test_a_periodic_orbit_closes_and_loses_area(learned):
    """(π, 2π) is a fixed point where the drift is 2π (1 − b)."""
    z = states_of(1_000, 3)
    image = damped_standard_map(z) - DRIFT + 2 * np.pi * (1 - B)
    fit = gfnn.fit(Pairs(z, image, 1.0), angles=(0,), learn="map")
    orbit = periodic_orbit(fit.map, np.array([3.0, 6.2]), 1, angles=(0,))
    assert np.abs(nearest_image(orbit.states - [np.pi, 2 * np.pi], (0,))).max() < 1e-12
    assert abs(np.prod(orbit.eigenvalues) - B) < 1e-12
    assert (np.abs(orbit.eigenvalues) < 1).all()
    with pytest.raises(ValueError, match="found none"):
        periodic_orbit(fit.map, np.array([np.nan, 0.0]), 1)


@pytest.mark.parametrize("b", [1.0, pytest.param(0.99, marks=pytest.mark.slow)])
def test_of_many_pairs_a_sample_tells_whether_areas_are_lost(b, monkeypatch):
    """Jacobians that are certain of a change, by their own error, do not make a fit look at all
    pairs; what is lost indeed is learned from all of them."""
    looked_at = []
    fitted = damping._Problem.fitted

    def counted(self, *given):
        looked_at.append(len(self.data.training))
        return fitted(self, *given)

    monkeypatch.setattr(damping._Problem, "fitted", counted)
    monkeypatch.setattr(damping.Options, "sample", 100)
    z = np.random.default_rng(0).uniform(-1, 1, (3_000, 2))
    p = z[:, 1] - 0.4 * np.sin(z[:, 0])
    image = np.stack([z[:, 0] + 0.4 * p, b * p], axis=1)
    data = Dataset.of(Pairs(z, image, 0.4), CARTESIAN).divided(0)
    jacobians = np.tile(np.sqrt(min(b, 1 - 1e-6)) * np.eye(2), (400, 1, 1))
    found = damping.learn_damping(data, jacobians, 0.0, "auto", None)
    if b == 1:
        assert found is None
        assert set(looked_at) == {100}
    else:
        np.testing.assert_allclose(found.factor, b, rtol=1e-6)
        assert max(looked_at) == len(data.training)
