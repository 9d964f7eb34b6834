"""Symmetries of a law."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn
from gfnn_jax.families.terms import given_terms
from gfnn_jax.models.hamiltonians.symmetries import LawNumbers, restricted, symmetries_of

R = "sqrt(q1**2 + q2**2)"


def states(dim, count=60):
    return np.random.default_rng(0).uniform(0.4, 1.6, (count, 2 * dim))


def told(dim, law, angles=()):
    family = given_terms(dim, list(law))
    return symmetries_of(family, np.array(list(law.values())), states(dim), angles)


@pytest.mark.parametrize(
    ("dim", "law", "expected", "absent"),
    [
        (2, {"p1**2": 0.5, "p2**2": 0.5, f"1/{R}": -1}, "rotation in (q1, q2)", "translation"),
        (2, {"p1**2": 0.5, "p2**2": 0.6, f"1/{R}": -1}, "reversal of time", "rotation"),
        (2, {"p1**2": 0.5, "p2**2": 0.5, "(q1 - q2)**4": 1}, "translation of all", "rotation"),
        (2, {"p1**2": 0.5, "p2**2": 0.5, "q2*p1": 1, "q1*p2": -1}, "rotation", "reversal of time"),
        (2, {"p1**2": 0.5, "p2**2/sin(q1)**2": 0.5}, "translation of q2", "exchange"),
        (1, {"p1**2": 0.5, "q1**2": 0.5}, "q1² + p1² conserved", "translation"),
        (
            3,
            {"p1**2": 1, "p3**2": 1, "p2**2": 2, "q1*q3": 1},
            "exchange of degrees of freedom 1 and 3",
            "rotation in (q1, q2)",
        ),
    ],
)
def test_symmetries_are_told(dim, law, expected, absent):
    found = "; ".join(told(dim, law))
    assert expected in found
    assert absent not in found


def test_what_is_said_to_be_conserved_is():
    """Angular momentum, along an orbit of another solver, of a charge in a magnetic field."""
    law = {"p1**2": 0.5, "p2**2": 0.5, "q2*p1": 0.3, "q1*p2": -0.3, f"1/{R}": -1.0}
    assert any("q1 p2 − q2 p1 conserved" in text for text in told(2, law))
    family, c = given_terms(2, list(law)), np.array(list(law.values()))

    def field(t, z):
        g = family.gradient(c, z)
        return np.concatenate([g[2:], -g[:2]])

    z = solve_ivp(field, (0, 5), [1.0, 0.2, 0.1, 0.9], "DOP853", rtol=1e-11, atol=1e-11).y
    assert np.ptp(z[0] * z[3] - z[1] * z[2]) < 1e-9


def test_numbers_within_their_errors_of_a_symmetry_are_given_it():
    family = given_terms(2, ["p1**2", "p2**2", f"1/{R}"])
    p = np.array([0.50003, 0.49998, -1.0001])
    covariance = np.diag([3e-5, 3e-5, 1e-4]) ** 2
    found = restricted(family, LawNumbers(p, covariance, 3_000), states(2), ())
    assert any(text.startswith("rotation in") for text in found.symmetries)
    assert found.numbers[0] == pytest.approx(found.numbers[1], rel=1e-14)
    assert found.numbers[0] == pytest.approx(p[:2].mean(), rel=1e-12)
    assert found.covariance[0, 0] == pytest.approx(0.5 * 3e-5**2, rel=1e-9)
    assert found.numbers[2] == p[2]


def test_numbers_that_their_errors_tell_apart_are_left_so():
    family = given_terms(2, ["p1**2", "p2**2", f"1/{R}"])
    p, covariance = np.array([0.5003, 0.4998, -1.0001]), np.diag([3e-5, 3e-5, 1e-4]) ** 2
    found = restricted(family, LawNumbers(p, covariance, 3_000), states(2), ())
    assert not any("rotation" in text for text in found.symmetries)
    np.testing.assert_array_equal(found.numbers, p)


@pytest.mark.slow
def test_diffrax_takes_the_vector_field_of_a_law():
    rng = np.random.default_rng(0)
    z0 = rng.uniform(-1, 1, (60, 2))
    cos, sin = np.cos(0.3), np.sin(0.3)
    z1 = np.stack([cos * z0[:, 0] + sin * z0[:, 1], cos * z0[:, 1] - sin * z0[:, 0]], axis=1)
    law = gfnn.fit(gfnn.Pairs(z0, z1, 0.3), learn="hamiltonian", tolerance=1e-9).hamiltonian
    solved = diffrax.diffeqsolve(
        diffrax.ODETerm(law.vector_field),
        diffrax.Dopri8(),
        0.0,
        2.0,
        0.1,
        jnp.array([1.0, 0.0]),
        stepsize_controller=diffrax.PIDController(rtol=1e-10, atol=1e-10),
    )
    np.testing.assert_allclose(solved.ys[-1], [np.cos(2.0), -np.sin(2.0)], atol=1e-8)
    assert law._repr_latex_() == "$H = 0.5 p_{1}^{2} + 0.5 q_{1}^{2}$"
    assert any("q1² + p1² conserved" in text for text in law.symmetries)
