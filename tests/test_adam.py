"""Adam on S: the paper's loss and schedule, the same bits for the same key, resumable."""

import dataclasses
import functools
import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from analytic import Network, gradient_data, network_params, steep_pendulum

from gfnn_jax.fitting.adam import (
    PAPER,
    PAPER_STANDARD_MAP,
    Recipe,
    Training,
    gradient_loss,
)

WEIGHT = np.array([0.5, 0.1])


NETWORK = Network()
LOSS = gradient_loss(NETWORK, WEIGHT)
start = partial(network_params, size=4)


TRAIN, VALIDATION = (gradient_data(steep_pendulum, *of) for of in ((330, 1), (40, 2)))
SHORT = Recipe(batch_size=50, epochs=6, rate=0.02, schedule="cosine", dtype="float64")


def fit(recipe=SHORT, *, params=None, train=TRAIN, seed=7, **options):
    training = Training(recipe, jax.random.key(seed), **options)
    params = start() if params is None else params
    return training.of_loss(LOSS, params, train, VALIDATION, 2)


def history_of(recipe):
    """A fit, and the errors (epochs, 2) of its epochs."""
    found = []
    result = fit(recipe, on_epoch=lambda _, *errors: found.append(errors))
    return result, np.array(found)


@functools.cache
def whole():
    return fit()


def numpy_gradient(params, w):
    """∇ of the network by hand: (N, 2)."""
    inner, bias, outer = (np.asarray(params[k]) for k in ("inner", "bias", "outer"))
    return ((1 - np.tanh(w @ inner + bias) ** 2) * outer) @ inner.T


def numpy_rms(params, w, target):
    """Root of the loss per component, written out."""
    total = 0.0
    for row, asked in zip(numpy_gradient(params, w), target, strict=True):
        total += sum((WEIGHT[i] * (row[i] - asked[i])) ** 2 for i in range(2))
    return math.sqrt(total / len(w) / 2)


def bits(tree):
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(tree)]


def test_the_loss_is_the_papers():
    """At a rate that moves nothing, in batches that are all pairs, both errors are the start's."""
    still = dataclasses.replace(SHORT, rate=1e-30, epochs=1, batch_size=330)
    (of_epoch,) = history_of(still)[1]
    expected = numpy_rms(start(), *TRAIN), numpy_rms(start(), *VALIDATION)
    assert of_epoch == pytest.approx(expected, rel=1e-12)


def test_one_iteration_is_adams():
    """The first update of Adam is the rate times the sign of the slope (but for its epsilon)."""
    recipe = Recipe(330, epochs=1, rate=1e-3, schedule="staircase", dtype="float64")
    w, target = TRAIN

    def loss(outer):
        return numpy_rms({**start(), "outer": outer}, w, target)

    outer, step = np.asarray(start()["outer"]), 1e-6
    slope = [
        loss(outer + step * e) - loss(outer - step * e) for e in np.eye(len(outer))
    ]  # its sign is that of the loss' slope
    moved = np.asarray(fit(recipe).params["outer"]) - outer
    np.testing.assert_allclose(moved, -1e-3 * np.sign(slope), rtol=1e-3)


def test_every_pair_is_used_once_per_epoch():
    """A loss that is linear in what a batch holds: its mean over an epoch is that of all pairs."""
    still = dataclasses.replace(SHORT, rate=1e-30, epochs=3, batch_size=30)  # 11 batches of 330
    train_rms = history_of(still)[1][:, 0]
    np.testing.assert_allclose(train_rms, numpy_rms(start(), *TRAIN), rtol=1e-12)


def test_an_epochs_length_may_be_given():
    """Longer than a pass: an epoch of 12 batches of all pairs is as good as 12 epochs of one."""
    still = dataclasses.replace(SHORT, epochs=1, batch_size=330, schedule="staircase")
    one = fit(dataclasses.replace(still, epoch_length=12))
    many = fit(dataclasses.replace(still, epochs=12))
    np.testing.assert_allclose(one.params["outer"], many.params["outer"], rtol=1e-9)


@pytest.mark.parametrize("recipe", [PAPER, PAPER_STANDARD_MAP])
def test_the_papers_schedule(recipe):
    first = {PAPER: 0.01, PAPER_STANDARD_MAP: 0.001}[recipe]
    for k in (0, 1, 99, 100, 101, 199, 200, 5000, 9999):
        rate = recipe.rate_at(k, 10_000)
        assert float(rate) == pytest.approx(first * 0.95 ** (k // 100), rel=1e-12)


def test_the_cosine_rises_and_falls():
    rates = np.asarray(jax.vmap(lambda k: SHORT.rate_at(k, 1000))(np.arange(1000.0)))
    assert rates.max() == pytest.approx(SHORT.rate)
    assert (np.diff(rates[:10]) > 0).all()
    assert (np.diff(rates[10:]) < 0).all()
    assert rates[-1] < 1e-3 * SHORT.rate


@pytest.mark.parametrize("dtype", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
def test_computes_in_the_recipes_dtype(dtype):
    result = fit(dataclasses.replace(SHORT, epochs=1, dtype=dtype))
    assert {leaf.dtype for leaf in jax.tree.leaves(result.params)} == {jnp.dtype(dtype)}


def test_the_same_key_gives_the_same_bits_and_another_key_others():
    first, again, other = whole(), fit(), fit(seed=8)
    assert bits(first[:3]) == bits(again[:3])
    assert bits(first.params) != bits(other.params)


def test_the_best_epoch_is_kept():
    """A rate far too high: the error does not end at its smallest, and the best is returned."""
    result, history = history_of(Recipe(50, 12, rate=0.3, schedule="staircase", dtype="float64"))
    errors = history[:, 1]
    assert errors.argmin() != len(errors) - 1
    assert result.validation_rms == errors.min()
    assert result.train_rms == history[errors.argmin(), 0]
    assert result.validation_rms == pytest.approx(numpy_rms(result.params, *VALIDATION), rel=1e-12)


def test_stops_where_numbers_cease_to_be_finite():
    recipe = Recipe(50, epochs=8, rate=1e200, schedule="staircase", dtype="float64")
    result = fit(recipe)
    assert "not finite in epoch" in result.stopped_because
    assert result.epochs < 8
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(result.params))
    assert result.validation_rms == pytest.approx(numpy_rms(result.params, *VALIDATION), rel=1e-12)


def test_refuses_what_is_not_finite_at_the_start():
    with pytest.raises(ValueError, match="not finite"):
        fit(params={**start(), "outer": jnp.full(11, jnp.inf)})


def test_any_loss_of_a_batch():
    """The mean of rows (a batch of them all each time) by its squared distances."""
    rows = np.random.default_rng(3).standard_normal((40, 3))
    recipe = Recipe(40, epochs=40, epoch_length=10, rate=0.1, schedule="cosine", dtype="float64")
    result = Training(recipe, jax.random.key(0)).of_loss(
        lambda centre, rows: jnp.mean(jnp.sum((rows - centre[None, :]) ** 2, axis=-1)),
        jnp.zeros(3),
        (rows,),
        (rows,),
        3,
    )
    np.testing.assert_allclose(result.params, rows.mean(axis=0), atol=1e-4)
    expected = np.sqrt(np.mean(rows.var(axis=0)))
    assert result.validation_rms == pytest.approx(expected, rel=1e-6)


def test_a_second_fit_of_the_same_shapes_compiles_nothing(compilations):
    """Other data, another start, another key."""
    fit()
    key, other, data = jax.random.key(11), start(seed=4), gradient_data(steep_pendulum, 330, 5)
    with compilations() as found:
        training = Training(SHORT, key)
        result = training.of_loss(LOSS, other, data, VALIDATION, 2)
    assert result.epochs == 6
    assert found.count == 0
    assert result.compile_seconds < 0.1


def test_a_cap_ends_the_training_and_its_rate():
    """Of few operations the schedule is gone through faster, to its end: the clock has no say."""
    recipe = dataclasses.replace(SHORT, epochs=10**6, epoch_length=20)
    one = fit(recipe, cap=1.0)
    assert one.epochs == 1
    result = fit(recipe, cap=8.5 * one.operations)
    assert result.stopped_because == f"the cap of {8.5 * one.operations:.3g} operations"
    assert result.epochs == 8
    again = fit(recipe, cap=8.5 * one.operations)
    jax.tree.map(np.testing.assert_array_equal, again.params, result.params)
    assert result.validation_rms < fit(recipe, cap=2 * one.operations).validation_rms
    uncapped = fit(dataclasses.replace(recipe, epochs=2), cap=1e15)
    assert uncapped.stopped_because == "epochs"
