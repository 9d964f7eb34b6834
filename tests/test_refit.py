"""All pairs of a file fit the map that a sample chose: outliers, judges, chunks."""

import numpy as np
import pytest
from analytic import standard_map

import gfnn_jax as gfnn
from gfnn_jax.learn.refit import refit

SIGMA = 1e-4


pytestmark = pytest.mark.slow  # one fit of 3,000 pairs, and its programs


@pytest.fixture(scope="module")
def sampled():
    """Noisy pairs of the standard map, those held out, and a fit of a sample of the others."""
    rng = np.random.default_rng(0)
    z = rng.uniform(-1, 1, (3_000, 2))
    noise = SIGMA * rng.standard_normal((2, *z.shape))
    pairs = gfnn.Pairs(z + noise[0], standard_map(z, 0.6) + noise[1], 1.0)
    few = pairs.take(slice(200, 500))
    fit = gfnn.fit(few, angles=(0,), tolerance=3e-3, chart="type2")
    return pairs, pairs.take(slice(200)), fit


def moved(fit, pairs):
    return np.asarray(fit.map.step(pairs.z0)[0])


def test_pairs_in_chunks_give_the_same_map(sampled):
    pairs, held, fit = sampled
    chunks = (pairs.take(slice(first, first + 700)) for first in range(0, 3_000, 700))
    chunked, once = refit(fit, chunks, held), refit(fit, [pairs], held)
    assert chunked.num_pairs == once.num_pairs == 3_000
    np.testing.assert_allclose(moved(chunked, held), moved(once, held), rtol=0, atol=1e-12)


def test_wrong_pairs_are_left_out(sampled):
    pairs, held, fit = sampled
    z1, rows = np.array(pairs.z1), [100, 700, 2_500]  # the first of them among those held out
    z1[rows] += [[0.0, 1e3], [0.0, 1e3], [np.pi, 0.0]]
    wrong = gfnn.Pairs(pairs.z0, z1, 1.0)
    clean = pairs.take(np.delete(np.arange(3_000), rows))
    with pytest.warns(gfnn.FitWarning, match="3 of 3000 pairs are outliers"):
        again = refit(fit, [wrong], wrong.take(slice(200)))
    assert again.met
    assert again.num_pairs == 2_997
    other = refit(fit, [clean], held.take(np.delete(np.arange(200), 100)))
    np.testing.assert_allclose(moved(again, held), moved(other, held), rtol=0, atol=1e-12)


def test_whole_turns_of_an_angle_do_not_matter(sampled):
    pairs, held, fit = sampled
    turns = 2 * np.pi * np.random.default_rng(2).integers(-3, 4, (3_000, 1)) * [[1.0, 0.0]]
    turned = gfnn.Pairs(pairs.z0, pairs.z1 + turns, 1.0)
    again, other = refit(fit, [turned], held), refit(fit, [pairs], held)
    assert again.num_pairs == 3_000
    np.testing.assert_allclose(moved(again, held), moved(other, held), rtol=0, atol=1e-12)


def test_those_held_out_have_no_part_in_it(sampled):
    pairs, held, fit = sampled
    others = pairs.take(slice(200, None))
    np.testing.assert_array_equal(
        moved(refit(fit, [pairs], held), held), moved(refit(fit, [others], held), held)
    )


@pytest.mark.parametrize("kick", [2e-3, 1e3])
def test_a_worse_map_is_not_kept(sampled, kick):
    """Pairs of another map: close enough to be believed, or so far that nothing is left."""
    pairs, held, fit = sampled
    others = pairs.take(slice(200, None))
    other = gfnn.Pairs(others.z0, others.z1 + np.array([0.0, kick]), 1.0)
    with pytest.warns(gfnn.FitWarning, match="is kept"):
        again = refit(fit, [other], held)
    np.testing.assert_array_equal(moved(again, held), moved(fit, held))
    assert again.num_pairs == fit.num_pairs
    assert any("is kept" in message for message in again.messages)
