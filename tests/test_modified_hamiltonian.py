"""The Hamiltonian whose flow a map is: against logarithms of matrices and the series in h."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from analytic import exact_oscillator, generated, map_of, oscillator, pendulum, standard

from gfnn_jax.coordinates import Coordinates
from gfnn_jax.families import from_function
from gfnn_jax.families.terms import Terms
from gfnn_jax.flows.flow import Flow
from gfnn_jax.generating.charts import MIDPOINT, TYPE1, TYPE2, TYPE3
from gfnn_jax.maps.piece import Affine
from gfnn_jax.phase_space import apply_j, symplectic_form

DATA = np.random.default_rng(0).uniform(-1, 1, (400, 2))
Z = DATA[:20]
HENON_HEILES = Terms(
    2,
    ("q1", "q2", "p1", "p2"),
    ((2, 0, 0, 0), (0, 2, 0, 0), (0, 0, 2, 0), (0, 0, 0, 2), (2, 1, 0, 0), (0, 3, 0, 0)),
)
C = np.array([0.5, 0.5, 0.5, 0.5, 1.0, -1 / 3])
WELL = np.random.default_rng(0).uniform(-0.25, 0.25, (50, 4))


@from_function
def bilinear(angle, w):
    """Type 1, h = 1: turns (q, p) by the angle."""
    return (0.5 * jnp.sum(w**2) * jnp.cos(angle) - w[0] * w[1]) / jnp.sin(angle)


def quadratic(q, p):
    """½ q q1² + ½ p p1² + 0.1 q1 p1, and its coefficients."""
    family = Terms(1, ("q1", "p1"), ((2, 0), (0, 2), (1, 1)))
    return family, np.array([0.5 * q, 0.5 * p, 0.1])


def linear(chart, dt=0.4):
    family, c = quadratic(1.0, 0.7)
    return generated(family, c, chart, dt)


HALF = Affine(scipy.linalg.expm(0.2 * symplectic_form(1)), np.array([0.2, 0.1]), np.array([0.3, 0]))
LINEAR = {
    "midpoint": map_of(linear(MIDPOINT), DATA),
    "type 2": map_of(linear(TYPE2), DATA),
    "type 3, backwards": map_of(linear(TYPE3), DATA).reversed(),
    "type 1": map_of(generated(bilinear, 0.4, TYPE1, 1.0), DATA),
    "type 1, backwards": map_of(generated(bilinear, 0.4, TYPE1, 1.0), DATA).reversed(),
    "base map": map_of(linear(MIDPOINT, 0.3), DATA, around=(HALF,)),
    "a flow before": dataclasses.replace(
        map_of(linear(MIDPOINT), DATA),
        pieces=(
            Flow(*quadratic(0.2, 0.3), 0.4, np.ones(2), stages=2, substeps=2),
            linear(MIDPOINT),
        ),
    ),
}

# Each like two others: what is before a piece, and a map backwards.
ALIKE = ("a flow before", "type 1, backwards", "type 1", "type 2", "type 3, backwards")
HEAVY = (*ALIKE, "base map")


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n in HEAVY else ()) for n in LINEAR]
)
def test_of_a_linear_map_it_is_the_logarithm(name):
    map_ = LINEAR[name]
    at_zero, *units = np.asarray(map_.step(np.concatenate([np.zeros((1, 2)), np.eye(2)]))[0])
    matrix = np.stack(units, axis=1) - at_zero[:, None]
    fixed = np.linalg.solve(np.eye(2) - matrix, at_zero)
    hessian = -symplectic_form(1) @ scipy.linalg.logm(matrix) / map_.dt
    expected = 0.5 * np.einsum("ni,ij,nj->n", Z - fixed, hessian, Z - fixed)
    value, error = map_.modified_hamiltonian(Z)
    off = value - expected
    np.testing.assert_allclose(off - off.mean(), 0, atol=2e-13)
    assert np.asarray(error).max() < 2e-12
    if name in ("midpoint", "type 2"):  # S vanishes at the fixed point, and so does H̃
        np.testing.assert_allclose(off, 0, atol=2e-13)


@pytest.mark.slow
def test_the_series_of_the_midpoint_rule():
    """Hairer, Lubich & Wanner, Geometric Numerical Integration, IX: H̃ = S − h²/24 S''(J∇S, J∇S) +
    O(h⁴)."""
    z = WELL[:44]  # as many states as the rollout below saves: one program
    gradient, hessian = HENON_HEILES.gradient_and_hessian(C, z)
    field = apply_j(gradient)
    second = np.einsum("ni,nij,nj->n", field, hessian, field) / 24
    s = HENON_HEILES.value(C, z)
    left = []
    for h in (0.2, 0.1):
        map_ = map_of(generated(HENON_HEILES, C, MIDPOINT, h, 2), WELL)
        left.append(np.abs(map_.hamiltonian(z) - (s - h**2 * second)).max())
        assert left[-1] < 0.03 * np.abs(h**2 * second).max()
    assert 14 < left[0] / left[1] < 18
    # It is what 100 steps keep, where S varies by 2e-4; and the error says how well.
    map_ = map_of(generated(HENON_HEILES, C, MIDPOINT, 0.4, 2), WELL)
    states = np.asarray(map_.rollout(z[:4], 100, save_every=10)[0])
    value, error = (
        np.asarray(a).reshape(4, -1) for a in map_.modified_hamiltonian(states.reshape(-1, 4))
    )
    assert np.ptp(HENON_HEILES.value(C, states), axis=1).min() > 1e-5
    drift = np.abs(value - value.mean(axis=1, keepdims=True))
    assert drift.max() < 1e-11
    assert (drift.max(axis=1) < 4 * error.mean(axis=1)).all()
    assert error.max() < 1e-9


@pytest.mark.slow
def test_turns_of_an_angle_change_nothing():
    coordinates = Coordinates("pendulum", angles=(0,))
    map_ = map_of(generated(pendulum, 1.0, MIDPOINT, 0.2), DATA, coordinates=coordinates)
    z = np.array([[3.0, 2.0], [3.0 + 8 * np.pi, 2.0], [0.3, 0.1]])  # two rotate, past π at once
    states, _ = map_.rollout(z, 40)
    value, error = map_.modified_hamiltonian(np.asarray(states).reshape(-1, 2))
    value = np.asarray(value).reshape(3, -1)
    np.testing.assert_allclose(value[1], value[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(value, np.tile(value[:, :1], 41), rtol=0, atol=1e-10)
    assert np.asarray(error).max() < 1e-9


@pytest.mark.slow
def test_a_kicked_map_is_near_no_flow():
    map_ = map_of(generated(standard, 2.0, TYPE2, 1.0), DATA)
    value, error = map_.modified_hamiltonian(np.array([[0.3, 0.2], [np.nan, 0.0]]))
    assert error[0] > 0.03
    assert np.isnan(value[1])
    assert map_.modified_hamiltonian(Z[0]).error.shape == ()


@pytest.mark.slow
def test_the_error_is_that_of_a_known_flow():
    dt = 2.0
    map_ = map_of(generated(oscillator, exact_oscillator(dt), MIDPOINT, dt), DATA)
    value, error = map_.modified_hamiltonian(Z)
    off = np.abs(value - 0.5 * np.sum(Z**2, axis=1))
    assert 1e-4 < off.max() < 1e-2  # two thirds of the frequency that a step can see
    assert (off < 3 * error).all()
    assert (error < 30 * off).all()
