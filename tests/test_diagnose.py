"""Diagnosis of data by neighbouring pairs: many, noisy, or on a single orbit."""

import numpy as np
import pytest
from analytic import rotated

from gfnn_jax.diagnosis.local_jacobians import (
    chart_determinant,
    data_defect,
    local_jacobians,
    look_symplectic,
)
from gfnn_jax.diagnosis.outliers import outliers
from gfnn_jax.diagnosis.residuals import differs_between_sequences, hidden_friction, is_smooth
from gfnn_jax.generating.charts import CHARTS


def test_more_noisy_pairs_are_judged_no_worse():
    rng = np.random.default_rng(0)
    z = rng.uniform(-1, 1, (60_000, 2))
    noise = 1e-2 * rng.standard_normal((2, *z.shape))
    y0, y1, scale = z + noise[0], rotated(z, 0.5) + noise[1], z.std(axis=0)
    jacobians, _ = local_jacobians(y0, y1, scale)
    assert data_defect(jacobians, scale) < 0.1
    found = chart_determinant(CHARTS["midpoint"], jacobians, scale)
    assert abs(found.low - np.cos(0.25) ** 2) < 0.15


def test_a_single_orbit_looks_symplectic():
    """Nothing is known across the orbit, and nothing is held against it."""
    phase = 0.3 + 0.1 * np.arange(1_000)
    z = np.stack([np.cos(phase), -np.sin(phase)], axis=1)
    scale = z.std(axis=0)
    jacobians, _ = local_jacobians(z[:-1], z[1:], scale)
    assert data_defect(jacobians, scale) < 0.1
    assert chart_determinant(CHARTS["midpoint"], jacobians, scale).low > 0.9


def test_noise_as_large_as_a_tenth_of_the_data_folds_no_chart():
    rng = np.random.default_rng(1)
    z = rng.uniform(-1, 1, (1_000, 2))
    noise = 5e-2 * rng.standard_normal((2, *z.shape))
    scale = z.std(axis=0)
    jacobians, _ = local_jacobians(z + noise[0], rotated(z, 0.5) + noise[1], scale)
    assert (
        abs(chart_determinant(CHARTS["midpoint"], jacobians, scale).low - np.cos(0.25) ** 2) < 0.2
    )


def bent(z):
    """A symplectic map that is steep in places."""
    q, p = z.T
    p = p + 0.5 * np.sin(3 * q)
    return np.stack([q + 0.5 * p, p], axis=1)


@pytest.mark.parametrize("sigma", [0.0, 1e-6, 3e-3])
def test_outliers_are_found_and_right_pairs_are_not(sigma):
    rng = np.random.default_rng(2)
    z = np.concatenate([rng.uniform(-1, 1, (1_500, 2)), 0.3 * rng.standard_normal((500, 2))])
    z1 = bent(z)
    scale = z.std(axis=0)
    noise = sigma * rng.standard_normal((2, *z.shape))
    assert len(outliers(z + noise[0], z1 + noise[1], scale)) == 0
    wrong = np.sort(rng.permutation(len(z))[:20])
    # Off by something like the data's size, never by nothing.
    angle = rng.uniform(0, 2 * np.pi, 20)
    z1[wrong] += np.stack([np.cos(angle), np.sin(angle)], axis=1)
    np.testing.assert_array_equal(outliers(z + noise[0], z1 + noise[1], scale), wrong)


def test_few_or_coinciding_pairs_are_no_outliers():
    z = np.random.default_rng(3).uniform(-1, 1, (5, 2))
    assert len(outliers(z, rotated(z, 0.5), z.std(axis=0))) == 0
    q, p = np.random.default_rng(1642).uniform(-1, 1, (2, 20))  # the worst of 4,000 such draws
    ahead = q + 0.5 * p
    pairs = np.c_[q, p], np.c_[ahead, p - np.sin(ahead)]
    assert len(outliers(*pairs, pairs[0].std(axis=0))) == 0
    many = np.tile(z, (20, 1))
    assert len(outliers(many, rotated(many, 0.5), many.std(axis=0))) == 0


def test_friction_is_told_from_noise_and_from_a_hamiltonian_residual():
    rng = np.random.default_rng(4)
    z = rng.uniform(-1, 1, (1_000, 4)) * [1, 2, 3, 4]
    noise = 1e-3 * rng.standard_normal(z.shape)
    friction = -1e-2 * z * [0, 0, 1, 1]
    change, error = hidden_friction(z, friction + noise)
    assert abs(change + 2e-2) < 5 * error
    assert error < 1e-4
    assert is_smooth(z, friction + noise)
    assert hidden_friction(z, noise) is None
    assert not is_smooth(z, noise)
    squeeze = 1e-2 * z * [1, 1, -1, -1]  # linear and Hamiltonian: no volume is lost
    assert hidden_friction(z, squeeze + noise) is None


def test_a_misfit_that_is_concentrated_is_no_friction():
    """Near the edge of the states alone it has a divergence that no rate of friction has."""
    z = np.random.default_rng(5).standard_normal((1_000, 2))
    misfit = -1e-2 * z**3 * [0, 1]
    assert hidden_friction(z, misfit) is None
    assert is_smooth(z, misfit)
    friction = -1e-2 * z * [0, 1]
    assert abs(hidden_friction(z, friction)[0] + 1e-2) < 1e-10


def test_many_degrees_of_freedom_are_diagnosed_in_seconds():
    """22 oscillators that turn by 0.5 each: linear, so that the local fits are exact."""
    dim = 22
    exact = np.kron([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]], np.eye(dim))
    z = np.random.default_rng(5).uniform(-1, 1, (300, 2 * dim))
    z1, scale = z @ exact.T, z.std(axis=0)
    jacobians, error = local_jacobians(z, z1, scale)
    assert error < 1e-9
    np.testing.assert_allclose(jacobians[:5], np.broadcast_to(exact, (5, 44, 44)), atol=1e-9)
    assert look_symplectic(jacobians, error, scale)
    assert len(outliers(z, z1, scale)) == 0
    z1[7, 3] += 1.0
    np.testing.assert_array_equal(outliers(z, z1, scale), [7])


def arcs(rng, dim, dt):
    """States (1000, 2d) of 20 arcs of oscillators of several frequencies, 50 states each."""
    phase = rng.uniform(0, 2 * np.pi, (20, 1, dim)) + dt * np.arange(50)[:, None] * (
        1 + 0.3 * np.arange(dim)
    )
    size = rng.uniform(0.3, 1, (20, 1, dim))
    z = np.concatenate([size * np.cos(phase), -size * np.sin(phase)], axis=2)
    return z.reshape(-1, 2 * dim)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_a_misfit_does_not_differ_between_sequences(dim):
    """It is as smooth along a sequence as across; a hidden parameter is not."""
    rng, sequence = np.random.default_rng(4), np.repeat(np.arange(20), 50)
    wave = rng.normal(size=(2 * dim, 2 * dim))
    for dt in (0.02, 0.05, 0.2):
        z = arcs(rng, dim, dt)
        for steep in (1.0, 3.0, 6.0):
            assert not differs_between_sequences(z, np.sin(steep * z @ wave), sequence)
    hidden = rng.normal(size=20)[sequence, None]
    assert differs_between_sequences(z, hidden * z[:, ::-1], sequence)


def test_a_misfit_that_grows_in_close_passages_does_not_differ_between_sequences():
    """Of Kepler's orbits a few states close to the centre leave over far more than all others."""
    rng, turn = np.random.default_rng(4), np.linspace(0, 4, 50)
    size, eccentricity = rng.uniform(0.3, 0.6, (20, 1)), rng.uniform(0.6, 0.85, (20, 1))
    radius = size / (1 + eccentricity * np.cos(turn - rng.uniform(1, 3, (20, 1))))
    angle = rng.uniform(0, 2 * np.pi, (20, 1)) + turn
    q = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    z = np.concatenate([q, np.gradient(q, axis=1)], axis=2).reshape(-1, 4)
    misfit, sequence = z / radius.reshape(-1, 1) ** 8, np.repeat(np.arange(20), 50)
    assert not differs_between_sequences(z, misfit, sequence)
    assert differs_between_sequences(z, rng.normal(size=20)[sequence, None] * misfit, sequence)
