"""Friction and inputs in the stages of a flow: order, derivatives, the form that is kept or not."""

import functools

import jax
import numpy as np
import pytest
import scipy.integrate

from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.families.friction import DRY, LINEAR, PLACED, Friction
from gfnn_jax.families.terms import Terms
from gfnn_jax.flows.collocation import Steps, images
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.forces import Forced
from gfnn_jax.flows.uniform import Uniform
from gfnn_jax.maps.domain import covering
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import symplecticity_defect

# Hénon–Heiles with a mass that depends on the position.
H = Terms(
    2,
    ("q1", "q2", "p1", "p2"),
    (
        (2, 0, 0, 0),
        (0, 2, 0, 0),
        (0, 0, 2, 0),
        (0, 0, 0, 2),
        (2, 1, 0, 0),
        (0, 3, 0, 0),
        (0, 1, 2, 0),
    ),
)
C = np.array([0.5, 0.5, 0.5, 0.5, 1.0, -1 / 3, 0.4])
GAMMA = 0.3
Z = np.random.default_rng(0).uniform(-0.2, 0.2, (12, 4))
FRICTION = Friction.of([((1, 0), LINEAR, 0.0), ((1, -1), DRY, 0.3), ((0, 1), PLACED, 0.1)], 2)
LOSSES, GAINS = np.array([0.2, 0.1, 2.0]), np.array([[1.0, 0.5], [0.0, 2.0]])
INPUTS = 0.1 * np.random.default_rng(1).normal(size=(12, 3, 2))  # u, u̇, ü/2 of each lane
FORCED, PARAMS = Forced(H, FRICTION, 2, 2), np.concatenate([C, LOSSES, GAINS.ravel()])
BOTH, BOTH_PARAMS = Uniform(FORCED), np.append(PARAMS, GAMMA)
step = jax.jit(Flow.step)


def flow(family, params, substeps=1, newton=False, stages=8, dt=1.0):
    return Flow(family, params, dt, np.ones(4), stages, substeps, newton)


@functools.cache
def exact(gamma, forced):
    """Images of Z after 1, by another integrator and from the equations as they are written."""

    def field(t, z, u):
        gradient = H.gradient(C, z[None])[0]
        v, push = gradient[2:], -gradient[:2] - gamma * z[2:]
        if forced:
            s = v[0] - v[1]
            dry = LOSSES[1] * s / np.sqrt(s**2 + 0.09)
            place = LOSSES[2] * (z[1] - 0.1) ** 2 * v[1]
            push = (
                push
                - [LOSSES[0] * v[0] + dry, place - dry]
                + GAINS @ (u[0] + u[1] * t + u[2] * t**2)
            )
        return np.concatenate([v, push])

    options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-15}
    return np.stack(
        [
            scipy.integrate.solve_ivp(field, (0, 1), z, args=(u,), **options).y[:, -1]
            for z, u in zip(Z, INPUTS, strict=True)
        ]
    )


@pytest.mark.slow
@pytest.mark.parametrize(("newton", "substeps"), [(False, 1), (False, 3), (True, 2)])
def test_uniform_friction_multiplies_the_form(newton, substeps):
    piece = flow(Uniform(H), np.append(C, GAMMA), substeps, newton)
    found, _ = step(piece, Z)
    np.testing.assert_allclose(found, exact(GAMMA, False), atol=1e-14)
    np.testing.assert_allclose(piece.image(Z), exact(GAMMA, False), atol=1e-14)
    np.testing.assert_allclose(step(piece.inverse(), found)[0], Z, atol=1e-15)
    map_ = SymplecticMap((piece,), CARTESIAN, covering(Z), np.ones(4), np.zeros(0), 1.0)
    assert map_.multiplier() == pytest.approx(np.exp(-GAMMA), rel=1e-15)
    assert np.asarray(map_.defect(Z)).max() < 1e-15


def test_the_form_is_kept_however_long_the_step():
    """The error of one step of 2 is large, its defect is roundoff."""
    family, params = Uniform(H), np.append(C, GAMMA)
    coarse = images(family, params, Z, 2.0, Steps(3, 1), derivatives=True)
    finer = images(family, params, Z, 2.0, Steps(8, 8)).states
    assert np.abs(coarse.states - finer).max() > 1e-5
    multiplier = np.exp(-2 * GAMMA)
    assert symplecticity_defect(coarse.by_state, multiplier=multiplier).max() < 1e-14


@pytest.mark.parametrize("stages", [1, 2, 3])
def test_the_order_with_uniform_friction(stages):
    errors = [
        np.abs(
            flow(Uniform(H), np.append(C, GAMMA), n, stages=stages).image(Z) - exact(GAMMA, False)
        ).max()
        for n in (4, 8)
    ]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2 * stages, abs=0.1)


@pytest.mark.slow
def test_no_friction_has_the_same_bits():
    plain, none = flow(H, C, 2), flow(Uniform(H), np.append(C, 0.0), 2)
    np.testing.assert_array_equal(step(none, Z)[0], step(plain, Z)[0])
    np.testing.assert_array_equal(none.image(Z), plain.image(Z))
    bits = (piece.compensated_step(Z, np.zeros_like(Z))[:2] for piece in (none, plain))
    jax.tree.map(np.testing.assert_array_equal, *bits)


def test_another_friction_compiles_nothing(compilations):
    step(flow(Uniform(H), np.append(C, GAMMA)), Z)
    with compilations() as found:
        step(flow(Uniform(H), np.append(C, 0.1)), Z)
    assert found.count == 0


@pytest.mark.slow
@pytest.mark.parametrize(("newton", "substeps"), [(False, 3), (True, 1)])
def test_friction_and_inputs_in_the_stages(newton, substeps):
    args, expected = INPUTS.reshape(12, -1), exact(GAMMA, forced=True)
    piece = flow(BOTH, BOTH_PARAMS, substeps, newton)
    np.testing.assert_allclose(step(piece, Z, args)[0], expected, atol=1e-13)
    np.testing.assert_allclose(piece.image(Z, args), expected, atol=1e-13)
    assert piece.multiplier() is None
    map_ = SymplecticMap((piece,), CARTESIAN, covering(Z), np.ones(4), np.zeros(0), 1.0)
    assert map_.multiplier() is None


@pytest.mark.slow
def test_derivatives_in_everything():
    """Of NumPy's flow in the state and the params, of JAX's in the inputs."""
    args, fine = INPUTS.reshape(12, -1), Steps(6, 2)

    def image(params, z=Z):
        return images(BOTH, params, z, 1.0, fine, args=args).states

    found = images(BOTH, BOTH_PARAMS, Z, 1.0, fine, args=args, derivatives=True)
    for j, e in enumerate(1e-5 * np.eye(len(BOTH_PARAMS))):
        slope = (image(BOTH_PARAMS + e) - image(BOTH_PARAMS - e)) / 2e-5
        np.testing.assert_allclose(found.by_coefficient[..., j], slope, atol=1e-9)
    for j, e in enumerate(1e-5 * np.eye(4)):
        slope = (image(BOTH_PARAMS, Z + e) - image(BOTH_PARAMS, Z - e)) / 2e-5
        np.testing.assert_allclose(found.by_state[..., j], slope, atol=1e-9)
    of_terms = images(BOTH, BOTH_PARAMS, Z, 1.0, fine, args=args, derivatives=True, along=H)
    np.testing.assert_array_equal(of_terms.by_coefficient, found.by_coefficient[..., :7])
    piece = flow(BOTH, BOTH_PARAMS, 2, stages=6)
    slope = jax.jit(jax.jacrev(lambda u: piece.step(Z[:1], u)[0][0]))(args[:1])[:, 0]
    for j, e in enumerate(1e-5 * np.eye(6)):
        expected = (piece.image(Z[:1], args[:1] + e) - piece.image(Z[:1], args[:1] - e)) / 2e-5
        np.testing.assert_allclose(slope[:, j], expected[0], atol=1e-9)


def test_power_is_the_rate_of_the_energy():
    """Ḣ = supplied − lost, along the field itself."""
    args = INPUTS.reshape(12, -1)
    lost, supplied = FORCED.power(PARAMS, Z, args)
    assert (lost >= 0).all()
    field = FORCED.gradient(PARAMS, Z, args)
    gradient = H.gradient(C, Z)
    rate = np.sum(gradient[:, :2] * field[:, 2:] - gradient[:, 2:] * field[:, :2], axis=1)
    np.testing.assert_allclose(supplied.sum(1) - lost.sum(1), rate, atol=1e-15)
