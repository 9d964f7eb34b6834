"""Least squares: exact where S is in the family, bounded by the noise elsewhere, unit-free."""

import dataclasses
import itertools
import math

import numpy as np
import pytest

from gfnn_jax.errors import FitError
from gfnn_jax.fitting import least_squares
from gfnn_jax.fitting.triangle import Triangle

RNG = np.random.default_rng(0)
W = RNG.uniform(-1, 1, (900, 4)) * np.array([1.0, 2.0, 0.5, 1.0]) + 0.3


@dataclasses.dataclass(frozen=True)
class Monomials:
    """S = Σ c_j Π w_i^{e_ji}, lowest degrees first; ``scale`` (2d,) divides w."""

    width: int
    degree: int
    scale: tuple[float, ...] = ()

    @property
    def exponents(self):
        every = itertools.product(range(self.degree + 1), repeat=self.width)
        kept = [e for e in every if 0 < sum(e) <= self.degree]
        return np.array(sorted(kept, key=sum))

    @property
    def num_parameters(self):
        return math.comb(self.width + self.degree, self.degree) - 1

    def term_gradients(self, w):
        assert isinstance(w, np.ndarray)
        scale = np.array(self.scale or (1.0,) * self.width)
        x, e = w / scale, self.exponents
        columns = []
        for i in range(self.width):
            lowered = e.copy()
            lowered[:, i] = np.maximum(e[:, i] - 1, 0)
            columns.append(e[:, i] / scale[i] * np.prod(x[:, None, :] ** lowered, axis=-1))
        return np.stack(columns, axis=1)


FAMILY = Monomials(4, 4)


def gradients(family, coefficients, w):
    return family.term_gradients(w) @ coefficients


EXACT = RNG.standard_normal(FAMILY.num_parameters)
TARGET = gradients(FAMILY, EXACT, W)
NOISY = TARGET + 0.1 * RNG.standard_normal(TARGET.shape)
ONE = np.ones(4)


def parts(w, target, num_train=600):
    return (w[:num_train], target[:num_train]), (w[num_train:], target[num_train:])


def reduced(family, w, target, weight=ONE, num_train=600):
    return [least_squares.reduce(family, [part], weight) for part in parts(w, target, num_train)]


def fitted(family, train, held, weight):
    """``reduce`` and ``solve`` in one go."""
    triangles = [least_squares.reduce(family, [rows], weight) for rows in (train, held)]
    return least_squares.solve(*triangles, family.num_parameters)


def numpys(family, w, target, weight=ONE):
    """Coefficients by numpy.linalg.lstsq on all rows at once."""
    rows = (family.term_gradients(w) * weight[:, None]).reshape(-1, family.num_parameters)
    return np.linalg.lstsq(rows, (target * weight).ravel(), rcond=None)[0]


def test_exact_polynomial_is_reproduced_to_roundoff():
    fit = fitted(FAMILY, *parts(W, TARGET), ONE)
    np.testing.assert_allclose(fit.coefficients, EXACT, rtol=0, atol=1e-12)
    assert fit.rank == FAMILY.num_parameters
    assert 1 < fit.condition < 1e3
    assert fit.train_rms < 1e-12
    assert fit.validation_rms < 1e-12


def test_reported_errors_are_those_of_the_rows():
    weight = np.array([1.0, 0.5, 2.0, 3.0])
    train, held = parts(W, NOISY)
    fit = fitted(FAMILY, train, held, weight)
    for (w, target), reported in ((train, fit.train_rms), (held, fit.validation_rms)):
        error = (gradients(FAMILY, fit.coefficients, w) - target) * weight
        assert reported == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-9)


def test_plain_solution_is_numpys(monkeypatch):
    monkeypatch.setattr(least_squares, "_RIDGES", (0.0,))
    weight = np.array([1.0, 0.5, 2.0, 3.0])
    fit = fitted(FAMILY, *parts(W, NOISY), weight)
    expected = numpys(FAMILY, W[:600], NOISY[:600], weight)
    np.testing.assert_allclose(fit.coefficients, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("bytes_per_block", [1, 200_000])  # 256 and 355 rows; neither divides 2,400
def test_blocks_and_parts_of_the_rows_do_not_matter(monkeypatch, bytes_per_block):
    whole = fitted(FAMILY, *parts(W, NOISY), ONE)
    monkeypatch.setattr(least_squares.Options, "block_bytes", bytes_per_block)
    (w, target), held = parts(W, NOISY)
    uneven = ((w[i:j], target[i:j]) for i, j in ((0, 7), (7, 7), (7, 450), (450, 600)))
    train = least_squares.reduce(FAMILY, uneven, ONE)
    assert train.rows == 2_400
    fit = least_squares.solve(train, least_squares.reduce(FAMILY, [held], ONE), len(EXACT))
    np.testing.assert_allclose(fit.coefficients, whole.coefficients, rtol=0, atol=1e-12)
    assert fit.validation_rms == pytest.approx(whole.validation_rms, rel=1e-10)
    assert fit.ridge == whole.ridge


def test_a_reduction_can_be_stopped_between_blocks(monkeypatch):
    monkeypatch.setattr(least_squares.Options, "block_bytes", 1)
    calls = []

    def stop():
        calls.append(None)
        if len(calls) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        least_squares.reduce(FAMILY, [(W, TARGET)], ONE, on_block=stop)
    assert len(calls) == 3


def test_leading_columns_answer_for_smaller_degrees():
    smaller = Monomials(4, 3)
    direct = fitted(smaller, *parts(W, TARGET), ONE)
    leading = least_squares.solve(*reduced(FAMILY, W, TARGET), smaller.num_parameters)
    np.testing.assert_allclose(leading.coefficients, direct.coefficients, rtol=0, atol=1e-11)
    assert leading.validation_rms == pytest.approx(direct.validation_rms, rel=1e-9)


def test_residuals_of_every_size_are_those_of_numpys_solutions():
    factors = reduced(FAMILY, W, NOISY)
    families = [Monomials(4, degree) for degree in (1, 2, 3, 4)]
    found = least_squares.residuals(*factors, [f.num_parameters for f in families])
    for family, (train_rms, validation_rms) in zip(families, found, strict=True):
        c = numpys(family, W[:600], NOISY[:600])
        for (w, target), rms in zip(parts(W, NOISY), (train_rms, validation_rms), strict=True):
            error = gradients(family, c, w) - target
            assert rms == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-10)


def test_residuals_of_an_exact_fit_are_roundoff():
    factors = reduced(FAMILY, W, TARGET)
    (_, before), (train_rms, validation_rms) = least_squares.residuals(*factors, [34, 69])
    assert before > 0.1
    assert train_rms < 1e-14
    assert validation_rms < 1e-14


@pytest.mark.parametrize("num_train", [20, 4])
def test_residuals_of_a_size_that_rows_barely_determine_are_those_of_a_regularised_fit(num_train):
    factors = reduced(FAMILY, W, NOISY, num_train=num_train)
    fit = least_squares.solve(*factors, 69)
    assert least_squares.residuals(*factors, [69]) == [(fit.train_rms, fit.validation_rms)]
    assert fit.validation_rms < 2 * np.sqrt(np.mean(NOISY[num_train:] ** 2))


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
    fit = fitted(FAMILY, train, held, ONE)
    error = gradients(FAMILY, fit.coefficients, W[700:]) - exact[700:]
    rms = np.sqrt(np.mean(error**2))
    assert rms < (10 if num_train < 600 else 0.5) * noise
    assert fit.validation_rms == pytest.approx(np.hypot(rms, noise), rel=0.3)


def test_fewer_rows_than_terms():
    """Ten pairs for 69 terms: no exception, a rank that says so, an error no larger than S."""
    fit = fitted(FAMILY, (W[:10], TARGET[:10]), (W[600:], TARGET[600:]), ONE)
    assert fit.rank == 40
    assert np.isfinite(fit.coefficients).all()
    assert fit.validation_rms <= 1.01 * np.sqrt(np.mean(TARGET[600:] ** 2))


class Twice(Monomials):
    """Family with every term twice: the data do not determine the copies apart."""

    @property
    def num_parameters(self):
        return 2 * super().num_parameters

    def term_gradients(self, w):
        return np.repeat(super().term_gradients(w), 2, axis=-1)


def test_rank_deficiency_is_reported_and_harmless():
    family = Twice(4, 3)
    target = gradients(Monomials(4, 3), EXACT[:34], W)
    fit = fitted(family, *parts(W, target), ONE)
    assert fit.rank == 34
    assert fit.condition > 1e12
    assert fit.validation_rms < 1e-11
    assert np.abs(fit.coefficients).max() < 1e3
    ((_, judged),) = least_squares.residuals(*reduced(family, W, target), [68])
    assert judged < 1e-11


def test_units_do_not_matter():
    """Coordinates and time in other units give the same S up to the unit of action per time."""
    q, p = W[:, 0], W[:, 1]
    w = np.stack([q, p], axis=1)
    target = np.stack([np.sin(q) * np.exp(0.3 * p), p - 0.3 * np.cos(q) * np.exp(0.3 * p)], axis=1)

    def predicted(unit_q, unit_p, unit_t):
        units = np.array([unit_q, unit_p])
        family = Monomials(2, 6, scale=(unit_q, unit_p))
        moved, h = w * units, 0.3 * unit_t
        asked = target * units[::-1] / unit_t
        fit = fitted(family, *parts(moved, asked), h / moved.std(axis=0)[::-1])
        return h * gradients(family, fit.coefficients, moved) / units[::-1], fit.validation_rms

    reference, rms = predicted(1.0, 1.0, 1.0)
    assert rms < 1e-2
    for units in ((1e6, 1e-3, 1.0), (1e-4, 1e-4, 1e5), (3.0, 7.0, 0.01)):
        moved, other = predicted(*units)
        np.testing.assert_allclose(moved, reference, rtol=0, atol=1e-9)
        assert other == pytest.approx(rms, rel=1e-6)


def test_columns_of_very_different_size_are_told_apart():
    """Scaled columns: a term a million times smaller than the others keeps its digits."""
    exact = EXACT * np.where(np.arange(EXACT.size) % 2, 1.0, 1e-6)
    fit = fitted(FAMILY, *parts(W, gradients(FAMILY, exact, W)), ONE)
    np.testing.assert_allclose(fit.coefficients, exact, rtol=1e-6, atol=1e-12)


def test_what_the_data_cannot_tell_from_zero_is_zero():
    """S = P²/2 + w₀³/3: the other coefficients would be rounding, 1e-17, and are exactly zero."""
    w = np.random.default_rng(1).uniform(-1, 1, (800, 2))
    target = np.stack([w[:, 0] ** 2, w[:, 1]], axis=1)
    family = Monomials(2, 5)
    fit = fitted(family, *parts(w, target), np.ones(2))
    found = {
        tuple(e) for e, c in zip(family.exponents.tolist(), fit.coefficients, strict=True) if c
    }
    assert found == {(0, 2), (3, 0)}
    assert fit.validation_rms < 1e-15


def test_nothing_is_dropped_that_held_out_pairs_need(monkeypatch):
    # Two columns so alike that rounding alone could make the coefficient of either.
    monkeypatch.setattr(least_squares, "_RIDGES", (0.0,))
    rng = np.random.default_rng(2)
    one = rng.standard_normal(800)
    columns = np.stack([one, one + 1e-14 * rng.standard_normal(800)], axis=1)
    rows = np.column_stack([columns, columns @ np.array([0.05, 1.95])])
    train, held = (Triangle.of(part) for part in (rows[:600], rows[600:]))
    assert least_squares.solve(train, held, 2).validation_rms < 1e-12


def test_gradients_that_are_not_finite_are_refused():
    broken = TARGET.copy()
    broken[3, 1] = np.nan
    with pytest.raises(FitError, match="finite"):
        least_squares.reduce(FAMILY, [(W, broken)], ONE)
