"""The flow of a Hamiltonian as a piece: order, inverse, derivatives, defect, lanes apart, drift."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.families.terms import Terms, given_terms
from gfnn_jax.flows.collocation import Steps, images
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.gauss import gauss
from gfnn_jax.maps.domain import covering
from gfnn_jax.maps.piece import Piece
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import symplectic_form
from gfnn_jax.solve.status import LEFT_DOMAIN, NON_FINITE, NOT_CONVERGED, OK

FAMILY = Terms(
    2,
    ("q1", "q2", "p1", "p2"),
    ((2, 0, 0, 0), (0, 2, 0, 0), (0, 0, 2, 0), (0, 0, 0, 2), (2, 1, 0, 0), (0, 3, 0, 0)),
)
C = np.array([0.5, 0.5, 0.5, 0.5, 1.0, -1 / 3])
Z = np.random.default_rng(0).uniform(-0.2, 0.2, (24, 4))


def flow(dt=0.5, stages=6, substeps=1, newton=False):
    return Flow(FAMILY, C, dt, np.ones(4), stages, substeps, newton)


def map_of(piece, dt=0.5):
    return SymplecticMap((piece,), CARTESIAN, covering(Z), np.ones(4), np.zeros(0), dt)


@pytest.mark.parametrize("stages", [1, 2, 5, 12])
def test_coefficients(stages):
    matrix, weights, nodes, coupling = gauss(stages)
    for k in range(1, 2 * stages + 1):  # the rule's order
        np.testing.assert_allclose(weights @ nodes ** (k - 1), 1 / k, rtol=1e-15)
    for k in range(1, stages + 1):  # collocation
        np.testing.assert_allclose(matrix @ nodes ** (k - 1), nodes**k / k, rtol=0, atol=2e-16)
    symplectic = weights[:, None] * matrix
    np.testing.assert_allclose(
        symplectic + symplectic.T, np.outer(weights, weights), rtol=0, atol=2e-17
    )

    np.testing.assert_allclose(coupling * weights, matrix, rtol=0, atol=2e-16)
    # To the last bit: what rounding makes of these is a drift of the energy.
    np.testing.assert_array_equal(coupling + coupling.T, np.ones((stages, stages)))
    np.testing.assert_array_equal(coupling, coupling[::-1, ::-1].T)


OPTIONS = [
    {},
    {"stages": 4, "substeps": 3},
    pytest.param({"newton": True, "stages": 5}, marks=pytest.mark.slow),
]


@pytest.mark.parametrize("options", OPTIONS)
def test_steps_are_those_of_numpy_and_of_the_exact_flow(options):
    piece = flow(**options)
    assert isinstance(piece, Piece)
    images_, info = jax.jit(lambda piece, z: piece.step(z))(piece, jnp.asarray(Z))
    assert (info.status == OK).all()
    steps = Steps(piece.stages, piece.substeps)
    np.testing.assert_allclose(images_, images(FAMILY, C, Z, 0.5, steps).states, atol=2e-16)
    np.testing.assert_allclose(images_, images(FAMILY, C, Z, 0.5, Steps(12, 4)).states, atol=1e-13)


def test_the_flow_of_a_quadratic_hamiltonian_is_a_matrix():
    quadratic = given_terms(2, ["p1**2 + q1**2 + p1*q2", "p2**2 + 2*q2**2"])
    hessian = quadratic.gradient_and_hessian(np.ones(2), np.zeros((1, 4)))[1][0]
    matrix = scipy.linalg.expm(0.3 * symplectic_form(2) @ hessian)
    images_, _ = jax.jit(Flow.step)(Flow(quadratic, np.ones(2), 0.3, np.ones(4), 6), Z)
    np.testing.assert_allclose(images_, Z @ matrix.T, atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("newton", [False, True])
def test_inverse_and_defect(newton):
    learned = map_of(flow(newton=newton, substeps=2))
    images_, _ = learned.step(Z)
    back, info = learned.inverse(images_)
    assert (info.status <= LEFT_DOMAIN).all()  # images of the outermost states
    np.testing.assert_allclose(back, Z, atol=5e-16)
    assert learned.defect(Z).max() < 1e-13


@pytest.mark.slow
@pytest.mark.parametrize("newton", [False, True])
def test_derivatives_in_everything_forward_and_reverse(newton):
    @jax.jit
    def image(params, dt, z):
        piece = Flow(FAMILY, params, dt, jnp.ones(4), 3, 1 if newton else 2, newton)
        return piece.step(z[None])[0][0]

    at = (jnp.asarray(C), jnp.asarray(0.5), jnp.asarray(Z[0]))
    everything = (0, 1, 2)
    forward = jax.jit(jax.jacfwd(image, argnums=everything))(*at)
    reverse = jax.jit(jax.jacrev(image, argnums=everything))(*at)
    step = 1e-6
    for n, (f, r) in enumerate(zip(forward, reverse, strict=True)):
        np.testing.assert_allclose(f, r, atol=1e-14)
        plus, minus = ([*at], [*at])
        unit = jnp.zeros_like(at[n]).ravel().at[0].set(step).reshape(at[n].shape)
        plus[n], minus[n] = at[n] + unit, at[n] - unit
        numeric = (image(*plus) - image(*minus)) / (2 * step)
        np.testing.assert_allclose(f.reshape(4, -1)[:, 0], numeric, atol=1e-9)


@pytest.mark.parametrize("newton", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_bad_lane_changes_no_other(newton):
    learned = map_of(flow(newton=newton))
    bad = Z.copy()
    bad[3], bad[7] = [3.0, -30.0, 100.0, 20.0], np.nan
    images_, info = learned.step(bad)
    good = np.delete(np.arange(len(Z)), [3, 7])
    np.testing.assert_array_equal(np.asarray(images_)[good], np.asarray(learned.step(Z)[0])[good])
    assert info.status[7] == NON_FINITE
    assert info.status[3] in (NOT_CONVERGED, NON_FINITE)


@pytest.mark.slow
def test_newton_solves_what_the_fixed_point_does_not():
    stiff = given_terms(1, ["p**2", "q**2"])
    z = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (4, 2)))
    made = {n: Flow(stiff, np.array([0.5, 50.0]), 1.0, np.ones(2), 3, 1, n) for n in (False, True)}
    step = jax.jit(lambda piece, z: piece.step(z))
    assert (step(made[False], z)[1].status == NOT_CONVERGED).all()
    assert (step(made[True], z)[1].status == OK).all()


def test_a_plain_function_is_a_hamiltonian():
    def pendulum(params, z):
        return z[1] ** 2 / 2 - params * jnp.cos(z[0])

    same = given_terms(1, ["p**2/2", "-cos(q)"])
    z, step = jnp.asarray(Z[:, :2]), jax.jit(lambda piece, z: piece.step(z)[0])
    one = step(Flow(pendulum, jnp.float64(1.0), 0.3, np.ones(2), 5), z)
    other = step(Flow(same, np.ones(2), 0.3, np.ones(2), 5), z)
    np.testing.assert_allclose(one, other, atol=1e-15)


@pytest.mark.slow
def test_energy_does_not_drift():
    learned = map_of(flow(stages=8))
    states, info = learned.rollout(Z[:4], 20_000, save_every=200)
    assert (info.status <= LEFT_DOMAIN).all()
    energy = FAMILY.value(C, np.asarray(states))
    assert np.abs(energy / energy[:, :1] - 1).max() < 5e-14


def test_coordinates_of_very_different_sizes_keep_all_digits():
    """A pendulum in units of 1e6 and 1e-3 has the images of the pendulum in plain units."""
    units, steps = np.array([1e6, 1e-3]), Steps(8, 2)
    z = np.random.default_rng(0).uniform(-1, 1, (50, 2))
    plain = images(given_terms(1, ["p1**2/2 - cos(q1)"]), np.ones(1), z, 0.2, steps).states
    family = given_terms(1, ["5e8*p1**2 - 1000*cos(1e-6*q1)"])
    found = images(family, np.ones(1), z * units, 0.2, steps, scale=units).states
    np.testing.assert_allclose(found / units, plain, atol=2e-15)
