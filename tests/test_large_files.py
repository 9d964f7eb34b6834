"""Files larger than memory: a sample chooses the candidate, all pairs fit it."""

import jax
import numpy as np
import pytest

import gfnn_jax as gfnn
from gfnn_jax.data.files import iterate_pairs, read_sample, read_trajectories
from gfnn_jax.jobs import fit as fit_job
from gfnn_jax.learn.refit import refit


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    scene = gfnn.scenes.make("standard-map-regular")
    pairs = gfnn.sample_pairs(scene, 3_000, jax.random.key(0))
    rng = np.random.default_rng(0)
    z0, z1 = (np.asarray(z) + 1e-4 * rng.standard_normal(z.shape) for z in (pairs.z0, pairs.z1))
    path = tmp_path_factory.mktemp("data") / "pairs.npz"
    np.savez(path, z0=z0, z1=z1, dt=1.0)
    return path


def test_a_sample_knows_precision_and_units_as_the_whole_does(tmp_path):
    states = np.random.default_rng(0).standard_normal((50, 2))
    np.save(tmp_path / "z.npy", states.astype(np.float32))
    assert read_sample(tmp_path / "z.npy", dt=0.1).precision == "float32"
    header = "t,q1 [km],p1 [km/s]"
    rows = np.column_stack([0.1 * np.arange(50), states])
    np.savetxt(tmp_path / "z.csv", rows, delimiter=",", header=header)
    assert read_sample(tmp_path / "z.csv").units == {"q1": "km", "p1": "km/s"}


def test_a_sample_is_of_the_files_own_pairs_each_once(file):
    whole = read_trajectories(file).pairs()
    sample = read_sample(file, num_pairs=500, seed=1)
    rows = {tuple(r) for r in np.hstack([whole.z0, whole.z1])}
    drawn = [tuple(r) for r in sample.states.reshape(500, -1)]
    assert len(set(drawn)) == 500
    assert set(drawn) <= rows
    again = read_sample(file, num_pairs=500, seed=1)
    np.testing.assert_array_equal(again.states, sample.states)
    # Uniform over the file: the mean row of 500 among 3,000, within five standard deviations.
    place = {tuple(r): i for i, r in enumerate(np.hstack([whole.z0, whole.z1]))}
    mean = np.mean([place[r] for r in drawn])
    assert abs(mean - 1500) < 5 * 3_000 / np.sqrt(12 * 500)


@pytest.mark.slow
def test_all_pairs_fit_better_than_the_sample(file, tmp_path, monkeypatch):
    monkeypatch.setattr(fit_job, "_LARGE_BYTES", 0)
    monkeypatch.setattr(fit_job, "read_sample", lambda p, dt: read_sample(p, dt=dt, num_pairs=200))
    ran = fit_job.fit(file, out=tmp_path / "m", scene_name="standard-map-regular", tolerance=1e-3,
                       chart="type2")  # fmt: skip
    assert ran is not None
    assert ran.report["data"]["num_pairs"] == 3_000
    scene = gfnn.scenes.make("standard-map-regular")
    test = gfnn.sample_pairs(scene, 500, jax.random.key(9))
    sample = gfnn.fit(
        read_sample(file, num_pairs=200).pairs(), scene, tolerance=1e-3, chart=ran.fit.chosen.chart
    )

    def error(map_):
        difference = np.asarray(map_.step(test.z0)[0] - test.z1)
        return np.sqrt(np.mean((difference - 2 * np.pi * np.round(difference / 2 / np.pi)) ** 2))

    # 15 times the pairs: the error that the noise leaves falls by about √15.
    assert error(ran.fit.map) < 0.6 * error(sample.map)


@pytest.fixture(scope="module")
def sampled(file):
    """Pairs of a file, those held out, and a fit of a sample of the others."""
    pairs = read_trajectories(file).pairs()
    scene = gfnn.scenes.make("standard-map-regular")
    few = pairs.take(slice(200, 500))
    return pairs, pairs.take(slice(200)), gfnn.fit(few, scene, tolerance=1e-3, chart="type2")


def moved(fit, pairs):
    return np.asarray(fit.map.step(pairs.z0)[0])


def test_outliers_are_left_out_of_a_refit(sampled):
    pairs, held, fit = sampled
    z1, rows = np.array(pairs.z1), [100, 700, 2_500]  # the first of them among those held out
    z1[rows] += [[0.0, 1e3], [0.0, 1e3], [np.pi, 0.0]]
    wrong = gfnn.Pairs(pairs.z0, z1, 1.0)
    clean = pairs.take(np.delete(np.arange(3_000), rows))
    with pytest.warns(gfnn.FitWarning, match="3 of 3000 pairs are far from what the others tell"):
        again = refit(fit, [wrong], wrong.take(slice(200)))
    assert again.met
    assert again.num_pairs == 2_997
    other = refit(fit, [clean], held.take(np.delete(np.arange(200), 100)))
    np.testing.assert_allclose(moved(again, held), moved(other, held), rtol=0, atol=1e-12)


def test_those_held_out_have_no_part_in_a_refit(sampled):
    pairs, held, fit = sampled
    others = pairs.take(slice(200, None))
    np.testing.assert_array_equal(
        moved(refit(fit, [pairs], held), held),
        moved(refit(fit, [others], held), held),
    )


@pytest.mark.parametrize("kick", [5e-4, 1e3])
def test_a_worse_refit_is_not_kept(sampled, kick):
    """Pairs of another map: close enough to be believed, or so far that nothing is left."""
    pairs, held, fit = sampled
    others = pairs.take(slice(200, None))
    other = gfnn.Pairs(others.z0, others.z1 + np.array([0.0, kick]), 1.0)
    with pytest.warns(gfnn.FitWarning, match="whose map is kept"):
        again = refit(fit, [other], held)
    np.testing.assert_array_equal(moved(again, held), moved(fit, held))
    assert again.num_pairs == fit.num_pairs
    assert any("whose map is kept" in message for message in again.messages)


def test_refitting_to_the_same_pairs_in_chunks_changes_nothing(file):
    scene = gfnn.scenes.make("standard-map-regular")
    pairs = read_trajectories(file).pairs()
    fit = gfnn.fit(pairs, scene, tolerance=1e-3, chart="type2")
    held = pairs.take(slice(200))
    once = refit(fit, [pairs], held)
    chunked = refit(fit, iterate_pairs(file, 700), held)
    assert chunked.num_pairs == once.num_pairs == 3_000
    np.testing.assert_allclose(
        chunked.map.step(pairs.z0)[0], once.map.step(pairs.z0)[0], rtol=0, atol=1e-12
    )
