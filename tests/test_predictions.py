"""The prediction writer: whatever interrupts it, the finished file is the same, bit for bit."""

import random
import resource
import textwrap
import tracemalloc
import warnings

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from other_python import killed_and_resumed, run_python

from gfnn_jax.data import predictions
from gfnn_jax.data.predictions import PredictionJob, PredictionWriter
from gfnn_jax.errors import InputError, WorkError

LANES, SAVED, WIDTH = 3, 20, 4
STEPS = np.arange(SAVED) * 5
STATES = np.random.default_rng(0).normal(size=(LANES, SAVED, WIDTH))
STATUS, LEFT_AT = np.array([0, 1, 2]), np.array([-1, 7, 9])


def writer(out, *, resume=False, overwrite=False, **options):
    options = {"identity": {"model": "m", "initial": "z0"}, **options}
    asked = PredictionJob(shape=(LANES, WIDTH), num_steps=99, save_every=5, dt=0.1, **options)
    return PredictionWriter(out, asked, resume=resume, overwrite=overwrite)


def append(job, count):
    part = STATES[:, job.saved : job.saved + count]
    job.append(part, {"z": part[:, -1], "step": np.int64(STEPS[job.saved + part.shape[1] - 1])})


def complete(out, **options):
    job = writer(out, **options)
    while job.saved < job.total:
        append(job, 6)
    job.finish(STATUS, LEFT_AT)
    return out.read_bytes()


@pytest.fixture
def whole(tmp_path):
    return complete(tmp_path / "whole.npz")


@settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.lists(st.tuples(st.integers(1, 9), st.booleans()), max_size=20))
def test_any_chunks_and_interruptions(tmp_path, whole, plan):
    out = tmp_path / "p.npz"
    job = writer(out, overwrite=True)
    for count, interrupt in plan:
        if job.saved == job.total:
            break
        append(job, count)
        if interrupt:
            saved = job.saved
            job = writer(out, resume=True)
            assert job.saved == saved
            assert job.carry is not None
            assert np.array_equal(job.carry["z"], STATES[:, saved - 1])
            assert job.carry["step"] == STEPS[saved - 1]
    if job.saved < job.total:
        append(job, job.total)
    job.finish(STATUS, LEFT_AT)
    assert out.read_bytes() == whole
    with np.load(out) as file:
        assert np.array_equal(file["trajectories"], STATES)
        assert np.array_equal(file["status"], STATUS)
        assert np.array_equal(file["left_at"], LEFT_AT)
        assert np.array_equal(file["steps"], STEPS)
        assert file["dt"] == 0.1
    assert not job.partial.exists()


def damage_flip(path):
    content = bytearray(path.read_bytes())
    content[random.Random(0).randrange(len(content))] ^= 4
    path.write_bytes(content)


def damage_cut(path):
    path.write_bytes(path.read_bytes()[:-5])


def damage_remove(path):
    path.unlink()


@pytest.mark.parametrize("damage", [damage_flip, damage_cut, damage_remove])
@pytest.mark.parametrize("which", [0, 1, 2])
def test_damaged_chunk_is_computed_again(tmp_path, whole, damage, which):
    out = tmp_path / "p.npz"
    job = writer(out)
    for _ in range(3):
        append(job, 6)
    damage(sorted(job.partial.glob("*.chunk"))[which])
    with pytest.warns(UserWarning, match=f"going on from saved state {6 * which}"):
        job = writer(out, resume=True)
    assert job.saved == 6 * which
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert complete(out, resume=True) == whole


@pytest.mark.parametrize("cut", [1, 30, 150])
def test_damaged_journal(tmp_path, whole, cut):
    out = tmp_path / "p.npz"
    job = writer(out)
    append(job, 6)
    append(job, 6)
    journal = job.partial / "journal.jsonl"
    journal.write_bytes(journal.read_bytes()[:-cut])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert complete(out, resume=True) == whole
    job = writer(out, overwrite=True)
    append(job, 6)
    (job.partial / "journal.jsonl").write_bytes(b'{"jo')
    with pytest.warns(UserWarning, match="starting again"):
        assert complete(out, resume=True, overwrite=True) == whole


def test_resuming_replaces_no_other_file(tmp_path):
    out = tmp_path / "p.npz"
    append(writer(out), 6)
    out.write_bytes(b"another's")
    with pytest.raises(InputError, match="exists already"):
        writer(out, resume=True)
    assert out.read_bytes() == b"another's"
    assert writer(out, resume=True, overwrite=True).saved == 6
    # Once said, it holds for this job.
    assert writer(out, resume=True).saved == 6


def test_killed_at_the_very_end(tmp_path, whole):
    """The output is there and its chunks are half removed: nothing is left to do but tidy up."""
    out = tmp_path / "whole.npz"
    (tmp_path / "whole.npz.partial").mkdir()
    (tmp_path / "whole.npz.partial" / "000000000000-000000000006.chunk").write_bytes(b"left")
    job = writer(out, resume=True)
    assert (job.finished, job.saved) == (True, job.total)
    assert [p.name for p in tmp_path.iterdir()] == ["whole.npz"]
    assert out.read_bytes() == whole


def test_refusals(tmp_path, whole):
    out = tmp_path / "whole.npz"
    with pytest.raises(InputError, match="exists already"):
        writer(out)
    assert writer(out, resume=True).finished
    assert out.read_bytes() == whole
    append(writer(tmp_path / "p.npz"), 6)
    with pytest.raises(InputError, match="model is m there and n here"):
        writer(tmp_path / "p.npz", resume=True, identity={"model": "n", "initial": "z0"})
    assert writer(tmp_path / "p.npz", resume=True).saved == 6
    job = writer(tmp_path / "p.npz", overwrite=True)
    assert job.saved == 0
    with pytest.raises(ValueError, match="expected states"):
        job.append(np.zeros((LANES, 21, WIDTH)), {})
    with pytest.raises(ValueError, match="0 of 20 states"):
        job.finish(STATUS, LEFT_AT)


@pytest.mark.parametrize("when", ["append", "finish"])
def test_full_disk(tmp_path, whole, when):
    """Every write beyond a size fails, as on a full disk; with room again the job goes on."""
    out = tmp_path / "whole.npz"
    job = writer(out, overwrite=True)
    append(job, 6)
    if when == "finish":
        append(job, 6)
        append(job, 8)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(WorkError, match=r"whole.npz: writing failed: \w+"):
            append(job, 14) if when == "append" else job.finish(STATUS, LEFT_AT)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert out.read_bytes() == whole
    assert sorted(p.name for p in tmp_path.iterdir()) == ["whole.npz", "whole.npz.partial"]
    assert writer(out, resume=True).saved == (6 if when == "append" else 20)
    assert complete(out, resume=True, overwrite=True) == whole


@pytest.mark.slow
def test_memory_is_bounded(tmp_path, monkeypatch):
    """An output of 50 MB within a few chunks and the assembly's buffer, also for a single lane."""
    monkeypatch.setattr(predictions.Options, "assembly", 2**20)
    for lanes in (1, 40):
        saved, chunk = 1_600_000 // lanes, 20_000 // lanes
        tracemalloc.start()
        asked = PredictionJob({}, (lanes, 4), saved - 1, 1.0)
        job = PredictionWriter(tmp_path / f"{lanes}.npz", asked)
        for start in range(0, saved, chunk):
            part = np.broadcast_to(np.arange(start, start + chunk)[:, None], (lanes, chunk, 4))
            job.append(part, {})
        job.finish(np.zeros(lanes), np.full(lanes, -1))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 10e6
        with np.load(tmp_path / f"{lanes}.npz") as file:
            assert np.array_equal(file["trajectories"][-1, :, 0], np.arange(saved))


WORKER = textwrap.dedent(
    """
    import sys, time
    import numpy as np
    from gfnn_jax.data.predictions import PredictionJob, PredictionWriter

    asked = PredictionJob({"model": "m"}, (50, 4), 399, 0.1)
    job = PredictionWriter(sys.argv[1], asked, resume=True)
    z = np.ones((50, 4)) if job.carry is None else job.carry["z"]
    print("started", flush=True)
    while job.saved < job.total:
        states = []
        for _ in range(10):
            states.append(z)
            z = z * 1.01 + np.sin(z)
        job.append(np.stack(states, axis=1), {"z": z})
    if not job.finished:
        job.finish(np.zeros(50), np.full(50, -1))
    """
)


@pytest.mark.parametrize(
    "kills", [1, pytest.param(20, marks=pytest.mark.slow)], ids=["short", "twenty"]
)
def test_sigkill(tmp_path, kills):
    run_python(WORKER, tmp_path / "whole.npz")
    killed = 0
    for attempt in range(kills):
        out = tmp_path / f"{attempt}.npz"
        killed += killed_and_resumed(WORKER, out, kills - killed, attempt, 0.03)
        assert out.read_bytes() == (tmp_path / "whole.npz").read_bytes()
        if killed >= kills:
            break
    assert killed >= kills
