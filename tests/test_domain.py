"""The domain: known ground is where the data were, for shells and annuli too."""

import jax
import numpy as np
import pytest

from gfnn_jax.maps.domain import covering


def annulus(num=2000, seed=0):
    rng = np.random.default_rng(seed)
    angle, radius = rng.uniform(0, 2 * np.pi, num), rng.uniform(0.9, 1.1, num)
    return radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def shell(num=2000, seed=0):
    """One energy of the four-dimensional oscillator, exactly: data on a surface."""
    y = np.random.default_rng(seed).standard_normal((num, 4))
    return y / np.linalg.norm(y, axis=1, keepdims=True)


def test_centre_of_an_annulus_is_outside():
    domain = covering(annulus())
    assert domain.contains(annulus()).all()
    assert domain.contains(annulus(seed=1)).all()
    assert not domain.contains(np.zeros((1, 2))).any()
    assert not domain.contains(1.5 * annulus(seed=1)).any()
    assert not domain.contains(0.5 * annulus(seed=1)).any()


def test_numpy_and_jax_agree_for_any_leading_axes():
    domain = covering(annulus())
    probe = np.random.default_rng(2).uniform(-1.5, 1.5, (5, 7, 2))
    found = domain.contains(probe)
    assert found.shape == (5, 7)
    assert 0 < found.sum() < found.size
    np.testing.assert_array_equal(jax.jit(lambda d, y: d.contains(y))(domain, probe), found)
    assert domain.contains(probe[0, 0]) == found[0, 0]


def test_data_on_a_surface_give_it_a_thickness():
    domain = covering(shell())
    assert domain.contains(shell(seed=1)).all()
    assert domain.contains((1 + 1e-6) * shell(seed=1)).all()
    assert not domain.contains(np.zeros((1, 4))).any()
    assert not domain.contains(1.5 * shell(seed=1)).any()


def test_a_cluster_ends_about_where_the_data_do():
    y = np.random.default_rng(0).uniform(-1, 1, (2000, 4))
    domain = covering(y)
    assert domain.contains(y).all()
    assert domain.contains(np.zeros((1, 4))).all()
    corner = np.ones((1, 4))
    assert domain.contains(0.9 * corner).all()
    assert not domain.contains(1.6 * corner).any()
    assert not domain.contains(2.0 * np.eye(4)).any()


def test_units_do_not_matter():
    rng = np.random.default_rng(2)
    data, probe = annulus(), rng.uniform(-1.5, 1.5, (500, 2))
    units, shift = np.array([1e7, 1e-5]), np.array([3e7, -2e-5])
    expected = covering(data).contains(probe)
    found = covering(data * units + shift).contains(probe * units + shift)
    assert 0 < expected.sum() < 500
    np.testing.assert_array_equal(found, expected)


@pytest.mark.filterwarnings("ignore:overflow")
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
def test_non_finite_and_huge_states_are_outside(bad):
    states = np.array([[bad, 0.0], [1.0, bad], [bad, bad]])
    with np.errstate(invalid="ignore"):
        assert not covering(annulus()).contains(states).any()


def test_ignored_coordinates_do_not_matter_unless_they_are_not_finite():
    y = np.concatenate([annulus(), np.zeros((2000, 2))], axis=1)[:, [0, 2, 1, 3]]
    domain = covering(y, ignore=(1, 3))
    elsewhere = y[:50] + np.array([0.0, 100.0, 0.0, -7.0])
    assert domain.contains(elsewhere).all()
    all_ignored = covering(y, ignore=(0, 1, 2, 3))
    assert all_ignored.contains(1e6 * y[:5]).all()
    for empty_or_not in (domain, all_ignored):
        assert not empty_or_not.contains(elsewhere * np.array([1.0, np.nan, 1.0, 1.0])).any()


def test_constant_coordinate():
    """Check a coordinate without spread: its value is inside, another one is not."""
    y = np.concatenate([annulus(), np.full((2000, 2), 5.0)], axis=1)
    domain = covering(y)
    assert domain.contains(y[:50]).all()
    assert not domain.contains(y[:50] + np.array([0.0, 0.0, 1.0, 0.0])).any()


def test_few_data():
    y = np.random.default_rng(3).standard_normal((3, 4))
    assert covering(y).contains(y).all()
    assert covering(y[:1]).contains(y[:1]).all()
