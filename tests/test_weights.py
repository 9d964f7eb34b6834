"""Pairs whose noise is known of each value are weighted by it, in the fits of S and of H."""

import dataclasses
import warnings

import numpy as np
import pytest
from scipy.optimize import least_squares as scipy_least_squares

import gfnn_jax as gfnn
from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.rows import of_rows, weighted_rows_of
from gfnn_jax.dataset.runs import identified
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products
from gfnn_jax.families.terms import given_terms
from gfnn_jax.fitting import least_squares
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.flows.collocation import Steps, images
from gfnn_jax.generating.charts import MIDPOINT

DT = 0.4
PENDULUM = given_terms(1, ("p1**2", "cos(q1)")), np.array([0.5, -1.0])
STEPS = Steps(6, 1)


def measured(num, *, std):
    """Pairs of a pendulum, half of them with noise a hundred times the others', told of σ or not;
    and σ of each value."""
    rng = np.random.default_rng(0)
    z0 = rng.uniform(-1.2, 1.2, (num, 2))
    z1 = images(*PENDULUM, z0, DT, STEPS).states
    own = np.where(np.arange(num) % 2, 1e-2, 1e-4)[:, None] * np.array([1.0, 1.3])
    noisy = (z + own * rng.normal(size=z.shape) for z in (z0, z1))
    return gfnn.Pairs(*noisy, DT, std=own if std else None), own


def dataset_of(pairs, coordinates=CARTESIAN):
    found, row = identified(pairs)
    return Dataset.of(found, coordinates, row=row)


def test_a_weight_is_the_usual_noise_over_that_of_a_value():
    pairs, own = measured(40, std=True)
    data = dataset_of(pairs)
    np.testing.assert_allclose(data.weight, np.sqrt(np.mean(own**2, axis=0)) / own, rtol=1e-12)
    few = data.take(np.arange(1, 40, 2))  # of noise that is alike
    assert few.weight is None
    alike = dataclasses.replace(pairs, std=own[0])
    assert dataset_of(alike).weight is None
    assert dataset_of(dataclasses.replace(pairs, std=None)).weight is None


def test_rows_of_S_are_weighted_by_the_coordinate_that_they_change():
    """The solution is NumPy's of the same rows, each divided by its own deviation."""
    pairs, own = measured(60, std=True)
    data = dataset_of(pairs)
    rows, weight = weighted_rows_of(data, MIDPOINT, slice(None))
    w = rows[0]
    family = Products(box_inputs(w), 4)
    triangle = least_squares.reduce(of_rows(family, weighted=True), [rows], weight)
    found = least_squares.solve(triangle, triangle, family.num_parameters).coefficients
    z0, moved = np.asarray(pairs.z0), np.asarray(pairs.z1) - np.asarray(pairs.z0)
    target = np.stack([-moved[:, 1], moved[:, 0]], axis=1) / DT  # ∂S/∂q changes p, ∂S/∂p q
    unit = own[:, ::-1]
    slopes = family.term_gradients(z0 + 0.5 * moved) / unit[..., None]
    # A weight of 1 is that of a coordinate's usual noise.
    channel = np.sqrt(np.mean(own**2, axis=0))[::-1] / np.asarray(data.scale)[::-1]
    expected = np.linalg.lstsq(
        (slopes * channel[:, None]).reshape(-1, family.num_parameters),
        (target / unit * channel).ravel(),
        rcond=None,
    )[0]
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-10)


def test_rows_of_H_are_weighted():
    """Coefficients and standard errors are those of SciPy from the weighted residuals."""
    pairs, own = measured(60, std=True)
    data, (family, true) = dataset_of(pairs), PENDULUM
    problem = Problem(data.y0, data.y1, DT, data.scale, weight=data.weight)
    fit = problem.fit(family, 1.05 * true, rounds=False, steps=STEPS)

    def residuals(c):
        off = images(family, c, data.y0, DT, STEPS).states - data.y1
        return (off / own * np.sqrt(np.mean(own**2, axis=0)) / data.scale).ravel()

    expected = scipy_least_squares(residuals, true, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    np.testing.assert_allclose(fit.coefficients, expected.x, rtol=1e-7)
    rms = np.sqrt(2 * expected.cost / (len(expected.fun) - 2))
    errors = rms * np.sqrt(np.diag(np.linalg.inv(expected.jac.T @ expected.jac)))
    np.testing.assert_allclose(fit.standard_errors, errors, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("learn", ["map", "hamiltonian"])
def test_a_fit_that_is_told_is_nearly_that_of_the_quiet_half(learn):
    z = np.random.default_rng(1).uniform(-1, 1, (200, 2))
    exact = images(*PENDULUM, z, DT, STEPS).states
    error = {}
    for told in (False, True):
        pairs = measured(400, std=told)[0]
        options = {"chart": "midpoint"} if learn == "map" else {"terms": PENDULUM[0].term_names}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", gfnn.FitWarning)
            fit = gfnn.fit(pairs, tolerance=1e-6, learn=learn, max_seconds=None, **options)
        error[told] = np.sqrt(np.mean((np.asarray(fit.map.step(z)[0]) - exact) ** 2))
    assert error[True] < 0.2 * error[False]
    assert error[True] < 1e-4
