"""Symmetries that pairs show by themselves, against those that their law is known to have."""

import numpy as np

import gfnn_jax as gfnn
from gfnn_jax.coordinates import Coordinates
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.diagnosis.symmetries import symmetries_of_pairs
from gfnn_jax.families.terms import given_terms
from gfnn_jax.models.hamiltonians.symmetries import imposed


def data_of(gradient, z0, angles=(), steps=20, dt=0.1):
    """Pairs by many steps of leapfrog of a separable H."""
    dim, z, h = z0.shape[1] // 2, z0.copy(), dt / steps
    for _ in range(steps):
        z[:, dim:] -= 0.5 * h * gradient(z)[:, :dim]
        z[:, :dim] += h * gradient(z)[:, dim:]
        z[:, dim:] -= 0.5 * h * gradient(z)[:, :dim]
    pairs = gfnn.Pairs(z0, z, dt, run=np.arange(len(z)), place=np.zeros(len(z), int))
    return Dataset.of(pairs, Coordinates("cartesian", angles=angles)).divided(0)


def told(data):
    return {symmetry.text: symmetry.left for symmetry in symmetries_of_pairs(data)}


def quartic(weights):
    """∇ of ½p² + Σ w_i q_i² + |q|⁴."""

    def gradient(z):
        q = z[:, :2]
        force = 2 * q * weights + 4 * q * np.sum(q**2, axis=1, keepdims=True)
        return np.concatenate([force, z[:, 2:]], axis=1)

    return gradient


ROTATION = "rotation in (q1, q2): angular momentum q1 p2 − q2 p1 conserved"
EXCHANGE = "exchange of degrees of freedom 1 and 2"


def test_a_round_well_is_turned_exchanged_and_reversed():
    z0 = np.random.default_rng(0).uniform(-1, 1, (400, 4))
    found = told(data_of(quartic(np.array([0.5, 0.5])), z0))
    assert set(found) == {ROTATION, EXCHANGE, "reversal of time", "reflection of all coordinates"}
    assert found[ROTATION] < 1e-12


def test_a_well_that_is_not_round_is_reversed_only():
    z0 = np.random.default_rng(0).uniform(-1, 1, (400, 4))
    found = told(data_of(quartic(np.array([0.5, 0.9])), z0))
    assert set(found) == {"reversal of time", "reflection of all coordinates"}


def test_a_momentum_of_an_angle_that_forces_do_not_know_is_conserved():
    """H = ½p₁² + ½p₂² − cos q₁, q₂ an angle too."""
    z0 = np.random.default_rng(0).uniform(-1, 1, (400, 4)) * [3, 3, 1, 1]

    def gradient(z):
        none = np.zeros(len(z))
        return np.stack([np.sin(z[:, 0]), none, z[:, 2], z[:, 3]], axis=1)

    found = told(data_of(gradient, z0, angles=(0, 1)))
    assert found["translation of q2: p2 conserved"] == 0
    assert "translation of q1: p1 conserved" not in found
    assert EXCHANGE not in found
    assert "reversal of time" in found


def test_a_magnetic_field_is_not_reversed():
    """H = ½(p₁ + ½q₂)² + ½(p₂ − ½q₁)² + q₁²: exact pairs, for it is linear."""
    from scipy.linalg import expm

    field = np.array([[0, 0.5, 1, 0], [-0.5, 0, 0, 1], [-2.25, 0, 0, 0.5], [0, -0.25, -0.5, 0]])
    z0 = np.random.default_rng(0).uniform(-1, 1, (400, 4))
    pairs = gfnn.Pairs(
        z0, z0 @ expm(0.1 * field).T, 0.1, run=np.arange(400), place=np.zeros(400, int)
    )
    found = told(Dataset.of(pairs, Coordinates("cartesian")).divided(0))
    assert set(found) == {"reflection of all coordinates"}


def test_a_law_has_its_symmetries_to_roundoff_where_its_errors_allow():
    """p1² and p2² of a round law get one coefficient, unless they are known to differ."""
    family = given_terms(2, ["p1**2", "p2**2", "q1**2", "q2**2", "1/sqrt(q1**2 + q2**2)"])
    z = np.random.default_rng(0).uniform(0.5, 1.0, (50, 4))
    exact = np.array([0.5, 0.5, 0.3, 0.3, -1.0])
    off = np.array([3e-12, -1e-12, 0.0, 2e-12, 1e-12])
    found = imposed(family, exact + off, np.full(5, 1e-12), z, ())
    assert np.abs(np.array([found[0] - found[1], found[2] - found[3]])).max() < 5e-15
    assert np.abs(found - exact).max() < 4e-12
    np.testing.assert_array_equal(
        imposed(family, exact + off, np.full(5, 1e-14), z, ()), exact + off
    )
