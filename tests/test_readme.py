"""Code of the README: all blocks run as printed."""

import re
import shlex
from pathlib import Path

import jax
import numpy as np
import pytest

import gfnn_jax
from gfnn_jax import cli

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README, re.S)


@pytest.fixture(scope="module")
def example():
    """The text of the example and the names that it leaves behind, after some of its steps:
    the programs of the tests are compiled quickly, and step slowly."""
    _, code = blocks("python")
    fewer = code.replace("num_steps=100_000, save_every=100", "num_steps=300, save_every=1")
    assert fewer != code
    names: dict = {}
    strict = jax.config.jax_numpy_dtype_promotion
    # As in a user's session, where nothing is strict.
    jax.config.update("jax_numpy_rank_promotion", "allow")
    jax.config.update("jax_numpy_dtype_promotion", "standard")
    exec(compile(fewer, "README.md", "exec"), names)
    yield code, names
    jax.config.update("jax_numpy_rank_promotion", "raise")
    jax.config.update("jax_numpy_dtype_promotion", strict)


def test_the_example_runs(example):
    code, names = example
    assert names["states"].shape == (10, 301, 4)
    assert not np.any(names["info"].status)
    assert names["fit"].met
    assert f"# {names['fit'].hamiltonian}\n" in code


@pytest.mark.slow
def test_a_recording_gives_its_law():
    """The law of a measured double pendulum, and a forecast beside what was measured."""
    code, names = blocks("python")[0], {}
    exec(compile(code, "README.md", "exec"), names)
    values, std = names["ahead"].values["theta1"], names["ahead"].std["theta1"]
    assert values.shape == std.shape == (1, 3)
    record = gfnn_jax.read(gfnn_jax.records.path("double_pendulum"))
    times, run = record.times(record.runs[0]), record.runs[0]
    measured = np.interp(3.6, times, record.unwrapped("theta1", run))
    assert abs(values[0, 0] - measured) < 0.03


@pytest.mark.slow
def test_gradients_pass_through_steps(example):
    _, names = example
    z = np.asarray(names["pairs"].z0[0])

    def later(z):
        return names["fit"].map.rollout(z, 20)[0][-1, 0]

    differences = [float(later(z + u) - later(z - u)) / 2e-5 for u in 1e-5 * np.eye(4)]
    np.testing.assert_allclose(jax.grad(later)(jax.numpy.asarray(z)), differences, atol=1e-6)


def test_links_lead_somewhere():
    local = re.findall(r"\]\((?!https?:)([^)#]+)\)", README)
    missing = [path for path in local if not (ROOT / path).exists()]
    assert not missing


def test_ci_runs_the_test_command():
    (command,) = [c for block in blocks("sh") for c in block.split("&&") if "pytest" in c]
    arguments = command.strip().removeprefix(".venv/bin/python")
    assert f'"$bin/python"{arguments}' in (ROOT / ".ci/run").read_text()


@pytest.mark.slow
def test_the_first_command_ends_in_the_law_that_is_printed_below_it(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    typed = blocks("sh")[0].strip().rpartition("/gfnn ")[2]
    assert cli.main(shlex.split(typed.replace(" --open", ""))) == 0
    told = capsys.readouterr()
    printed = blocks("text")[0].splitlines()
    assert [line for line in told.out.splitlines() if line.startswith(("L = ", "R = "))] == printed
    assert "not met" not in told.out + told.err
    assert list(tmp_path.glob("runs/*/report.html"))


@pytest.mark.slow
def test_the_first_command_of_the_help_meets_its_tolerance(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["run", "two-body", "--quick", "--strict"]) == 0
    told = capsys.readouterr()
    assert "not met" not in told.out + told.err
