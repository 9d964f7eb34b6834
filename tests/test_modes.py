"""Libraries of modes: which modes an H of angles has."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gfnn_jax.coordinates import CARTESIAN, Coordinates
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.dataset.runs import identified
from gfnn_jax.families.modes import modes
from gfnn_jax.families.terms import Terms, given_terms, multiplied
from gfnn_jax.flows.collocation import Steps, images
from gfnn_jax.models.hamiltonians.libraries import libraries_of
from gfnn_jax.models.hamiltonians.problem import LawProblem
from gfnn_jax.models.hamiltonians.search import learn_hamiltonian
from gfnn_jax.phase_space import Pairs


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


def test_harmonics_are_found_that_no_others_lead_to():
    """Of order 3 and 5: an H of those of order 2 is no better than one of order 1."""
    terms, coefficients = ["p1**2", "cos(q1)", "sin(3*q1)", "cos(5*q1)"], [0.5, -1.0, 0.3, -0.1]
    found = learned(pairs_of(terms, coefficients, 500, 0.2), 1e-8)
    assert str(found) == "-cos(q1) + 0.3 sin(3*q1) - 0.1 cos(5*q1) + 0.5 p1²"
    assert found.candidate.validation_relative < 1e-14


def test_an_angle_in_degrees_has_no_boxes_of_modes_to_search():
    """Boxes beyond the second were 35 of 37 CPU s; a rotor that runs over turns has them all."""
    rng, angles = np.random.default_rng(0), Coordinates("angles", angles=(0,))
    z0 = np.stack([rng.uniform(-20.0, 20.0, 400), rng.uniform(-9.0, 9.0, 400)], axis=1)
    family, counts = given_terms(1, ["p1**2", "cos(q1)"]), []
    for unit in (1.0, np.degrees(1.0)):  # of pendulums that turn, and of ones that swing by 20°
        z = z0 / [unit, 1.0 if unit == 1 else 20.0]
        z1 = images(family, np.array([0.5, -1.0]), z, 0.5, Steps(8, 2)).states
        pairs = Pairs(z * [unit, 1.0], z1 * [unit, 1.0], 0.5)
        data = Dataset.of(identified(pairs).pairs, angles).divided(0)
        counts.append(len(list(libraries_of(LawProblem(data, Tolerance(1e-6))))))
    assert counts == [6, 2]


def test_a_mass_of_an_angle_takes_many_modes():
    pairs = pairs_of(["p1**2/(1 + cos(q1)/2)**2", "cos(q1)"], [0.5, -1.0], 400, 0.2)
    found = learned(pairs, 1e-5)
    assert found.candidate.validation_relative < 1e-5
    known = {term.term: term.coefficient for term in found.terms}
    mean = (1 - 1 / 4) ** -1.5  # of 1/(1 + cos(q)/2)²
    assert known["p1²"] == pytest.approx(mean / 2, abs=1e-4)
    assert known["cos(q1)"] == pytest.approx(-1.0, abs=1e-4)


def test_modes_are_those_of_at_most_two_angles_up_to_their_sign():
    names = modes(3, (0, 1, 2), ("p1",), 1, 1).term_names
    waves = [n for n in names if n.startswith("cos") and not n.endswith("p1")]
    assert len(waves) == 3 + 2 * 3
    assert {"cos(q1 - q2) p1", "sin(q2 + q3)", "p1"} <= set(names)
    assert len(names) == (2 * len(waves) + 1) * 2 - 1


def test_a_given_term_is_multiplied_by_modes_and_momenta():
    term = "1/(1 + sin(q1)**2)"
    pairs = pairs_of([f"p1**2*{term}", "cos(q1)"], [0.5, -1.0], 150, 0.3)
    found = learned(pairs, 1e-12, [term])
    assert str(found) == f"-cos(q1) + 0.5 ({term}) p1²"
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
def test_behind_noise_no_further_modes_are_taken():
    pairs = pairs_of(["p1**2", "cos(q1)"], [0.5, -1.0], 200, 0.2)
    noise = 1e-3 * np.random.default_rng(1).standard_normal(pairs.z1.shape)
    found = learned(Pairs(pairs.z0, pairs.z1 + noise, 0.2), 1e-9)
    assert {t.term for t in found.terms} == {"cos(q1)", "p1²"}


def test_multiples_of_an_angle_cost_one_cosine():
    family = given_terms(2, [f"cos({m}*q1 - {m}*q2)" for m in range(1, 17)])
    w, c = np.random.default_rng(0).uniform(-3, 3, (50, 4)), np.ones(16)
    expected = sum(np.cos(m * (w[:, 0] - w[:, 1])) for m in range(1, 17))
    np.testing.assert_allclose(family.value(c, w), expected, rtol=0, atol=1e-13)
    program = str(jax.make_jaxpr(family.gradient)(jnp.asarray(c), jnp.asarray(w)))
    assert program.count(" cos ") == 1
