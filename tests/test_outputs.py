"""Outputs: nothing is overwritten unasked, nothing is left half written."""

import signal

import pytest

from gfnn_jax.errors import InputError, WorkError
from gfnn_jax.storage import outputs
from gfnn_jax.storage.outputs import unfinished


def test_ensure_new(tmp_path):
    (tmp_path / "file").write_text("kept")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").write_text("kept")
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "model.json").write_text("{}")
    (tmp_path / "mixed" / "model").mkdir(parents=True)
    (tmp_path / "mixed" / "report.json").write_text("{}")
    (tmp_path / "mixed" / "data.npz").write_text("kept")
    (tmp_path / "deep" / "model").mkdir(parents=True)
    (tmp_path / "deep" / "report.json").write_text("{}")
    (tmp_path / "deep" / "model" / "data.csv").write_text("kept")
    (tmp_path / "empty").mkdir()
    for name, overwrite, folder, message in [
        ("file", False, False, "exists already"),
        ("file", True, True, "expected a folder"),
        ("model", False, True, "exists already"),
        ("model", True, False, "expected a file"),
        ("other", True, True, "not overwritten"),
        ("mixed", True, True, "holds data.npz"),
        ("deep", True, True, "holds data.csv"),
        ("file/below", False, False, "not a folder|Not a directory"),
    ]:
        with pytest.raises(InputError, match=message):
            outputs.ensure_new(tmp_path / name, overwrite, folder=folder)
    for name, overwrite, folder in [
        ("new", False, False),
        ("far/new", False, True),
        ("file", True, False),
        ("model", True, True),
        ("empty", False, True),
    ]:
        assert outputs.ensure_new(tmp_path / name, overwrite, folder=folder) == tmp_path / name
    assert not (tmp_path / "far").exists()
    assert (tmp_path / "file").read_text() == "kept"


def test_the_current_folder_cannot_be_exchanged(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for name in (".", "..", tmp_path, "../here"):
        with pytest.raises(InputError, match="current folder"):
            outputs.ensure_new(name, True, folder=True)


def test_atomic_outputs_on_failure(tmp_path):
    """A failure leaves what was there before, and no rubbish beside it."""
    outputs.atomic_write(tmp_path / "a", "before")
    with outputs.atomic_folder(tmp_path / "f") as new:
        (new / "x").write_text("before")

    def half_a_file():
        with outputs.atomic_file(tmp_path / "a") as stream:
            stream.write(b"half")
            raise OSError(28, "No space left on device")

    def half_a_folder():
        with outputs.atomic_folder(tmp_path / "f") as new:
            (new / "x").write_text("half")
            raise OSError(28, "No space left on device")

    for half in (half_a_file, half_a_folder):
        with pytest.raises(WorkError, match="No space left"):
            half()
    with pytest.raises(KeyboardInterrupt), outputs.atomic_folder(tmp_path / "f") as new:
        raise KeyboardInterrupt
    assert (tmp_path / "a").read_text() == (tmp_path / "f" / "x").read_text() == "before"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "f"]
    with outputs.atomic_folder(tmp_path / "f") as new:
        (new / "y").write_text("after")
    assert [p.name for p in (tmp_path / "f").iterdir()] == ["y"]


def test_interrupted_exchange_of_folders(tmp_path):
    (tmp_path / ".f.old").mkdir()
    (tmp_path / ".f.old" / "x").write_text("before")
    outputs.restore_interrupted(tmp_path / "f")
    assert (tmp_path / "f" / "x").read_text() == "before"


def test_a_signal_waits_for_the_end_of_an_exchange_of_folders(tmp_path, monkeypatch):
    """Between the two renames neither the old folder nor the new one would be there."""
    rename = outputs.os.rename

    def slow(*names):
        signal.raise_signal(signal.SIGINT)
        rename(*names)

    (tmp_path / "f").mkdir()
    monkeypatch.setattr(outputs.os, "rename", slow)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job ignores it
    try:
        with pytest.raises(KeyboardInterrupt), outputs.atomic_folder(tmp_path / "f") as new:
            (new / "x").write_text("after")
    finally:
        signal.signal(signal.SIGINT, before)
    assert (tmp_path / "f" / "x").read_text() == "after"


def job(tmp_path, *, overwrite=False, resume=False, **what):
    return unfinished(
        tmp_path / "out", {"seed": 0} | what, what="job", overwrite=overwrite, resume=resume
    )


def test_a_folder_of_others_is_never_removed(tmp_path):
    (tmp_path / "out.partial").mkdir()
    (tmp_path / "out.partial" / "thesis.tex").write_text("kept")
    for options in ({}, {"overwrite": True}, {"resume": True}):
        with pytest.raises(InputError, match="is no unfinished job"), job(tmp_path, **options):
            pass
    assert (tmp_path / "out.partial" / "thesis.tex").read_text() == "kept"
