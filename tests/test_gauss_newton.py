"""H from pairs: coefficients, formulas, hard cases."""

import numpy as np
import pytest

from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.dataset.runs import identified
from gfnn_jax.families.terms import Terms, given_terms, polynomial_terms
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.fitting.linear_starts import log_start, midpoint_start
from gfnn_jax.fitting.significance import null_terms
from gfnn_jax.flows.collocation import Steps, images, truncation
from gfnn_jax.models.hamiltonians.problem import LawProblem
from gfnn_jax.models.hamiltonians.search import learn_hamiltonian
from gfnn_jax.phase_space import Pairs

HENON_HEILES = Terms(
    2,
    ("q1", "q2", "p1", "p2"),
    ((2, 0, 0, 0), (0, 2, 0, 0), (0, 0, 2, 0), (0, 0, 0, 2), (2, 1, 0, 0), (0, 3, 0, 0)),
)
TRUE = np.array([0.5, 0.5, 0.5, 0.5, 1.0, -1 / 3])


def henon_heiles(count, dt, seed=0, size=0.3):
    z0 = np.random.default_rng(seed).uniform(-size, size, (count, 4))
    return Pairs(z0, images(HENON_HEILES, TRUE, z0, dt, Steps(12, int(np.ceil(2 * dt)))).states, dt)


def learned(pairs, *, tolerance=1e-12, terms=(), coordinates=CARTESIAN):
    data, asked = Dataset.of(identified(pairs).pairs, coordinates).divided(0), Tolerance(tolerance)
    return learn_hamiltonian(LawProblem(data, asked, terms=terms)), data, asked


def problem_of(pairs):
    return Problem(pairs.z0, pairs.z1, pairs.dt, pairs.z0.std(axis=0))


def off(family, coefficients):
    """The largest error of a coefficient."""
    true = dict(zip(HENON_HEILES.term_names, TRUE, strict=True))
    expected = np.array([true.get(name, 0.0) for name in family.term_names])
    return np.abs(coefficients - expected).max()


def test_derivatives_in_state_and_coefficients():
    family, pairs = polynomial_terms(2, 3), henon_heiles(5, 1.0)
    c, z, steps = np.random.default_rng(1).normal(0, 0.1, 34), pairs.z0, Steps(4, 2)
    c[[4, 8, 11, 13]] += 0.5
    found = images(family, c, z, 1.0, steps, derivatives=True)
    step = 1e-6

    def difference(make):
        plus, minus = (images(family, *make(s), 1.0, steps).states for s in (step, -step))
        return (plus - minus) / (2 * step)

    for j in range(0, 34, 5):
        numeric = difference(lambda s, j=j: (c + s * np.eye(34)[j], z))
        np.testing.assert_allclose(found.by_coefficient[:, :, j], numeric, atol=1e-9)
    for i in range(4):
        numeric = difference(lambda s, i=i: (c, z + s * np.eye(4)[i]))
        np.testing.assert_allclose(found.by_state[:, :, i], numeric, atol=1e-9)


def test_collocation_has_its_order_and_says_its_error():
    pairs = henon_heiles(20, 1.0)
    errors = [
        np.abs(images(HENON_HEILES, TRUE, pairs.z0, 1.0, Steps(2, n)).states - pairs.z1).max()
        for n in (4, 8)
    ]
    assert 12 < errors[0] / errors[1] < 20  # order 4
    told = np.abs(truncation(HENON_HEILES, TRUE, pairs.z0, 1.0, Steps(2, 4))).max()
    assert 0.8 < told / errors[0] < 1.2


def test_stages_that_no_fixed_point_finds_are_found_by_newton():
    stiff = given_terms(1, ["p**2", "q**2"])
    z = np.random.default_rng(0).uniform(-1, 1, (6, 2))
    plain = images(stiff, np.array([0.5, 200.0]), z, 1.0, Steps(2, 1, newton=False))
    assert not plain.solved.any()
    assert np.isnan(plain.states).all()
    assert images(stiff, np.array([0.5, 200.0]), z, 1.0, Steps(2, 1)).solved.all()


@pytest.mark.parametrize("dt", [0.5, pytest.param(1.0, marks=pytest.mark.slow)])
def test_henon_heiles_told_nothing(dt):
    pairs = henon_heiles(100, dt)
    found, _, _ = learned(pairs)
    assert len(found.terms) == 6
    assert found.candidate.validation_relative < 1e-14
    assert off(found.flow.family, found.flow.params) < 1e-11
    assert max(t.std for t in found.terms) < 1e-12
    assert str(found) == "0.5 q1² + 0.5 q2² + 0.5 p1² + 0.5 p2² + q1² q2 - 0.333333333333 q2³"
    assert found.candidate.learns == "hamiltonian"
    assert not found.messages


@pytest.mark.slow
def test_long_steps_from_the_logarithm():
    pairs = henon_heiles(90, 3.0, size=0.2)
    family = polynomial_terms(2, 3)
    problem = problem_of(pairs)
    start = log_start(family, pairs.z0, pairs.z1, pairs.dt, problem.scale)
    fit = problem.fit(family, start)
    assert fit.rms < 1e-14
    assert off(family, fit.coefficients) < 1e-12


@pytest.mark.slow
def test_standard_errors_are_those_of_noise():
    pairs, sigma = henon_heiles(2_000, 0.5), 1e-4
    pulls = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        noisy = Pairs(pairs.z0, pairs.z1 + sigma * rng.standard_normal((2_000, 4)), 0.5)
        fit = problem_of(noisy).fit(HENON_HEILES, TRUE, rounds=False)
        pulls.append((fit.coefficients - TRUE) / fit.standard_errors)
    assert 0.5 < np.std(pulls) < 1.6


def test_terms_that_no_state_tells_apart_are_removed():
    terms = ["p1**2", "p2**2", "q1**2", "q2**2", "q1**2 + q2**2", "q1**2*q2", "q2**3"]
    _, null = null_terms(given_terms(2, terms), henon_heiles(50, 0.5).z0)
    assert null == [4]
    found, _, _ = learned(henon_heiles(40, 0.5), terms=terms)
    assert found.null_terms == ("q1**2 + q2**2",)
    assert found.candidate.validation_relative < 1e-14


@pytest.mark.slow
def test_what_no_hamiltonian_explains_is_said():
    """Energy that comes from nowhere; what goes is friction."""
    pairs = henon_heiles(200, 0.5)
    for factor in (1.03, 0.97):
        image = pairs.z1 * [1, 1, factor, factor]
        found, _, _ = learned(Pairs(pairs.z0, image, 0.5), tolerance=1e-6)
        assert ("no H of the terms tried" in found.unmet) == (factor > 1)
        assert bool(found.friction) == (factor < 1)


def test_starts_are_exact_for_what_they_are_made_for():
    z0 = np.random.default_rng(0).uniform(-1, 1, (30, 4))
    quadratic = Terms(2, HENON_HEILES.variables, HENON_HEILES.powers[:4])
    c = np.array([0.5, 0.8, 0.5, 0.3])
    z1 = images(quadratic, c, z0, 1.5, Steps(10, 4)).states
    start = log_start(quadratic, z0, z1, 1.5, np.ones(4))
    np.testing.assert_allclose(start, c, atol=1e-12)
    short = images(quadratic, c, z0, 0.01, Steps(4, 1)).states
    np.testing.assert_allclose(midpoint_start(quadratic, z0, short, 0.01, np.ones(4)), c, atol=1e-4)


@pytest.mark.slow
def test_close_passages_do_not_hide_the_law():
    """Two bodies, e up to 0.98: a few passages at a fiftieth of the axis outweigh all quiet pairs,
    and no start resolves them."""
    rng, count = np.random.default_rng(0), 300
    e, angle, phase = rng.uniform(0, 0.98, count), *rng.uniform(0, 2 * np.pi, (2, count))
    r, b, turn = 1 - e * np.cos(phase), np.sqrt(1 - e**2), np.exp(1j * angle)
    x = turn * (np.cos(phase) - e + 1j * b * np.sin(phase))
    v = turn * (-np.sin(phase) + 1j * b * np.cos(phase)) / r
    z0 = np.stack([x.real, x.imag, v.real, v.imag], axis=1)
    kepler = given_terms(2, ["1/sqrt(q1**2 + q2**2)", "p1**2", "p2**2"])
    z1 = images(kepler, np.array([-1.0, 0.5, 0.5]), z0, 0.1, Steps(12, 128)).states
    found, _, _ = learned(Pairs(z0, z1, 0.1), tolerance=1e-8, terms=["1/sqrt(q1**2 + q2**2)"])
    assert found.formula == "-1/sqrt(q1**2 + q2**2) + 0.5*p1**2 + 0.5*p2**2"
    off = [t.coefficient - c for t, c in zip(found.terms, (-1.0, 0.5, 0.5), strict=True)]
    assert np.abs(off).max() < 1e-12
    assert found.candidate.validation_bound < 1e-8  # by steps that resolve the held-out passages
    assert 0 < found.left_out < 0.2 * count
    assert any(f"{found.left_out} of" in m for m in found.messages)


def test_collocation_goes_back_in_time_as_accurately():
    pairs = henon_heiles(20, 0.5)
    back = images(HENON_HEILES, TRUE, pairs.z1, -0.5, Steps(8, 2)).states
    np.testing.assert_allclose(back, pairs.z0, rtol=0, atol=1e-13)
