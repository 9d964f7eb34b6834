"""Files that other programs write are read without an option, or with the one that is named."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

from exports_of_others import SWING, T, case, exports, rows

import gfnn_jax as gfnn
from gfnn_jax.cli import main
from gfnn_jax.data.roles import is_time
from gfnn_jax.errors import InputError

NEEDS = {"phyphox, xls": "xlwt", "LibreOffice, ods": "odf", "Excel, xlsx with dates": "openpyxl"}


@pytest.mark.parametrize("name", exports())
def test_each_export_is_read(tmp_path, name):
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
        pytest.importorskip("python_calamine")
    found = case(exports()[name], tmp_path)
    assert found["read"], found


def test_a_missing_reader_of_workbooks_is_named(tmp_path, monkeypatch):
    (tmp_path / "b.xlsx").write_bytes(b"PK")
    monkeypatch.setitem(sys.modules, "python_calamine", None)
    with pytest.raises(InputError, match=r"pip install 'gfnn_jax\[files\]'"):
        gfnn.read(tmp_path / "b.xlsx")


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        ("a note\nabout\nnothing\nmore\n", ("'a note'", "'about'", "'nothing'")),
        ("t,x\n0,1\n1,two\n2,3\n3,x\n4,y\n5,6\n6,7\n", ("line 3, x: 'two'", "line 5", "line 6")),
        ("t,x,v\n0,1,2\n1,2\n2,3\n3,4,5\n", ("line 3: 3 columns", "line 4")),
    ],
)
def test_a_refusal_shows_the_lines_that_it_could_not_read(tmp_path, text, lines):
    (tmp_path / "bad.csv").write_text(text)
    with pytest.raises(InputError) as found:
        gfnn.read(tmp_path / "bad.csv")
    assert all(line in str(found.value) for line in lines)
    assert "\n" not in str(found.value)


def test_a_preamble_may_be_as_wide_as_the_table(tmp_path):
    rows = "\n".join(f"{k * 0.1:.1f};{k % 7}".replace(".", ",") for k in range(40))
    (tmp_path / "p.csv").write_text(f"Rig 3;Miller\nZeit [s];Weg [mm]\n{rows}\n")
    recording = gfnn.read(tmp_path / "p.csv")
    assert (recording.columns, recording.units["Weg"]) == (("Weg",), "mm")


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("Zeit t", True),
        ("Date Time", True),
        ("time constant", False),
        ("tau", False),
        ("v_t", False),
    ],
)
def test_names_of_times(name, told):
    assert is_time(name) == told


def test_days_and_years_stay_as_they_are():
    days = gfnn.Recording({"JDTDB": 2458398.5 + np.arange(9.0), "x": np.cos(np.arange(9.0))})
    assert (days.time_unit, days.clock) == ("d", "d")
    assert np.diff(days.times("0")) == pytest.approx(1.0)
    hours = gfnn.Recording({"t": np.arange(9.0), "x": np.cos(np.arange(9.0))}, time_unit="h")
    assert (hours.clock, np.diff(hours.times("0"))[0]) == ("s", 3600.0)


def test_names_with_commas_go_through_every_option():
    t, x = np.arange(50) * 0.1, np.cos(np.arange(50) * 0.3)
    table = {"t": t, "Angle, Ch 1": x, "Current (A), Ch 2": np.sin(t)}
    for typed in (("Angle", "Ch 1"), ("Angle, Ch 1",), ("Angle,Ch 1",)):
        recording = gfnn.Recording(table, positions=typed, angles=typed)
        assert recording.positions == recording.angles == ("Angle, Ch 1",)
    both = ("Angle", "Ch 1", "Current (A)", "Ch 2")
    assert gfnn.Recording(table, positions=both).positions == ("Angle, Ch 1", "Current (A), Ch 2")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("head", "columns", "options"),
    [("x", (SWING,), ["--dt", "0.02"]), ("t,#,x", (T, T, SWING), ["--columns", "t,x"])],
)
def test_predict_reads_a_file_as_fit_did(tmp_path, capsys, head, columns, options):
    """The command that ``fit`` prints runs as printed."""
    path, model = tmp_path / "s.csv", tmp_path / "model"
    path.write_text(("" if head is None else head + "\n") + rows(*columns))
    assert main(["fit", str(path), *options, "--out", str(model)]) == 0
    printed = capsys.readouterr().out.split("next: gfnn ")[1].splitlines()[0]
    typed = printed.replace("forecast.csv", str(tmp_path / "forecast.csv")).split()
    assert main(typed) == 0
    assert (tmp_path / "forecast.csv").exists()
