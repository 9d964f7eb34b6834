"""Files and tables of Python are read as ``gfnn FILE`` reads them, and hints are Python."""

import ast
import inspect
import re
from pathlib import Path

import numpy as np
import pytest
from command_line import gfnn as command

import gfnn_jax as gfnn
from gfnn_jax.data.proposed import as_proposed
from gfnn_jax.data.recording import ReadOptions
from gfnn_jax.errors import InputError, in_python, read_in_a_shell
from gfnn_jax.learn.fit import as_pairs_or_recording
from gfnn_jax.learn.options import OPTIONS

T = 0.02 * np.arange(200)
RATE = np.sin(4.4 * T) + 0.05


def test_a_file_a_table_and_the_command_line_are_read_alike(tmp_path):
    path = tmp_path / "gyro.csv"
    rows = (f"{t:.2f},{w:.5f}" for t, w in zip(T, RATE, strict=True))
    path.write_text("Time (s),Gyroscope x (rad/s)\n" + "\n".join(rows))
    told = as_proposed(path, {})
    assert told.new == {"coordinates": ("theta",), "observe": {"Gyroscope x": "omega + b"}}
    table = {"Time (s)": T, "Gyroscope x (rad/s)": RATE}
    for data in (str(path), table):
        recording, proposed = as_pairs_or_recording(data)
        assert recording.coordinates == ("theta",)
        assert proposed.new["coordinates"] == ("theta",)
    code = proposed.summary.call
    assert code.startswith("gfnn.fit(gfnn.Recording(table, coordinates=['theta'], observe=")


def test_what_was_given_is_not_proposed_again():
    given = {"positions": ("x",), "angles": ()}
    assert as_proposed({"t": T, "x": np.cos(5 * T)}, given).new == {}


@pytest.mark.parametrize(
    ("typed", "called"),
    [
        ("If degrees: --degrees angle. Else", "If degrees: degrees=['angle']. Else"),
        ("--positions 'a,b c' --velocities v", "positions=['a', 'b c'] velocities=['v']"),
        ("Leave it out of --inputs", "Leave it out of inputs="),
        ("these: --from, --to, or NaN", "these: start=, stop=, or NaN"),
        ("begin there: --from 3.2", "begin there: start=3.2"),
        (
            "--observe 'x = l*sin(theta)' --guess l=2",
            "observe={'x': 'l*sin(theta)'} guess={'l': 2.0}",
        ),
        (
            "--angles none; its drive: --inputs NAME",
            "angles=[]; its drive: inputs=",
        ),
        ("--positions and --velocities, in one order", "positions= and velocities=, in one order"),
        ("a larger --max-seconds gives it", "a larger max_seconds= gives it"),
        ("name it: --angles 0,2", "name it: angles=[0, 2]"),
        ("use --to fmu or --learn map", "use to='fmu' or learn='map'"),
        ("(--overwrite replaces it)", "(overwrite=True replaces it)"),
        ("in seconds, --std gate=1e-4", "in seconds, std={'gate': 0.0001}"),
        ("--max-operations 1,000,000 pays", "max_operations=1000000 pays"),
    ],
)
def test_options_of_the_command_line_as_keywords(typed, called):
    assert in_python(typed) == called


def options_named(path: Path):
    """Options that the texts of a module name, but for its docstrings."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    with_body = (ast.Module, ast.ClassDef, ast.FunctionDef)
    docstrings = {
        ast.get_docstring(n, clean=False) for n in ast.walk(tree) if isinstance(n, with_body)
    }
    texts = (node.value for node in ast.walk(tree) if isinstance(node, ast.Constant))
    for text in texts:
        if isinstance(text, str) and text not in docstrings:
            yield from re.findall(r"--([a-z][a-z-]+)", text)


@pytest.mark.slow
def test_every_option_that_a_message_names_is_a_keyword_of_python():
    package = Path(gfnn.__file__).parent
    known = {*ReadOptions.__annotations__, *OPTIONS, *inspect.signature(gfnn.read).parameters}
    known |= {"overwrite", "scene", "states", "to", "despite", "out"}
    for room in ("data", "dataset", "diagnosis", "exports", "families", "learn", "maps", "models"):
        for path in (package / room).rglob("*.py"):
            for option in options_named(path):
                name = re.match(r"\w+", in_python(f"--{option}"))
                assert name is not None
                assert name[0] in known | {"resume"}, (path.name, option)


def test_both_doors_name_what_their_reader_can_type(capsys, tmp_path):
    table = {"when": T, "height": RATE}
    with pytest.raises(InputError) as error:
        gfnn.Recording(table)
    assert "dt=" in str(error.value)
    assert "--" not in str(error.value)
    path = tmp_path / "swing.csv"
    path.write_text("when,height\n" + "\n".join(f"{t},{x}" for t, x in zip(T, RATE, strict=True)))
    assert command("look", path) == 2
    assert "--dt" in capsys.readouterr().err
    with read_in_a_shell():
        assert "--dt" in str(error.value)


def test_a_summary_in_python_names_python():
    text = str(gfnn.Recording({"t": T, "angle": 80 * RATE}).summary())
    assert "--" not in text
    assert "next: gfnn.fit(gfnn.Recording(table, degrees=['angle']))" in text


@pytest.mark.parametrize("library", ["polars", pytest.param("xarray", marks=pytest.mark.slow)])
def test_tables_of_other_libraries(library):
    module = pytest.importorskip(library)
    if library == "polars":
        table = module.DataFrame({"t": T, "x": RATE})
    else:
        table = module.Dataset({"x": ("t", RATE)}, coords={"t": T})
    recording, _ = as_pairs_or_recording(table)
    np.testing.assert_array_equal(recording.values("x", "0"), RATE)
    np.testing.assert_array_equal(gfnn.read(table).times("0"), T)


@pytest.mark.slow
def test_units_in_the_names_of_a_table():
    recording = gfnn.Recording({"Time [ms]": 1e3 * T, "angle [deg]": 20 * RATE})
    np.testing.assert_allclose(recording.times("0"), T)
    np.testing.assert_allclose(recording.values("angle [deg]", "0"), np.deg2rad(20 * RATE))
