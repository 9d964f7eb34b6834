"""Commands that are stopped: what is kept, what resumes to the same bits, what is not harmed."""

import contextlib
import dataclasses
import errno
import math
import os
import signal
import subprocess
import sys

import jax
import numpy as np
import pytest
from command_line import (
    DT,
    files,
    fitted_oscillator,
    gfnn,
    oscillator,
    oscillators_map,
    pairs_file,
    predict,
)

from gfnn_jax.data.predictions import PredictionWriter
from gfnn_jax.jobs import output
from gfnn_jax.jobs import predict as predict_job
from gfnn_jax.maps import saved as models
from gfnn_jax.storage import checkpoints


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return oscillators_map(tmp_path_factory.mktemp("models") / "m")


@pytest.fixture(scope="module")
def fitted():
    return fitted_oscillator()


@pytest.mark.slow
def test_a_training_that_was_stopped(fitted, tmp_path, capsys, monkeypatch):
    """Stop a training: its checkpoints stay beside the output, and are resumed or discarded."""
    started_from = []

    def training(*args, checkpoints, **kwargs):
        found = checkpoints.latest()
        started_from.append(found and found[0])
        if found is None:
            checkpoints.save(7, {"theta": np.arange(3.0)})
            raise KeyboardInterrupt
        return fitted

    monkeypatch.setattr(output, "fit", training)
    fit = ("fit", pairs_file(tmp_path / "d.npz"), "--out", tmp_path / "m")
    assert gfnn(*fit) == 130
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.endswith("m.partial keeps step_000000000007: --resume goes on with it")
    assert gfnn(*fit) == 2
    assert "m.partial: holds an unfinished fit" in capsys.readouterr().err
    assert gfnn(*fit, "--resume", "--seed", 1) == 2
    assert "m.partial: belongs to another fit: seed differ" in capsys.readouterr().err
    assert gfnn(*fit, "--overwrite") == 130
    assert gfnn(*fit, "--resume") == 0
    assert started_from == [None, None, 7]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["d.npz", "m"]


def test_nothing_is_left_where_nothing_was_kept(tmp_path, capsys, monkeypatch):
    def stop(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(output, "fit", stop)
    assert gfnn("fit", pairs_file(tmp_path / "d.npz"), "--out", tmp_path / "m") == 130
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == "gfnn: stopped; nothing of the fit was kept"
    assert [p.name for p in tmp_path.iterdir()] == ["d.npz"]


def stopped_with(better):
    """A fit that hands on these (map, candidate) and is then interrupted."""

    def fit(*args, on_better, **kwargs):
        for map_, candidate in better:
            on_better(map_, candidate)
        raise KeyboardInterrupt

    return fit


def test_an_interrupted_fit_publishes_the_best_of_all_its_runs(
    fitted, tmp_path, capsys, monkeypatch
):
    """A resumed fit meets its small sizes again; what it left in OUT it may replace."""
    fit = ("fit", pairs_file(tmp_path / "d.npz"), "--out", tmp_path / "m", "--resume")
    for error, best in ((1e-2, 1e-2), (1e-3, 1e-3), (1e-1, 1e-3)):
        candidate = dataclasses.replace(fitted.chosen, validation_relative=error)
        monkeypatch.setattr(output, "fit", stopped_with([(fitted.map, candidate)]))
        assert gfnn(*fit) == 130
        assert "m and can be used" in capsys.readouterr().err
        assert models.record(tmp_path / "m")["validation_relative"] == best
    monkeypatch.setattr(output, "fit", lambda *args, **kwargs: fitted)
    assert gfnn(*fit) == 0
    assert "unfinished" not in models.record(tmp_path / "m")


def test_an_interrupted_fit_leaves_an_older_model_as_it_is(fitted, tmp_path, capsys, monkeypatch):
    fit = ("fit", pairs_file(tmp_path / "d.npz"), "--out", tmp_path / "m", "--overwrite")
    monkeypatch.setattr(output, "fit", lambda *args, **kwargs: fitted)
    assert gfnn(*fit) == 0
    before = files(tmp_path / "m")
    monkeypatch.setattr(output, "fit", stopped_with([(fitted.map, fitted.chosen)]))
    capsys.readouterr()
    assert gfnn(*fit) == 130
    assert files(tmp_path / "m") == before
    told = capsys.readouterr().err.splitlines()[-1]
    assert f"m is as it was before; the best map so far is in {tmp_path}/m.partial/best" in told


def test_a_killed_fit_that_kept_nothing_is_in_nobodys_way(fitted, tmp_path, monkeypatch):
    monkeypatch.setattr(output, "fit", lambda *args, **kwargs: fitted)
    (tmp_path / "m.partial").mkdir()
    (tmp_path / "m.partial" / "job.json").write_text("{}")
    assert gfnn("fit", pairs_file(tmp_path / "d.npz"), "--out", tmp_path / "m") == 0
    assert not (tmp_path / "m.partial").exists()


@contextlib.contextmanager
def stopped_after(num_chunks, stop):
    """The prediction is stopped after so many chunks."""
    append = PredictionWriter.append
    count = 0

    def counting(writer, states, carry):
        nonlocal count
        append(writer, states, carry)
        count += 1
        if count == num_chunks:
            stop()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(predict_job, "_CHUNK_LANE_STEPS", 30)
        patch.setattr(PredictionWriter, "append", counting)
        yield


def interrupt():
    raise KeyboardInterrupt


@pytest.mark.slow
def test_a_prediction_backwards_comes_back(model, tmp_path, capsys):
    assert predict(model, tmp_path / "there.npz", num_steps=40) == 0
    with np.load(tmp_path / "there.npz") as there:
        ahead = there["trajectories"][:2]
    np.save(tmp_path / "end.npy", ahead[:, -1])
    with stopped_after(3, interrupt):
        back = ("predict", model, "--initial", tmp_path / "end.npy", "--num-steps", -40)
        back = (*back, "--save-every", 2, "--out", tmp_path / "back.npz")
        assert gfnn(*back) == 130
    assert gfnn(*back, "--resume") == 0
    assert "2 trajectories of 40 steps backwards" in capsys.readouterr().out
    with np.load(tmp_path / "back.npz") as found:
        np.testing.assert_array_equal(found["steps"], np.arange(0, -41, -2))
        assert found["dt"] == DT
        np.testing.assert_allclose(found["trajectories"], ahead[:, ::-2], rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("stop", "status"), [(interrupt, 130), (lambda: signal.raise_signal(signal.SIGTERM), 143)]
)
def test_a_prediction_resumes_to_the_same_bits(stop, status, model, tmp_path, capsys):
    with stopped_after(math.inf, stop):
        assert predict(model, tmp_path / "whole.npz") == 0
    with stopped_after(3, stop):
        assert predict(model, tmp_path / "p.npz") == status
        assert not (tmp_path / "p.npz").exists()
        last = capsys.readouterr().err.splitlines()[-1]
        assert last.startswith("gfnn: terminated" if status == 143 else "gfnn: stopped")
        assert last.endswith("p.npz.partial keeps 20 of 50 steps: --resume goes on with it")
        assert predict(model, tmp_path / "p.npz") == 2
        assert predict(model, tmp_path / "p.npz", "--resume", num_steps=60) == 2
    with stopped_after(math.inf, stop):
        assert predict(model, tmp_path / "p.npz", "--resume") == 0
        assert predict(model, tmp_path / "p.npz", "--resume") == 0  # nothing left to do
    assert (tmp_path / "p.npz").read_bytes() == (tmp_path / "whole.npz").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["p.npz", "whole.npz"]


def test_a_full_disk(model, fitted, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(output, "fit", lambda *args, **kwargs: fitted)
    assert predict(model, tmp_path / "p.npz") == 0
    before = files(tmp_path)
    with monkeypatch.context() as patch:

        def full(handle):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        patch.setattr(os, "fsync", full)
        assert predict(model, tmp_path / "p.npz", "--overwrite", num_steps=7) == 1
        data = pairs_file(tmp_path / "d.npz")
        assert gfnn("fit", data, "--out", tmp_path / "m") == 1
    errors = [e for e in capsys.readouterr().err.splitlines() if e.startswith("gfnn: ")]
    assert len(errors) == 2
    assert all("No space left on device" in e for e in errors)
    assert not (tmp_path / "m").exists()
    assert before.items() <= files(tmp_path).items()


# Every iteration of the training is saved and told.
TRAINING = """
import sys
from gfnn_jax import cli
from gfnn_jax.jobs import progress
from gfnn_jax.models.generating_functions import networks

networks._CHECKPOINT_SECONDS = progress.BETWEEN = 0.0
sys.exit(cli.main(sys.argv[1:]))
"""


def same_model(one, other):
    """To the last bit."""
    (arrays, described), (others, as_described) = map(checkpoints.load_model, (one, other))
    jax.tree.map(np.testing.assert_array_equal, arrays, others)
    assert described["map"] == as_described["map"]


def killed_training(arguments, seconds):
    """Start a training and kill it so many seconds after a few iterations; whether it was so."""
    command = [sys.executable, "-c", TRAINING, *(str(a) for a in arguments)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    with process, process.stderr as told:
        iterations = (line for line in told if ": iteration " in line)
        for _ in range(3):
            next(iterations, None)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(seconds)
        process.kill()
    assert process.returncode in (0, -signal.SIGKILL)
    return process.returncode != 0


@pytest.mark.slow
@pytest.mark.parametrize(("kills", "tolerance"), [(1, 1e-3), (20, 1e-14)])
def test_killed_trainings_resume(kills, tolerance, tmp_path):
    """SIGKILLs at random moments of a training: the same map in the end, to the last bit."""
    data = pairs_file(tmp_path / "d.npz", oscillator(100, [0, 1.0]), dt=1.0)
    fit = ("fit", data, "--family", "mlp", "--chart", "type2", "--tolerance", tolerance, "--out")
    assert gfnn(*fit, tmp_path / "whole") == 0
    rng, killed = np.random.default_rng(0), 0
    while killed < kills:
        out = tmp_path / f"after_{killed}"
        resumed = (*fit, out, "--resume")
        while killed < kills and killed_training(resumed, rng.uniform(0, kills / 5)):
            killed += 1
            assert list((tmp_path / f"{out.name}.partial").glob("step_*"))
        assert gfnn(*resumed) == 0
        same_model(out, tmp_path / "whole")


# Runs a command and prints its peak of resident memory. A process of its own: a child's figure
# includes the memory of the process that it was forked from, which is small here.
MEASURE = """
import resource, subprocess, sys

subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL)
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lanes", "num_steps", "save_every"), [(1, 10_000_000, 1_000), (1_000, 125_000, 1)]
)
def test_memory_of_a_long_prediction(lanes, num_steps, save_every, model, tmp_path):
    """Ten million steps of one trajectory, and an output of 2 GB: each within 1 GB of memory."""
    z0, out = tmp_path / "z0.npy", tmp_path / "p.npz"
    np.save(z0, np.random.default_rng(0).uniform(-0.5, 0.5, (lanes, 2)))
    own = [sys.executable, "-m", "gfnn_jax", "predict", model, "--initial", z0, "--out", out]
    steps = ("--num-steps", num_steps, "--save-every", save_every)
    command = [str(c) for c in (sys.executable, "-c", MEASURE, *own, *steps)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE)
    bytes_per_unit = 1 if sys.platform == "darwin" else 1024
    assert int(done.stdout) * bytes_per_unit < 1e9
    assert out.stat().st_size > lanes * num_steps // save_every * 16
    with np.load(out) as predicted:
        assert predicted["steps"][-1] == num_steps
        assert predicted["status"].shape == (lanes,)
    out.unlink()
