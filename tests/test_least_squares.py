"""Least squares: exact where S is in the family, bounded by the noise elsewhere, unit-free."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gfnn_jax.generating.charts import MIDPOINT, TYPE2
from gfnn_jax.fitting import least_squares
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products

RNG = np.random.default_rng(0)
W = RNG.uniform(-1, 1, (900, 4)) * np.array([1.0, 2.0, 0.5, 1.0]) + 0.3


def family_of(degree=4, w=W, **options):
    return Products(box_inputs(w, **options), degree)


@functools.partial(jax.jit, static_argnums=0)
def _gradients(family, coefficients, w):
    matrix = family.unflatten(coefficients)
    return jax.vmap(lambda w: jax.grad(family, argnums=1)(matrix, w))(w)


def gradients(family, coefficients, w):
    return np.asarray(_gradients(family, jnp.asarray(coefficients), jnp.asarray(w)))


FAMILY = family_of()
EXACT = RNG.standard_normal(FAMILY.num_parameters)
WANTED = gradients(FAMILY, EXACT, W)
ONE = np.ones(4)


def parts(w, wanted, num_train=600):
    return (w[:num_train], wanted[:num_train]), (w[num_train:], wanted[num_train:])


def test_exact_polynomial_is_reproduced_to_roundoff():
    fit = least_squares.fit(FAMILY, *parts(W, WANTED), ONE)
    np.testing.assert_allclose(fit.coefficients, EXACT, rtol=0, atol=1e-12)
    assert fit.rank == FAMILY.num_parameters
    assert 1 < fit.condition < 1e3
    assert fit.train_rms < 1e-12
    assert fit.validation_rms < 1e-12


def test_reported_errors_are_those_of_the_rows():
    noisy = WANTED + 0.1 * RNG.standard_normal(WANTED.shape)
    weight = np.array([1.0, 0.5, 2.0, 3.0])
    (w, wanted), (held, held_wanted) = parts(W, noisy)
    fit = least_squares.fit(FAMILY, (w, wanted), (held, held_wanted), weight)
    for points, target, reported in (
        (w, wanted, fit.train_rms),
        (held, held_wanted, fit.validation_rms),
    ):
        error = (gradients(FAMILY, fit.coefficients, points) - target) * weight
        assert reported == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-9)


def test_plain_solution_is_numpys(monkeypatch):
    monkeypatch.setattr(least_squares, "_RIDGES", (0.0,))
    noisy = WANTED + 0.1 * RNG.standard_normal(WANTED.shape)
    fit = least_squares.fit(FAMILY, *parts(W, noisy), ONE)
    rows = np.asarray(jax.vmap(FAMILY.gradient_features)(jnp.asarray(W[:600])))
    expected = np.linalg.lstsq(
        rows.reshape(-1, FAMILY.num_parameters), noisy[:600].reshape(-1), rcond=None
    )[0]
    np.testing.assert_allclose(fit.coefficients, expected, rtol=0, atol=1e-12)


def test_chunked_is_unchunked(monkeypatch):
    noisy = WANTED + 0.1 * RNG.standard_normal(WANTED.shape)
    whole = least_squares.fit(FAMILY, *parts(W, noisy), ONE)
    for size in (70, 250):  # neither divides 600
        monkeypatch.setattr(least_squares, "chunk_size", lambda *_, n=size: n)
        chunked = least_squares.fit(FAMILY, *parts(W, noisy), ONE)
        np.testing.assert_allclose(chunked.coefficients, whole.coefficients, rtol=0, atol=1e-12)
        assert chunked.validation_rms == pytest.approx(whole.validation_rms, rel=1e-10)
        assert chunked.ridge == whole.ridge


def test_chunks_keep_to_their_memory():
    for parameters, dim in ((10, 1), (500, 2), (100_000, 8)):
        size = least_squares.chunk_size(parameters, dim)
        assert size >= 64
        assert size == 64 or size * 2 * dim * (parameters + 1) * 8 <= 256 * 2**20


def test_leading_columns_answer_for_smaller_degrees():
    reduced = least_squares.reduce(FAMILY, *parts(W, WANTED), ONE)
    smaller = family_of(3)
    direct = least_squares.fit(smaller, *parts(W, WANTED), ONE)
    leading = least_squares.solve(reduced, smaller.num_parameters)
    np.testing.assert_allclose(leading.coefficients, direct.coefficients, rtol=0, atol=1e-11)
    assert leading.validation_rms == pytest.approx(direct.validation_rms, rel=1e-9)


@pytest.mark.parametrize("num_train", [20, 30, 600])
@pytest.mark.parametrize("noise", [1e-6, 1e-2])
def test_noise_leaves_an_error_of_its_own_order(num_train, noise):
    """Against the exact gradients, on points no fit saw, also where the fit could interpolate.

    20 pairs give 80 rows for 69 unknowns: plain least squares would amplify the noise many times.
    """
    smooth = EXACT * 1e-2  # of the size of the data's own scale, so that noise matters
    exact = gradients(FAMILY, smooth, W)
    noisy = exact + noise * np.random.default_rng(num_train).standard_normal(exact.shape)
    train, held = (W[:num_train], noisy[:num_train]), (W[600:700], noisy[600:700])
    fit = least_squares.fit(FAMILY, train, held, ONE)
    error = gradients(FAMILY, fit.coefficients, W[700:]) - exact[700:]
    rms = np.sqrt(np.mean(error**2))
    assert rms < (10 if num_train < 600 else 0.5) * noise
    assert fit.validation_rms == pytest.approx(np.hypot(rms, noise), rel=0.3)


def test_fewer_rows_than_terms():
    """Ten pairs for 69 terms: no exception, a rank that says so, an error no larger than S."""
    fit = least_squares.fit(FAMILY, (W[:10], WANTED[:10]), (W[600:], WANTED[600:]), ONE)
    assert fit.rank == 40
    assert np.isfinite(fit.coefficients).all()
    assert fit.validation_rms <= 1.01 * np.sqrt(np.mean(WANTED[600:] ** 2))


def test_rank_deficiency_is_reported_and_harmless():
    """A feature given twice: its terms cannot be told apart, and need not be."""
    twice = box_inputs(W, features=lambda w: jnp.stack([w[0], w[1], w[0]]))
    family = Products(twice, 3)
    wanted = gradients(family, RNG.standard_normal(family.num_parameters), W)
    fit = least_squares.fit(family, *parts(W, wanted), ONE)
    assert fit.rank == Products(box_inputs(W, cyclic=(2, 3)), 3).num_parameters
    assert fit.condition > 1e12
    assert fit.validation_rms < 1e-11
    assert np.abs(fit.coefficients).max() < 1e3


@pytest.mark.parametrize("chart", [TYPE2, MIDPOINT], ids=str)
def test_units_do_not_matter(chart):
    """q, p and dt in other units give the same map: the same S up to the unit of action/time."""
    rng = np.random.default_rng(2)
    z0 = rng.uniform(-1, 1, (400, 2))
    dt = 0.3
    half = z0[:, 1] - 0.5 * dt * np.sin(z0[:, 0])
    q = z0[:, 0] + dt * half
    z1 = np.stack([q, half - 0.5 * dt * np.sin(q)], axis=1)  # a leapfrog step of the pendulum

    def predicted(unit_q, unit_p, unit_t):
        units = np.array([unit_q, unit_p])
        a, b, h = jnp.asarray(z0 * units), jnp.asarray(z1 * units), dt * unit_t
        w, wanted = np.asarray(chart.point(a, b)), np.asarray(chart.wanted(a, b, h))
        family = Products(box_inputs(w), 6)
        scale = np.std(z0 * units, axis=0)
        fit = least_squares.fit(family, *parts(w, wanted, 300), h / scale[::-1])
        assert fit.validation_rms < 1e-4
        gradient = gradients(family, fit.coefficients, w)
        return h * gradient / units[::-1], fit.validation_rms

    reference, rms = predicted(1.0, 1.0, 1.0)
    for units in ((1e6, 1e-3, 1.0), (1e-4, 1e-4, 1e5), (3.0, 7.0, 0.01)):
        moved, other = predicted(*units)
        np.testing.assert_allclose(moved, reference, rtol=0, atol=1e-9)
        assert other == pytest.approx(rms, rel=1e-6)


def test_columns_of_very_different_size_are_told_apart():
    """Scaled columns: a term a million times smaller than the others keeps its digits."""
    exact = EXACT * np.where(np.arange(EXACT.size) % 2, 1.0, 1e-6)
    fit = least_squares.fit(FAMILY, *parts(W, gradients(FAMILY, exact, W)), ONE)
    np.testing.assert_allclose(fit.coefficients, exact, rtol=1e-6, atol=1e-12)


def standard_kicks(num):
    """Pairs of the standard map as type 2 sees them: S = P²/2 + 0.6 cos θ."""
    rng = np.random.default_rng(1)
    w = rng.uniform(0, 2 * np.pi, (num, 2))
    return w, np.stack([-0.6 * np.sin(w[:, 0]), w[:, 1]], axis=1)


def test_what_the_data_cannot_tell_from_zero_is_zero():
    w, wanted = standard_kicks(800)
    family = Products(box_inputs(w, angles=(0,)), 2)
    fit = least_squares.fit(family, *parts(w, wanted), np.ones(2))
    # cos θ, P and P² (the box is not centred at P = 0).
    assert np.count_nonzero(fit.coefficients) == 3
    assert fit.validation_rms < 1e-14
    # An odd kick, evaluated in floating point, is odd to the last bit.
    matrix = family.unflatten(fit.coefficients)
    kick = jax.vmap(lambda q: jax.grad(family, argnums=1)(matrix, jnp.stack([q, 3.0]))[0])
    theta = jnp.asarray(w[:, 0])
    np.testing.assert_array_equal(kick(-theta), -kick(theta))


def test_nothing_is_dropped_that_held_out_pairs_need(monkeypatch):
    # Two columns so alike that rounding alone could make the coefficient of either.
    monkeypatch.setattr(least_squares, "_RIDGES", (0.0,))
    rng = np.random.default_rng(2)
    one = rng.standard_normal(800)
    columns = np.stack([one, one + 1e-14 * rng.standard_normal(800)], axis=1)
    rows = np.column_stack([columns, columns @ np.array([0.05, 1.95])])
    train, held = (np.linalg.qr(part, mode="r") for part in (rows[:600], rows[600:]))
    fit = least_squares.solve(least_squares.Reduced(train, 600, held, 200, 0.0, 0.0), 2)
    assert fit.validation_rms < 1e-12
