"""The Legendre transform of a Lagrangian: derivatives, its flow against the equations of motion."""

import jax
import numpy as np
import pytest
import scipy.integrate

from gfnn_jax.families.friction import DRY, LINEAR, Friction
from gfnn_jax.families.lagrangian import Lagrangian, Terms
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.legendre import Legendre, family_of, law_of

# A double pendulum with a spring, and a term linear in v, as of a magnetic field.
NONE = (0, 0)
TERMS = Terms.of(
    [
        ((2, 0), NONE, NONE, 0.0),
        ((0, 2), NONE, NONE, 0.0),
        ((1, 1), NONE, (1, -1), 0.0),
        (NONE, NONE, (1, 0), 0.0),
        (NONE, NONE, (0, 1), 0.0),
        (NONE, (0, 2), NONE, 0.0),
        ((1, 0), (0, 1), NONE, 0.0),
    ],
    2,
)
THETA = np.array([1.0, 0.5, 1.0, 19.6, 9.8, -0.4, 0.7])
W = np.random.default_rng(0).normal(size=(5, 4))
LAW = Lagrangian(
    TERMS,
    THETA,
    Friction.of([((1, 0), LINEAR, 0.0), ((1, -1), DRY, 0.3)], 2),
    np.array([0.2, 0.1]),
    0.1,
    np.array([[1.0], [0.5]]),
)


def slopes(function, x, e=1e-5):
    """∂function/∂x (..., n) by differences, all rows of x together."""
    along = [e * unit for unit in np.eye(x.shape[-1])]
    return np.stack([(function(x + a) - function(x - a)) / (2 * e) for a in along], axis=-1)


def test_derivatives():
    family = Legendre(TERMS)
    gradient, hessian = family.gradient_and_hessian(THETA, W)
    np.testing.assert_allclose(gradient, slopes(lambda w: family.value(THETA, w), W), atol=1e-8)
    np.testing.assert_allclose(
        hessian, slopes(lambda w: family.gradient(THETA, w), W), rtol=1e-7, atol=1e-8
    )
    np.testing.assert_array_equal(hessian, np.swapaxes(hessian, 1, 2))
    np.testing.assert_allclose(
        family.parameter_gradients(THETA, W),
        slopes(lambda theta: family.gradient(theta, W), THETA),
        rtol=1e-6,
        atol=1e-7,
    )
    both = jax.jit(lambda w: family.gradient_and_hessian(THETA, w))(W)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), both, (gradient, hessian)
    )


@pytest.mark.slow
def test_the_flow_obeys_the_equations_of_motion():
    """Positions and velocities by another integrator, from the accelerations of the law."""
    q, v, u = W[:, :2], W[:, 2:], np.linspace(-1, 1, 5)[:, None]

    def field(t, y, u):
        return np.concatenate([y[2:], LAW.acceleration(y[None, :2], y[None, 2:], u[None])[0]])

    there = np.stack(
        [
            scipy.integrate.solve_ivp(
                field, (0, 0.1), y, args=(one,), method="DOP853", rtol=1e-13, atol=1e-14
            ).y[:, -1]
            for y, one in zip(W, u, strict=True)
        ]
    )
    family, params = family_of(LAW)
    piece = Flow(family, params, 0.1, np.ones(4), 8, 4)
    here, expected = (
        np.concatenate([a, LAW.momentum(a, b)], axis=1)
        for a, b in ((q, v), np.split(there, 2, axis=1))
    )
    np.testing.assert_allclose(piece.image(here, u), expected, atol=1e-11)
    found, _ = jax.jit(Flow.step)(piece, here, u)
    np.testing.assert_allclose(found, expected, atol=1e-11)


@pytest.mark.parametrize("uniform", [0.0, 0.1])
@pytest.mark.parametrize("gains", [np.zeros((2, 0)), LAW.gains])
def test_a_law_comes_back_from_its_flow(uniform, gains):
    law = Lagrangian(TERMS, THETA, LAW.friction, LAW.losses, uniform, gains)
    family, params = family_of(law)
    assert family.num_parameters == len(params)
    again = law_of(family, params)
    for name in ("coefficients", "losses", "uniform", "gains"):
        np.testing.assert_array_equal(getattr(again, name), getattr(law, name))
    bare = Lagrangian(TERMS, THETA, Friction.of([], 2), np.zeros(0), uniform, np.zeros((2, 0)))
    assert law_of(*family_of(bare)).uniform == uniform
    assert Flow(*family_of(bare), 0.5, np.ones(4)).multiplier() == np.exp(-0.5 * uniform)
