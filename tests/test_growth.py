"""Libraries of modes that grow: which modes an H of angles has."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gfnn_jax.coordinates import CARTESIAN, Coordinates
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.dataset.runs import identified
from gfnn_jax.families.modes import Mode, Modes
from gfnn_jax.families.terms import Terms, given_terms, multiplied
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.flows.collocation import Steps, images
from gfnn_jax.models.hamiltonians.library_search import grow
from gfnn_jax.models.hamiltonians.problem import LawProblem
from gfnn_jax.models.hamiltonians.search import learn_hamiltonian
from gfnn_jax.phase_space import Pairs

BASIS = Modes(2, (0, 1), ("p1", "p2"))


def pairs_of(terms, coefficients, count, dt, seed=0):
    """Pairs of the H that is the sum of these terms: angles anywhere, |p| ≤ 1."""
    dim = 2 if "q2" in " ".join(terms) else 1
    rng = np.random.default_rng(seed)
    z0 = np.hstack([rng.uniform(-np.pi, np.pi, (count, dim)), rng.uniform(-1, 1, (count, dim))])
    family = given_terms(dim, terms)
    return Pairs(z0, images(family, np.array(coefficients), z0, dt, Steps(8, 2)).states, dt)


def learned(pairs, tolerance, terms=(), angles=(0,)):
    coordinates = Coordinates("angles", angles=angles) if angles else CARTESIAN
    data = Dataset.of(identified(pairs).pairs, coordinates).divided(0)
    return learn_hamiltonian(LawProblem(data, Tolerance(tolerance), terms=terms))


def test_growth_follows_the_difference_of_two_angles():
    """Of the modes of order 4 the box holds none; they are found along m₁ + m₂ = 0 alone."""
    terms = [
        "p1**2",
        "p2**2",
        "cos(q2)",
        "cos(q1 - q2)*p1*p2",
        "cos(2*q1 - 2*q2)",
        "cos(4*q1 - 4*q2)*p1**2",
        "sin(5*q1 - 5*q2)*p1*p2",
    ]
    coefficients = [0.5, 0.5, -1.0, -0.5, 0.3, 0.1, 0.05]
    pairs = pairs_of(terms, coefficients, 250, 0.05)
    problem = Problem(pairs.z0, pairs.z1, pairs.dt, np.ones(4))
    *_, found = grow(problem, BASIS, np.arange(250), 1e-9, 100)
    assert found.ended == "the training pairs meet the tolerance"
    heavy = np.abs(found.coefficients) > 1e-6
    names = [name for name, h in zip(found.family.term_names, heavy, strict=True) if h]
    expected = [name.replace("**2", "²").replace("*p", " p") for name in terms]
    assert set(names) == set(expected)
    known = dict(zip(found.family.term_names, found.coefficients, strict=True))
    np.testing.assert_allclose([known[n] for n in expected], coefficients, rtol=0, atol=1e-6)


def test_candidates_are_sums_and_differences_for_the_products_that_are_there():
    square, wave = Mode((0, 0), False, (2, 0)), Mode((1, -1), False, (0, 0))
    found = BASIS.around([square, wave])
    assert Mode((2, -2), True, (2, 0)) in found
    assert Mode((1, -1), False, (2, 0)) in found
    assert Mode((1, -1), False, (1, 0)) in found
    assert {m.wave for m in found} == {(0, 0), (1, -1), (2, -2)}
    assert not {square, wave} & set(found)
    assert BASIS.terms([Mode((2, -3), True, (0, 2))]).term_names == ("sin(2*q1 - 3*q2) p2²",)


def test_a_given_term_is_multiplied_by_modes_and_momenta():
    term = "1/(1 + sin(q1)**2)"
    pairs = pairs_of([f"p1**2*{term}", "cos(q1)"], [0.5, -1.0], 150, 0.3)
    found = learned(pairs, 1e-12, [term])
    assert str(found) in (f"0.5 p1² ({term}) - cos(q1)", f"-cos(q1) + 0.5 p1² ({term})")
    assert found.candidate.validation_relative < 1e-14


@pytest.mark.slow
def test_a_given_term_is_multiplied_where_there_are_no_angles():
    term = "1/(1 + q1**2)"
    pairs = pairs_of([f"p1**2*{term}", "q1**2"], [0.5, 0.5], 100, 0.2)
    found = learned(pairs, 1e-12, [term], angles=())
    assert {t.term for t in found.terms} == {"q1²", f"({term}) p1²"}
    assert found.candidate.validation_relative < 1e-14
    own = given_terms(1, ["1/q1", "exp(q1)"])
    assert multiplied(own, Terms(1, ("p1",), ((1,), (2,)))).num_parameters == 4


@pytest.mark.slow
def test_growth_ends_where_nothing_gains_and_says_so():
    pairs = pairs_of(["p1**2", "cos(q1)"], [0.5, -1.0], 200, 0.2)
    noise = 1e-3 * np.random.default_rng(1).standard_normal(pairs.z1.shape)
    found = learned(Pairs(pairs.z0, pairs.z1 + noise, 0.2), 1e-9)
    assert {t.term for t in found.terms} == {"cos(q1)", "p1²"}
    assert "The search for modes ended: no further mode gains" in found.unmet


def test_multiples_of_an_angle_cost_one_cosine():
    family = given_terms(2, [f"cos({m}*q1 - {m}*q2)" for m in range(1, 17)])
    w, c = np.random.default_rng(0).uniform(-3, 3, (50, 4)), np.ones(16)
    expected = sum(np.cos(m * (w[:, 0] - w[:, 1])) for m in range(1, 17))
    np.testing.assert_allclose(family.value(c, w), expected, rtol=0, atol=1e-13)
    program = str(jax.make_jaxpr(family.gradient)(jnp.asarray(c), jnp.asarray(w)))
    assert program.count(" cos ") == 1
