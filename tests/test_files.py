"""Reading a user's data: every good file gives its numbers back, every bad one its line."""

import dataclasses
import tracemalloc
import warnings
import zipfile

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gfnn_jax.data import files
from gfnn_jax.data.blocks import BLOCK_ROWS, DataWarning
from gfnn_jax.data.files import summary
from gfnn_jax.errors import InputError

RNG = np.random.default_rng(0)
Z = RNG.normal(size=(30, 4))
QUICK = settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def save(path, **arrays):
    np.savez(path, **arrays)
    return path


def table(z, t=None, dt=0.1):
    return np.column_stack([np.arange(len(z)) * dt if t is None else t, z])


def csv(path, header, rows):
    lines = [header, *(",".join(repr(float(x)) for x in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


HEADER = "t,q1,q2,p1,p2"


# Good files


def test_pairs_file(tmp_path):
    path = save(tmp_path / "d.npz", z0=Z[:-1], z1=Z[1:], dt=0.1)
    data = files.read_trajectories(path)
    pairs = data.pairs()
    assert np.array_equal(pairs.z0, Z[:-1])
    assert np.array_equal(pairs.z1, Z[1:])
    assert (data.dim, data.dt, data.num_pairs, data.source) == (2, 0.1, 29, str(path))
    assert len(data.digest) == 64


@QUICK
@given(
    st.lists(st.integers(1, 9), min_size=1, max_size=6),
    st.integers(1, 3),
    st.integers(1, 12),
    st.sampled_from([np.float64, np.float32, np.dtype(">f8"), np.int32]),
    st.booleans(),
    st.booleans(),
)
def test_sequences_of_any_length(tmp_path, lengths, dim, chunk, dtype, compressed, fortran):
    """Padded rows are ignored, whatever stands in them, and chunks hold the same pairs."""
    lengths = [*lengths, 2 * dim + 2]  # enough pairs
    padded = np.full((len(lengths), max(lengths), 2 * dim), 0, dtype)
    rng = np.random.default_rng(sum(lengths))
    sequences = [(100 * rng.normal(size=(n, 2 * dim))).astype(dtype) for n in lengths]
    if padded.dtype.kind == "f":
        padded[:] = np.nan
    for row, sequence in zip(padded, sequences, strict=True):
        row[: len(sequence)] = sequence
    padded = np.asfortranarray(padded) if fortran else padded
    path = tmp_path / "d.npz"
    (np.savez_compressed if compressed else np.savez)(
        path, trajectories=padded, lengths=lengths, dt=2
    )
    data = files.read_trajectories(path)
    assert data.states.dtype == np.float64
    assert data.precision == str(np.dtype(dtype))
    assert np.array_equal(data.states, np.concatenate(sequences))
    assert data.lengths.tolist() == lengths
    assert np.array_equal(files.read_initial(path, dim)[0], [s[-1] for s in sequences])
    pairs = data.pairs()
    assert np.array_equal(pairs.z0, np.concatenate([s[:-1] for s in sequences]))
    assert np.array_equal(pairs.z1, np.concatenate([s[1:] for s in sequences]))
    chunks = list(files.iterate_pairs(path, chunk))
    assert max(map(len, chunks)) <= chunk
    assert np.array_equal(np.concatenate([c.z0 for c in chunks]), pairs.z0)
    assert np.array_equal(np.concatenate([c.z1 for c in chunks]), pairs.z1)


def test_csv_headers(tmp_path):
    """Units stay in the metadata; np.savetxt's commented header, comments and blank lines serve."""
    path = tmp_path / "d.csv"
    np.savetxt(
        path, table(Z), delimiter=",", header="made by hand\nt [s],Q1 [km],q2 (km),p1,p2 [km/s]"
    )
    path.write_text(path.read_text() + "\n\n")
    data = files.read_trajectories(path)
    assert data.units == {"t": "s", "q1": "km", "q2": "km", "p2": "km/s"}
    assert np.allclose(data.states, Z, rtol=1e-15)
    assert data.dt == pytest.approx(0.1, rel=1e-13)
    path = csv(tmp_path / "e.csv", "q1,q2,p1,p2,energy", np.column_stack([Z, Z[:, 0]]))
    with pytest.warns(DataWarning, match="ignored: energy"):
        assert np.array_equal(files.read_trajectories(path, dt=0.5).states, Z)


def test_arrays_that_are_not_read_are_named(tmp_path):
    known = {"z0": Z, "z1": Z + 1, "dt": 0.1, "params": Z[:, :1], "param_names": ["k"]}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        files.read_trajectories(save(tmp_path / "known.npz", **known))
        about = {"status": np.zeros(1), "job": "f3"}  # as predictions hold
        files.read_trajectories(save(tmp_path / "p.npz", trajectories=Z[None], dt=0.1, **about))
    path = save(tmp_path / "more.npz", k=Z[:, 0], args=Z[:, 1], **known)
    with pytest.warns(DataWarning, match=r"more.npz: arrays ignored: k, args \(parameters are in"):
        assert len(files.read_trajectories(path).states) == 2 * len(Z)


@pytest.mark.parametrize("digits", [4, 5, 9])
def test_printed_times_are_rounded(tmp_path, digits):
    """Steps of 1/3 differ by a unit of the last decimal, and a line of spaces is none."""
    lines = [f"{i / 3:.{digits}f}," + ",".join(map(repr, row)) for i, row in enumerate(Z.tolist())]
    path = tmp_path / "t.csv"
    path.write_text("t,q1,q2,p1,p2\n" + "\n".join([*lines[:9], "   ", *lines[9:]]) + "\n")
    data = files.read_trajectories(path)
    assert abs(data.dt - 1 / 3) < 10.0**-digits
    np.testing.assert_array_equal(data.pairs().z0, Z[:-1])


@pytest.mark.parametrize(
    ("dt", "odd", "digits"), [(0.1, 0.101, 3), (1 / 3, 0.3337, 4), (100, 101, 0)]
)
def test_rounding_explains_no_odd_step(tmp_path, dt, odd, digits):
    """One step in thirty that is off by more than the last decimal that rounding can make: each
    pair then has its own."""
    steps = np.full(29, dt)
    steps[[12, 13, 14]] = odd
    t = np.append(0, np.cumsum(steps))
    lines = [f"{i:.{digits}f}," + ",".join(map(repr, row)) for i, row in zip(t, Z.tolist())]  # noqa: B905
    path = tmp_path / "t.csv"
    path.write_text("t,q1,q2,p1,p2\n" + "\n".join(lines) + "\n")
    found = files.read_trajectories(path).pairs()
    np.testing.assert_allclose(found.dt, steps, atol=0.7 * 10.0**-digits)


def test_initial_states(tmp_path):
    np.save(tmp_path / "z.npy", Z)
    np.save(tmp_path / "m.npy", Z.reshape(5, 6, 4))
    save(tmp_path / "z.npz", z0=Z)
    rows = csv(tmp_path / "rows.csv", "q1,q2,p1,p2", Z)
    orbit = csv(tmp_path / "orbit.csv", HEADER, table(Z))
    for path in (tmp_path / "z.npy", tmp_path / "z.npz", rows):
        assert np.array_equal(files.read_initial(path, 2)[0], Z)
    assert np.array_equal(files.read_initial(tmp_path / "m.npy", 2)[0], Z[5::6])
    assert np.array_equal(files.read_initial(orbit, 2)[0], Z[-1:])
    with pytest.raises(InputError, match=r"d = 3\), found 4 columns"):
        files.read_initial(orbit, 3)


def test_prediction_file_as_data(tmp_path):
    """A prediction that kept every tenth step holds states ten time steps apart."""
    arrays = {"trajectories": Z.reshape(3, 10, 4), "steps": np.arange(10) * 10}
    assert files.read_trajectories(save(tmp_path / "p.npz", **arrays, dt=0.1)).dt == 1.0


def test_given_dt(tmp_path):
    np.save(tmp_path / "d.npy", Z)
    assert files.read_trajectories(tmp_path / "d.npy", dt=0.1).dt == 0.1
    path = save(tmp_path / "d.npz", z0=Z, z1=Z + 1, dt=np.float32(0.1))
    assert files.read_trajectories(path, dt=0.1).dt == 0.1


@pytest.mark.parametrize(
    ("z0", "z1", "message"),
    [
        (Z, Z, "every state equals"),
        (Z * [1, 1, 1, 0], (Z + 1) * [1, 1, 1, 0], "constant column.s. p2"),
        (Z[:, [0, 0, 2, 3]], Z[:, [0, 0, 2, 3]] + 1, "q1 and q2 are equal"),
    ],
)
def test_odd_columns_warn(tmp_path, z0, z1, message):
    with pytest.warns(DataWarning, match=message):
        files.read_trajectories(save(tmp_path / "d.npz", z0=z0, z1=z1, dt=1.0))


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".csv"])
def test_streaming_memory_is_bounded(tmp_path, suffix):
    rows = 60_000 if suffix == ".csv" else 500_000
    z = np.random.default_rng(1).normal(size=(rows, 4))
    path = tmp_path / f"d{suffix}"
    if suffix == ".csv":
        np.savetxt(path, z, delimiter=",", header="q1,q2,p1,p2", comments="")
        # A block of lines as text and as numbers; the whole file so would take 23 MB.
        limit = BLOCK_ROWS * 600
    else:
        limit = z.nbytes // 4
        np.save(path, z) if suffix == ".npy" else np.savez_compressed(path, trajectories=z)
    next(files.iterate_pairs(path, 10, dt=0.1))  # imports
    tracemalloc.start()
    count = sum(len(pairs) for pairs in files.iterate_pairs(path, 10_000, dt=0.1))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert count == rows - 1
    assert peak < limit


# Bad files: one line each


def bad(value, row=3, column=1):
    z = Z.copy()
    z[row, column] = value
    return z


def npz(**arrays):
    return lambda tmp: save(tmp / "d.npz", **arrays)


def npy(array):
    def make(tmp):
        np.save(tmp / "d.npy", array)
        return tmp / "d.npy"

    return make


def text(content, name="d.csv"):
    def make(tmp):
        (tmp / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        return tmp / name

    return make


def rows(header, values):
    return lambda tmp: csv(tmp / "d.csv", header, values)


def changed(change, make=None):
    """The bytes of a good file, changed."""

    def make_changed(tmp):
        path = (make or npz(z0=Z[:-1], z1=Z[1:], dt=0.1))(tmp)
        path.write_bytes(change(path.read_bytes()))
        return path

    return make_changed


def flip(data, at):
    return data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :]


def gap(tmp):
    t = np.arange(30) * 0.1
    t[20:] += 0.05
    return csv(tmp / "d.csv", HEADER, table(Z, t))


def folder(tmp):
    (tmp / "d.npz").mkdir()
    return tmp / "d.npz"


def packed(compression):
    def make(tmp):
        with zipfile.ZipFile(tmp / "d.npz", "w", compression) as archive:
            for name, value in {"z0": Z[:-1], "z1": Z[1:], "dt": np.array(0.1)}.items():
                with archive.open(f"{name}.npy", "w") as member:
                    np.save(member, value)
        return tmp / "d.npz"

    return make


def encrypted_flag(tmp):
    path = npz(z0=Z, z1=Z, dt=0.1)(tmp)
    data = bytearray(path.read_bytes())
    data[6] |= 1
    data[data.index(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(bytes(data))
    return path


# name -> (how the file is made, what the refusal must name beside the file: a line, an element)
BAD_FILES = {
    "missing file": (lambda tmp: tmp / "none.npz", ""),
    "other suffix": (text("x", "d.txt"), ""),
    "empty file npz": (text("", "d.npz"), ""),
    "text as npz": (text("hello\nworld", "d.npz"), ""),
    "binary as csv": (text(bytes(range(128, 256))), "header"),
    "truncated npz": (changed(lambda b: b[: len(b) // 2]), ""),
    "truncated npy": (changed(lambda b: b[:-8], npy(Z)), "(30, 4)"),
    "flipped bit in npz": (changed(lambda b: flip(b, 700)), "z0"),
    "flipped version in npy": (changed(lambda b: flip(b, 6), npy(Z)), "(17, 0)"),
    "flipped bit in lzma": (changed(lambda b: flip(b, 700), packed(zipfile.ZIP_LZMA)), ""),
    "flipped bit in bzip2": (changed(lambda b: flip(b, 700), packed(zipfile.ZIP_BZIP2)), ""),
    "flipped bit in deflate": (changed(lambda b: flip(b, 700), packed(zipfile.ZIP_DEFLATED)), ""),
    "huge shape in npy": (
        changed(lambda b: b.replace(b"(30, 4), }        ", b"(3000000000, 4), }"), npy(Z)),
        "",
    ),
    "encrypted npz": (encrypted_flag, ""),
    "pickle": (npz(z0=np.array([None, {}]), z1=Z, dt=0.1), "z0"),
    "no arrays": (npz(dt=0.1), "dt"),
    "both kinds": (npz(z0=Z, z1=Z, trajectories=Z[None], dt=0.1), "trajectories"),
    "odd dimension": (npz(z0=Z[:, :3], z1=Z[:, :3], dt=0.1), "z0"),
    "shapes differ": (npz(z0=Z, z1=Z[:-1], dt=0.1), "(29, 4)"),
    "four-dimensional": (npz(trajectories=Z[None, None], dt=0.1), "trajectories"),
    "complex": (npz(z0=Z + 1j, z1=Z, dt=0.1), "complex128"),
    "booleans": (npy(Z > 0), "bool"),
    "nan": (npz(z0=bad(np.nan), z1=Z, dt=0.1), "z0[3, 1] = nan"),
    "infinity": (npz(z0=Z, z1=bad(-np.inf), dt=0.1), "z1[3, 1] = -inf"),
    "nan in trajectories": (npz(trajectories=bad(np.nan, 7)[None], dt=0.1), "[0, 7, 1]"),
    "huge value": (npz(z0=bad(1e200), z1=Z, dt=0.1), "z0[3, 1]"),
    "no dt": (npz(z0=Z, z1=Z), "dt"),
    "dt array": (npz(z0=Z, z1=Z, dt=[0.1, 0.2]), "(2,)"),
    "dt of one pair": (npz(z0=Z, z1=Z, dt=-Z[:, 0]), "dt[0] = -"),
    "times fall": (npz(trajectories=Z[None], times=Z[None, :, 0] % 0.7), "times[0, "),
    "times and dt": (npz(trajectories=Z[None], times=Z[None, :, 0], dt=0.1), "dt or times"),
    "params shape": (npz(z0=Z, z1=Z, dt=0.1, params=Z[:7, :2]), "(7, 2)"),
    "param names": (npz(z0=Z, z1=Z, dt=0.1, params=Z[:, :2], param_names=["l"]), "param_names"),
    "lengths too long": (npz(trajectories=Z[None], lengths=[31], dt=0.1), "lengths[0] = 31"),
    "lengths shape": (npz(trajectories=Z[None], lengths=[3, 3], dt=0.1), "lengths"),
    "csv without header": (rows("1.0,2.0,3.0", table(Z)), ""),
    "csv without p2": (rows("t,q1,q2,p1", table(Z[:, :3])), "p2"),
    "csv column twice": (rows("t,q1,q1,p1", table(Z[:, :3])), "q1"),
    "csv word": (text("t,q1,p1\n0,1,2\n1,x,2\n"), "line 3, q1: 'x'"),
    "csv hole": (text("t,q1,p1\n0,1,2\n\n1,,2\n"), "line 4, q1"),
    "csv short row": (text("t,q1,p1\n0,1,2\n1,1\n"), "line 3: 3 columns"),
    "csv nan": (rows(HEADER, table(bad(np.nan))), "line 5, q2 = nan"),
    "csv gap, dt given": (gap, "dt = 0.1"),
    "csv time falls": (
        rows(HEADER, table(Z, np.where(np.arange(30) == 20, 0.3, np.arange(30) * 0.1))),
        "t must rise in a sequence, found 0.3 in line 22",
    ),
    "csv time stands": (rows(HEADER, table(Z, np.zeros(30))), "line 3"),
    "csv time nan": (rows(HEADER, table(Z, bad(np.nan)[:, 1])), "column t"),
    "csv no time": (rows("q1,q2,p1,p2", Z), "dt"),
    "csv sequences mixed": (rows("sequence,q1,q2,p1,p2", table(Z, np.arange(30) % 2)), "line 4"),
}
TOO_SHORT = {  # name -> (array, number of pairs): too few for a fit, and no mistake of a stream
    "empty arrays": (npz(z0=Z[:0], z1=Z[:0], dt=0.1), 0),
    "no sequences": (npz(trajectories=Z[None][:0], dt=0.1), 0),
    "one pair": (npz(z0=Z[:1], z1=Z[1:2], dt=0.1), 1),
    "too few pairs": (npz(z0=Z[:4], z1=Z[1:5], dt=0.1), 4),
    "single states": (npz(trajectories=Z[:, None], dt=0.1), 0),
    "csv semicolons": (text("t;q1;p1\n0;1;2\n1;1,5;2\n"), 1),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_file(tmp_path, name):
    make, place = BAD_FILES[name]
    path = make(tmp_path)
    given = ("csv sequences mixed", "csv gap, dt given")
    dt = 0.1 if path.suffix == ".npy" or name in given else None
    for read in (files.read_trajectories, lambda p, dt: list(files.iterate_pairs(p, 10, dt=dt))):
        with pytest.raises(InputError) as caught:
            read(path, dt=dt)
        line = str(caught.value)
        assert str(path) in line
        assert place in line
        assert "\n" not in line
        assert len(line) < 400


@pytest.mark.parametrize("name", TOO_SHORT)
def test_too_few_pairs(tmp_path, name):
    make, count = TOO_SHORT[name]
    path = make(tmp_path)
    with pytest.raises(InputError, match=f"{count} pair"):
        files.read_trajectories(path)
    assert sum(map(len, files.iterate_pairs(path, 10))) == count


@pytest.mark.parametrize("dt", [0.0, -1.0, np.nan, np.inf, 0.2])
def test_bad_given_dt(tmp_path, dt):
    with pytest.raises(InputError, match="dt"):
        files.read_trajectories(save(tmp_path / "d.npz", z0=Z, z1=Z + 1, dt=0.1), dt=dt)


@settings(max_examples=75, deadline=None)
@given(st.data())
def test_damaged_bytes_never_escape(tmp_path_factory, data):
    """Any flip or cut of any kind of file is read the same, or read as other text, or refused."""
    tmp = tmp_path_factory.mktemp("damaged")
    kind = data.draw(st.sampled_from(["npz", "zip", "npy", "csv"]))
    path = tmp / f"d.{'npz' if kind == 'zip' else kind}"
    if kind in ("npz", "zip"):
        (np.savez if kind == "npz" else np.savez_compressed)(path, z0=Z[:9], z1=Z[1:10], dt=0.1)
    elif kind == "npy":
        np.save(path, Z[:9])
    else:
        csv(path, HEADER, table(Z[:9]))
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(content[: data.draw(st.integers(len(content) // 2, len(content)))])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        try:
            read = files.read_trajectories(path, dt=None if kind in ("npz", "zip", "csv") else 0.1)
        except InputError as error:
            assert "\n" not in str(error)  # noqa: PT017
        else:
            if kind in ("npz", "zip"):  # the archive's checksums vouch for every bit
                assert np.array_equal(read.pairs().z1, Z[1:10])


def test_a_summary_says_what_is_there(tmp_path):
    z0 = np.array([[0.0, 1.0], [2.0, 3.0], [4.0, 5.0], [4.0, 5.0]])
    z1 = z0 + np.array([0.5, -2.0])
    first, q, p = summary(files.read_trajectories(save(tmp_path / "a.npz", z0=z0, z1=z1, dt=0.1)))
    assert first == "4 pairs, d = 1, dt = 0.1; sequences: 4, each of 2 states; copies: 1"
    assert q.startswith("q1: 0 to 4.5, spread 1.6")
    assert p.startswith("p1: -1 to 5, spread")
    assert p.endswith("movement in a step 2")
    path = csv(tmp_path / "a.csv", "t,q1 [km],p1", table(np.c_[np.arange(9.0), np.ones(9)]))
    with pytest.warns(DataWarning, match="constant"):
        _, q, _ = summary(files.read_trajectories(path))
    assert q == "q1: 0 to 8 km, spread 2.582, movement in a step 1"
    t = np.delete(np.arange(0, 4, 0.1), slice(20, 30))
    z = np.stack([np.cos(t), -np.sin(t)], axis=1)
    gap = files.read_trajectories(save(tmp_path / "g.npz", trajectories=z[None], times=t[None]))
    assert "; sequences: 1, each of 30 states; gaps: 1; " in summary(gap)[0]
    drawn = summary(dataclasses.replace(gap, sampled=900))[0]
    assert drawn == "29 pairs (a sample of 900), d = 1, dt = 0.1 to 1.1; gaps: 1; copies: 0"


def test_a_parameter_that_changes_between_two_blocks_of_a_sequence_is_refused(tmp_path):
    rows = np.random.default_rng(0).normal(size=(BLOCK_ROWS + 9, 2))
    length = np.where(np.arange(len(rows)) < BLOCK_ROWS, 1.0, 2.0)
    path = csv(tmp_path / "a.csv", "t,q1,p1,l", table(np.c_[rows, length]))
    with pytest.raises(InputError, match=rf"line {BLOCK_ROWS + 2}: .* found 2 after 1"):
        files.read_trajectories(path)
