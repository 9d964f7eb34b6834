"""Files and tables of Python are read as ``gfnn FILE`` reads them, and hints are Python."""

import numpy as np
import pytest

import gfnn_jax as gfnn
from gfnn_jax.data.proposed import as_proposed
from gfnn_jax.errors import in_python
from gfnn_jax.learn.fit import as_pairs_or_recording

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


@pytest.mark.parametrize(
    ("typed", "called"),
    [
        ("If degrees: --degrees angle. Else", "If degrees: degrees=['angle']. Else"),
        ("--positions 'a,b c' --velocities v", "positions=['a', 'b c'] velocities=['v']"),
        (
            "--observe 'x = l*sin(theta)' --guess l=2",
            "observe={'x': 'l*sin(theta)'} guess={'l': 2.0}",
        ),
        ("name it: --angles 0,2", "name it: angles=[0, 2]"),
        ("--max-operations 1,000,000 pays", "max_operations=1000000 pays"),
    ],
)
def test_options_of_the_command_line_as_keywords(typed, called):
    assert in_python(typed) == called


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
