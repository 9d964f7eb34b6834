"""The final map is fitted to the test rows too, where rows are scarce; what is stated is not."""

import warnings

import jax
import numpy as np
import pytest

import gfnn_jax as gfnn
from gfnn_jax.phase_space import sizes


@pytest.fixture(scope="module")
def few():
    """A fit to 190 pairs of Hénon–Heiles, all of whose sizes are too small."""
    scene = gfnn.scenes.henon_heiles(1 / 12)
    pairs = gfnn.sample_pairs(scene, 2_190, jax.random.key(0))
    rows = np.arange(2_190)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        fit = gfnn.fit(
            pairs.take(rows[:190]),
            tolerance=1e-14,
            learn="map",
            chart="midpoint",
            family="polynomial",
            max_seconds=None,
        )
    return fit, pairs.take(rows[190:])


def least_squares(fit, pairs):
    """Coefficients of the chosen size's terms by NumPy, from these pairs."""
    (piece,) = fit.map.pieces
    z0, z1, scale = np.asarray(pairs.z0), np.asarray(pairs.z1), np.asarray(piece.scale)
    w, moved = 0.5 * (z0 + z1), z1 - z0
    target = np.concatenate([-moved[:, 2:], moved[:, :2]], axis=1) / float(pairs.dt)
    weight = 1.0 / np.roll(scale, 2)
    family = jax.tree.map(np.asarray, piece.family)
    slopes = family.term_gradients(w) * weight[:, None]
    return np.linalg.lstsq(
        slopes.reshape(-1, slopes.shape[-1]), (target * weight).ravel(), rcond=None
    )[0]


def without(fit, *parts):
    """Pairs of the fit that are in none of these parts."""
    apart = {tuple(z) for part in parts for z in np.asarray(part.z0)}
    rows = [i for i, z in enumerate(np.asarray(fit.pairs.z0)) if tuple(z) not in apart]
    return fit.pairs.take(np.array(rows))


@pytest.mark.slow
def test_the_coefficients_are_of_training_and_test_pairs(few):
    fit, _ = few
    assert fit.stated_by.endswith(
        "took no part in the fit or its choices; the map is fitted to them too"
    )
    (piece,) = fit.map.pieces
    z = np.asarray(fit.test_pairs.z0)
    found = piece.family.gradient(piece.params, z)
    both, alone = (
        piece.family.gradient(piece.family.unflatten(least_squares(fit, without(fit, *parts))), z)
        for parts in ([fit.validation_pairs], [fit.validation_pairs, fit.test_pairs])
    )
    off = np.abs(found - both).max()
    assert off < 1e-12 < 1e-10 < np.abs(found - alone).max()


@pytest.mark.slow
def test_the_stated_error_is_that_without_them(few):
    fit, fresh = few
    test = fit.test_pairs
    relative = []
    for pairs in (test, fresh):
        error = np.asarray(fit.map.step(pairs.z0)[0]) - np.asarray(pairs.z1)
        relative.append(np.sqrt(np.mean((error / sizes(fit.pairs.z0)) ** 2)))
    # The final map has seen the test pairs; it is no worse on fresh ones than what is stated.
    assert relative[0] < 0.8 * fit.chosen.validation_relative
    assert relative[1] < 1.5 * fit.chosen.validation_relative


@pytest.mark.slow
def test_test_pairs_take_no_size_away(few):
    """190 pairs, of which 19 choose: 171 of four rows each determine 228 terms, 152 only 202."""
    fit, _ = few
    assert 202 < max(c.num_parameters for c in fit.candidates) <= 228


@pytest.mark.slow
def test_plenty_of_pairs_stay_as_they_are():
    rng = np.random.default_rng(0)
    z = rng.uniform(-1, 1, (200, 2))
    image = np.stack([z[:, 0] + 0.3 * z[:, 1], z[:, 1]], axis=1)
    fit = gfnn.fit(gfnn.Pairs(z, image, 0.3), tolerance=1e-6, learn="map")
    assert "fitted to them too" not in fit.stated_by
