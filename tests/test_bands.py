"""Posterior of the coefficients, maps drawn from it, bands of predictions."""

from unittest import mock

import jax
import numpy as np
import pytest
from analytic import generated, henon_heiles_pairs, map_of, standard_map

import gfnn_jax as gfnn
from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.data.files import read_initial_noise
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.errors import InputError
from gfnn_jax.families.terms import given_terms
from gfnn_jax.fitting import uncertainty
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.generating.charts import MIDPOINT, TYPE2
from gfnn_jax.jobs.output import Output
from gfnn_jax.jobs.predict import Steps, predict
from gfnn_jax.maps.posterior import bands, horizon
from gfnn_jax.models.generating_functions import sweeps
from gfnn_jax.models.generating_functions.map_of_terms import SumOfTerms
from gfnn_jax.models.generating_functions.sweeps import Linear, LinearSweep
from gfnn_jax.scenes import henon_heiles, two_body

NOISE = 1e-3


SIX = ["p1**2", "p2**2", "q1**2", "q2**2", "q1**2*q2", "q2**3"]


def noisy_fit(**options):
    """Forty sequences of fifty states with noise, and the law that is learned of them."""
    scene = henon_heiles()
    z0 = np.asarray(gfnn.sample_test_states(scene, 40, jax.random.key(0)))
    states = np.asarray(gfnn.reference_trajectories(scene, z0, 49))
    states = states + NOISE * np.random.default_rng(0).normal(size=states.shape)
    pairs = gfnn.Pairs(states[:, :-1].reshape(-1, 4), states[:, 1:].reshape(-1, 4), scene.dt)
    with pytest.warns(gfnn.FitWarning):
        return scene, gfnn.fit(pairs, learn="hamiltonian", **options)


@pytest.fixture(scope="module")
def noisy():
    return noisy_fit(terms=SIX)


@pytest.fixture(scope="module")
def told_nothing():
    return noisy_fit()


@pytest.mark.slow
def test_a_law_is_fitted_to_whole_sequences(told_nothing):
    """Pairs alone gave 2 to 5e-5 of one step and 4 to 10e-4 of a hundred."""
    scene, fit = told_nothing
    assert fit.hamiltonian.arcs == 40
    assert fit.chosen.num_parameters == 6
    np.testing.assert_allclose(fit.noise, NOISE, rtol=0.04)
    test = np.asarray(gfnn.sample_test_states(scene, 40, jax.random.key(111)))
    reference = np.asarray(gfnn.reference_trajectories(scene, test, 100))
    error = np.asarray(fit.map.rollout(test, 100)[0]) - reference
    rms = np.sqrt(np.mean(error**2, axis=(0, 2)))
    assert rms[1] <= 3e-5
    assert rms[100] <= 3e-4


def factored(rows, target):
    return Triangle.of(np.column_stack([rows, target]))


def test_covariance_is_that_of_the_textbook_where_all_rows_are_alike():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(20_000, 3)) * [1.0, 10.0, 0.1]
    residual = 0.2 * rng.choice([-1.0, 1.0], size=len(rows))
    train = factored(rows, residual)
    root = uncertainty.root(train, 3, (rows, residual), noise=1.0)
    inverse = np.linalg.inv(rows.T @ rows)
    leverage = np.sum((rows @ inverse) * rows, axis=1)
    middle = rows.T @ (rows * (0.04 / (1 - leverage) ** 2)[:, None])
    np.testing.assert_allclose(root.T @ root, inverse @ middle @ inverse, rtol=1e-3)
    misfit = uncertainty.root(train, 3, (rows, residual), noise=0.0)
    inflated = root.T @ root * 2 * len(rows) / 3
    np.testing.assert_allclose(misfit.T @ misfit, inflated, rtol=1e-9)


def test_noise_of_shared_states_nearly_cancels():
    """Of a slope c that is read off a noisy sequence, c̄ + noise: r_k = e_{k+1} − e_k, A = 1."""
    rng, repeats, count = np.random.default_rng(0), 400, 60
    noise = rng.normal(size=(repeats, count + 1)) * 0.3
    true = np.var(np.diff(noise, axis=1).mean(axis=1))
    found = []
    for e in noise[:20]:
        left = np.diff(e)[:, None] - np.mean(np.diff(e))
        slopes, one = np.ones((count, 1, 1)), np.ones((count, 1, 1))
        rows = uncertainty.scores(slopes, left, -one, one, np.ones(count - 1, bool))
        found.append(np.sum(rows**2) / count**2)
    assert np.mean(found) == pytest.approx(true, rel=0.2)  # 400 repeats tell it to a tenth
    assert np.mean(found) < 0.1 * np.var(np.diff(noise)) / count


def test_directions_that_no_row_tells_are_not_sampled():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(500, 2))[:, [0, 1, 1]]
    residual = rng.normal(size=500)
    root = uncertainty.root(factored(rows, residual), 3, (rows, residual), noise=1.0)
    assert np.abs(root @ [0.0, 1.0, -1.0]).max() < 1e-12
    assert np.linalg.norm(root @ [0.0, 1.0, 1.0]) > 0.01


@pytest.mark.slow
def test_bands_hold_the_true_error_of_a_noisy_law(noisy):
    scene, fit = noisy
    z0 = np.asarray(gfnn.sample_test_states(scene, 30, jax.random.key(9)))
    reference = np.asarray(gfnn.reference_trajectories(scene, z0, 100))
    samples = fit.sample(jax.random.key(1), 30)
    states, info = samples.rollout(z0, 100)
    mean = np.asarray(fit.map.rollout(z0, 100)[0])
    assert states.shape == (30, 30, 101, 4)
    assert (np.asarray(info.status) <= 1).all()
    band = 2 * bands(states, mean).std
    for step in (1, 10, 100):
        error = np.abs(mean - reference)[:, step]
        assert np.mean(error <= band[:, step]) > 0.75  # six coefficients: errors go together
        assert np.median(band[:, step]) < 4 * np.sqrt(np.mean(error**2))


@pytest.mark.slow
def test_a_rollout_has_the_bands_of_its_samples(noisy):
    scene, fit = noisy
    z0 = np.asarray(gfnn.sample_test_states(scene, 3, jax.random.key(9)))
    states, info = fit.map.rollout(z0, 6, save_every=2, samples=8, key=jax.random.key(1))
    drawn = fit.sample(jax.random.key(1), 8).rollout(z0, 6, save_every=2)[0]
    assert info.bands.std.shape == info.bands.median.shape == (3, 4, 4)
    np.testing.assert_allclose(info.bands.median, np.median(drawn, axis=0), atol=1e-15)
    np.testing.assert_array_equal(info.bands.std, bands(drawn, states).std)
    np.testing.assert_array_equal(states, fit.map.rollout(z0, 6, save_every=2)[0])
    one = fit.map.rollout(z0[1], 6, save_every=2, samples=8, key=jax.random.key(1))[1].bands
    np.testing.assert_allclose(one.std, info.bands.std[1], rtol=1e-9, atol=1e-15)
    assert one.quantiles.shape == (3, 4, 4)
    with pytest.raises(ValueError, match="a key"):
        fit.map.rollout(z0, 6, samples=8)


@pytest.mark.slow
def test_every_sample_is_a_symplectic_map_and_rolls_out_as_it(noisy):
    scene, fit = noisy
    z0 = np.asarray(gfnn.sample_test_states(scene, 3, jax.random.key(9)))
    samples = fit.sample(jax.random.key(1), 4)
    together = np.asarray(samples.rollout(z0, 5)[0])
    for i in (0, 3):
        alone = np.asarray(samples[i].rollout(z0, 5)[0])
        np.testing.assert_allclose(together[i], alone, rtol=0, atol=1e-14)
        assert float(np.max(np.asarray(samples[i].defect(z0)))) < 1e-13
    assert np.abs(together[0] - together[3]).max() > 1e-6
    again = np.asarray(fit.sample(jax.random.key(1), 4).params)
    np.testing.assert_array_equal(again, np.asarray(samples.params))


@pytest.mark.slow
def test_samples_roll_back_to_where_they_began(noisy):
    _, fit = noisy
    samples = fit.map.sample(jax.random.key(1), 3)
    z = np.array([[0.1, 0.2, -0.1, 0.05]])
    ahead, _ = samples.rollout(z, 20)
    ends = np.asarray(ahead)[:, :, -1]
    back, _ = samples.rollout(ends, -20)
    np.testing.assert_allclose(back, ahead[:, :, ::-1], rtol=0, atol=1e-13)
    shared, _ = fit.map.sharded(1).rollout(ends[0], -20)
    alone, _ = fit.map.rollout(ends[0], -20)
    np.testing.assert_allclose(shared, alone, rtol=0, atol=1e-14)
    with pytest.raises(ValueError, match="inputs"):
        samples.rollout(z, -2, inputs=np.ones((2, 1)))


@pytest.mark.slow
def test_a_law_of_uneven_times_knows_each_rows_own_step():
    """Of an oscillator, turned by h, noise σ leaves each of 2N numbers an error of σ√2, and a
    coefficient moves them by about h times the states: two thirds of a unit in the square."""
    rng = np.random.default_rng(3)
    z, h = rng.uniform(-1, 1, (600, 2)), rng.uniform(0.1, 0.4, 600)
    turn = np.stack([np.cos(h), np.sin(h), -np.sin(h), np.cos(h)], axis=1).reshape(-1, 2, 2)
    image = (turn @ z[..., None])[..., 0]
    noise = NOISE * rng.normal(size=(2, *z.shape))
    pairs = gfnn.Pairs(z + noise[0], image + noise[1], h)
    with pytest.warns(gfnn.FitWarning):
        fit = gfnn.fit(pairs, learn="hamiltonian", terms=["q1**2", "p1**2"])
    fit = fit.map.posterior
    std = np.linalg.norm(np.asarray(fit.root), axis=0)
    expected = NOISE * np.sqrt(2) / np.sqrt(600 * np.mean(h**2) * 4 / 3)
    assert np.all((std > 0.3 * expected) & (std < 3 * expected)), std / expected


@pytest.mark.slow
def test_the_posterior_of_s_covers_the_held_out_misfit():
    pairs, fresh = henon_heiles_pairs(400, 0), henon_heiles_pairs(200, 1)
    fit = gfnn.fit(pairs, learn="map", family="polynomial", chart="midpoint", tolerance=1e-3)
    posterior = fit.map.posterior
    piece = fit.map.pieces[posterior.piece]
    point = MIDPOINT.evaluation_point(fresh.z0, fresh.z1)
    aim = MIDPOINT.target_gradient(fresh.z0, fresh.z1, fresh.dt)
    error = piece.family.gradient(piece.params, point) - aim
    std = np.linalg.norm(piece.family.term_gradients(point) @ posterior.root.T, axis=-1)
    assert np.mean(np.abs(error) <= 2 * std) > 0.88
    assert 0.5 < np.sqrt(np.mean(std**2) / np.mean(error**2)) < 3


def test_residual_of_s_moves_with_the_states_as_its_derivatives_say():
    pairs = henon_heiles_pairs(100)
    data = Dataset.of(pairs, CARTESIAN).trained_on(np.arange(80)).validated_on(np.arange(80, 100))
    for chart in (MIDPOINT, TYPE2):
        sweep = LinearSweep(data, Tolerance(1e-6), chart, Linear("polynomial"))
        family = sweep.sizes[0].family
        drawn = np.random.default_rng(0).normal(size=family.num_parameters)
        params = family.unflatten(drawn)

        def residual(y0, y1, sweep=sweep, chart=chart, family=family, params=params):
            gradient = family.gradient(params, chart.evaluation_point(y0, y1))
            return sweep._weight * (gradient - chart.target_gradient(y0, y1, pairs.dt))

        y0, y1, scale = data.y0[:5], data.y1[:5], data.scale
        found = sweep.by_states(family, params, chart.evaluation_point(y0, y1))
        off = 1e-5 * np.diag(scale)
        for j in range(4):
            by = [
                (residual(y0 + off[j], y1) - residual(y0 - off[j], y1)) / 2e-5,
                (residual(y0, y1 + off[j]) - residual(y0, y1 - off[j])) / 2e-5,
            ]
            for whole, column in zip(found, by, strict=True):
                np.testing.assert_allclose(whole[:, :, j], column, rtol=0, atol=1e-7)


def test_noise_that_differs_between_coordinates_is_told_from_misfit():
    """A radial momentum of circular orbits has thirty times the noise of an angle, ÷ spreads; the
    part of noise is what the same size leaves less of the pairs without noise."""
    scene, rng, found, true = two_body(), np.random.default_rng(0), [], []
    clean = gfnn.sample_pairs(scene, 400, jax.random.key(0))
    spread = np.std(clean.z0, axis=0)
    for rows in np.split(np.arange(400), 4):
        squares = []
        for noise in (0.0, 1e-4 * spread):
            states = (z[rows] + noise * rng.normal(size=(100, 4)) for z in (clean.z0, clean.z1))
            data = Dataset.of(gfnn.Pairs(*states, scene.dt), scene.coordinates)
            data = data.trained_on(np.arange(80)).validated_on(np.arange(80, 100))
            sweep = LinearSweep(data, Tolerance(1e-6), MIDPOINT, Linear("polynomial"))
            size = sweep.sizes[2]
            left = sweep.factors(size.group).train.residual_norm(size.family.num_parameters)
            squares.append(left**2)
        with mock.patch.object(sweeps, "part_of_noise", wraps=sweeps.part_of_noise) as part:
            sweep.root(size)
        found.append(sweeps.part_of_noise(*part.call_args.args))
        true.append(1 - squares[0] / squares[1])
    assert np.mean(found) == pytest.approx(np.mean(true), abs=0.15)


def test_bands_compare_angles_modulo_turns():
    rng = np.random.default_rng(0)
    off = 0.1 * rng.normal(size=(4_000, 1, 1, 2))
    states = np.array([[[1.0, 2.0]]])
    turned = off + [2 * np.pi, 0.0] * rng.integers(-2, 3, size=(4_000, 1, 1, 1))
    found = bands(states + turned, states, angles=(0,))
    np.testing.assert_allclose(found.std, 0.1, rtol=0.05)
    np.testing.assert_allclose(
        found.quantiles[:, 0, 0] - states[0, 0], np.outer([-0.1645, 0, 0.1645], [1, 1]), atol=0.01
    )


def test_horizon_is_the_first_step_beyond():
    std = np.zeros((3, 4, 2))
    std[0, 2:, 0] = 1.0
    std[2, 3, 0] = np.nan
    np.testing.assert_array_equal(horizon(std, [0, 10, 20, 30], 1.5), [20, -1, 30])


@pytest.mark.slow
def test_predictions_hold_bands(noisy, tmp_path, monkeypatch):
    scene, fit = noisy
    fit.map.save(tmp_path / "model")
    loaded = gfnn.load(tmp_path / "model").map
    np.testing.assert_array_equal(
        np.asarray(loaded.sample(jax.random.key(3), 2).params),
        np.asarray(fit.sample(jax.random.key(3), 2).params),
    )
    z0 = np.asarray(gfnn.sample_test_states(scene, 5, jax.random.key(9)))
    np.save(tmp_path / "z0.npy", z0)
    np.savez(tmp_path / "noisy.npz", z0=z0, z0_std=np.full(z0.shape, 0.01))

    def predicted(initial, out):
        asked = Steps(20, samples=8, horizon=0.02)
        predict(tmp_path / "model", tmp_path / initial, Output(tmp_path / out), asked)
        with np.load(tmp_path / out) as file:
            return dict(file)

    clean, with_start = predicted("z0.npy", "a.npz"), predicted("noisy.npz", "b.npz")
    assert clean["std"].shape == clean["trajectories"].shape == (5, 21, 4)
    assert clean["quantiles"].shape == (3, 5, 21, 4)
    assert (np.diff(clean["quantiles"], axis=0) >= 0).all()
    assert str(clean["band"]) == "model"
    assert str(with_start["band"]) == "model and initial state"
    assert (clean["std"][:, 0] == 0).all()
    assert np.median(with_start["std"][:, 0]) == pytest.approx(0.01, rel=0.3)
    assert (clean["horizon"] == -1).all()
    assert (with_start["horizon"] >= 0).all()
    monkeypatch.setattr("gfnn_jax.jobs.predict._CHUNK_LANE_STEPS", 9 * 5 * 6)  # six steps a chunk
    np.testing.assert_array_equal(predicted("z0.npy", "c.npz")["std"], clean["std"])


def test_what_is_no_noise_of_initial_states_is_refused(tmp_path):
    path = tmp_path / "z0.npz"
    for bad in (np.zeros((2, 3)), np.full((2, 4), -1.0), np.full((2, 4), np.nan)):
        np.savez(path, z0=np.zeros((2, 4)), z0_std=bad)
        with pytest.raises(InputError, match="z0_std"):
            read_initial_noise(path, (2, 4))
    piece = generated(given_terms(1, ["q1**2", "p1**2"]), np.ones(2), MIDPOINT, 0.3)
    map_of(piece, np.ones((3, 2))).save(tmp_path / "model")
    with pytest.raises(InputError, match="horizon= needs samples="):
        predict(tmp_path / "model", path, Output(tmp_path / "o.npz"), Steps(2, horizon=1.0))


@pytest.fixture(scope="module")
def kicked():
    """600 pairs with noise of standard maps of several strengths, which are told."""
    rng = np.random.default_rng(0)
    z, k = rng.uniform(-1, 1, (600, 2)), rng.uniform(0.5, 1.0, 600)
    noisy = (x + 1e-3 * rng.normal(size=x.shape) for x in (z, standard_map(z, k)))
    return gfnn.Pairs(*noisy, 1.0, args={"k": k})


def test_the_posterior_of_s_with_parameters_tells_noise_from_misfit(kicked):
    data, rng = Dataset.of(kicked, CARTESIAN), np.random.default_rng(1)
    data = data.trained_on(np.arange(500)).validated_on(np.arange(500, 600))
    found = SumOfTerms(data, Tolerance(1e-8), chart="type2").learned()
    z, args = rng.uniform(-0.8, 0.8, (200, 2)), rng.uniform(0.6, 0.9, (200, 1))
    image, piece = standard_map(z, args[:, 0]), found.piece
    point, aim = TYPE2.evaluation_point(z, image), TYPE2.target_gradient(z, image, 1.0)
    error = piece.family.gradient(np.asarray(piece.params), point, args) - aim
    slopes = piece.family.term_gradients(point, args)
    std = np.linalg.norm(slopes @ found.covariance().T, axis=-1)
    assert 0.5 < np.sqrt(np.mean(std**2) / np.mean(error**2)) < 2


@pytest.mark.slow
def test_bands_of_a_polynomial_with_parameters(kicked):
    with pytest.warns(gfnn.FitWarning):
        fit = gfnn.fit(kicked, angles=(0,), family="polynomial", chart="type2", tolerance=1e-8)
    rng = np.random.default_rng(1)
    z, k = rng.uniform(-0.8, 0.8, (40, 2)), rng.uniform(0.6, 0.9, 40)
    states, info = fit.map.rollout(z, 1, params=k[:, None], samples=30, key=jax.random.key(0))
    error = np.asarray(states)[:, 1] - standard_map(z, k)
    assert 0.7 < np.median(2 * info.bands.std[:, 1]) / np.sqrt(np.mean(error**2)) < 4
