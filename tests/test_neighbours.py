"""Noise or structure by neighbouring pairs, and friction that a tolerance hides."""

import warnings

import numpy as np
import pytest
from analytic import moved

import gfnn_jax as gfnn
from gfnn_jax.diagnosis.residuals import hidden_friction, is_noise

RNG = np.random.default_rng(0)


def single(count):
    """(run, place) of pairs that stand alone."""
    return np.arange(count), np.zeros(count, int)


def test_what_neighbours_share_is_no_noise():
    z = RNG.normal(size=(1_000, 2))
    noise, kink = RNG.normal(size=z.shape), np.sign(z[:, :1]) * [0.0, 1.0]
    assert is_noise(z, noise, *single(1_000)) is True
    assert is_noise(z, kink, *single(1_000)) is False
    assert is_noise(z, kink + 0.2 * noise, *single(1_000)) is False
    assert is_noise(z, 0.2 * kink + noise, *single(1_000)) is True


def test_pairs_that_lie_far_apart_tell_nothing():
    z = RNG.normal(size=(500, 24))
    assert is_noise(z, RNG.normal(size=z.shape), *single(500)) is None
    assert is_noise(z[:9, :2], z[:9, :2], *single(9)) is None


def test_the_noise_of_a_state_that_two_pairs_share_is_noise():
    """Along a record the next state is the nearest; both pairs have its noise."""
    t = 0.05 * np.arange(1_201)
    noise = RNG.normal(size=(1_200, 2))
    z = np.stack([np.cos(t), np.sin(t)], axis=1)[:-1] * (1 + 1e-3 * t[:-1, None])
    shared = noise + np.roll(noise, 1, axis=0)
    assert is_noise(z, shared, np.zeros(1_200, int), np.arange(1_200)) is True


def kicked(z, strength, loss):
    q, p = z.T
    p = loss * (p - 0.2 * np.sin(q) * strength)
    return np.stack([q + 0.2 * p, p], axis=1)


def test_friction_is_told_apart_from_what_a_map_misses():
    """A loss of 0.31 % beside forces that the map has 5 % too weak."""
    z = RNG.uniform(-1, 1, (400, 2))
    image = kicked(z, 0.95, 1.0)
    found = hidden_friction(image, kicked(z, 1.0, 0.9969) - image)
    assert found is not None
    change, error = found
    assert change == pytest.approx(-0.0031, rel=0.01)
    assert error < 1e-5
    assert hidden_friction(image, kicked(z, 1.0, 1.0) - image) is None
    noise = 0.01 * RNG.normal(size=z.shape)
    assert hidden_friction(image, kicked(z, 1.0, 0.9969) + noise - image) is None
    assert hidden_friction(image[:6], noise[:6]) is None


@pytest.mark.parametrize("friction", [0.0155, 0.0])
def test_a_loose_tolerance_hides_no_friction(friction):
    """A pendulum by another solver; a map of degree 2 keeps areas and meets the tolerance."""
    z = RNG.uniform(-1, 1, (300, 2))
    image = moved(lambda _, z: [z[1], -np.sin(z[0]) - friction * z[1]], z, 0.2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        fit = gfnn.fit(gfnn.Pairs(z, image, 0.2), tolerance=2e-2, learn="map")
    assert fit.met
    told = [m for m in fit.messages if "as by friction" in m]
    assert bool(told or fit.damping is not None) == (friction > 0)
    assert all("change by -0.0031 " in m for m in told)
