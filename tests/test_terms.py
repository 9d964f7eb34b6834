"""Terms as formulas are written: parsed text, traced functions, derivatives, refusals."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy

from gfnn_jax.errors import InputError
from gfnn_jax.families import Family, LinearFamily
from gfnn_jax.families.expressions import parse, to_text
from gfnn_jax.families.modes import modes
from gfnn_jax.families.terms import Terms, given_terms, joined, polynomial_terms
from gfnn_jax.families.text import Term, plain
from gfnn_jax.families.traced import traced
from gfnn_jax.models.hamiltonians.fitted_law import formula
from gfnn_jax.models.lagrangians.learned_law import Hamiltonian
from gfnn_jax.scenes import SCENES
from gfnn_jax.scenes.systems import pcr3bp_features as features

RNG = np.random.default_rng(0)
W = RNG.uniform(0.3, 0.9, (5, 2, 4))
FAMILIES = {
    "polynomials": polynomial_terms(2, 4),
    "modes": modes(2, (0, 1), ("p1", "p2", "1/(2 + cos(q1))"), 1, 1),
    "features": polynomial_terms(2, 2, features=features),
    "given": given_terms(
        2, ["1/(1 + sin(q1 - q2)**2)", "exp(-q1**2)*tanh(p2)", "log(q1**2 + 1)/sqrt(p1**2 + 2)"]
    ),
}


@pytest.mark.parametrize("name", FAMILIES)
def test_derivatives_are_those_of_jax_in_both_namespaces(name):
    family = FAMILIES[name]
    assert isinstance(family, Family)
    assert isinstance(family, LinearFamily)
    c = RNG.standard_normal(family.num_parameters)
    one = partial(family, jnp.asarray(c))
    w = jnp.asarray(W)
    value, gradient, hessian, *by_jax = jax.jit(
        lambda w: (
            family.value(jnp.asarray(c), w),
            jax.grad(lambda w: one(w).sum())(w),
            jax.vmap(jax.vmap(jax.hessian(one)))(w),
            *family.gradient_and_hessian(jnp.asarray(c), w),
        )
    )(w)
    for found in (family.gradient_and_hessian(c, W), by_jax):
        np.testing.assert_allclose(found[0], gradient, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(found[1], hessian, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(family.gradient(c, W), gradient, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(family.term_gradients(W) @ c, gradient, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(family.value(c, W), value, rtol=1e-11)


def test_many_terms_are_one_product_of_matrices():
    family = polynomial_terms(2, 6)
    c = RNG.standard_normal(family.num_parameters)
    by_jax = jax.jit(family.gradient_and_hessian)(jnp.asarray(c), jnp.asarray(W))
    for found, expected in zip(by_jax, family.gradient_and_hessian(c, W), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(family.term_gradients(W) @ c, by_jax[0], rtol=1e-11, atol=1e-11)


def test_numbers_of_terms():
    assert polynomial_terms(2, 3).num_parameters == 34
    assert polynomial_terms(2, 4).num_parameters == 69
    assert "q2" not in " ".join(polynomial_terms(2, 2, cyclic=(1,)).term_names)


def test_a_reversor_leaves_the_even_terms():
    family = polynomial_terms(2, 2, reversor=(1, 1, -1, -1))
    z = RNG.uniform(-1, 1, (6, 4))
    c = RNG.standard_normal(family.num_parameters)
    np.testing.assert_allclose(family.value(c, z), family.value(c, z * [1, 1, -1, -1]), rtol=1e-14)
    assert polynomial_terms(2, 2, features=features, reversor=(1, -1, -1, 1)).num_parameters == 17


@pytest.mark.parametrize("name", ["pcr3bp", "henon-heiles-regular", "two-body"])
def test_a_scenes_hamiltonian_is_traced_to_text(name):
    """Trace a Python function to text, and read it back as a function of the same values."""
    scene = SCENES[name]()
    (tree,) = traced(scene.hamiltonian, scene.dim)
    again = parse(to_text(tree, scene.dim), scene.dim)
    family = Terms(scene.dim, (to_text(again, scene.dim),), ((1,),))
    z = W.reshape(-1, 4)
    expected = jax.vmap(scene.hamiltonian)(jnp.asarray(z))
    np.testing.assert_allclose(family.value(np.ones(1), z), expected, rtol=1e-14)


@pytest.mark.parametrize(
    "function",
    [
        lambda z: z[0] ** 2 / (1 + z[3] ** 2),
        lambda z: jnp.sum(z[:2] * z[2:]) ** 1.5,
        lambda z: jnp.linalg.norm(z[:2]) ** -3,
        lambda z: jnp.stack([z @ z, jnp.exp(-z[0]) * jnp.cos(z[1] - z[2])]),
        lambda z: jnp.concatenate([z[::-1], z[jnp.array([0, 2])] - 1]) * 2.0,
    ],
)
def test_functions_are_traced(function):
    family = given_terms(2, [function])
    count = family.num_parameters
    z = W.reshape(-1, 4)
    found = np.stack([family.value(np.eye(count)[j], z) for j in range(count)], axis=-1)
    expected = jax.vmap(function)(jnp.asarray(z)).reshape(len(z), -1)
    np.testing.assert_allclose(found, expected, rtol=1e-13)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("__import__('os')", "a call of '__import__'"),
        ("q3", "the name 'q3'"),
        ("9.0**9**9*q1", "is no expression"),
        ("q1 + " * 4_000 + "q1", "at most"),
        ("-" * 200 + "q1", "levels"),
    ],
)
def test_other_text_is_refused_in_one_line(text, says):
    with pytest.raises(InputError, match=says) as caught:
        given_terms(2, [text])
    assert "\n" not in str(caught.value)


def test_a_function_that_has_no_formula_is_refused():
    with pytest.raises(InputError, match="has no formula here"):
        given_terms(1, [lambda z: jnp.maximum(z[0], z[1])])


def test_one_degree_of_freedom_has_short_names():
    assert given_terms(1, ["p**2 - cos(q)"]).variables == ("p1**2 - cos(q1)",)


def test_terms_are_joined_and_taken():
    own = given_terms(2, ["1/q1", "p1**2/q1"])
    both = joined(own, polynomial_terms(2, 2))
    assert both.num_parameters == 2 + 14
    some = both.take([0, 3])
    assert some.term_names == (both.term_names[0], both.term_names[3])
    assert set(some.variables) < set(both.variables)
    assert hash(some) == hash(both.take([0, 3]))  # static: what is compiled for one serves both


@pytest.mark.parametrize(
    ("shown", "code"),
    [
        ("0.5 q1² + 0.25 p1⁴ − cos(q1)", "0.5*q1**2 + 0.25*p1**4 - cos(q1)"),
        ("-2.5e-05 p1² (1/(2 + cos(q1)))²", "-2.5e-05*p1**2*(1/(2 + cos(q1)))**2"),
        ("0.5 (q1**2 - q2**2) - 2 sin (q1 - q2)", "0.5*(q1**2 - q2**2) - 2*sin(q1 - q2)"),
        ("q1 ** 2 * p2", "q1**2*p2"),
    ],
)
def test_a_formula_is_read_as_it_is_shown(shown, code):
    assert parse(shown, 2) == parse(code, 2)


def test_what_a_fit_shows_can_be_given_to_it_and_to_sympy():
    family = given_terms(2, ["q1² p2", "1/sqrt(q1**2 + q2**2)", "0.5 (p1² + p2²)"])
    shown = formula([Term(t, c, 0.0) for t, c in zip(family.term_names, (2, -1, 3), strict=True)])
    value = family.value(np.array([2.0, -1.0, 3.0]), W)
    again = given_terms(2, [shown])
    np.testing.assert_allclose(again.value(np.ones(1), W), value, rtol=1e-14)
    by_sympy = sympy.lambdify(sympy.symbols("q1 q2 p1 p2"), sympy.sympify(plain(shown)))
    np.testing.assert_allclose(by_sympy(*np.moveaxis(W, -1, 0)), value, rtol=1e-14)


def test_h_of_a_law_is_whole_for_sympy():
    """½ pᵀM⁻¹p + V at one state, of an M that depends on the angles."""
    listed = (("M11: 1", 1.0), ("M12: cos(a - b)", 0.4), ("M22: 1", 0.3), ("cos(a)", -2.0))
    law = Hamiltonian(tuple(Term(term, c, 0.0) for term, c in listed))
    state = {"a": 0.3, "b": -1.1, "p1": 0.7, "p2": -0.2}
    p, mixed = np.array([0.7, -0.2]), 0.4 * np.cos(1.4)
    expected = p @ np.linalg.solve([[1.0, mixed], [mixed, 0.3]], p) / 2 - 2 * np.cos(0.3)
    assert float(law.sympy().subs(state)) == pytest.approx(expected, rel=1e-14)
    assert r"\cos{\left(a \right)}" in law.latex()
