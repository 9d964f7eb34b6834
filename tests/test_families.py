"""Families: each in NumPy as in JAX, its closed derivatives those of ``jax.grad``."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gfnn_jax.families import Family, LinearFamily, as_family, from_function
from gfnn_jax.families.family import symmetric_gradient, symmetric_gradient_and_hessian
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.mlp import Mlp
from gfnn_jax.families.products import Products
from gfnn_jax.families.sines import Sines

DATA = np.random.default_rng(0).uniform(-1.3, 0.9, (300, 4))
W = DATA[:6].reshape(2, 3, 4)


def features(w):
    q, p = w[:2], w[2:]
    return jnp.stack([jnp.sum(q * q), jnp.sum(p * p), jnp.sum(q * p)])


INPUTS = {
    "plain": box_inputs(DATA),
    "angle": box_inputs(DATA, angles=(0,)),
    "angles and cyclic": box_inputs(DATA, angles=(0, 3), cyclic=(1,)),
    "one variable": box_inputs(DATA, cyclic=(0, 1, 2)),
    "features": box_inputs(DATA, features=features),
}


def quartic(params, w):
    """A user's own S of one state."""
    return params["a"] * (w @ w) ** 2 + jnp.sin(params["b"] @ w)


QUARTIC = {"a": np.float64(0.3), "b": np.array([1.0, -0.5, 0.2, 2.0])}


def case(kind, inputs):
    """A family with random parameters."""
    if kind == "from_function":
        return from_function(quartic), QUARTIC
    if kind == "mlp":
        family = Mlp(INPUTS[inputs], (4, 3), "tanh", 3.0)
        params = jax.tree.map(np.asarray, family.init(jax.random.key(0), np.float64))
        return family, jax.tree.map(lambda a: a + 0.1, params)
    family = Products(INPUTS[inputs], 3) if kind == "products" else Sines(INPUTS[inputs], 6)
    c = np.random.default_rng(1).standard_normal(family.num_parameters)
    return family, family.unflatten(c)


OTHERS = ("angles and cyclic", "features")
LINEAR = [(kind, inputs) for kind in ("products", "sines") for inputs in OTHERS]
LINEAR += [("products", "one variable")]
EVERY = [*LINEAR, ("mlp", "angles and cyclic"), ("from_function", "plain")]
HEAVY = [("mlp", "angles and cyclic"), ("products", "features")]


values = jax.jit(lambda family, params, w: (family(params, w), family.gradient(params, w)))
closed = jax.jit(lambda family, params, w: family.gradient_and_hessian(params, w))


@pytest.mark.parametrize(
    ("kind", "inputs"),
    [pytest.param(*case, marks=pytest.mark.slow if case in HEAVY else ()) for case in EVERY],
)
def test_derivatives_are_those_of_the_value_in_numpy_and_in_jax(kind, inputs):
    family, params = case(kind, inputs)
    assert isinstance(family, Family)
    gradient, hessian = family.gradient_and_hessian(params, W)
    assert isinstance(gradient, np.ndarray)
    assert isinstance(hessian, np.ndarray)
    assert np.abs(hessian).max() > 1e-3
    around = W[..., None, :] + 1e-5 * np.stack([np.eye(4), -np.eye(4)])[:, None, None]
    compiled = kind in ("mlp", "from_function")  # else by NumPy, as in fits
    value, slope = map(
        np.asarray, (values if compiled else values.__wrapped__)(family, params, around)
    )
    difference, curvature = ((a[0] - a[1]) / 2e-5 for a in (value, slope))
    size = 1 + np.abs(hessian).max()
    np.testing.assert_allclose(gradient, difference, rtol=0, atol=1e-7 * size)
    np.testing.assert_allclose(hessian, curvature, rtol=0, atol=1e-7 * size)
    np.testing.assert_allclose(hessian, np.swapaxes(hessian, -1, -2), rtol=0, atol=1e-12 * size)
    again = family.gradient(params, W)
    np.testing.assert_allclose(again, gradient, rtol=0, atol=1e-13 * size)
    for traced, eager in zip(closed(family, params, W), (gradient, hessian), strict=True):
        np.testing.assert_allclose(traced, eager, rtol=0, atol=1e-12 * size)


@jax.jit
def automatic(family, params, w):
    """Derivatives of the value by JAX at the states w (B, 4)."""
    over = functools.partial(jax.vmap, in_axes=(None, 0))
    return (
        over(jax.grad(family, argnums=1))(params, w),
        over(jax.hessian(family, argnums=1))(params, w),
    )


@pytest.mark.parametrize(("kind", "inputs"), [("products", "features"), ("from_function", "plain")])
def test_closed_derivatives_are_those_of_autodiff(kind, inputs):
    family, params = case(kind, inputs)
    found = family.gradient_and_hessian(params, W[0])
    for one, other in zip(found, automatic(family, params, W[0]), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12 * (1 + np.abs(other).max()))


@pytest.mark.parametrize("kind", ["products", pytest.param("sines", marks=pytest.mark.slow)])
def test_the_gradients_derivative_is_symmetric_to_the_last_bit(kind):
    """Compare it with JAX's as well, to rounding, in w and in the parameters."""
    family, params = case(kind, "angles and cyclic")
    w, dot = jnp.asarray(W[0]), np.random.default_rng(2).normal(size=W[0].shape)

    def jacobian(gradient):
        return np.asarray(jax.jit(jax.vmap(jax.jacfwd(lambda v: gradient(params, v))))(w))

    found = jacobian(functools.partial(symmetric_gradient, family))
    np.testing.assert_array_equal(found, np.swapaxes(found, 1, 2))
    np.testing.assert_allclose(found, jacobian(family.gradient), rtol=1e-11, atol=1e-12)

    def along(gradient):
        """Derivatives of gradient and Hessian along a direction of all arguments."""
        dots = (jax.tree.map(lambda a: 0.1 * jnp.ones_like(a), params), dot)
        return jax.jit(lambda: jax.jvp(gradient, (params, w), dots)[1])()

    expected = along(family.gradient_and_hessian)
    found = along(functools.partial(symmetric_gradient_and_hessian, family))
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-11)


@pytest.mark.parametrize(("kind", "inputs"), [*LINEAR, ("from_function", "plain")])
def test_any_leading_axes(kind, inputs):
    family, params = case(kind, inputs)
    whole = family.gradient_and_hessian(params, W)
    for index in ((), (1,), (1, 2)):
        w = W[index]
        gradient, hessian = family.gradient_and_hessian(params, w)
        assert (gradient.shape, hessian.shape) == (w.shape, (*w.shape, 4))
        np.testing.assert_allclose(gradient, whole[0][index], rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(hessian, whole[1][index], rtol=1e-12, atol=1e-13)
        lazy = jax.eval_shape(family.gradient_and_hessian, params, w)
        assert [a.shape for a in lazy] == [gradient.shape, hessian.shape]


@pytest.mark.parametrize(("kind", "inputs"), LINEAR)
def test_terms_of_linear_families_add_up(kind, inputs):
    family, _ = case(kind, inputs)
    assert isinstance(family, LinearFamily)
    c = np.random.default_rng(2).standard_normal(family.num_parameters)
    terms = family.term_gradients(W)
    assert terms.shape == (2, 3, 4, family.num_parameters)
    expected = family.gradient(family.unflatten(c), W)
    np.testing.assert_allclose(terms @ c, expected, rtol=0, atol=1e-12 * (1 + np.abs(c).sum()))
    in_jax = jax.jit(family.term_gradients)(W)
    np.testing.assert_allclose(in_jax, terms, rtol=0, atol=1e-12 * (1 + np.abs(terms).max()))


@pytest.mark.parametrize(("kind", "inputs"), EVERY)
def test_float32_stays_float32_and_dots_are_not_tf32(kind, inputs):
    family, params = jax.tree.map(lambda a: np.asarray(a, np.float32), case(kind, inputs))
    w = W.astype(np.float32)
    lowered = jax.jit(lambda w: family.gradient_and_hessian(params, w)).lower(w)
    assert {a.dtype for a in jax.tree.leaves(lowered.out_info)} == {jnp.dtype(jnp.float32)}
    if kind == "from_function":
        return  # the user's own
    dots = [line for line in lowered.as_text().splitlines() if "stablehlo.dot_general" in line]
    assert dots
    assert all("precision = [HIGHEST, HIGHEST]" in line for line in dots)


def test_derivatives_in_the_parameters():
    """Check derivatives in the parameters of every kind of family."""
    for kind in ("products", "sines", "mlp", "from_function"):
        family, params = case(kind, "angle")

        @jax.jit
        def first(params, family=family):
            return jnp.sum(family.gradient(params, jnp.asarray(W))[..., 0])

        slope = jax.jit(jax.grad(first))(params)
        step = jax.tree.map(lambda a: 1e-6 * np.ones_like(a), params)
        above, below = (first(jax.tree.map(op, params, step)) for op in (np.add, np.subtract))
        along = sum(1e-6 * np.sum(a) for a in jax.tree.leaves(slope))
        np.testing.assert_allclose(0.5 * (above - below), along, rtol=1e-6, err_msg=kind)


def test_what_was_compiled_for_some_data_serves_others():
    """A family is a pytree: what it knows of the data are leaves, all else is static."""
    traces = []

    @jax.jit
    def value(family, params, w):
        traces.append(1)
        return family.gradient(params, w)

    for kind in (Products, Sines, functools.partial(Mlp, hidden=(5,))):
        traces.clear()
        for data in (DATA, 2 * DATA + 1):
            inputs = box_inputs(data, angles=(0,))
            family = kind(inputs) if kind.__class__ is functools.partial else kind(inputs, 3)
            params = (
                family.init(jax.random.key(0), np.float64)
                if isinstance(family, Mlp)
                else family.unflatten(np.ones(family.num_parameters))
            )
            value(family, params, W)
        assert len(traces) == 1


def test_a_plain_function_becomes_a_family_and_a_family_stays():
    family, _ = case("products", "plain")
    assert as_family(family) is family
    made = as_family(quartic)
    assert isinstance(made, Family)
    assert not isinstance(made, LinearFamily)
    np.testing.assert_allclose(made(QUARTIC, W)[0, 1], quartic(QUARTIC, W[0, 1]), rtol=1e-14)


def test_a_function_may_hold_numbers_and_take_args():
    """Check that the leaves of a callable pytree are leaves of the family."""

    def driven(strength, params, w, args):
        return strength * jnp.sum(w**2) + args * w[0]

    family = from_function(jax.tree_util.Partial(driven, np.float64(3.0)))
    assert jax.tree.leaves(family) == [3.0]
    gradient = family.gradient(None, W, np.float64(0.5))
    np.testing.assert_allclose(gradient, 6 * W + 0.5 * np.eye(4)[0], rtol=1e-14)


def test_no_states_have_no_features():
    for inputs in (INPUTS["features"], INPUTS["plain"]):
        assert inputs(np.zeros((0, 4))).shape == (0, inputs.num_variables)
