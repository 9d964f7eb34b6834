"""H of sites and bodies as text: read back by the package, and by sympy."""

import numpy as np
import pytest
import sympy

from gfnn_jax.errors import InputError
from gfnn_jax.families.expressions import parse, window_terms
from gfnn_jax.families.sums import body_terms, site_terms
from gfnn_jax.families.terms import given_terms
from gfnn_jax.models.hamiltonians.fitted_law import Term, as_code

RNG = np.random.default_rng(0)
FAMILIES = {
    **{ends: site_terms(4, ends, 2, 2) for ends in ("ring", "free", "fixed")},
    **{f"{ends} of two": site_terms(6, ends, 1, 2, fields=2) for ends in ("ring", "fixed")},
    "functions": site_terms(4, "fixed", 0, 0, ("cos(q2 - q1)", "p1**2", "exp(-q1)")),
    "bodies": body_terms(3, 2, (-1, 2)),
    "species": body_terms(3, 3, (-1,), species="abb"),
}


def by_sympy(text, dim, z):
    """Value at z (2d,) of what sympy reads; coordinates of the walls are 0."""
    q, p = sympy.Function("q"), sympy.Function("p")
    known = dict.fromkeys((f(k) for f in (q, p) for k in (-1, 0, dim + 1, dim + 2)), 0)
    for k in range(dim):
        for f, value in ((q, z[k]), (p, z[dim + k])):
            known |= {f(k + 1): value, sympy.Symbol(f"{f}{k + 1}"): value}
    return float(sympy.sympify(text).doit().xreplace(known))


@pytest.mark.parametrize("name", FAMILIES)
def test_the_formula_of_a_structure_is_read_back(name):
    family = FAMILIES[name]
    coefficients = RNG.normal(size=family.num_parameters).round(3)
    terms = [Term(n, c, 0.0) for n, c in zip(family.term_names, coefficients, strict=True)]
    text, z = as_code(family, terms), RNG.uniform(0.2, 1.0, (2, 2 * family.dim))
    expected = np.asarray(family.value(coefficients, z))
    found = given_terms(family.dim, (text,))
    np.testing.assert_allclose(found.value(np.ones(1), z), expected, rtol=1e-12)
    assert by_sympy(text, family.dim, z[0]) == pytest.approx(expected[0], rel=1e-9)


def test_a_structure_takes_the_summands():
    text = "Sum(p(i)**2/2, (i, 1, 9)) + Sum(cos(q(Mod(i, 9) + 1) - q(i)), (i, 1, 9))"
    assert window_terms(text) == ["p1 ** 2 / 2", "cos(q2 - q1)"]
    assert window_terms("q1 + exp(q2)") == ["q1 + exp(q2)"]
    z = RNG.normal(size=(3, 18))
    family = site_terms(9, "ring", 0, 0, (text,))
    whole = given_terms(9, (text,))
    np.testing.assert_allclose(family.value(np.ones(2), z), whole.value(np.ones(1), z), rtol=1e-12)


def test_a_sum_of_many_addends():
    text = " - ".join(f"{k}*q1**2" for k in range(1, 200))
    assert given_terms(1, (text,)).value(np.ones(1), np.array([2.0, 0.0])) == 4 * (2 - 199 * 100)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("Sum(p(i)**2, (i, 1, 19))", r"expected p\(1\) to p\(4\), got p\(7\)"),
        ("Sum(p(i)**2, (i, 4, 1))", "1 to 10,000 sites, got 0"),
    ],
)
def test_a_sum_that_cannot_be_read(text, words):
    with pytest.raises(InputError, match=words):
        parse(text, 4)
