"""What a user writes in a module of their own goes through fit, save, load, sample and predict."""

import jax
import numpy as np
import own_module
import pytest

import gfnn_jax as gfnn

SCENE = own_module.double_well()


@pytest.fixture(scope="module")
def pairs():
    return gfnn.sample_pairs(SCENE, 400, jax.random.key(0))


@pytest.fixture(scope="module")
def fresh():
    return gfnn.sample_pairs(SCENE, 200, jax.random.key(1))


def error_of(map_, pairs):
    return np.sqrt(np.mean((np.asarray(map_.step(pairs.z0)[0]) - np.asarray(pairs.z1)) ** 2))


def kept(map_, folder):
    """The map, saved and loaded."""
    map_.save(folder)
    return gfnn.load(folder)


def test_a_family(pairs, fresh, tmp_path):
    def sizes(inputs):
        return (own_module.RadialBumps(inputs, n, width=0.5) for n in (20, 40, 80))

    fit = gfnn.fit(pairs, SCENE, family=sizes, chart="midpoint", tolerance=1e-2)
    assert fit.met
    assert (fit.chosen.family, fit.chosen.label) == ("own", "bumps 80")
    assert error_of(fit.map, fresh) < 1e-2 * np.std(np.asarray(fresh.z0), axis=0).max()
    assert fit.symplecticity_defect < 1e-10
    again = kept(fit.map, tmp_path / "m")
    np.testing.assert_array_equal(*(np.asarray(m.step(fresh.z0)[0]) for m in (again, fit.map)))
    states, info = again.sample(jax.random.key(2), 3).rollout(fresh.z0[:5], 1)
    assert not np.any(info.status)
    assert np.ptp(states[:, :, 1], axis=0).max() < 1e-2


def test_a_model_and_its_piece(pairs, fresh, tmp_path):
    fit = gfnn.fit(pairs, SCENE, model=own_module.Kicks(), tolerance=2e-2)
    assert fit.met
    assert (fit.chosen.family, fit.chosen.label) == ("kicks", "kicks 3")
    assert error_of(fit.map, fresh) < 2e-2
    assert fit.symplecticity_defect < 1e-14
    again = kept(fit.map, tmp_path / "m")
    states, info = again.rollout(fresh.z0[:5], 20)
    assert not np.any(info.status)
    back, _ = again.inverse(states[:, -1])
    np.testing.assert_allclose(back, states[:, -2], rtol=0, atol=1e-14)


def test_few_pairs_are_cross_validated(pairs):
    fit = gfnn.fit(pairs.take(slice(40)), SCENE, model=own_module.Kicks(), tolerance=2e-2)
    assert "cross-validation" in fit.stated_by


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"model": object()}, "a model with a name, sizes"),
        ({"model": own_module.Kicks(), "learn": "map"}, "a model of one's own is all"),
        ({"family": lambda inputs: [inputs]}, "Inputs has no name"),
        ({"family": 3}, "expected one of auto, .* as family"),
    ],
)
def test_what_is_none(options, message, pairs):
    with pytest.raises(gfnn.FitError, match=message):
        gfnn.fit(pairs, SCENE, **options)


def test_a_name_is_taken_once():
    class Flow:
        pass

    with pytest.raises(gfnn.InputError, match="expected a dataclass to register"):
        gfnn.register(Flow)
    import dataclasses

    with pytest.raises(gfnn.InputError, match="another type is registered as Flow"):
        gfnn.register(dataclasses.dataclass(Flow))
