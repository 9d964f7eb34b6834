"""``gfnn compare``: the same data through other methods, and what becomes of an interrupted one."""

import dataclasses
import json

import jax
import numpy as np
import pytest

import gfnn_jax as gfnn
from gfnn_jax import scenes
from gfnn_jax.baselines import Budget
from gfnn_jax.baselines.learned import paper_gfnn
from gfnn_jax.errors import InputError
from gfnn_jax.jobs import compare as comparison
from gfnn_jax.jobs.compare import SharedData
from gfnn_jax.jobs.figures import divergences
from gfnn_jax.jobs.measure import Rollouts, affine_errors, without_runaways
from gfnn_jax.jobs.output import Output
from gfnn_jax.jobs.progress import Progress

CHEAP = ("p-sympnet", "hnn")


@pytest.fixture(scope="module")
def small():
    """Little data, short rollouts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(comparison, "_QUICK_PAIRS", 500)
        patch.setattr(comparison, "_QUICK_TRAJECTORIES", 3)
        patch.setattr(comparison, "_NUM_FRESH", 50)
        patch.setattr(comparison, "NUM_STEPS", 100)
        yield


def compare(out, methods=CHEAP, scene="two-body", seed=0, **options):
    given = {"methods": methods, "quick": True, "seed": seed, "cap": 0.2}
    return comparison.compare(scene, Output(out, **options), **given)


@pytest.mark.slow
def test_an_interrupted_comparison_keeps_what_is_finished_and_reports_all(small, tmp_path):
    out = tmp_path / "out"

    def stop(line):
        if line.startswith("P-SympNet"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compare(out, progress=Progress(stop))
    assert not out.exists()
    kept = json.loads((out.with_name("out.partial") / "hnn.json").read_text())
    with pytest.raises(InputError, match="an unfinished comparison"):
        compare(out)
    with pytest.raises(InputError, match="seed"):
        compare(out, resume=True, seed=1)
    told = []
    compared = compare(out, resume=True, progress=Progress(told.append))
    assert compared is not None
    report = json.loads((out / "report.json").read_text())
    assert report == compared
    assert list(report["methods"]) == ["hnn", "p-sympnet"]
    for part in report["methods"].values():
        assert {"model", "data", "fit", "map", "rollout"} <= set(part)
        assert part["data"] == {"num_pairs": 500, "sequence_length": 2}
        assert part["fit"]["capped"]
        assert part["kl"] is None
        assert set(part["rollout"]["error"]) == {"1", "10", "100", "1000"}
        assert part["rollout"]["error"]["1000"] is None  # of 100 steps
        assert part["rollout"]["num_trajectories"] == 3
    assert report["methods"]["p-sympnet"]["map"]["symplecticity_defect"] < 1e-12
    assert 1e-12 < report["methods"]["hnn"]["map"]["symplecticity_defect"] < 1e-6
    drawn = {path.stem for path in out.glob("*.png")}
    assert drawn == {"error", "energy", "elements", "coordinates"}
    assert not out.with_name("out.partial").exists()
    assert not any(line.startswith("HNN") for line in told)
    assert compared["methods"]["hnn"]["fit"] == kept["fit"]
    assert compare(out, resume=True) is None  # done, this very job
    with pytest.raises(InputError, match="exists already"):
        compare(out)


@pytest.mark.slow
def test_methods_that_apply():
    everywhere = comparison.chosen_methods((), scenes.make("two-body"))
    assert set(comparison.TITLES) - set(everywhere) == {"onet-2", "onet-5"}
    beside = scenes.DrawnFrom(lambda key, num: 1 + 0.1 * jax.random.normal(key, (num, 4)))
    coupled = dataclasses.replace(scenes.make("pcr3bp"), sampling=beside)
    assert set(comparison.chosen_methods((), coupled)) == set(comparison.TITLES)


def test_the_same_data_for_every_method(small):
    data = SharedData(scenes.make("two-body"), 3, True)
    again = SharedData(scenes.make("two-body"), 3, True)
    np.testing.assert_array_equal(data.sequences(2).z, again.sequences(2).z)
    assert data.sequences(2) is data.sequences(2)
    assert data.sequences(5).z.shape == (500, 5, 4)  # on two bodies as many as pairs
    other = SharedData(scenes.make("standard-map-regular"), 3, True)
    assert other.sequences(5).num_pairs == other.sequences(2).num_pairs


def test_divergences_of_a_chaotic_scene(small):
    scene = scenes.make("standard-map-chaotic")
    data = SharedData(scene, 0, True)
    same = divergences(scene, data.reference, data.reference)
    assert same == {"θ": 0.0, "p": 0.0}
    shifted = divergences(scene, data.reference + 2 * np.pi, data.reference)
    assert max(shifted.values()) < 1e-9  # modulo 2π
    still = np.broadcast_to(data.reference[:, :1], data.reference.shape)
    assert min(divergences(scene, still, data.reference).values()) > 1
    assert divergences(scenes.make("two-body"), None, None) is None


def test_a_runaway_is_lost_from_there_on():
    reference = np.ones((2, 4, 2))
    states = reference.copy()
    states[1, 2, 0] = 101.0
    status = np.zeros(2, int)
    kept = without_runaways(Rollouts(states, status, 1.0), reference)
    np.testing.assert_array_equal(kept.states[0], 1.0)
    assert np.isnan(kept.states[1, 2:]).all()
    np.testing.assert_array_equal(kept.states[1, :2], 1.0)
    assert kept.status.tolist() == [0, 4]


@pytest.mark.slow
def test_the_papers_recipe_on_the_standard_map(small):
    """Check that the map commutes with shifts by 2π: S depends on θ by cos and sin alone."""
    data = SharedData(scenes.make("standard-map-regular"), 0, True)
    budget = Budget(jax.random.key(0), cap=1e8)
    learned = paper_gfnn(data.sequences(2), budget)
    z = np.array([[1.0, 2.0], [1.0 + 2 * np.pi, 2.0 - 4 * np.pi]])
    image = np.asarray(learned.map.step(z)[0])
    np.testing.assert_allclose(image[1] - image[0], [2 * np.pi, -4 * np.pi], atol=1e-12)
    assert learned.family.hidden == (500, 500, 200, 20)


def test_the_plain_map_beside_ours_is_exact_where_the_motion_is_linear():
    t, r = 0.1 * np.arange(300), np.linspace(0.8, 1.2, 4)[:, None]
    c, s = r * np.cos(t), r * np.sin(t)
    states = np.stack([c, s, -s, c], axis=-1)
    pairs = gfnn.Pairs(states[:, :-1].reshape(-1, 4), states[:, 1:].reshape(-1, 4), dt=0.1)
    assert affine_errors(pairs, scenes.make("two-body"), states).max() < 1e-9
