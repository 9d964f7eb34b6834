"""Flows of laws with a bracket: exactly Poisson, Casimirs kept, and all that maps can do."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn
from gfnn_jax.coordinates import CARTESIAN, LOG
from gfnn_jax.families.terms import given_terms
from gfnn_jax.flows.collective import collective
from gfnn_jax.flows.compiled_steps import STAGES, Stepper
from gfnn_jax.flows.flow import Flow
from gfnn_jax.maps.domain import covering
from gfnn_jax.solve.status import NON_FINITE, OK

INERTIA = np.linalg.inv([[1.0, 0.2, 0.1], [0.2, 1.7, 0.3], [0.1, 0.3, 2.5]])
B = gfnn.Bracket
SYSTEMS = {  # bracket, terms of H in q1.. p.., a state
    "top": (
        B.se3(),
        ("q1**2", "q2**2+q1*q2", "q3**2/3", "p3", "p2**2"),
        [0.3, -0.5, 1, 0.2, 0.3, 0.9],
    ),
    "spins": (
        B.so3(2, basis=np.eye(6) + 0.1 * np.arange(36).reshape(6, 6) % 0.7),
        ("q1*p1", "q2*p2", "q3**2+p3", "q1"),
        [0.3, -0.5, 1, 0.2, 0.3, 0.9],
    ),
    "rock-paper-scissors": (
        B.log([[0, 1, -1], [-1, 0, 2], [1, -2, 0]]),
        ("q1+q2", "p1"),
        [0.8, 1.4, 0.5],
    ),
    "scalings": (
        B.lie(("aff", "centre"), basis=[[1, 0, 0], [0.3, 1, 0], [0, 1, 1]]),
        ("q1**2", "q2**2/2+p1**2/2"),
        [0.8, -0.4, 0.5],
    ),
    "degenerate": (
        B.constant([[0, 1, 0.3], [-1, 0, 0.2], [-0.3, -0.2, 0]]),
        ("q1**4", "q2**2+p1**2"),
        [0.8, 0.4, 0.5],
    ),
    "magnetic": (
        B.magnetic([[[0, 1], [-1, 0]], [[0, 0.4], [-0.4, 0]]], [[0, 0], [1, 0]]),
        ("p1**2+p2**2", "q1**2*q2"),
        [0.8, 0.4, 0.5, 0.1],
    ),
}


def made(name, dt=0.1, stages=6):
    bracket, terms, z = SYSTEMS[name]
    n = bracket.size
    family = given_terms(-(-n // 2), terms)
    log = bracket.name == "log-canonical"
    params = np.linspace(0.7, 1.1, family.num_parameters)
    flow = Flow(collective(family, bracket), params, dt, np.ones(n), stages)
    domain = covering(np.zeros((1, n)), ignore=tuple(range(n)))
    return gfnn.SymplecticMap(
        (flow,), LOG if log else CARTESIAN, domain, np.ones(n), np.zeros(0), dt, bracket=bracket
    ), np.array(z, float)


def wide(casimirs, number, lanes):
    """A Casimir of the lanes in the platform's longest floats, what rounding has lost included."""
    y = np.asarray(lanes.y, np.longdouble) + np.asarray(lanes.compensation, np.longdouble)
    return sum(
        value * y[:, a] * (y[:, b] / 2 if b >= 0 else 1)
        for (own, a, b), value in zip(casimirs.entries, casimirs.values, strict=True)
        if own == number
    )


@pytest.mark.slow
@pytest.mark.parametrize("steps", [1_000, 10_000])
@pytest.mark.parametrize("name", SYSTEMS)
def test_step(name, steps, tmp_path):
    """The step is the flow of B∇H, exactly Poisson by the derivative of what ran; Casimirs stay;
    it is undone by its inverse and saved."""
    map_, z = made(name)
    bracket, flow = map_.bracket, map_.pieces[0]

    def field(_, y):
        return bracket.apply(y, flow.family.family.gradient(flow.params, y))

    reference = solve_ivp(field, (0, 0.1), z, method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1]
    states = np.stack([z, 1.1 * z])
    after, info = map_.step(states)
    assert (np.asarray(info.status) == OK).all()
    np.testing.assert_allclose(after[0], reference, atol=5e-14)
    assert np.max(map_.defect(states)) < 1e-13
    np.testing.assert_allclose(map_.inverse(after)[0], states, atol=2e-14)
    begun = map_.start(states)
    lanes, saved = map_.advance(begun, 1, save_every=steps)
    casimirs = flow.family.casimirs
    for number in range(len(bracket.casimirs)):
        values = [wide(casimirs, number, of) for of in (begun, lanes)]
        assert np.max(abs(values[1] / values[0] - 1)) < 1e-17
    for casimir in bracket.casimirs:
        assert np.max(abs(casimir(np.asarray(saved)[:, 0]) / casimir(states) - 1)) < 4e-15
    map_.save(tmp_path / "model")
    again = gfnn.load(tmp_path / "model").map
    np.testing.assert_array_equal(again.step(states)[0], after)
    assert str(again.bracket) == str(bracket)


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
def test_long_rollouts(name):
    """Compiled steps are those of JAX; Casimirs stay to the last digit."""
    map_, z = made(name, stages=STAGES)
    assert Stepper.of(map_.pieces[0]) is not None
    states, info = map_.rollout(z, 10_000)
    few, _ = map_.rollout(z, 30)
    np.testing.assert_allclose(states[:31], few, rtol=5e-14, atol=5e-14)
    fine = np.asarray(states)[np.isfinite(states).all(axis=1)]
    assert (len(fine) == len(states)) == (info.status == OK)
    for casimir in map_.bracket.casimirs:
        assert np.max(abs(casimir(fine) / casimir(z) - 1)) < 6e-15


@pytest.mark.parametrize(
    "name", [pytest.param("top", marks=pytest.mark.slow), "rock-paper-scissors"]
)
def test_long_rollouts_of_short_steps_keep_the_energy(name):
    """Stages that begin close to their end are iterated to it all the same."""
    map_, z = made(name, dt=0.02, stages=STAGES)
    states, _ = map_.rollout(z, 10_000)
    flow = map_.pieces[0]
    energy = np.asarray(flow.family.family.value(flow.params, np.asarray(states)))
    assert np.max(abs(energy - energy[0])) < 1e-14


@pytest.mark.slow
def test_long_rollouts_leave_the_domain():
    map_, z = made("top", stages=STAGES)
    domain = covering(np.random.default_rng(0).uniform(-1, 1, (200, 6)) * 0.2 + z)
    map_ = dataclasses.replace(map_, domain=domain)
    both = [map_.rollout(z, n, stop_outside=True) for n in (60, 10_000)]
    few, many = (info for _, info in both)
    assert few.left_at > 0
    assert (few.left_at, few.status) == (many.left_at, many.status)
    np.testing.assert_allclose(both[1][0][:61], both[0][0], atol=1e-14)


@pytest.mark.slow
def test_transformations():
    """jit, vmap and grad, in states and coefficients, by the implicit function theorem."""
    map_, z = made("top")

    def total(map_, z):
        return jnp.sum(map_.rollout(z, 3)[0][-1] ** 2)

    by_map, by_z = jax.jit(jax.grad(total, (0, 1), allow_int=True))(map_, z)
    unit, e = np.eye(6)[1], 1e-5
    numeric = (total(map_, z + e * unit) - total(map_, z - e * unit)) / (2 * e)
    np.testing.assert_allclose(by_z[1], numeric, rtol=1e-7)
    assert np.isfinite(by_map.pieces[0].params).all()
    assert by_map.pieces[0].params.any()
    batch = np.stack([z, 2 * z])
    mapped = jax.vmap(lambda y: map_.step(y)[0])(batch)
    np.testing.assert_allclose(mapped, map_.step(batch)[0], atol=1e-15)
    ahead, _ = map_.step(z, dt=0.3)
    np.testing.assert_allclose(ahead, map_.rollout(z, 3)[0][-1], atol=2e-14)


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        pytest.param("top", [1, 2, 3, 0, 0, 0], marks=pytest.mark.slow),
        ("rock-paper-scissors", [1, -1, 1]),
        pytest.param("scalings", [-0.1, 1, 1], marks=pytest.mark.slow),
    ],
)
def test_states_without_a_step_have_a_status(name, bad):
    map_, z = made(name)
    states, info = map_.rollout(np.stack([z, np.array(bad, float)]), 2)
    assert np.asarray(info.status).tolist() == [OK, NON_FINITE]
    assert np.isfinite(states[0]).all()
    assert not np.isfinite(states[1, -1]).any()


def test_no_modified_hamiltonian_of_a_bracket():
    map_, z = made("top")
    with pytest.raises(ValueError, match="bracket"):
        map_.modified_hamiltonian(z)
    flow = map_.pieces[0]
    np.testing.assert_allclose(
        map_.hamiltonian(z), flow.family.family.value(flow.params, z), rtol=1e-13
    )
