"""Files larger than memory: a sample chooses the candidate, all pairs fit it."""

import functools

import jax
import numpy as np
import pytest

import gfnn_jax as gfnn
from gfnn_jax.data.files import read_trajectories
from gfnn_jax.data.sample import read_sample
from gfnn_jax.jobs import fit as fit_job
from gfnn_jax.jobs.output import Output


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


def test_a_sample_knows_of_how_many_pairs_it_is(file):
    assert read_sample(file, num_pairs=500).sampled == 3_000
    assert read_trajectories(file).sampled is None


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
    few = functools.partial(read_sample, num_pairs=200)
    monkeypatch.setattr(fit_job, "read_sample", few)
    ran = fit_job.fit(
        file,
        output=Output(tmp_path / "m"),
        scene_name="standard-map-regular",
        tolerance=1e-3,
        chart="type2",
    )
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
