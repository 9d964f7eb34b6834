"""Chebyshev × Fourier products: derivatives, parity, counts of terms, inputs."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gfnn_jax.families.inputs import Inputs, box_inputs, variable_signs
from gfnn_jax.families.products import Products, chebyshev, fourier


@pytest.mark.parametrize("degree", range(9))
def test_chebyshev_and_fourier_agree_with_their_definitions(degree):
    x = np.array([-0.9, 0.0, 0.3, 1.0, 1.7])
    for order, table in enumerate(chebyshev(jnp.asarray(x), degree)):
        assert table.shape == (degree + 1, 5)
        for k, row in enumerate(table):
            exact = np.polynomial.Chebyshev.basis(k).deriv(order)(x)
            np.testing.assert_allclose(row, exact, rtol=1e-12, atol=1e-12)
    harmonics = np.arange(degree + 1)[:, None]
    for order, table in enumerate(fourier(jnp.asarray(x), degree)):
        assert table.shape == (2 * degree + 1, 5)
        turned = harmonics * x + order * np.pi / 2  # each derivative is a quarter turn
        size = harmonics**order
        exact = np.concatenate([size * np.cos(turned), (size * np.sin(turned))[1:]])
        np.testing.assert_allclose(table, exact, rtol=1e-12, atol=1e-13 * (1 + degree) ** order)


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
    x = family.inputs(w)
    a, b = family.basis.halves
    row, column = family.basis.terms.T
    which = np.concatenate([a.indices[row], b.indices[column]], axis=1)
    degree, product = family.degree, coefficients
    for j, column in enumerate(which.T):
        if j in family.inputs.angles:
            waves = [jnp.cos(k * x[j]) for k in range(degree + 1)]
            functions = waves + [jnp.sin(k * x[j]) for k in range(1, degree + 1)]
        else:
            powers = [
                np.polynomial.chebyshev.cheb2poly(np.eye(k + 1)[k]) for k in range(degree + 1)
            ]
            functions = [jnp.polyval(jnp.asarray(c[::-1].copy()), x[j]) for c in powers]
        product = product * jnp.stack(functions)[column]
    return jnp.sum(product)


def all_derivatives(scalar):
    """Value, gradient, Hessian and third derivative in w, gradient in the parameters, mixed."""
    gradient = jax.grad(scalar, argnums=1)
    hessian = jax.jacfwd(gradient, argnums=1)
    return jax.jit(
        lambda params, w: (
            scalar(params, w),
            gradient(params, w),
            hessian(params, w),
            jax.jacfwd(hessian, argnums=1)(params, w),
            jax.grad(scalar)(params, w),
            jax.jacrev(gradient)(params, w),
        )
    )


@pytest.mark.parametrize("even", [False, True], ids=["", "even"])
@pytest.mark.parametrize("case", ["plain", "angles and cyclic", "features"])
def test_every_derivative_agrees_with_autodiff_of_the_formula(case, even):
    family = family_of(case, degree=3, even=even)
    rng = np.random.default_rng(1)
    c = jnp.asarray(rng.standard_normal(family.num_parameters))
    w = jnp.asarray(rng.uniform(-1, 1, 4))
    found = all_derivatives(lambda c, w: family(family.unflatten(c), w))(c, w)
    expected = all_derivatives(functools.partial(naive, family))(c, w)
    for one, other in zip(found, expected, strict=True):
        size = 1 + np.abs(other).max()
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12 * size)


@pytest.mark.parametrize("case", CASES)
def test_gradient_features_are_the_gradient_of_each_term(case):
    family = family_of(case)
    c = jnp.asarray(np.random.default_rng(2).standard_normal(family.num_parameters))
    w = jnp.asarray(DATA[0])
    rows = jax.jit(family.gradient_features)(w)
    gradient = jax.jit(jax.grad(family, argnums=1))(family.unflatten(c), w)
    assert rows.shape == (4, family.num_parameters)
    np.testing.assert_allclose(rows @ c, gradient, rtol=0, atol=1e-12)


def test_terms_by_count():
    """All polynomials of degree 1 to 8 in four variables: 12 choose 4, less the constant."""
    assert family_of("plain", 8).num_parameters == math.comb(12, 4) - 1 == 494
    assert family_of("plain", 8, even=True).num_parameters == 254
    assert family_of("features", 5).num_parameters == math.comb(8, 3) - 1
    assert family_of("one variable", 6).num_parameters == 6
    # One angle and two others, degree 2: 1, cos, sin, cos 2, sin 2 times 1 + 2 + 3 up to degree.
    assert family_of("angle", 2).num_parameters == math.comb(5, 3) + 2 * (4 + 1) - 1
    for case in CASES:
        smaller, larger = family_of(case, 2), family_of(case, 3)
        order = [a + b for a, b in _orders(larger)]
        assert order == sorted(order)
        assert smaller.num_parameters == sum(o <= 2 for o in order)


def _orders(family):
    a, b = family.basis.halves
    return [(a.orders[i], b.orders[j]) for i, j in family.basis.terms]


@pytest.mark.parametrize("case", ["plain", "angles and cyclic", "features"])
def test_even_families_are_even_and_others_are_not(case):
    rng = np.random.default_rng(3)
    w = jnp.asarray(rng.uniform(-1, 1, (20, 4)))
    flipped = w * jnp.asarray(REVERSOR, float)[None]
    for even in (True, False):
        family = family_of(case, even=even)
        c = family.unflatten(jnp.asarray(rng.standard_normal(family.num_parameters)))
        values = jax.jit(jax.vmap(functools.partial(family, c)))
        difference = np.abs(values(w) - values(flipped)).max()
        assert difference < 1e-13 if even else difference > 0.1


def test_cyclic_coordinate_has_no_gradient_at_all():
    family = family_of("angles and cyclic")
    c = family.unflatten(
        jnp.asarray(np.random.default_rng(4).standard_normal(family.num_parameters))
    )
    gradient = jax.grad(family, argnums=1)(c, jnp.asarray(DATA[0]))
    assert gradient[1] == 0.0
    assert np.abs(gradient).min(where=np.arange(4) != 1, initial=np.inf) > 0


def test_angles_have_period_two_pi_and_are_not_scaled():
    family = family_of("angles and cyclic")
    c = family.unflatten(
        jnp.asarray(np.random.default_rng(5).standard_normal(family.num_parameters))
    )
    w = jnp.asarray(DATA[0])
    turned = w.at[0].add(6 * jnp.pi).at[3].add(-2 * jnp.pi)
    np.testing.assert_allclose(family(c, turned), family(c, w), rtol=1e-12)


def test_families_are_hashable_constants_and_compile_once():
    traces = []

    @functools.partial(jax.jit, static_argnums=0)
    def value(family, c, w):
        traces.append(1)
        return family(c, w)

    for _ in range(2):
        family = Products(box_inputs(DATA), 3)  # equal, not identical
        value(family, family.unflatten(jnp.ones(family.num_parameters)), jnp.ones(4))
    assert len(traces) == 1
    assert Products(box_inputs(DATA), 4) != family


def test_float32_stays_float32_and_dots_are_not_tf32():
    family = family_of("angles and cyclic")
    c = family.unflatten(jnp.ones(family.num_parameters, jnp.float32))
    w = jnp.ones(4, jnp.float32)
    gradient = jax.grad(family, argnums=1)
    assert gradient(c, w).dtype == jnp.float32
    hessian = jax.jacfwd(gradient, argnums=1)
    lowered = jax.jit(lambda c, w: (family(c, w), gradient(c, w), hessian(c, w))).lower(c, w)
    dots = [line for line in lowered.as_text().splitlines() if "stablehlo.dot_general" in line]
    assert len(dots) > 5
    assert all("precision = [HIGHEST, HIGHEST]" in line for line in dots)


# Inputs.


def test_box_holds_the_data():
    inputs = box_inputs(DATA)
    x = np.asarray(jax.vmap(inputs)(jnp.asarray(DATA)))
    assert 0.999 < np.abs(x).max() < 1
    np.testing.assert_allclose(x.max(axis=0), -x.min(axis=0), rtol=1e-12)
    assert isinstance(inputs, Inputs)
    assert inputs.num_variables == 4


def test_box_of_flipped_coordinates_is_symmetric_and_others_fit_tight():
    inputs = box_inputs(DATA, reversor=REVERSOR)
    assert inputs.centre[2:] == (0.0, 0.0)
    np.testing.assert_allclose(inputs.scale[2:], np.abs(DATA[:, 2:]).max(axis=0), rtol=1e-8)
    assert inputs.centre[:2] == box_inputs(DATA).centre[:2]


def test_constant_variable_does_not_divide_by_zero():
    data = DATA.copy()
    data[:, 1], data[:, 2] = 5.0, 0.0
    x = np.asarray(jax.vmap(box_inputs(data))(jnp.asarray(data)))
    assert np.isfinite(x).all()


def test_feature_without_parity_is_refused():
    inputs = box_inputs(DATA, features=lambda w: jnp.stack([w[0] + w[2], w[1]]))
    with pytest.raises(ValueError, match="feature 0 is neither"):
        variable_signs(inputs, REVERSOR, DATA)
    even = box_inputs(DATA, features=features)
    assert variable_signs(even, REVERSOR, DATA) == (1, 1, -1)
