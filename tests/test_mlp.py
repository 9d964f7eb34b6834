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
W = jnp.asarray(DATA[7])
KEY = jax.random.key(1)
GRADIENT = jax.jit(jax.grad(PLAIN, argnums=1))


def size(family):
    shapes = jax.eval_shape(lambda: family.init(KEY, jnp.float32))
    return sum(leaf.size for leaf in jax.tree.leaves(shapes))


def test_is_the_network_written_out():
    params = PLAIN.init(KEY, jnp.float64)
    x = (np.asarray(W) - PLAIN.inputs.centre) / PLAIN.inputs.scale
    assert np.abs(x).max() <= 1
    layers = sorted(params.items())
    assert [dict(layer).keys() for _, layer in layers[:-1]] == [{"kernel", "bias"}] * 2
    for _, layer in layers[:-1]:
        x = np.tanh(x @ np.asarray(layer["kernel"]) + np.asarray(layer["bias"]))
    expected = 3.0 * (x @ np.asarray(layers[-1][1]["kernel"]))[0]
    np.testing.assert_allclose(PLAIN(params, W), expected, rtol=1e-13)


def test_the_papers_shapes():
    inputs = Inputs((0, 1, 2, 3), (), (0.0,) * 4, (1.0,) * 4)
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
    params = PLAIN.init(KEY, dtype)
    assert {leaf.dtype for leaf in jax.tree.leaves(params)} == {jnp.dtype(dtype)}
    assert PLAIN(params, W.astype(w_dtype)).dtype == dtype
    gradient = GRADIENT(params, W.astype(w_dtype))
    assert gradient.shape == (4,)
    assert gradient.dtype == w_dtype
    wide = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), params)
    exact = GRADIENT(wide, W)
    error = float(jnp.max(jnp.abs(gradient.astype(jnp.float64) / exact - 1)))
    assert error < (1e-4 if jnp.float32 in (dtype, w_dtype) else 1e-13)
    if dtype == jnp.float32:
        assert error > 1e-9  # it was not computed in float64


@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
def test_gradient_and_hessian_are_those_of_s(activation):
    """Against finite differences: every activation is smooth enough for Newton's iteration."""
    family = dataclasses.replace(PLAIN, activation=activation)
    params = family.init(KEY, jnp.float64)
    scale = jnp.asarray(family.inputs.scale)
    value_and_gradient = jax.jit(jax.vmap(jax.value_and_grad(family, 1), (None, 0)))
    hessian = jax.jit(jax.hessian(family, 1))(params, W)
    steps = 1e-5 * jnp.diag(scale)
    above, slope_above = value_and_gradient(params, W[None] + steps)
    below, slope_below = value_and_gradient(params, W[None] - steps)
    gradient = value_and_gradient(params, W[None])[1][0]
    assert float(jnp.max(jnp.abs(hessian))) > 0
    np.testing.assert_allclose((above - below) / 2e-5, gradient * scale, rtol=1e-7, atol=1e-8)
    units = jnp.outer(scale, scale)
    curvature = (slope_above - slope_below) / 2e-5 * scale[None]
    np.testing.assert_allclose(curvature, hessian * units, rtol=1e-6, atol=1e-8)


def test_other_units_make_the_same_network():
    """What the data are measured in is scaled away inside S."""
    units = np.array([1e3, 1e-4, 7.0, 0.2])
    there = dataclasses.replace(PLAIN, inputs=box_inputs(DATA * units))
    params = PLAIN.init(KEY, jnp.float64)
    np.testing.assert_allclose(there(params, W * units), PLAIN(params, W), rtol=1e-12)


def test_an_angle_may_turn():
    family = Mlp(box_inputs(DATA, angles=(1,)), (9, 4))
    params = family.init(KEY, jnp.float64)
    both = jax.jit(jax.value_and_grad(family, 1))
    value, gradient = both(params, W)
    for turns in (-3, 1):
        turned = W.at[1].add(2 * jnp.pi * turns)
        again, slope = both(params, turned)
        np.testing.assert_allclose(again, value, rtol=1e-12)
        np.testing.assert_allclose(slope, gradient, rtol=1e-10, atol=1e-13)
    half = W.at[1].add(jnp.pi)
    assert abs(float(both(params, half)[0] - value)) > 1e-3
    assert abs(float(gradient[1])) > 1e-6


def test_a_cyclic_coordinate_is_not_seen():
    family = Mlp(box_inputs(DATA, cyclic=(2,)), (9, 4))
    gradient = jax.grad(family, 1)(family.init(KEY, jnp.float64), W)
    assert gradient[2] == 0
    assert (gradient[jnp.array([0, 1, 3])] != 0).all()


def test_starts_from_its_key():
    first, again = PLAIN.init(KEY, jnp.float64), PLAIN.init(KEY, jnp.float64)
    other = PLAIN.init(jax.random.key(2), jnp.float64)
    assert jax.tree.all(jax.tree.map(lambda a, b: bool((a == b).all()), first, again))
    assert not jax.tree.all(jax.tree.map(lambda a, b: bool((a == b).all()), first, other))


def test_is_a_hashable_constant():
    assert hash(PLAIN) == hash(dataclasses.replace(PLAIN))
    assert dataclasses.replace(PLAIN, hidden=(7, 6)) != PLAIN


def test_refuses_unknown_activations_and_empty_layers():
    with pytest.raises(ValueError, match="tanh, sin, softplus, silu, gelu"):
        dataclasses.replace(PLAIN, activation="relu")
    for hidden in ((), (4, 0)):
        with pytest.raises(ValueError, match="positive width"):
            dataclasses.replace(PLAIN, hidden=hidden)


def test_the_amplitude_is_the_size_of_s():
    """S = 5 sin(w₀/100) varies by about 5, whatever the units of w."""
    w = np.random.default_rng(3).uniform(-300, 300, (400, 2))
    wanted = np.stack([0.05 * np.cos(w[:, 0] / 100), np.zeros(400)], axis=-1)
    assert 2.5 < amplitude_of(w, wanted) < 10
    assert amplitude_of(w * 1e6, wanted / 1e6) == pytest.approx(amplitude_of(w, wanted))
    assert amplitude_of(w, 0 * wanted) == 1.0
