"""Rollouts shared out among devices and processes: the same bits on any number of them."""

import dataclasses

import numpy as np
import pytest
from analytic import map_of
from command_line import gfnn
from other_python import ended, run_python, started

from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.data import predictions
from gfnn_jax.data.predictions import PredictionJob, PredictionWriter
from gfnn_jax.errors import InputError
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products
from gfnn_jax.families.terms import Terms
from gfnn_jax.flows.flow import Flow
from gfnn_jax.generating.charts import MIDPOINT
from gfnn_jax.generating.generated import Generated
from gfnn_jax.maps import saved
from gfnn_jax.maps.domain import covering
from gfnn_jax.maps.parameters import sampled
from gfnn_jax.maps.posterior import Posterior
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.processes import Share

DT, LANES, STEPS = 0.3, 700, 30


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A model of no fit, a near-identity map of many terms, and 700 initial states."""
    folder = tmp_path_factory.mktemp("sharded")
    rng = np.random.default_rng(0)
    z = rng.uniform(-1, 1, (100, 2))
    family = Products(box_inputs(z), 6)
    params = family.unflatten(rng.normal(size=family.num_parameters) / 1000)
    generated = Generated(family, params, MIDPOINT, DT, np.ones(2))
    map_ = SymplecticMap((generated,), CARTESIAN, covering(z), np.ones(2), np.zeros(0), DT)
    saved.save(map_, folder / "m")
    np.save(folder / "z0.npy", rng.uniform(-0.5, 0.5, (LANES, 2)))
    return folder


ON_DEVICES = """
import sys
from pathlib import Path
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
from gfnn_jax.data.predictions import PredictionWriter
from gfnn_jax.jobs import predict as job
from gfnn_jax.jobs.output import Output
from gfnn_jax.maps import saved
from gfnn_jax.maps.samples import Samples
from gfnn_jax.maps.sharded import Sharded, local_devices

folder = Path(sys.argv[1])
map_, z0 = saved.load(folder / "m"), np.load(folder / "z0.npy")
assert len(jax.devices()) == 3
found = []
for count in (1, 2, 3):
    states, info = map_.sharded(count).rollout(z0, 30, save_every=10)
    found.append((states.tobytes(), *(a.tobytes() for a in jax.tree.leaves(info))))
assert len(set(found)) == 1, "bits depend on the number of devices"
block, _ = map_.rollout(z0[:256], 30, save_every=10)
np.testing.assert_array_equal(block, states[:256], "a block is what the map itself makes of it")
few, _ = map_.sharded(1).rollout(z0[:3], 30, save_every=10)
np.testing.assert_array_equal(few, states[:3], "bits depend on the number of lanes")

params = np.asarray(map_.pieces[0].params)
samples = Samples(map_, jax.device_put(np.stack([params, 1.1 * params])), 0)
of = [Sharded(samples, local_devices(n)).rollout(z0, 10, save_every=5)[0] for n in (1, 3)]
assert of[0].tobytes() == of[1].tobytes(), "bits of samples depend on the number of devices"

def predicted(name, devices, **more):
    job.predict(folder / "m", folder / "z0.npy", Output(folder / name, **more),
                job.Steps(30, devices=devices))
    return (folder / name).read_bytes()

job._CHUNK_LANE_STEPS = 3_500
whole = predicted("one.npz", 1)
append = PredictionWriter.append

def stopping(self, states, carry):
    append(self, states, carry)
    if self.saved > 20:
        raise KeyboardInterrupt

PredictionWriter.append = stopping
try:
    predicted("stopped.npz", 3)
except KeyboardInterrupt:
    PredictionWriter.append = append
assert predicted("stopped.npz", 2, resume=True) == whole, "resumed on other devices"
"""


@pytest.mark.slow
def test_the_same_bits_on_any_number_of_devices(folder):
    run_python(ON_DEVICES, folder, devices=3)


def test_parameters_go_with_their_lanes():
    """Compare one block and a part of the next with the map's own rollout."""
    rng = np.random.default_rng(1)
    z, args = rng.uniform(-1, 1, (300, 2)), rng.uniform(0.5, 1.5, (300, 1))
    piece = Flow(
        Terms(1, ("p1", "q1", "k"), ((2, 0, 0), (0, 2, 1)), ("k",)), np.full(2, 0.5), DT, np.ones(2)
    )
    map_ = dataclasses.replace(map_of(piece, z), parameters=sampled(("k",), args))
    states, info = map_.sharded().rollout(z, 5, params=args[:, 0])
    expected, how = map_.rollout(z, 5, params=args[:, 0])
    np.testing.assert_allclose(states, expected, rtol=0, atol=1e-14)
    assert (info.status == np.asarray(how.status)).all()


@pytest.mark.parametrize(("number", "count"), [(0, 2), (1, 3), (700, 2), (700, 5), (5_000, 8)])
def test_shares_are_all_lanes_in_whole_blocks(number, count):
    shares = [Share(i, count).of(number, 256) for i in range(count)]
    assert [i for s in shares for i in range(number)[s]] == [*range(number)]
    assert all(s.start % 256 == 0 for s in shares if s.start < s.stop)


# Several processes


def predicting(folder, out, *more, num_steps=STEPS, count=2, **flags):
    """Start ``count`` processes of one prediction."""
    of = ("predict", folder / "m", "--initial", folder / "z0.npy", "--num-steps", num_steps)
    return started(*of, "--out", out, *more, count=count, **flags)


@pytest.fixture(scope="module")
def alone(folder):
    of = ("predict", folder / "m", "--initial", folder / "z0.npy", "--num-steps", STEPS)
    assert gfnn(*of, "--out", folder / "alone.npz", "--devices", "all") == 0
    return (folder / "alone.npz").read_bytes()


@pytest.mark.slow
def test_a_killed_job_resumes_to_the_same_bits(folder, alone, monkeypatch):
    """Resume where only the beginning of one of two parts is there."""
    from gfnn_jax.jobs import predict as job
    from gfnn_jax.jobs.output import Output

    append = PredictionWriter.append

    def stopping(self, states, carry):
        append(self, states, carry)
        if self.saved > 20:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(job, "_CHUNK_LANE_STEPS", 3_500)
        patch.setattr(PredictionWriter, "append", stopping)
        output = Output(folder / "again.npz")
        with pytest.raises(KeyboardInterrupt):
            job.predict(folder / "m", folder / "z0.npy", output, job.Steps(STEPS), Share(0, 2))
    found = ended(predicting(folder, folder / "again.npz", "--resume"))
    assert [status for status, *_ in found] == [0, 0], found
    assert (folder / "again.npz").read_bytes() == alone
    assert not [*folder.glob("again.part*")]


def test_parts_of_everything_that_a_prediction_can_hold(tmp_path):
    """Put together as if one process had written it."""
    rng = np.random.default_rng(0)
    states, z0 = rng.normal(size=(5, 3, 10)), rng.normal(size=(5, 1))
    job = {"num_steps": 2, "dt": 0.5, "bands": True}

    def written(path, lanes, identity):
        beside = {"params": (("a",), z0[lanes]), "drive": (z0[lanes, 0], 2.0)}
        asked = PredictionJob(identity, (len(range(5)[lanes]), 2), **job, **beside)
        writer = PredictionWriter(path, asked)
        writer.append(states[lanes], {})
        writer.finish(
            np.arange(5)[lanes], np.arange(5)[lanes], band="model", horizon=np.arange(5)[lanes]
        )
        return path

    whole = written(tmp_path / "whole.npz", slice(0, 5), {"m": 1})
    own = [
        written(tmp_path / f"{i}.npz", lanes, {"m": 1, "part": i})
        for i, lanes in enumerate((slice(0, 2), slice(2, 5)))
    ]
    predictions.put_together(own, tmp_path / "p.npz", PredictionJob({"m": 1}, (5, 2), **job).record)
    assert (tmp_path / "p.npz").read_bytes() == whole.read_bytes()
    assert not any(path.exists() for path in own)


@pytest.fixture(scope="module")
def sampled_folder(folder, tmp_path_factory):
    """The model with a posterior, and 300 of its initial states with noise of their own."""
    more = tmp_path_factory.mktemp("sampled")
    map_ = saved.load(folder / "m")
    count = map_.pieces[0].family.num_parameters
    saved.save(dataclasses.replace(map_, posterior=Posterior(0, 1e-5 * np.eye(count))), more / "m")
    z0 = np.load(folder / "z0.npy")[:300]
    np.savez(more / "z0.npz", z0=z0, z0_std=np.full(z0.shape, 1e-3))
    return more


@pytest.mark.slow
def test_samples_of_any_number_of_processes(sampled_folder):
    """Compare numbers of processes; a stopped job resumes on fewer than began it."""
    from gfnn_jax.jobs import predict as job
    from gfnn_jax.jobs.output import Output

    def predicted(name, share=None, devices=None, **more):
        output = Output(sampled_folder / name, **more)
        asked = job.Steps(20, 10, samples=3, horizon=1e-3, devices=devices)
        job.predict(sampled_folder / "m", sampled_folder / "z0.npz", output, asked, share)
        return sampled_folder / name

    whole = predicted("whole.npz", devices=1)
    plain = np.load(predicted("plain.npz"))
    found = np.load(whole)
    for name in ("trajectories", "std", "quantiles"):
        assert found[name].shape == plain[name].shape
        np.testing.assert_allclose(found[name], plain[name], rtol=0, atol=1e-13)
    np.testing.assert_array_equal(found["horizon"], plain["horizon"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(job, "wait_for_all", lambda: None)
        predicted("parts.npz", share=Share(1, 2))
        with pytest.raises(InputError, match="resume=True goes on with them"):
            predicted("parts.npz", share=Share(0, 1))
        there = predicted("parts.npz", share=Share(0, 1), resume=True)
    assert there.read_bytes() == whole.read_bytes()
    assert not [*sampled_folder.glob("parts.part*")]
