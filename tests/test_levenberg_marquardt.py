"""Levenberg–Marquardt on S: exact where S is representable, equal to SciPy's optimum, resumable."""

from contextlib import nullcontext
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from analytic import Network, gradient_data, network_params, steep_pendulum
from jax.flatten_util import ravel_pytree

from gfnn_jax.errors import OutOfTime
from gfnn_jax.families.family import from_function
from gfnn_jax.fitting import levenberg_marquardt as lm
from gfnn_jax.fitting.levenberg_marquardt import BLOCK, GradientFit, Limits

NETWORK = Network()


TRAINING, VALIDATION = gradient_data(steep_pendulum, 130, 0), gradient_data(steep_pendulum, 50, 1)


def fit_pendulum(*, chunk=40, resume=None, **limits):
    """13 hidden units; 130 pairs in chunks of 40 need padding."""
    return GradientFit(
        *TRAINING,
        validation=VALIDATION,
        chunk=chunk,
        resume=resume,
        limits=Limits(**{"max_iterations": 12, **limits}),
    ).train(NETWORK, network_params(2, 13))


def test_recovers_an_exactly_representable_function_to_roundoff():
    exact = network_params(0, 4)
    start = jax.tree.map(lambda a: a + 0.1 * np.cos(np.arange(a.size)).reshape(a.shape), exact)
    training, validation = (
        gradient_data(partial(NETWORK.value, exact), num, seed) for num, seed in ((101, 1), (50, 2))
    )
    result = GradientFit(*training, validation=validation, chunk=30).train(NETWORK, start)
    assert result.stopped_because == "no progress"
    assert result.iterations < 100
    assert result.train_rms < 1e-13
    assert result.validation_rms < 1e-13
    recovered = jax.jit(NETWORK.gradient)(result.params, validation[0])
    np.testing.assert_allclose(recovered, validation[1], atol=1e-12)


def test_finds_the_optimum_that_scipy_finds():
    """Two hidden units on noisy data: a residual that stays, whose minimum is the same."""
    exact = network_params(3, 2)
    start = jax.tree.map(lambda a: 1.2 * a, exact)
    w, target = gradient_data(partial(NETWORK.value, exact), 60, 3)
    target = target + 0.05 * np.random.default_rng(5).standard_normal(target.shape)
    theta, unravel = ravel_pytree(start)

    @jax.jit
    def residual(theta):
        return (NETWORK.gradient(unravel(theta), jnp.asarray(w)) - target).ravel()

    oracle = scipy.optimize.least_squares(
        residual, theta, jac=jax.jit(jax.jacfwd(residual)), method="lm", xtol=1e-14, ftol=1e-14
    )
    result = GradientFit(w, target, validation=(w, target)).train(NETWORK, start)
    np.testing.assert_allclose(result.train_rms**2, 2 * oracle.cost / target.size, rtol=1e-6)


@pytest.mark.slow
def test_training_error_falls_at_every_iteration_whatever_the_chunk():
    history = []
    whole = fit_pendulum(reports=(lambda state: history.append(state.train_rms),), chunk=1_000)
    assert len(history) == 12
    assert np.all(np.diff(history) < 0)
    assert whole.train_rms < 1e-2
    np.testing.assert_allclose(fit_pendulum().train_rms, whole.train_rms, rtol=1e-4)


def test_the_best_parameters_on_validation_are_returned():
    states = []
    w, target = (a[:12] for a in TRAINING)  # 24 numbers, 52 parameters: overfits the noise
    target = target + 0.3 * np.random.default_rng(6).standard_normal(target.shape)
    result = GradientFit(
        w, target, validation=VALIDATION, limits=Limits(15, reports=(states.append,))
    ).train(NETWORK, network_params(2, 13))
    best = min(states, key=lambda state: state.validation_rms)
    assert best.iteration < result.iterations
    assert result.validation_rms == best.validation_rms
    np.testing.assert_array_equal(ravel_pytree(result.params)[0], best.theta)


def test_resuming_is_bit_identical_to_never_having_stopped():
    states = []
    whole = fit_pendulum(reports=(states.append,))
    resumed = fit_pendulum(resume=states[4])
    assert resumed.iterations == whole.iterations == 12
    assert (resumed.train_rms, resumed.validation_rms) == (whole.train_rms, whole.validation_rms)
    for a, b in zip(jax.tree.leaves(whole.params), jax.tree.leaves(resumed.params), strict=True):
        np.testing.assert_array_equal(a, b)
    again = fit_pendulum(resume=states[-1])
    assert again.iterations == 12
    assert again.seconds == states[-1].seconds


def test_a_second_fit_of_the_same_shapes_compiles_nothing(compilations):
    """Other data, another start, other leaves of the family."""
    fit_pendulum(max_iterations=2)
    w, target = gradient_data(steep_pendulum, 130, 8)
    start = network_params(5, 13)
    with compilations() as found:
        result = GradientFit(w, target, validation=VALIDATION, limits=Limits(2), chunk=40).train(
            Network(amplitude=2.0), start
        )
    assert found.count == 0
    assert result.compile_seconds < 0.1
    assert result.iterations == 2


def test_stops_at_the_target_and_where_a_block_of_iterations_does_not_fit():
    result = fit_pendulum(target_rms=0.05)
    assert result.stopped_because == "target"
    assert result.validation_rms <= 0.05
    assert result.iterations < 12
    blocks = iter([nullcontext()])

    def block(iterations):
        try:
            return next(blocks)
        except StopIteration:
            raise OutOfTime from None

    result = fit_pendulum(block=block)
    assert (result.stopped_because, result.iterations) == ("budget", BLOCK)


def test_a_step_into_non_finite_values_is_rejected():
    """S = −log(b) w: the undamped step from b = 1 overshoots to b < 0, where S is NaN."""
    family = from_function(lambda params, w: -jnp.log(params) @ w)
    w = np.zeros((3, 2))
    target = np.full((3, 2), 6.0)
    result = GradientFit(w, target, validation=(w, target)).train(family, jnp.ones(2))
    assert result.train_rms < 1e-10
    np.testing.assert_allclose(result.params, np.exp(-6.0), rtol=1e-9)


@pytest.mark.slow
def test_memory_is_bounded_by_the_chunk_and_not_by_the_pairs():
    theta, layout = lm.flattened(network_params(0, 50))
    w, target = (np.tile(a, (10, 1)) for a in TRAINING)
    chunk, num_parameters = 100, theta.size
    given = (NETWORK, lm.chunked(w, target, np.ones(2), chunk), theta)
    square = np.zeros((theta.size, theta.size))
    linearize = lm.linearize.lower(*given, layout=layout)
    attempt = lm.attempt.lower(*given, (square, theta), 1.0, layout=layout)
    jacobian, matrix = 2 * chunk * num_parameters, num_parameters**2
    assert len(w) * 2 * num_parameters > 4 * (jacobian + matrix)  # whole, it would not fit below

    def numbers(lowered):
        memory = lowered.compile().memory_analysis()
        return (memory.temp_size_in_bytes + memory.output_size_in_bytes) / 8

    assert numbers(linearize) < 1.1 * (2 * matrix + 4 * jacobian)
    assert numbers(attempt) < 1.3 * (3 * matrix + jacobian)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("where", range(4))
def test_non_finite_data_are_refused_by_name(bad, where):
    data = [a.copy() for a in (*TRAINING, *VALIDATION)]
    data[where][3, 1] = bad
    names = ("w", "target_gradient", "the validation's w", "the validation's target_gradient")
    with pytest.raises(ValueError, match=rf"^{names[where]} has entries that are NaN or infinite"):
        GradientFit(*data[:2], validation=tuple(data[2:])).train(NETWORK, network_params(0, 3))
