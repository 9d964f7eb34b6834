"""A Lagrangian with forces: its closed forms against JAX's derivatives of the plain sum."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gfnn_jax.families.friction import (
    DRY,
    ISOTROPIC,
    LINEAR,
    LOADED,
    ONE_SIDED,
    PLACED,
    POWER,
    QUADRATIC,
    STRIBECK,
    Friction,
)
from gfnn_jax.families.lagrangian import Lagrangian, Terms
from gfnn_jax.flows.legendre import family_of

ROWS = [
    ((2, 0), (0, 0), (0, 0), 0.0),
    ((0, 2), (0, 0), (0, 0), 0.0),
    ((1, 1), (0, 0), (1, -1), 0.0),
    ((0, 2), (1, 2), (0, 0), 0.0),
    ((1, 0), (0, 1), (2, 0), -np.pi / 2),
    ((0, 0), (0, 0), (1, 0), 0.0),
    ((0, 0), (2, 1), (0, 3), 0.4),
    ((1, 0), (0, 1), (1, 0), 0.2, "1/sqrt(q1**2 + q2**2 + 1)"),
    ((0, 0), (0, 0), (0, 0), 0.0, "(q1 - q2)**2*exp(q2)/cosh(q1)**1.5"),
]
SHAPES = {
    "1/sqrt(q1**2 + q2**2 + 1)": lambda q: 1 / jnp.sqrt(q @ q + 1),
    "(q1 - q2)**2*exp(q2)/cosh(q1)**1.5": lambda q: (
        (q[0] - q[1]) ** 2 * jnp.exp(q[1]) / jnp.cosh(q[0]) ** 1.5
    ),
}
THETA = np.array([1.0, 0.7, 0.3, 0.1, 0.2, 2.0, -0.6, 0.3, 0.8])
FRICTION = [((1, 0), LINEAR, 1.0), ((-1, 1), QUADRATIC, 1.0), ((0, 1), DRY, 0.1)]
FRICTION += [((1, 0), POWER, 1.5), ((0, -1), ONE_SIDED, 0.0), ((1, 1), ISOTROPIC, 2.0)]
FRICTION += [((1, -1), STRIBECK, 0.4), ((1, 0), LOADED + 2, 0.2), ((-1, 1), PLACED, 0.3)]
RHO = np.array([0.1, 0.2, 0.05, 0.3, 0.4, 0.15, 0.25, 0.35, 0.45])
GAINS = np.array([[1.0, 0.0, 0.5], [0.0, -2.0, 0.3]])


def law():
    terms, friction = Terms.of(ROWS, 2), Friction.of(FRICTION, 2)
    return Lagrangian(terms, THETA, friction, RHO, 0.03, GAINS)


def plain(q, v):
    """L, term by term, as a person would write it."""
    total = 0.0
    for theta, (k, n, m, phase, *shape) in zip(THETA, ROWS, strict=True):
        wave = jnp.cos(m[0] * q[0] + m[1] * q[1] + phase)
        product = v[0] ** k[0] * v[1] ** k[1] * q[0] ** n[0] * q[1] ** n[1]
        total = total + theta * product * wave * (SHAPES[shape[0]](q) if shape else 1.0)
    return total


def rayleigh(q, v, u):
    s = v[1] - v[0]
    of_all = (
        v[0] ** 2 / 2,
        jnp.abs(s) ** 3 / 3,
        jnp.sqrt(v[1] ** 2 + 0.01),
        jnp.abs(v[0]) ** 2.5 / 2.5,
        jnp.maximum(-v[1], 0) ** 2 / 2,
        (v @ v) ** 1.5 / 3,
        0.4 * (1 - jnp.exp(-jnp.abs(s) / 0.4)) - jnp.abs(s),
        jnp.abs(u[2]) * jnp.sqrt(v[0] ** 2 + 0.04),
        (q[1] - q[0] - 0.3) ** 2 * s**2 / 2,
    )
    return sum(rho * term for rho, term in zip(RHO, of_all, strict=True))


def states(count=5):
    return np.random.default_rng(0).normal(size=(2, count, 2))


@jax.jit
@jax.vmap
def derivatives_of_the_plain_sum(q, v):
    x, whole = jnp.concatenate([q, v]), lambda x: plain(x[:2], x[2:])
    by, twice = jax.grad(whole)(x), jax.hessian(whole)(x)
    by_q, by_v = twice[:2], twice[2:]
    return whole(x), by[:2], by[2:], by_q[:, :2], by_v[:, :2], by_q[:, 2:], by_v[:, 2:]


@pytest.mark.parametrize("xp", [np, jnp])
def test_derivatives_are_those_of_the_plain_sum(xp):
    q, v = states()
    model, compiled = law(), jax.jit if xp is jnp else lambda function: function
    found = compiled(lambda q, v: (*model.derivatives(q, v), model.momentum(q, v)))(q, v)
    expected = derivatives_of_the_plain_sum(q, v)
    for a, b in zip(found, (*expected, expected[2]), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_acceleration_solves_the_equation_of_motion():
    q, v = states()
    u = np.random.default_rng(1).normal(size=(5, 3))
    a = law().acceleration(q, v, u)

    found = derivatives_of_the_plain_sum(q, v)
    _, by_q, momentum, _, of_q, _, masses = (np.asarray(one) for one in found)
    rate = np.einsum("nij,nj->ni", of_q, v) + np.einsum("nij,nj->ni", masses, a)
    friction = np.asarray(jax.jit(jax.vmap(jax.grad(rayleigh, 1)))(q, v, u)) + 0.03 * momentum
    np.testing.assert_allclose(rate, by_q - friction + u @ GAINS.T, rtol=1e-11, atol=1e-11)
    terms = law().terms.residuals(q, v, a)
    rest = np.einsum("npd,p->nd", terms, THETA) - law().forces(q, v, u)
    np.testing.assert_allclose(rest, 0, atol=1e-11)


def test_energy_changes_by_the_power_of_the_forces():
    q, v = states()
    u = np.random.default_rng(1).normal(size=(5, 3))
    model, a = law(), law().acceleration(q, v, u)
    h = 1e-5
    rate = (model.energy(q + h * v, v + h * a) - model.energy(q - h * v, v - h * a)) / (2 * h)
    lost, supplied = model.power(q, v, u)
    np.testing.assert_allclose(rate, supplied.sum(-1) - lost.sum(-1), rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("xp", [np, jnp])
def test_friction_is_the_gradient_of_its_potential(xp):
    """And its stiffness the Hessian, at rest too, where |v|³ has one."""
    q, v = states()
    model = law()
    u = np.random.default_rng(1).normal(size=(5, 3))
    found = model.losses_by_v(q, xp.asarray(v), u)
    expected = jax.vmap(jax.hessian(rayleigh, 1))(q, v, u)
    np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-12)
    found = model.friction.by_place(xp.asarray(q), xp.asarray(v), RHO)
    expected = jax.vmap(jax.jacfwd(jax.grad(rayleigh, 1)))(q, v, u)
    np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-12)
    drag = Friction.of([((1, 1), ISOTROPIC, a) for a in (1.0, 2.0, 3.0)], 2)
    rest, one = xp.zeros((1, 2)), xp.ones(3)
    np.testing.assert_array_equal(drag.forces(rest, one), 0.0)
    np.testing.assert_array_equal(drag.stiffness(rest, one)[0], np.eye(2))


def test_dry_friction_without_a_width_has_finite_tables_at_rest():
    friction = Friction.of([((1,), DRY, 0.0)], 1)
    speeds = np.array([0.0, 1e-110, -1e-110, 0.3])
    value, slope, curvature = (table[:, 0] for table in friction.tables(speeds[:, None]))
    np.testing.assert_array_equal(slope, np.sign(speeds))
    np.testing.assert_array_equal(curvature, 0.0)
    assert value[-1] == 0.3


@pytest.mark.parametrize("leaders", [(0,), (1,)])
def test_terms_of_coordinates_that_are_led_act_on_these_alone(leaders):
    """The field of the flow is that of the accelerations, and its derivative that of finite
    differences."""
    (q, v), model = states(), law()
    model = dataclasses.replace(model, terms=dataclasses.replace(model.terms, leaders=leaders))
    model, led = dataclasses.replace(model, uniform=0.0), 1 - leaders[0]
    u, e = np.random.default_rng(1).normal(size=(5, 3)), 1e-6
    other = model.terms.take(~model.terms.follows)
    alone = dataclasses.replace(model, terms=other, coefficients=THETA[~model.terms.follows])
    a = model.acceleration(q, v, u)
    rest = model.terms.residuals(q, v, a)[..., leaders[0]] @ THETA
    expected = other.residuals(q, v, a)[..., leaders[0]] @ alone.coefficients
    np.testing.assert_allclose(rest, expected, atol=1e-12)
    whole = law().terms.residuals(q, v, a)[..., led] @ THETA
    np.testing.assert_allclose(model.terms.residuals(q, v, a)[..., led] @ THETA, whole, atol=1e-12)
    family, params = family_of(model)
    z = np.concatenate([q, model.momentum(q, v)], axis=1)
    field, slope = family.gradient_and_hessian(params, z, u)
    np.testing.assert_allclose(field[:, 2:], v, atol=1e-12)
    ends = [model.momentum(q + s * v, v + s * a) for s in (e, -e)]
    np.testing.assert_allclose(-field[:, :2], (ends[0] - ends[1]) / (2 * e), atol=1e-7)
    ends = [[family.gradient(params, z + s * row, u) for s in (e, -e)] for row in np.eye(4)]
    by = np.stack([(up - down) / (2 * e) for up, down in ends], axis=-1)
    np.testing.assert_allclose(slope, by, atol=1e-7)


@pytest.mark.slow
def test_bad_terms_are_refused():
    with pytest.raises(ValueError, match="two factors v"):
        Terms.of([((2, 1), (0, 0), (0, 0), 0.0)], 2)
    with pytest.raises(ValueError, match="powers"):
        Terms.of([((0, 0), (9, 0), (0, 0), 0.0)], 2)
