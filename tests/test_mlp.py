"""The MLP family: the network by hand, scaling, angles, dtypes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gfnn_jax.families.inputs import Inputs, box_inputs
from gfnn_jax.families.mlp import (
    ACTIVATIONS,
    PAPER_HIDDEN,
    PAPER_HIDDEN_STANDARD_MAP,
    Mlp,
    amplitude_of,
)

DATA = np.random.default_rng(0).uniform(-1, 1, (50, 4)) * [1.0, 20.0, 0.03, 2.0] + [5.0, 0, 0, -1]
PLAIN = Mlp(box_inputs(DATA), (7, 5), "tanh", amplitude=3.0)
W = DATA[7]
KEY = jax.random.key(1)
value_and_gradient = jax.jit(
    lambda family, params, w: (family.value(params, w), family.gradient(params, w))
)


def initial(family, dtype=np.float64, key=KEY):
    return family.init(key, dtype)


def size(family):
    shapes = jax.eval_shape(lambda: initial(family))
    return sum(leaf.size for leaf in jax.tree.leaves(shapes))


def test_is_the_network_written_out():
    params = initial(PLAIN)
    x = (W - PLAIN.inputs.centre) / PLAIN.inputs.scale
    assert np.abs(x).max() <= 1
    layers = sorted(params.items())
    assert [dict(layer).keys() for _, layer in layers[:-1]] == [{"kernel", "bias"}] * 2
    for _, layer in layers[:-1]:
        x = np.tanh(x @ np.asarray(layer["kernel"]) + np.asarray(layer["bias"]))
    expected = 3.0 * (x @ np.asarray(layers[-1][1]["kernel"]))[0]
    np.testing.assert_allclose(value_and_gradient(PLAIN, params, W)[0], expected, rtol=1e-13)


def test_the_papers_shapes():
    inputs = Inputs((0, 1, 2, 3), (), 4, np.zeros(4), np.ones(4))
    paper = Mlp(inputs, PAPER_HIDDEN)
    assert PAPER_HIDDEN == (200, 100, 50, 20)
    assert PAPER_HIDDEN_STANDARD_MAP == (500, 500, 200, 20)
    assert paper.label == "mlp 200-100-50-20"
    assert paper.name == "mlp"
    # 4·200 + 200·100 + 100·50 + 50·20 + 20·1 weights, 370 biases
    assert paper.num_parameters == 27_190
    assert size(paper) == 27_190


@pytest.mark.parametrize("angles", [(), (0,), (0, 2)])
def test_counts_its_parameters(angles):
    family = Mlp(box_inputs(DATA, angles=angles), (6, 3))
    assert family.num_parameters == size(family)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("w_dtype", [jnp.float32, jnp.float64])
def test_parameters_decide_the_dtype(dtype, w_dtype):
    """The gradient comes in the dtype of w, computed in that of the parameters."""
    params = initial(PLAIN, dtype)
    assert {leaf.dtype for leaf in jax.tree.leaves(params)} == {jnp.dtype(dtype)}
    value, gradient = value_and_gradient(PLAIN, params, W.astype(w_dtype))
    assert value.dtype == dtype
    assert gradient.shape == (4,)
    assert gradient.dtype == w_dtype
    wide = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), params)
    exact = np.asarray(value_and_gradient(PLAIN, wide, W)[1])
    error = np.max(np.abs(np.asarray(gradient, np.float64) / exact - 1))
    assert error < (1e-4 if jnp.float32 in (dtype, w_dtype) else 1e-13)
    if dtype == jnp.float32:
        assert error > 1e-9  # it was not computed in float64


@pytest.mark.parametrize(
    "activation",
    [
        pytest.param(a, marks=() if a in ("gelu", "tanh") else pytest.mark.slow)
        for a in sorted(ACTIVATIONS)
    ],
)
def test_every_activation_is_smooth_enough_for_newton(activation):
    """The gradient and Hessian of S against finite differences."""
    family = dataclasses.replace(PLAIN, activation=activation)
    params, scale = initial(family), family.inputs.scale
    steps = 1e-5 * np.diag(scale)
    gradient, hessian = family.gradient_and_hessian(params, W)
    around = np.concatenate([W + steps, W - steps])
    value, slope = map(np.asarray, value_and_gradient(family, params, around))
    assert np.abs(hessian).max() > 0
    difference = (value[:4] - value[4:]) / 2e-5
    np.testing.assert_allclose(difference, gradient * scale, rtol=1e-7, atol=1e-8)
    curvature = (slope[:4] - slope[4:]) / 2e-5 * scale
    np.testing.assert_allclose(curvature, hessian * np.outer(scale, scale), rtol=1e-6, atol=1e-8)


def test_other_units_make_the_same_network():
    """Check that the units of the data are scaled away inside S."""
    units = np.array([1e3, 1e-4, 7.0, 0.2])
    there = dataclasses.replace(PLAIN, inputs=box_inputs(DATA * units))
    params = initial(PLAIN)
    value, gradient = value_and_gradient(there, params, W * units)
    expected, slope = value_and_gradient(PLAIN, params, W)
    np.testing.assert_allclose(value, expected, rtol=1e-12)
    np.testing.assert_allclose(gradient * units, slope, rtol=1e-10)


def test_an_angle_may_turn():
    family = Mlp(box_inputs(DATA, angles=(1,)), (9, 4))
    params = initial(family)
    turned = W + np.array([-3.0, 0.0, 1.0, 0.5])[:, None] * np.array([0, 2 * np.pi, 0, 0])
    value, slope = map(np.asarray, value_and_gradient(family, params, turned))
    np.testing.assert_allclose(value[[0, 2]], value[[1, 1]], rtol=1e-12)
    np.testing.assert_allclose(slope[[0, 2]], slope[[1, 1]], rtol=1e-10, atol=1e-13)
    assert abs(value[3] - value[1]) > 1e-3
    assert abs(slope[1, 1]) > 1e-6


def test_a_cyclic_coordinate_is_not_seen():
    family = Mlp(box_inputs(DATA, cyclic=(2,)), (9, 4))
    gradient = family.gradient(initial(family), W)
    np.testing.assert_array_equal(gradient == 0, [False, False, True, False])


def test_starts_from_its_key():
    first, again, other = initial(PLAIN), initial(PLAIN), initial(PLAIN, key=jax.random.key(2))
    same = jax.tree.map(np.array_equal, first, again)
    assert jax.tree.all(same)
    assert not jax.tree.all(jax.tree.map(np.array_equal, first, other))


def test_amplitude_is_the_size_of_the_scalar():
    """S = 5 sin(w₀/100): of size 5 whatever the units of w."""
    w = np.random.default_rng(3).uniform(-300, 300, (400, 2))
    target = np.stack([0.05 * np.cos(w[:, 0] / 100), np.zeros(400)], axis=-1)
    assert 2.5 < amplitude_of(w, target) < 10
    assert amplitude_of(w * 1e6, target / 1e6) == pytest.approx(amplitude_of(w, target))
    assert amplitude_of(w, 0 * target) == 1.0
