"""S of noisy pairs: no bias of noisy evaluation points, its size, and misfit near the noise."""

import dataclasses
from types import SimpleNamespace
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gfnn_jax as gfnn
from gfnn_jax.budget import Budget
from gfnn_jax.coordinates import CARTESIAN, Coordinates, to_user
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.dataset.runs import arcs_of_pairs
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products
from gfnn_jax.fitting import least_squares, uncertainty
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.generating.arcs import GeneratedOnArcs
from gfnn_jax.generating.charts import MIDPOINT, TYPE2
from gfnn_jax.generating.generated import Generated
from gfnn_jax.learn import noisy_sweeps
from gfnn_jax.learn.noisy_sweeps import NoisySweep, best_size
from gfnn_jax.maps.piece import Affine
from gfnn_jax.models.generating_functions.map_arcs import NearestArcs
from gfnn_jax.models.generating_functions.sweeps import Linear, LinearSweep, Size
from gfnn_jax.search.search import Entry

SIGMA, DT = 0.03, 0.5


def generated_pairs(chart, num, degree=4, seed=0):
    """Pairs of the map that a known S of one degree of freedom generates, without noise; the S."""
    rng = np.random.default_rng(seed)
    z0 = rng.uniform(-1, 1, (num, 2))
    family = Products(box_inputs(1.5 * np.array([[-1.0, -1.0], [1.0, 1.0]])), degree)
    params = family.unflatten(0.15 * rng.normal(size=family.num_parameters))
    piece = Generated(family, params, chart, DT, np.ones(2))
    z1 = piece.refined_step(z0, chart.first_guess(z0))[0]
    for _ in range(20):
        z1, error = piece.refined_step(z0, chart.evaluation_point(z0, z1))
    assert error.max() < 1e-10
    return z0, z1, family, params


def coefficients_of(family, params, w):
    """(num_parameters,) of these params, from the gradients of S at these points."""
    rows = w, np.asarray(family.gradient(params, w))
    triangle = least_squares.reduce(family, [rows], np.ones(2))
    return least_squares.solve(triangle, triangle, family.num_parameters).coefficients


@pytest.mark.slow
@pytest.mark.parametrize("chart", [MIDPOINT, TYPE2], ids=["midpoint", "type2"])
def test_rows_of_the_nearest_states_have_no_bias(chart):
    """Coefficients of 40,000 noisy pairs against the S that made them, in standard errors."""
    z0, z1, family, params = generated_pairs(chart, 40_000)
    rng = np.random.default_rng(1)
    z0, z1 = (z + SIGMA * rng.normal(size=z.shape) for z in (z0, z1))
    w, target = chart.evaluation_point(z0, z1), chart.target_gradient(z0, z1, DT)
    true = coefficients_of(family, params, w)
    count = family.num_parameters

    def off(reduced, found) -> float:
        """RMS of the coefficients' errors in standard errors."""
        a = reduced.factor[:count, :count]
        error = a @ (found - true) / np.sqrt(uncertainty.variance(reduced, count))
        return float(np.sqrt(np.mean(error**2)))

    measured = least_squares.reduce(family, [(w, target)], np.ones(2))
    found = least_squares.solve(measured, measured, count).coefficients
    assert off(measured, found) > 3
    arcs = arcs_of_pairs(z0, z1, 1)
    assert arcs is not None
    for _ in range(2):
        model = GeneratedOnArcs(family, chart, DT, arcs.moves)
        reduced = NearestArcs.of(model, found, arcs, np.full(2, SIGMA)).triangle(family)
        found = least_squares.solve(reduced, reduced, count).coefficients
    assert off(reduced, found) < 1.6
    variance = uncertainty.variance(reduced, count)
    assert variance == pytest.approx(1.0, abs=0.05)  # in units of the noise


BENT = Coordinates(
    "bent",
    forward=lambda z: jnp.stack([z[0], z[1] + 0.3 * z[0] ** 2]),
    inverse=lambda y: jnp.stack([y[0], y[1] - 0.3 * y[0] ** 2]),
)


@pytest.mark.parametrize("coordinates", [CARTESIAN, BENT], ids=["plain", "bent"])
@pytest.mark.parametrize("chart", [MIDPOINT, TYPE2], ids=["midpoint", "type2"])
def test_an_arc_is_linearised_as_its_steps_change(chart, coordinates):
    """Φ and c of the defect beside finite differences of the map that S generates, with a turn as
    its base map, in the user's coordinates."""
    z0, z1, family, params = generated_pairs(chart, 40)
    turn = np.array([[0.8, 0.6], [-0.6, 0.8]])
    half = Affine(turn, np.zeros(2), np.zeros(2))
    p = coefficients_of(family, params, chart.evaluation_point(z0, z1))
    inner = half.inverse().image(z0), half.image(z1)
    z0, z1 = (to_user(coordinates, y) for y in inner)
    moves, ends = np.ones((40, 1), bool), ((half,), (half,))
    model = GeneratedOnArcs(family, chart, DT, moves, ends, coordinates=coordinates)
    at = model.defects(p, np.stack([z0, z1], axis=1))
    np.testing.assert_allclose(at.closing, 0, atol=1e-9)
    moved = 1e-6 * np.random.default_rng(3).normal(size=(2, 40, 2))
    off = model.defects(p, np.stack([z0 + moved[0], z1 + moved[1]], axis=1))
    linear = (at.by_state[:, 0] @ moved[0][..., None])[..., 0] - moved[1]
    np.testing.assert_allclose(off.closing[:, 0], linear, atol=1e-10)


def test_misfit_is_the_posterior_mean_of_what_was_simulated():
    """Variances v ≥ 1 drawn from 1/v, and sums of squares of as many normal numbers: the mean of
    v − 1 among those whose sum is close to a given one."""
    rng = np.random.default_rng(0)
    for terms in (6, 40):
        v = np.exp(rng.uniform(0, np.log(50), 2_000_000))
        explained = v * rng.chisquare(terms, len(v))
        for given in (0.7 * terms, 1.0 * terms, 2.0 * terms):
            near = np.abs(explained - given) < 0.03 * given
            simulated = terms * np.mean(v[near] - 1)
            found = uncertainty.misfit(2.5 * given, terms, 2.5) / 2.5
            assert found == pytest.approx(simulated, rel=0.08)
    assert uncertainty.misfit(1e6, 40, 1.0) == pytest.approx(1e6 * 40 / 38 - 40)
    assert 0 < uncertainty.misfit(0.0, 40, 1.0) < 4


def sweep_of(chart, sigma, num=3_000):
    z0, z1, family, params = generated_pairs(chart, num)
    rng = np.random.default_rng(2)
    pairs = gfnn.Pairs(*(z + sigma * rng.normal(size=z.shape) for z in (z0, z1)), DT)
    data = Dataset.of(pairs, CARTESIAN).trained_on(np.arange(300, num)).validated_on(np.arange(300))
    plain = LinearSweep(data, Tolerance(1e-6), chart, Linear("polynomial"))
    return plain, family, params, pairs


def test_the_size_of_smallest_expected_error_is_that_of_the_true_s():
    plain, *_ = sweep_of(MIDPOINT, SIGMA)
    free = (Budget(), lambda message: None)
    most = next(s for s in plain.sizes if s.family.degree == 6)
    size = best_size(plain, plain.sizes[0], most, *free).size
    deviations = plain.state_deviations(size)
    np.testing.assert_allclose(deviations, SIGMA, rtol=0.1)
    sweep = NoisySweep(plain, plain, size, deviations)
    found = best_size(sweep, size, most, *free)
    assert found.size.family.degree == 4
    assert found.noise == pytest.approx(1.0, abs=0.08)


def test_a_size_whose_step_has_no_root_leaves_a_smaller_one(monkeypatch):
    plain, *_ = sweep_of(MIDPOINT, SIGMA)
    free = (Budget(), lambda message: None)
    size = next(s for s in plain.sizes if s.family.degree == 3)
    most = next(s for s in plain.sizes if s.family.degree == 6)
    plain.factors(most.group, *free)
    validate = NoisySweep.validate

    def rootless(self, size, *others):
        found = validate(self, size, *others)
        fails = size.family.degree == 4  # which is the true one
        return dataclasses.replace(found, validation_relative=np.inf) if fails else found

    monkeypatch.setattr(NoisySweep, "validate", rootless)
    request = SimpleNamespace(budget=free[0], watch=SimpleNamespace(on_progress=free[1]))
    entry = noisy_sweeps._corrected([Entry(plain.estimate(size, *free), plain, size)], request)
    assert entry.size.family.degree == 3
    assert np.isfinite(entry.candidate.validation_relative)


@pytest.mark.slow
def test_noise_behind_polar_coordinates_is_that_of_the_users():
    """The noise of the radial momentum is mostly that of the positions."""
    scene = gfnn.scenes.two_body()
    clean, rng = gfnn.sample_pairs(scene, 1_000, jax.random.key(0)), np.random.default_rng(0)
    noise = np.array([2.0, 2.0, 1.0, 1.0]) * 1e-4
    z0, z1 = (np.asarray(z) + noise * rng.normal(size=z.shape) for z in (clean.z0, clean.z1))
    data = Dataset.of(gfnn.Pairs(z0, z1, scene.dt), scene.coordinates)
    data = data.trained_on(np.arange(100, 1_000)).validated_on(np.arange(100))
    sweep = LinearSweep(data, Tolerance(1e-6), MIDPOINT, Linear("polynomial"))
    size = next(s for s in sweep.sizes if s.family.degree == 5)
    np.testing.assert_allclose(sweep.state_deviations(size), noise, rtol=0.25)


@pytest.mark.parametrize(("misfit", "count"), [(1.0, 3), (2.0, 6), (4.0, 6)])
def test_misfit_weighs_as_much_as_in_the_posterior(misfit, count):
    """Three more terms take three units of noise: worth it where twice the misfit is more."""
    counts, rows, larger = (3, 6, 9), 1_009, []
    factor = np.zeros((10, 10))
    # Noise of variance 1: every term takes one unit of it, and what nine leave is one for each row.
    factor[3:, -1] = np.sqrt([1 + misfit / 3] * 3 + [1.0] * 3 + [rows - 9.0])
    sizes = [Size(SimpleNamespace(num_parameters=n), larger, float(n)) for n in counts]
    sweep = SimpleNamespace(
        sizes=sizes,
        alike=uncertainty.ALIKE,
        factors=lambda *_: SimpleNamespace(train=Triangle(factor, rows)),
        degrees_of_freedom=lambda near, most, counts: list(map(float, counts)),
    )
    found = best_size(cast(LinearSweep, sweep), sizes[0], sizes[-1], Budget(), print)
    assert found.size.family.num_parameters == count
    assert found.noise == pytest.approx(1.0)


@pytest.mark.slow
def test_derivatives_in_the_states_count_a_base_map():
    plain, *_ = sweep_of(MIDPOINT, 0.0, 400)
    turn = np.array([[0.8, 0.6], [-0.6, 0.8]])
    half = Affine(turn, np.zeros(2), np.zeros(2))
    data = plain.data.without(None, half)
    moved = LinearSweep(data, plain.tolerance, MIDPOINT, Linear("polynomial"))
    of_point, of_target = moved.of_states
    z0, z1 = plain.data.y0[:5], plain.data.y1[:5]
    states = np.concatenate([z0, z1], axis=1) / np.tile(data.scale, 2)
    y1 = half.inverse().image(z1)
    np.testing.assert_allclose(states @ of_point.T, MIDPOINT.evaluation_point(z0, y1), atol=1e-12)
    np.testing.assert_allclose(
        states @ of_target.T, MIDPOINT.target_gradient(z0, y1, DT), atol=1e-12
    )


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::gfnn_jax.errors.FitWarning")
@pytest.mark.parametrize("tolerance", [1e-5, 1e-12])
def test_pairs_without_noise_are_fitted_as_measured(monkeypatch, tolerance):
    """The correction changes no bit of a fit that meets its tolerance, or misses it for misfit."""
    pairs = gfnn.sample_pairs(gfnn.scenes.henon_heiles(), 300, jax.random.key(0))
    options = {"learn": "map", "family": "polynomial", "chart": "midpoint"}
    fit = gfnn.fit(pairs, tolerance=tolerance, **options)
    monkeypatch.setattr("gfnn_jax.learn.fit.without_bias", lambda found, request: found)
    again = gfnn.fit(pairs, tolerance=tolerance, **options)
    np.testing.assert_array_equal(fit.map.pieces[0].params, again.map.pieces[0].params)


@pytest.mark.slow
def test_noisy_pairs_are_fitted_to_their_nearest_states(monkeypatch):
    """Two pairs of fits: with as without the correction, error at a hundred steps."""
    scene = gfnn.scenes.henon_heiles()
    clean = gfnn.sample_pairs(scene, 2_000, jax.random.key(0))
    rng = np.random.default_rng(0)
    spread = np.std(clean.z0, axis=0)
    z0, z1 = (
        np.asarray(z) + 0.03 * spread * rng.normal(size=z.shape) for z in (clean.z0, clean.z1)
    )
    test = np.asarray(gfnn.sample_test_states(scene, 30, jax.random.key(7)))
    reference = np.asarray(gfnn.reference_trajectories(scene, test, 50))

    def error() -> float:
        with pytest.warns(gfnn.FitWarning):
            fit = gfnn.fit(
                gfnn.Pairs(z0, z1, scene.dt), learn="map", family="polynomial", chart="type2"
            )
        np.testing.assert_allclose(fit.noise / spread, 0.03, rtol=0.12)
        return float(np.sqrt(np.mean((np.asarray(fit.map.rollout(test, 50)[0]) - reference) ** 2)))

    corrected = error()
    monkeypatch.setattr(noisy_sweeps, "only_noise", lambda entry, found: False)
    assert corrected < 0.8 * error()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::gfnn_jax.errors.FitWarning")
def test_noise_beyond_the_radial_speed_leaves_a_chart_that_is_corrected():
    """In polar coordinates the noise is half of the radial momentum's spread: no states near the
    measured ones follow an S of many terms, and errors of different coordinates do not compare."""
    scene = gfnn.scenes.two_body()
    clean, rng = gfnn.sample_pairs(scene, 1_000, jax.random.key(511)), np.random.default_rng(511)
    z0, z1 = (
        np.asarray(z) + 0.01 * np.std(clean.z0, axis=0) * rng.normal(size=z.shape)
        for z in (clean.z0, clean.z1)
    )
    fit = gfnn.fit(gfnn.Pairs(z0, z1, scene.dt), scene, learn="map", max_seconds=None)
    test = np.asarray(gfnn.sample_test_states(scene, 100, jax.random.key(7)))
    true = np.asarray(gfnn.reference_trajectories(scene, test, 1))[:, 1]
    error = np.asarray(fit.map.step(test)[0]) - true
    assert np.sqrt(np.mean(error**2)) < 2e-3  # 7e-3 of the measured points
