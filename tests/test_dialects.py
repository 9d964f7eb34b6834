"""Tables written in any dialect of text are read back equal; a damaged one is read, or refused."""

import warnings

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import gfnn_jax as gfnn
from gfnn_jax.data.blocks import DataWarning
from gfnn_jax.data.files import are_recordings, read_trajectories
from gfnn_jax.errors import InputError

NUMBERS = st.floats(-1e12, 1e12).map(lambda x: x + 0.5)  # no column of whole numbers alone
OF_RECORDING = ("t", "theta", "omega", "tau")
OF_STATES = ("t", "q1", "q2", "p1", "p2")
UNITS = {"t": "s", "theta": "rad", "omega": "rad/s", "q1": "m", "p1": "kg m/s"}


@st.composite
def dialects(draw):
    """(separator, decimal sign, how units are written, text before the header, end of a line,
    whether cells are quoted, whether blank lines and comments stand between the rows)."""
    separator = draw(st.sampled_from([",", ";", "\t", " ", "   "]))
    decimal = draw(st.sampled_from([".", ","])) if separator in (";", "\t") else "."
    units = draw(st.sampled_from(["none", "brackets", "parentheses", "row"]))
    blank = not separator.strip(" ")
    return {
        "separator": separator,
        "decimal": decimal,
        "units": "none" if blank else units,
        "begin": draw(st.sampled_from(["", "\ufeff", "# made by hand\n", "\ufeff% by hand\n"])),
        "end": draw(st.sampled_from(["\n", "\r\n"])),
        "quoted": not blank and draw(st.booleans()),
        "holes": draw(st.booleans()),
    }


def written(names, values, dialect):
    """The text of a table in a dialect."""
    separator = dialect["separator"]

    def line(cells):
        return separator.join(f'"{cell}"' if dialect["quoted"] else cell for cell in cells)

    brackets = {"brackets": " [{}]", "parentheses": " ({})"}.get(dialect["units"], "")
    heads = [name + (brackets.format(UNITS[name]) if name in UNITS else "") for name in names]
    lines = [line(heads)]
    if dialect["units"] == "row":
        lines.append(line([UNITS.get(name, "-") for name in names]))
    for row in values.tolist():
        lines.append(line([repr(x).replace(".", dialect["decimal"]) for x in row]))
        lines += ["", "   "] if dialect["holes"] and len(lines) % 3 == 0 else []
    return (dialect["begin"] + "\n".join(lines) + "\n").replace("\n", dialect["end"])


def tables(names):
    columns = hnp.arrays(
        np.float64, st.tuples(st.integers(6, 20), st.just(len(names) - 1)), elements=NUMBERS
    )
    return columns.map(lambda x: np.column_stack([0.25 * np.arange(len(x)), x]))


ANY = settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@ANY
@given(tables(OF_RECORDING), dialects())
def test_a_recording_in_any_dialect_is_read_back_equal(tmp_path, values, dialect):
    path = tmp_path / "r.csv"
    path.write_bytes(written(OF_RECORDING, values, dialect).encode())
    assert are_recordings(path)
    recording = gfnn.read(path)
    np.testing.assert_array_equal(recording.times("0"), values[:, 0])
    for name, column in zip(OF_RECORDING[1:], values.T[1:], strict=True):
        np.testing.assert_array_equal(recording.values(name, "0"), column)
    if dialect["units"] != "none":
        assert recording.units["omega"] == "rad/s"


@ANY
@given(tables(OF_STATES), dialects())
def test_states_in_any_dialect_are_read_back_equal(tmp_path, values, dialect):
    path = tmp_path / "s.csv"
    path.write_bytes(written(OF_STATES, values, dialect).encode())
    assert not are_recordings(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        data = read_trajectories(path, fewest=1)
    assert data.dt == 0.25
    np.testing.assert_array_equal(data.states, values[:, 1:])
    if dialect["units"] != "none":
        assert data.units["p1"] == "kg m/s"


@settings(max_examples=50, deadline=None)
@given(st.data(), dialects(), st.sampled_from([OF_RECORDING, OF_STATES]))
def test_a_mutated_table_is_read_or_refused(tmp_path_factory, data, dialect, names):
    """Whatever is inserted, replaced or cut: no error but InputError, and that in one line."""
    values = np.random.default_rng(0).normal(size=(9, len(names)))
    values[:, 0] = 0.1 * np.arange(9)
    text = bytearray(written(names, values, dialect).encode())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(text) - 1))
        new = data.draw(st.sampled_from([b"", b"\n", b"\r", b'"', b",", b";", b"x", b"-", b"\0"]))
        text[at : at + data.draw(st.integers(0, 3))] = new
    path = tmp_path_factory.mktemp("mutated") / "m.csv"
    path.write_bytes(text)
    for read in (gfnn.read, read_trajectories):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                read(path)
            except InputError as error:
                assert "\n" not in str(error)  # noqa: PT017
                assert str(path) in str(error)  # noqa: PT017
