"""Model folders and training checkpoints: the same bits back, or one line that says why not."""

import json
import os
import random
import textwrap
import warnings

import jax
import numpy as np
import optax
import pytest
from other_python import killed_and_resumed

from gfnn_jax.errors import InputError, WorkError
from gfnn_jax.storage import checkpoints
from gfnn_jax.storage.checkpoints import TrainingCheckpoints, load_model, save_model

RNG = np.random.default_rng(0)
ARRAYS = {
    "mlp": {
        "layer 0": {"kernel": RNG.normal(size=(4, 8)), "bias": np.zeros(8, np.float32)},
        "layer/0": {"kernel": np.array([np.nan, -0.0, np.inf, 5e-324])},
    },
    "degrees": np.arange(6, dtype=np.int16).reshape(2, 3),
    "count": np.float64(0.1),
    "mask": np.array([True, False]),
    "pairs": ([np.ones(2), None], (np.zeros(3, np.float32),)),
    "strided": RNG.normal(size=(6, 4)).T[::2],
    "no terms": np.zeros((0, 4)),
    "bias": None,
    "nothing": {},
}
DESCRIPTION = {"chart": "midpoint", "dt": 0.1, "angles": [0, 2], "name": "θ", "rollout": None}


def assert_same(a, b):
    """Assert that two trees have the same structure, types, dtypes and bits."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert np.shape(x) == np.shape(y)
        assert np.asarray(x).dtype == np.asarray(y).dtype
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


def latest(saved):
    found = saved.latest()
    assert found is not None
    return found


@pytest.fixture
def model(tmp_path):
    save_model(tmp_path / "model", ARRAYS, DESCRIPTION)
    return tmp_path / "model"


@pytest.mark.parametrize("arrays", [ARRAYS, {}, {"a": None}, {"a": np.zeros(0)}])
def test_model_round_trip(tmp_path, arrays):
    save_model(tmp_path / "deep" / "m", arrays, DESCRIPTION)
    loaded, description = load_model(tmp_path / "deep" / "m")
    assert_same(loaded, arrays)
    assert description == DESCRIPTION
    assert os.listdir(tmp_path / "deep") == ["m"]


def test_model_is_replaced_whole(model):
    save_model(model, {"a": np.ones(2)}, {})
    assert list(load_model(model)[0]) == ["a"]
    (model / "report.json").write_text("{}")  # files beside the listed ones do no harm
    assert list(load_model(model)[0]) == ["a"]


def test_failed_save_changes_nothing(model, monkeypatch):
    before = {p: p.read_bytes() for p in model.rglob("*") if p.is_file()}
    with pytest.raises(TypeError, match="mlp/name"):
        save_model(model, {"mlp": {"name": "x"}}, {})
    for tree in ({"key": jax.random.key(0)}, {1: np.ones(2)}, {"a": optax.EmptyState()}):
        with pytest.raises(TypeError):
            save_model(model, tree, {})
    with pytest.raises(TypeError, match="object"):
        save_model(model, {"a": np.array([None])}, {})
    with pytest.raises(TypeError, match="JSON"):
        save_model(model, {}, {"a": object()})

    def disk_full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoints.Path, "write_text", disk_full)
    with pytest.raises(WorkError, match="No space left on device"):
        save_model(model, {"a": np.ones(2)}, {})
    assert before == {p: p.read_bytes() for p in model.rglob("*") if p.is_file()}
    assert os.listdir(model.parent) == ["model"]


def test_every_file_is_guarded(model):
    """A flipped bit, a cut or a missing file anywhere in the folder is refused in one line."""
    rng = random.Random(0)
    for path in sorted(p for p in model.rglob("*") if p.is_file()):
        whole = path.read_bytes()
        flipped = bytearray(whole)
        if whole:
            flipped[rng.randrange(len(whole))] ^= 1 << rng.randrange(8)
        for content in (bytes(flipped), whole[: len(whole) // 2], None):
            if content == whole:
                continue
            path.unlink() if content is None else path.write_bytes(content)
            with pytest.raises(InputError) as caught:
                load_model(model)
            assert "\n" not in str(caught.value)
            path.write_bytes(whole)
    load_model(model)


def rewrite(folder, change):
    """Change model.json as another release would: with its digest."""
    record = json.loads((folder / "model.json").read_text())
    old = checkpoints.hashlib.sha256((folder / "model.json").read_bytes()).hexdigest()
    change(record)
    (folder / "model.json").write_text(json.dumps(record))
    new = checkpoints.hashlib.sha256((folder / "model.json").read_bytes()).hexdigest()
    sums = folder / "SHA256SUMS"
    sums.write_text(sums.read_text().replace(old, new))


def kernel(record):
    return next(leaf for leaf in record["leaves"] if leaf["name"] == "mlp/layer 0/kernel")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: r.update(format=4), "has format 4, this release reads formats 2 and 3"),
        (lambda r: kernel(r).update(dtype="float32"), "should be float32 of shape"),
        (lambda r: kernel(r).update(sha256="0"), "mlp/layer 0/kernel has changed"),
    ],
)
def test_other_contents_are_refused(model, change, message):
    rewrite(model, change)
    with pytest.raises(InputError, match=message):
        load_model(model)


def test_float64_needs_x64(model):
    with jax.enable_x64(False), pytest.raises(InputError, match=r"jax_enable_x64"):
        load_model(model)
    save_model(model, {"a": np.ones(3, np.float32)}, {})
    with jax.enable_x64(False):
        assert load_model(model)[0]["a"].dtype == np.float32


# Training checkpoints


def test_checkpoints_round_trip(tmp_path):
    saved = TrainingCheckpoints(tmp_path / "c", {"data": "d", "seed": 1})
    assert saved.latest() is None
    tree = {"theta": RNG.normal(size=20), "epoch": 3, "loss": 0.1, "stopped": False}
    for step in (5, 10, 15):
        saved.save(step, tree)
    assert sorted(os.listdir(tmp_path / "c")) == ["step_000000000010", "step_000000000015"]
    step, found = latest(TrainingCheckpoints(tmp_path / "c", {"seed": 1, "data": "d"}))
    assert step == 15
    assert_same(found, tree)
    assert (type(found["epoch"]), type(found["loss"]), found["stopped"]) == (int, float, False)
    with pytest.raises(InputError, match=r"data"):
        TrainingCheckpoints(tmp_path / "c", {"seed": 1, "data": "e"}).latest()


def test_damaged_checkpoint_is_passed_over(tmp_path):
    saved = TrainingCheckpoints(tmp_path, {})
    for step in (1, 2):
        saved.save(step, {"w": np.full(3, step)})
    newest = tmp_path / "step_000000000002"
    for path in [p for p in newest.rglob("*") if p.is_file() and p.stat().st_size]:
        whole = path.read_bytes()
        path.write_bytes(bytes([whole[0] ^ 1]) + whole[1:])
        with pytest.warns(UserWarning, match="checkpoint"):
            step, tree = latest(saved)
        assert (step, tree["w"][0]) == (1, 1)
        path.write_bytes(whole)
    (newest / "model.json").unlink()
    # The damaged one never crowds out a good one.
    for step in (1, 2):
        saved.save(step, {"w": np.full(3, 10 * step)})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert latest(saved)[1]["w"][0] == 20


WORKER = textwrap.dedent(
    """
    import sys
    import numpy as np
    from gfnn_jax.storage.checkpoints import TrainingCheckpoints

    saved = TrainingCheckpoints(sys.argv[1], {})
    step, tree = saved.latest() or (0, {"w": np.ones((100, 50)), "b": np.zeros(3)})
    print("started", flush=True)
    while step < 30:
        step += 1
        tree = {"w": tree["w"] + 0.01 * np.sin(tree["w"]), "b": tree["b"] + step}
        saved.save(step, tree)
    """
)


@pytest.mark.slow
@pytest.mark.parametrize("kills", [1, 20], ids=["short", "twenty"])
def test_sigkill(tmp_path, kills):
    """Killed at random moments and resumed, the training ends with the uninterrupted bits."""
    killed, rounds = 0, 0
    while killed < kills:
        folder = tmp_path / str(rounds)
        rounds += 1
        killed += killed_and_resumed(WORKER, folder, kills - killed, rounds, 2.0)
        w, b = np.ones((100, 50)), np.zeros(3)
        for step in range(1, 31):
            w, b = w + 0.01 * np.sin(w), b + step
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            step, tree = latest(TrainingCheckpoints(folder, {}))
        assert step == 30
        assert_same(tree, {"w": w, "b": b})
        assert len(os.listdir(folder)) == 2
