"""Turn of the states in a step: its size, its sense, its use and its messages."""

import numpy as np
import pytest
from analytic import henon_heiles_pairs
from scipy.linalg import expm

import gfnn_jax as gfnn
from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.families.terms import given_terms
from gfnn_jax.fitting.linear_starts import backwards, forward_logarithm, tangent, turns
from gfnn_jax.flows.collocation import Steps, images
from gfnn_jax.models.hamiltonians.search import long_step
from gfnn_jax.phase_space import symplectic_form


def stable(dim, seed=0):
    """JA of a positive definite A, and sizes of the coordinates."""
    root = np.random.default_rng(seed).normal(size=(2 * dim, 2 * dim)) + np.eye(2 * dim)
    generator = symplectic_form(dim) @ (root @ root.T)
    return generator / np.abs(np.linalg.eigvals(generator)).max(), np.ones(2 * dim)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_turns_of_a_flow_are_its_frequencies(dim):
    generator, scale = stable(dim)
    rates = np.sort(np.abs(np.linalg.eigvals(generator).imag))
    angles, _, _ = turns(expm(2.0 * generator), scale)
    np.testing.assert_allclose(np.sort(angles), 2.0 * rates, rtol=0, atol=1e-9)
    forth, back = (backwards(turns(expm(t * generator), scale)[0]) for t in (3.0, 4.0))
    assert forth == 0
    assert back == pytest.approx(2 * np.pi - 4.0, abs=1e-9)  # of the fastest, whose rate is 1


def test_turns_do_not_depend_on_units():
    generator, _ = stable(2)
    unit = np.array([1e-3, 1e2, 1e3, 1e-2])  # canonical: of q, and of p its inverse
    jacobian = unit[:, None] * expm(2.0 * generator) / unit
    angles = turns(jacobian, unit)[0]
    expected = turns(expm(2.0 * generator), np.ones(4))[0]
    np.testing.assert_allclose(np.sort(angles), np.sort(expected), rtol=0, atol=1e-6)


def test_the_logarithm_turns_forwards_beyond_half_a_turn():
    generator, scale = stable(2)
    found = forward_logarithm(expm(5.0 * generator), scale)
    np.testing.assert_allclose(found, 5.0 * generator, rtol=0, atol=1e-9)
    # A plane that is turned over and stretched has no real logarithm.
    assert forward_logarithm(np.diag([-2.0, -0.5]), np.ones(2)) is None


def test_the_tangent_is_that_of_a_cubic_map():
    z0 = np.random.default_rng(0).normal(size=(200, 2))
    centre = z0.mean(axis=0)
    x = z0 - centre
    z1 = np.column_stack([z0[:, 0] + 0.3 * x[:, 1] + x[:, 0] ** 3, z0[:, 1] - x[:, 0] * x[:, 1]])
    at, image, jacobian = tangent(z0, z1, z0.std(axis=0))
    np.testing.assert_allclose(at, centre)
    np.testing.assert_allclose(image, centre, rtol=0, atol=1e-12)
    np.testing.assert_allclose(jacobian, [[1, 0.3], [0, 1]], rtol=0, atol=1e-12)


@pytest.mark.parametrize(("dt", "said"), [(0.5, False), (1.0, False), (2.0, False), (4.0, True)])
def test_a_step_that_is_too_long_is_named(dt, said):
    """Hénon–Heiles oscillates at about 1 rad per unit of time."""
    data = Dataset.of(henon_heiles_pairs(400, dt=dt), CARTESIAN)
    messages = long_step(data, None)
    assert bool(messages) is said
    if said:
        assert "ωh > π)" in messages[0]
    assert not long_step(data, gfnn.scenes.make("standard-map-regular"))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::gfnn_jax.errors.FitWarning")
@pytest.mark.parametrize("dt", [4.0, 5.5])
def test_a_law_of_few_terms_is_found_beyond_half_a_turn_and_that_is_said(dt):
    """Its quadratic part has aliases; with the cubic term only one of them is a polynomial."""
    family = given_terms(1, ["0.5*q**2 + 0.5*p**2 + 0.1*q**3"])
    z0 = np.random.default_rng(0).uniform(-0.8, 0.8, (100, 2))
    z1 = images(family, np.ones(1), z0, dt, Steps(10, 40)).states
    fit = gfnn.fit(gfnn.Pairs(z0, z1, dt), tolerance=1e-11, learn="hamiltonian")
    assert fit.met
    assert fit.formula == "0.5*q1**2 + 0.5*p1**2 + 0.1*q1**3"
    assert "beyond π" in " ".join(fit.messages)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::gfnn_jax.errors.FitWarning")
def test_a_map_without_such_a_law_is_told_of_its_turns():
    """A turn of 4 with a kick that no H of few terms has."""
    rng = np.random.default_rng(0)
    z0 = rng.uniform(-1, 1, (200, 2))
    kicked = z0 + np.column_stack([0 * z0[:, 0], 0.05 * np.sign(z0[:, 0])])
    c, s = np.cos(4.0), np.sin(4.0)
    pairs = gfnn.Pairs(z0, kicked @ np.array([[c, -s], [s, c]]), 1.0)
    with pytest.warns(gfnn.FitWarning, match=r"radians backwards, or by 3\.9"):
        gfnn.fit(pairs, tolerance=1e-9, max_seconds=None, max_operations=10**8, learn="hamiltonian")
