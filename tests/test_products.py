"""Chebyshev × Fourier products: the formula, parity, counts of terms, inputs."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gfnn_jax.families.inputs import Inputs, box_inputs, variable_signs
from gfnn_jax.families.products import Products, chebyshev, fourier, number_of_terms


@pytest.mark.parametrize("degree", range(9))
def test_chebyshev_and_fourier_agree_with_their_definitions(degree):
    x = np.array([[-0.9, 0.0, 0.3], [1.0, 1.7, -0.2]])
    k = np.arange(degree + 1)
    exact = np.polynomial.chebyshev.chebvander(x, degree)
    np.testing.assert_allclose(chebyshev(x, degree), exact, rtol=1e-12, atol=1e-12)
    waves = x[..., None] * k
    exact = np.concatenate([np.cos(waves), np.sin(waves)[..., 1:]], axis=-1)
    np.testing.assert_allclose(fourier(x, degree), exact, rtol=1e-12, atol=1e-13)


def features(w):
    q, p = w[:2], w[2:]
    return jnp.stack([q @ q, p @ p, q @ p])


DATA = np.random.default_rng(0).uniform(-1.3, 0.9, (300, 4))
CASES = {
    "plain": box_inputs(DATA),
    "angle": box_inputs(DATA, angles=(0,)),
    "angles and cyclic": box_inputs(DATA, angles=(0, 3), cyclic=(1,)),
    "one variable": box_inputs(DATA, cyclic=(0, 1, 2)),
    "features": box_inputs(DATA, features=features),
}
REVERSOR = (1, 1, -1, -1)


def family_of(case, degree=4, even=False):
    inputs = CASES[case]
    if even:
        inputs = box_inputs(
            DATA,
            angles=(0, 3) if "angle" in case else (),
            features=inputs.features,
            reversor=REVERSOR,
        )
    signs = variable_signs(inputs, REVERSOR, DATA) if even else None
    return Products(inputs, degree, signs)


def naive(family, coefficients, w):
    """Σ c_j times the product of its one-dimensional functions, as the definition says."""
    x, (a, b) = family.inputs(w), family.basis.halves
    row, column = family.basis.terms.T
    which = np.concatenate([a.indices[row], b.indices[column]], axis=1)
    k, product = np.arange(family.degree + 1), coefficients
    for j, column in enumerate(which.T):
        if j in family.inputs.angles:
            functions = np.concatenate([np.cos(k * x[j]), np.sin(k * x[j])[1:]])
        else:
            functions = np.polynomial.chebyshev.chebvander(x[j], family.degree)[0]
        product = product * functions[column]
    return np.sum(product)


@pytest.mark.parametrize("even", [False, True], ids=["", "even"])
@pytest.mark.parametrize("case", ["plain", "angles and cyclic", "features"])
def test_value_is_that_of_the_formula(case, even):
    family = family_of(case, degree=3, even=even)
    c = np.random.default_rng(1).standard_normal(family.num_parameters)
    found = family(family.unflatten(c), DATA[:5])
    expected = [naive(family, c, w) for w in DATA[:5]]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_terms_by_count():
    """All polynomials of degree 1 to 8 in four variables: 12 choose 4, less the constant."""
    assert family_of("plain", 8).num_parameters == math.comb(12, 4) - 1 == 494
    assert family_of("plain", 8, even=True).num_parameters == 254
    assert family_of("features", 5).num_parameters == math.comb(8, 3) - 1
    assert family_of("one variable", 6).num_parameters == 6
    # One angle and three others, degree 2: 1, cos, sin, cos 2, sin 2 times what is left of it.
    assert family_of("angle", 2).num_parameters == math.comb(5, 3) + 2 * (4 + 1) - 1


@pytest.mark.parametrize("case", CASES)
def test_a_smaller_degree_has_the_first_terms_of_a_larger(case):
    """Check the order of the terms, by which one factor of all rows serves every size."""
    smaller, larger = family_of(case, 2), family_of(case, 3)
    assert (np.diff(larger.basis.term_orders) >= 0).all()
    assert smaller.num_parameters == np.sum(larger.basis.term_orders <= 2)
    few, many = smaller.term_gradients(DATA[:3]), larger.term_gradients(DATA[:3])
    np.testing.assert_allclose(many[..., : smaller.num_parameters], few, rtol=0, atol=1e-13)


@pytest.mark.parametrize("case", ["plain", "angles and cyclic", "features"])
def test_even_families_are_even_and_others_are_not(case):
    rng = np.random.default_rng(3)
    w = rng.uniform(-1, 1, (20, 4))
    for even in (True, False):
        family = family_of(case, even=even)
        c = family.unflatten(rng.standard_normal(family.num_parameters))
        difference = np.abs(family(c, w) - family(c, w * np.array(REVERSOR, float))).max()
        assert difference < 1e-13 if even else difference > 0.1


def test_cyclic_coordinate_has_no_gradient_at_all():
    family = family_of("angles and cyclic")
    c = family.unflatten(np.random.default_rng(4).standard_normal(family.num_parameters))
    gradient, hessian = family.gradient_and_hessian(c, DATA[0])
    np.testing.assert_array_equal(gradient == 0, [False, True, False, False])
    assert (hessian[1] == 0).all()
    assert (hessian[:, 1] == 0).all()


def test_angles_have_period_two_pi_and_are_not_scaled():
    family = family_of("angles and cyclic")
    c = family.unflatten(np.random.default_rng(5).standard_normal(family.num_parameters))
    turned = DATA[0] + np.array([6 * np.pi, 0, 0, -2 * np.pi])
    np.testing.assert_allclose(family(c, turned), family(c, DATA[0]), rtol=1e-12)


# Inputs.


def test_box_holds_the_data():
    inputs = box_inputs(DATA)
    x = inputs(DATA)
    assert 0.999 < np.abs(x).max() < 1
    np.testing.assert_allclose(x.max(axis=0), -x.min(axis=0), rtol=1e-12)
    assert isinstance(inputs, Inputs)
    assert inputs.num_variables == 4


def test_box_of_flipped_coordinates_is_symmetric_and_others_fit_tight():
    inputs = box_inputs(DATA, reversor=REVERSOR)
    np.testing.assert_array_equal(inputs.centre[2:], 0.0)
    np.testing.assert_allclose(inputs.scale[2:], np.abs(DATA[:, 2:]).max(axis=0), rtol=1e-8)
    np.testing.assert_array_equal(inputs.centre[:2], box_inputs(DATA).centre[:2])


def test_constant_variable_does_not_divide_by_zero():
    data = DATA.copy()
    data[:, 1], data[:, 2] = 5.0, 0.0
    assert np.isfinite(box_inputs(data)(data)).all()


def test_feature_without_parity_is_refused():
    inputs = box_inputs(DATA, features=lambda w: jnp.stack([w[0] + w[2], w[1]]))
    with pytest.raises(ValueError, match=r"feature 0"):
        variable_signs(inputs, REVERSOR, DATA)
    even = box_inputs(DATA, features=features)
    assert variable_signs(even, REVERSOR, DATA) == (1, 1, -1)


def test_features_of_many_states_are_those_of_each(compilations):
    """Whatever the number of states: they are compiled for a few sizes."""
    inputs = CASES["features"]
    w = np.random.default_rng(6).uniform(-1, 1, (5_000, 4))
    inputs(w[:70])
    with compilations() as found:
        few = inputs(w[:100])
    assert found.count == 0
    many = inputs(w)
    q, p = w[:, :2], w[:, 2:]
    raw = np.stack([np.sum(q * q, 1), np.sum(p * p, 1), np.sum(q * p, 1)], axis=1)
    np.testing.assert_allclose(many * inputs.scale + inputs.centre, raw, rtol=0, atol=1e-14)
    np.testing.assert_allclose(few, many[:100], rtol=0, atol=1e-14)


@pytest.mark.parametrize("even", [False, True])
@pytest.mark.parametrize("case", list(CASES))
def test_terms_are_counted_without_making_them(case, even):
    if even and "cyclic" in case:
        pytest.skip("reversors of cyclic coordinates are the inputs' tests")
    for degree in (2, 5):
        family = family_of(case, degree, even)
        counted = number_of_terms(family.inputs.is_angle, degree, family.signs)
        assert counted == family.num_parameters


# Args beside the state.


@pytest.mark.slow
@pytest.mark.parametrize(("width", "num_args"), [(4, 1), (2, 1), (2, 3)])
def test_products_of_state_and_args_have_the_gradients_of_jax(width, num_args):
    """Compare with JAX, also where one half of the variables is args alone."""
    rng = np.random.default_rng(3)
    w, args = rng.uniform(-2, 1, (6, width)), rng.uniform(0.1, 0.4, (6, num_args))
    family = Products(box_inputs(w, args=args), 3)
    assert family.num_parameters == family.terms_of(3)
    assert family.terms_of(3) == math.comb(3 + width + num_args, 3) - math.comb(3 + num_args, 3)
    c = rng.standard_normal(family.num_parameters)
    params = family.unflatten(c)
    gradient, hessian = family.gradient_and_hessian(params, w, args)
    value = partial(family, params)
    slopes, bends = (
        jax.jit(jax.vmap(derivative(value)))(w, args) for derivative in (jax.grad, jax.hessian)
    )
    np.testing.assert_allclose(gradient, slopes, rtol=0, atol=1e-11)
    np.testing.assert_allclose(hessian, bends, rtol=0, atol=1e-10)
    np.testing.assert_allclose(family.gradient(params, w, args), gradient, rtol=0, atol=1e-12)
    np.testing.assert_allclose(family.term_gradients(w, args) @ c, gradient, rtol=0, atol=1e-11)


def test_every_product_of_state_and_args_moves_the_state():
    rng = np.random.default_rng(4)
    w, args = rng.uniform(-1, 1, (200, 2)), rng.uniform(-1, 1, (200, 1))
    family = Products(box_inputs(w, args=args), 5)
    columns = family.term_gradients(w, args).reshape(-1, family.num_parameters)
    assert np.linalg.matrix_rank(columns) == family.num_parameters
