"""A user's trajectories and initial states in: reading and checking.

Three kinds of file hold the same thing, sequences of states z = (q, p), q first, and the time
between them, one number where it is always the same:

- ``.npz``: ``z0``, ``z1`` of shape (N, 2d) with ``dt``, a number or (N,); or ``trajectories`` of
  shape (M, L, 2d) with optional ``lengths`` (M,), rows beyond a length ignored, and ``dt`` or
  ``times`` (M, L). Optional ``params``, parameters of the system, (N, k) or (M, k), with
  ``param_names``; and of a driven system its ``period``, with ``t0``, the time of the drive at each
  z0 (N,) or at the begin of each sequence (M,), unless ``times`` say it.
- ``.npy``: one array of shape (L, 2d) or (M, L, 2d).
- ``.csv``: a header that names the columns ``t, q1..qd, p1..pd`` in any order, optionally
  ``sequence``; units as in ``q1 [km]`` or ``q1 (km)``. Every further column is a parameter, where
  it is constant in each sequence; one named ``period`` makes ``t`` the time of a drive.

All are read as blocks of consecutive rows, so that a whole file and a file larger than memory go
through the same checks. Every refusal is an `InputError`: one line that says what was expected
and what came. Nothing here needs JAX, so that a refusal comes at once.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import itertools
import re
import warnings
import zipfile
from collections.abc import Callable, Iterator
from io import TextIOWrapper
from pathlib import Path
from typing import Any

import numpy as np

from gfnn_jax.errors import InputError

# Times in text files carry few digits: relative agreement asked of time steps.
TIME_TOLERANCE = 1e-5
# A larger number overflows in the squares, products and sums of squares that a fit makes.
LARGEST = 1e100
_TIME = "t"  # `phase_space.TIME`, which brings JAX
# Rows read at a time when no chunk is asked for; 16k rows of four numbers are 6 MB as text.
BLOCK_ROWS = 16_384


class DataWarning(UserWarning):
    """Data that can be used but look odd: constant, duplicated or unknown columns."""


# ---------------------------------------------------------------------------------------------
# What was read
# ---------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class TrajectoryData:
    """Sequences of states, one after the other.

    states:    (T, 2d) float64, q first: the sequences' states, concatenated.
    lengths:   (M,) the number of states in each sequence. Pairs z0, z1 are sequences of two.
    dt:        time between consecutive states, in the user's unit of time; one of each pair
               (num_pairs,) where it is not always the same.
    args:      parameters, name -> (num_pairs,), or None; by the name t the time of a drive.
    period:    of the drive.
    source:    the file it came from; digest: the SHA-256 of that file.
    precision: the dtype that the file stores, "float32" say; ``states`` is float64 always.
    units:     units by column name, as a CSV header gave them.
    """

    states: np.ndarray
    lengths: np.ndarray
    dt: Any
    source: str
    digest: str
    precision: str = "float64"
    units: dict[str, str] = dataclasses.field(default_factory=dict)
    args: dict[str, np.ndarray] | None = None
    period: float | None = None

    @property
    def dim(self) -> int:
        """Degrees of freedom d."""
        return self.states.shape[1] // 2

    @property
    def num_pairs(self) -> int:
        return len(self.states) - len(self.lengths)

    @property
    def sequences(self) -> list[np.ndarray]:
        """The M sequences, each of shape (L_i, 2d)."""
        return np.split(self.states, np.cumsum(self.lengths)[:-1])

    def pairs(self):
        """All pairs of consecutive states, as `Pairs` of shape (num_pairs, 2d)."""
        from gfnn_jax.phase_space import Pairs  # brings JAX

        starts = np.ones(len(self.states), bool)
        starts[np.cumsum(self.lengths) - 1] = False
        rows = np.flatnonzero(starts)
        return Pairs(
            self.states[rows], self.states[rows + 1], self.dt, self.args, period=self.period
        )

    def last_states(self) -> np.ndarray:
        """The last state of each sequence, (M, 2d)."""
        return self.states[np.cumsum(self.lengths) - 1]


def read_trajectories(
    path, *, dt: float | None = None, fewest: int | None = None
) -> TrajectoryData:
    """Read and check a trajectory file.

    dt: the time step for a file that holds none; it must agree with one that a file holds.
    fewest: pairs that are needed at least; None: those that determine an affine map.
    Raises InputError where the file cannot be used; warns (DataWarning) about constant or
    duplicated columns and about states that never move.
    """
    with _open(path, dt) as source:
        blocks = list(source.blocks(2**62 if source.is_array else BLOCK_ROWS))
        states = np.concatenate([np.empty((0, 2 * source.dim)), *(b.states for b in blocks)])
        sequence = np.concatenate([np.empty(0), *(b.sequence for b in blocks)])
        own = joined([b.own for b in blocks])
    going = np.flatnonzero(sequence[1:] == sequence[:-1])
    dt, args = source.of_pairs(own, going)
    ends = np.flatnonzero(sequence[1:] != sequence[:-1]) + 1
    lengths = np.diff(np.concatenate([[0], ends, [len(sequence)]])) if len(sequence) else ends
    pairs = len(states) - len(lengths)
    needed = 2 * source.dim + 1 if fewest is None else fewest
    if pairs < needed:
        raise InputError(
            f"{path}: {pairs} pair{'s' * (pairs != 1)} of consecutive states found, at least "
            f"{needed} are needed for d = {source.dim}"
        )
    _warn_of_odd_columns(path, states, sequence)
    return TrajectoryData(
        states, lengths, dt, str(path), _digest(path), source.precision, source.units, args,
        source.period,
    )  # fmt: skip


def read_sample(
    path, *, dt: float | None = None, num_pairs: int = 200_000, seed: int = 0
) -> TrajectoryData:
    """As `read_trajectories`, of a file larger than memory: a random sample of its pairs.

    The file is read once, block by block, and checked all through; each pair is kept with the
    same probability, as a sequence of two states. Memory is that of the sample and a few blocks.
    """
    rng = np.random.default_rng(seed)
    kept, priority, dts = None, np.empty(0), np.empty(0)
    args: dict[str, np.ndarray] = {}
    for pairs in iterate_pairs(path, BLOCK_ROWS, dt=dt):
        rows = np.stack([pairs.z0, pairs.z1], axis=1)
        kept = rows if kept is None else np.concatenate([kept, rows])
        priority = np.concatenate([priority, rng.random(len(rows))])
        dts = np.concatenate([dts, np.broadcast_to(pairs.dt, len(rows))])
        args = {n: np.append(args.get(n, []), v) for n, v in (pairs.args or {}).items()}
        if len(kept) > num_pairs:
            first = np.argpartition(priority, num_pairs)[:num_pairs]
            kept, priority, dts = kept[first], priority[first], dts[first]
            args = {name: values[first] for name, values in args.items()}
    if kept is None:
        raise InputError(f"{path}: no pair of consecutive states found")
    states = kept.reshape(-1, kept.shape[-1])
    lengths = np.full(len(kept), 2)
    same = np.ptp(dts) == 0
    with _open(path, dt) as source:
        precision, units, period = source.precision, source.units, source.period
    return TrajectoryData(
        states, lengths, float(dts[0]) if same else dts, str(path), _digest(path), precision, units,
        args or None, period,
    )  # fmt: skip


def iterate_pairs(path, chunk: int, *, dt: float | None = None) -> Iterator[Any]:
    """The pairs of a file larger than memory, as `Pairs` of at most ``chunk`` pairs each.

    Memory stays within a few chunks, whatever the file's size, except for arrays stored in
    Fortran order, which are read whole. The same checks as in `read_trajectories`, block by
    block: a NaN far into the file is found only when it is reached.
    """
    from gfnn_jax.phase_space import Pairs

    with _open(path, dt) as source:
        last_state, last_sequence = np.empty((0, 2 * source.dim)), np.empty(0)
        last_own: list[np.ndarray | None] = []
        for block in source.blocks(chunk):
            states = np.concatenate([last_state, block.states])
            sequence = np.concatenate([last_sequence, block.sequence])
            own = joined([*last_own, block.own])
            rows = np.flatnonzero(sequence[1:] == sequence[:-1])
            if len(rows):
                z0, z1, given = states[rows], states[rows + 1], source.of_pairs(own, rows)
                yield Pairs(z0, z1, *given, period=source.period)
            last_state, last_sequence = states[-1:], sequence[-1:]
            last_own = [None if own is None else own[-1:]]


def joined(parts: list[np.ndarray | None]) -> np.ndarray | None:
    """The rows of all parts; None where they have none."""
    found = [part for part in parts if part is not None]
    return np.concatenate(found) if found else None


def read_initial_states(path, dim: int) -> np.ndarray:
    """Initial states (B, 2d) float64 to predict from, for a map of ``dim`` degrees of freedom.

    An ``.npy`` of shape (B, 2d), an ``.npz`` with ``z0``, or a ``.csv`` without a column ``t``
    holds one state a row; of any other trajectory file each sequence gives its last state.
    """
    return read_initial(path, dim)[0]


def read_initial(
    path, dim: int, parameters: tuple[str, ...] = ()
) -> tuple[np.ndarray, np.ndarray | None]:
    """(states, params) to predict from: as `read_initial_states`, with the values (B, k) of these
    parameters, which the file must hold; None where there are none. t among them is the time of a
    drive: t0 of the file, or the time of each sequence's last state."""
    driven = _TIME in parameters
    with _open(path, None, initial=True, driven=driven) as source:
        if source.dim != dim:
            raise InputError(
                f"{path}: expected states of {2 * dim} columns (d = {dim}), found "
                f"{2 * source.dim} columns (d = {source.dim})"
            )
        columns = {name: 1 + i for i, name in enumerate(source.parameters)}
        if driven and "t0" in columns:
            columns[_TIME] = columns["t0"]
        elif driven and source.timed:
            columns[_TIME] = 0
        if driven and _TIME not in columns:
            raise InputError(
                f"{path}: expected t0, the time of the drive that the model was learned with, "
                "beside the states; found none"
            )
        missing = [name for name in parameters if name not in columns]
        if missing:
            raise InputError(
                f"{path}: expected the parameter{'s' * (len(missing) > 1)} {', '.join(missing)}, "
                "which the model was learned with, beside the states; found "
                f"{', '.join(source.parameters) or 'none'}"
            )
        found: list[_Block] = []
        held: _Block | None = None  # the last row so far: the end of its sequence, or not
        for block in source.blocks(BLOCK_ROWS):
            ends = np.flatnonzero(block.sequence[1:] != block.sequence[:-1])
            if held is not None and held.sequence[0] != block.sequence[0]:
                found.append(held.checked(path))
            found.append(block.rows(ends).checked(path))
            held = block.rows(np.array([len(block.sequence) - 1]))
        if held is None:
            raise InputError(f"{path}: holds no states")
        found.append(held.checked(path))
    states = np.concatenate([block.states for block in found])
    if not parameters:
        return states, None
    own = joined([block.own for block in found])
    assert own is not None
    return states, own[:, [columns[name] for name in parameters]]


def read_initial_noise(path, shape: tuple[int, int]) -> np.ndarray | None:
    """Standard deviations (B, 2d) of the noise on the initial states of this shape, ``z0_std`` of
    an ``.npz``, finite and not below 0; None where the file has none."""
    if Path(path).suffix != ".npz":
        return None
    with np.load(path, allow_pickle=False) as file:
        if "z0_std" not in file.files:
            return None
        std = np.asarray(file["z0_std"])
    if std.shape != shape or std.dtype.kind not in "fiu":
        raise InputError(f"{path}: expected z0_std as numbers {shape}, got {std.dtype} {std.shape}")
    std = std.astype(np.float64)
    if not (np.isfinite(std) & (std >= 0)).all():
        raise InputError(f"{path}: expected z0_std that is finite and not below 0")
    return std


# ---------------------------------------------------------------------------------------------
# Blocks of rows: what every kind of file is turned into
# ---------------------------------------------------------------------------------------------


@dataclasses.dataclass
class _Block:
    """Consecutive rows. ``sequence`` (n,) changes where one sequence ends and the next begins;
    ``locate(row, column)`` says where in the file a number stands. ``own`` (n, 1 + k): the row's
    time and parameters, where the file has these."""

    states: np.ndarray
    sequence: np.ndarray
    locate: Callable[[int, int], str]
    own: np.ndarray | None = None

    def rows(self, index: np.ndarray) -> _Block:
        return _Block(
            self.states[index], self.sequence[index], lambda r, c: self.locate(int(index[r]), c),
            None if self.own is None else self.own[index],
        )  # fmt: skip

    def checked(self, path) -> _Block:
        """Itself, if every number is finite and not too large; else InputError."""
        for bad, what in (
            (~np.isfinite(self.states), "not finite (NaN or infinity)"),
            (np.abs(self.states) > LARGEST, f"too large (above {LARGEST:.0e})"),
        ):
            if bad.any():
                row, column = (int(i) for i in np.argwhere(bad)[0])
                count = int(bad.sum())
                raise InputError(
                    f"{path}: {count} value{'s' * (count != 1)} {what}, first "
                    f"{self.locate(row, column)} = {self.states[row, column]}"
                )
        return self


@dataclasses.dataclass
class _Source:
    """An open file: what its header says, and its rows in blocks of at most so many.

    uneven: whether the times that were read so far are not dt apart. parameters: names of those
    that the rows have. period: of a drive, whose time the rows' times are. timed: whether they have
    times at all.
    """

    dim: int
    dt: float  # NaN where initial states need none, or the times say it
    precision: str
    units: dict[str, str]
    is_array: bool
    blocks: Callable[[int], Iterator[_Block]]
    parameters: tuple[str, ...] = ()
    uneven: bool = False
    period: float | None = None
    timed: bool = False

    def of_pairs(self, own: np.ndarray | None, rows) -> tuple[Any, dict[str, np.ndarray] | None]:
        """(dt, args) of the pairs that begin in these rows."""
        if own is None:
            return self.dt, None
        dt = own[rows + 1, 0] - own[rows, 0] if self.uneven else self.dt
        args = {name: own[rows, 1 + i] for i, name in enumerate(self.parameters)}
        if self.period is not None:
            args[_TIME] = own[rows, 0]
        return dt, args or None


@contextlib.contextmanager
def _open(
    path, dt: float | None, *, initial: bool = False, driven: bool = False
) -> Iterator[_Source]:
    """Open a trajectory file, its header checked. ``initial``: only its last states are wanted, and
    their times where ``driven``."""
    path = Path(path)
    kinds = {".npz": _open_npz, ".npy": _open_npy, ".csv": _open_csv}
    if path.suffix.lower() not in kinds:
        raise InputError(f"{path}: expected a .npz, .npy or .csv file")
    if dt is not None:
        dt = _check_dt(dt, "the given dt")
    try:
        if not path.exists():
            raise InputError(f"{path}: no such file")
        if not path.is_file():
            raise InputError(f"{path}: is not a file")
        if path.stat().st_size == 0:
            raise InputError(f"{path}: is empty")
        stream = open(path, "rb")  # noqa: SIM115, closed below
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    with stream:
        source = kinds[path.suffix.lower()](path, stream, dt, initial, driven)
        unchecked = source.blocks
        if not initial:  # of initial states only the rows that are used are checked
            source.blocks = lambda rows: (block.checked(path) for block in unchecked(rows))
        yield source


def _check_dt(dt: Any, what: str) -> float:
    array = np.asarray(dt)
    if array.size != 1 or array.dtype.kind not in "fiu":
        raise InputError(f"{what} must be one number, got {array.dtype} of shape {array.shape}")
    value = float(array.reshape(())[()])
    if not (np.isfinite(value) and value > 0):
        raise InputError(f"{what} must be finite and above 0, got {value}")
    return value


def _agreed_dt(path, given: float | None, found: float | None) -> float:
    if found is not None and np.isnan(found):
        if given is not None:
            raise InputError(f"{path}: the given dt = {given} disagrees with times that are uneven")
        return found
    if given is None and found is None:
        raise InputError(f"{path}: holds no time step and none was given (dt)")
    if given is None or found is None:
        return given if found is None else found  # pyright: ignore[reportReturnType]
    if abs(given - found) > TIME_TOLERANCE * found:
        raise InputError(f"{path}: the given dt = {given} disagrees with the file's dt = {found}")
    return given


def _check_width(path, name: str, shape: tuple[int, ...]) -> int:
    """d of an array of shape (..., 2d)."""
    width = shape[-1]
    if width == 0 or width % 2:
        raise InputError(
            f"{path}: {name} of shape {shape} must have an even last dimension 2d (q first, then "
            f"p), found {width}"
        )
    return width // 2


def _column(index: int, dim: int) -> str:
    return f"q{index + 1}" if index < dim else f"p{index - dim + 1}"


def _warn_of_odd_columns(path, states: np.ndarray, sequence: np.ndarray) -> None:
    dim = states.shape[1] // 2
    same = sequence[1:] == sequence[:-1]
    if np.array_equal(states[1:][same], states[:-1][same]):
        warnings.warn(
            f"{path}: every state equals the one before it",
            DataWarning,
            stacklevel=3,
        )
        return
    constant = [c for c in range(2 * dim) if np.all(states[:, c] == states[0, c])]
    if constant:
        names = ", ".join(_column(c, dim) for c in constant)
        warnings.warn(
            f"{path}: constant column(s) {names}; a conserved momentum may be, other columns "
            "should not",
            DataWarning,
            stacklevel=3,
        )
    for a, b in itertools.combinations(range(2 * dim), 2):
        if a not in constant and np.array_equal(states[:, a], states[:, b]):
            warnings.warn(
                f"{path}: columns {_column(a, dim)} and {_column(b, dim)} are equal in every row",
                DataWarning,
                stacklevel=3,
            )


def _digest(path) -> str:
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


# ---------------------------------------------------------------------------------------------
# .npy and .npz
# ---------------------------------------------------------------------------------------------


class _StoredArray:
    """An array in an ``.npy`` stream: its header now, its rows in order when asked for.

    The header is checked against the stream's size first, so that a damaged one allocates nothing.
    """

    def __init__(self, path, name: str, stream, size: int):
        self.path, self.name, self.stream = path, name, stream
        with _damage(path, name):
            version = np.lib.format.read_magic(stream)
            read_header = {
                (1, 0): np.lib.format.read_array_header_1_0,
                (2, 0): np.lib.format.read_array_header_2_0,
            }[version]
            self.shape, self.fortran_order, self.dtype = read_header(stream)
        if self.dtype.kind not in "fiu":
            hint = " (save padded sequences with 'lengths')" if self.dtype.hasobject else ""
            raise InputError(
                f"{path}: {name} must hold real numbers, found dtype {self.dtype}{hint}"
            )
        count = 1
        for n in self.shape:
            count *= n
        if size - stream.tell() != count * self.dtype.itemsize:
            raise InputError(
                f"{path}: {name} is damaged: {count * self.dtype.itemsize} bytes expected for "
                f"shape {self.shape}, {size - stream.tell()} found"
            )

    def whole(self) -> np.ndarray:
        with _damage(self.path, self.name):
            data = np.frombuffer(self.stream.read(), self.dtype)
        return data.reshape(self.shape, order="F" if self.fortran_order else "C")

    def read_rows(self, rows: int) -> Iterator[np.ndarray]:
        """The array as (-1, 2d) float64, in blocks of at most so many rows."""
        width = self.shape[-1]
        if self.fortran_order:
            everything = self.whole().reshape(-1, width)
            for start in range(0, len(everything), rows):
                yield everything[start : start + rows].astype(np.float64)
            return
        left = int(np.prod(self.shape[:-1], dtype=object))
        while left:
            count = min(rows, left)
            with _damage(self.path, self.name):
                data = self.stream.read(count * width * self.dtype.itemsize)
                block = np.frombuffer(data, self.dtype).reshape(count, width)
            left -= count
            yield block.astype(np.float64, copy=False)
        with _damage(self.path, self.name):
            self.stream.read(1)  # the end of an archive's member, where its checksum is compared


@contextlib.contextmanager
def _damage(path, name: str) -> Iterator[None]:
    """Whatever a damaged file makes zipfile, zlib or NumPy raise, in one line."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        detail = (str(error) or type(error).__name__)[:120]
        raise InputError(f"{path}: {name} cannot be read: damaged? ({detail})") from error


def _open_npy(path: Path, stream, dt, initial: bool, driven: bool) -> _Source:
    array = _StoredArray(path, "the array", stream, path.stat().st_size)
    dt = np.nan if initial else _agreed_dt(path, dt, None)
    return _array_source(path, array, None, dt, each_row=initial and len(array.shape) == 2)


def _open_npz(path: Path, stream, dt, initial: bool, driven: bool) -> _Source:
    with _damage(path, "the archive"):
        archive = zipfile.ZipFile(stream)
    names = [name.removesuffix(".npy") for name in archive.namelist()]

    def member(name: str) -> _StoredArray:
        with _damage(path, name):
            opened = archive.open(f"{name}.npy")
        return _StoredArray(path, name, opened, archive.getinfo(f"{name}.npy").file_size)

    if initial and "z0" in names:
        params, z0 = _read_params(path, names, member), member("z0")
        t0 = _read_t0(path, member, _rows_of(z0)) if driven and "t0" in names else None
        times = None if t0 is None else t0[:, None]
        return _array_source(path, z0, None, np.nan, each_row=True, params=params, times=times)
    is_pairs = "z0" in names and "z1" in names
    if is_pairs == ("trajectories" in names):
        raise InputError(
            f"{path}: expected either the arrays z0 and z1, or trajectories; found "
            f"{', '.join(names[:8]) or 'none'}{', ...' * (len(names) > 8)}"
        )
    found, own_dt, period = None, None, None
    if "period" in names and not initial:
        period = _check_dt(member("period").whole(), f"{path}: period")
    with_t0 = "t0" in names and (driven or not initial)
    if period is not None and not (with_t0 or "times" in names):
        raise InputError(f"{path}: expected t0, the time of the drive, beside its period; got none")
    if with_t0 and not initial and period is None:
        raise InputError(f"{path}: expected the drive's period beside t0, found none")
    if "dt" in names and (driven or not initial):
        value = member("dt").whole()
        if is_pairs and value.size > 1:
            own_dt, found = value, np.nan
        else:
            found = _check_dt(value, f"{path}: dt")
    trajectories = None if is_pairs else member("trajectories")
    if trajectories is not None and found is not None and "steps" in names:
        found *= _stride(path, trajectories.shape, member("steps").whole())
    params = _read_params(path, names, member)
    if trajectories is None:
        dt, z0 = _agreed_dt(path, dt, found), member("z0")
        t0 = None
        if with_t0 and period is not None:
            t0 = np.mod(_read_t0(path, member, _rows_of(z0)), period)
        return _pairs_source(path, z0, member("z1"), dt, own_dt, params, t0, period)
    lengths = member("lengths").whole() if "lengths" in names else None
    times = None
    if "times" in names and (driven or not initial):
        if found is not None:
            raise InputError(f"{path}: expected dt or times, found both")
        times = member("times").whole().astype(np.float64)
        found = _times_dt(path, times, trajectories.shape, lengths)
    dt = found if initial else _agreed_dt(path, dt, found)
    if with_t0:
        if times is not None:
            raise InputError(f"{path}: expected t0 or times, found both")
        if dt is None:
            raise InputError(f"{path}: holds no time step, by which t0 goes on")
        count, length = (1, *trajectories.shape)[-3:-1]
        times = _read_t0(path, member, count)[:, None] + dt * np.arange(length)
    dt = np.nan if initial or dt is None else dt
    return _array_source(path, trajectories, lengths, dt, times=times, params=params, period=period)


def _rows_of(array: _StoredArray) -> int:
    """Its rows."""
    return array.shape[0] if array.shape else 0


def _read_t0(path, member, count: int) -> np.ndarray:
    """The times (count,) of a drive."""
    t0 = np.atleast_1d(member("t0").whole().astype(np.float64))
    if t0.shape != (count,) or not np.isfinite(t0).all():
        raise InputError(
            f"{path}: t0 must be finite, of shape ({count},), found {t0.shape}"
            + ("" if np.isfinite(t0).all() else " with NaN or infinity")
        )
    return t0


def _read_params(path, names: list[str], member) -> tuple[tuple[str, ...], np.ndarray] | None:
    """The names (k,) and the values (n, k) of the parameters; None where there are none."""
    if "params" not in names:
        return None
    values = member("params").whole().astype(np.float64)
    if values.ndim == 1:
        values = values[:, None]
    if values.ndim != 2 or values.shape[1] == 0:
        raise InputError(f"{path}: params must have shape (n, k), found {values.shape}")
    if not np.isfinite(values).all():
        row, column = np.argwhere(~np.isfinite(values))[0]
        raise InputError(
            f"{path}: params not finite (NaN or infinity), first params[{row}, {column}]"
        )
    called = tuple(f"a{i + 1}" for i in range(values.shape[1]))
    if "param_names" in names:
        with _damage(path, "param_names"), np.load(path, allow_pickle=False) as file:
            called = tuple(np.atleast_1d(file["param_names"]).astype(str).tolist())
        if len(called) != values.shape[1] or len(set(called)) < len(called):
            raise InputError(
                f"{path}: param_names must be {values.shape[1]} different names, found "
                f"{', '.join(called)}"
            )
    return called, values


def _own_columns(path, times, params, count: int, what: str, repeat: int):
    """What rows have beside their states (rows, 1 + k), or None: times of all rows, and params of
    each of ``count`` sequences of ``repeat`` rows."""
    if times is None and params is None:
        return None
    if params is not None and len(params[1]) != count:
        raise InputError(
            f"{path}: params must have a row for each of the {count} {what}, found "
            f"{params[1].shape}"
        )
    columns = [np.zeros((count * repeat, 1)) if times is None else times.reshape(-1, 1)]
    if params is not None:
        columns.append(np.repeat(params[1], repeat, axis=0))
    return np.concatenate(columns, axis=1)


def _times_dt(path, times, shape, lengths) -> float:
    """The time step of ``times`` (M, L), NaN where they are uneven."""
    times = times[None] if times.ndim == 1 else times
    if times.shape != ((1, *shape[:1]) if len(shape) == 2 else shape[:2]):
        raise InputError(
            f"{path}: times must have the shape of the trajectories without the last axis, found "
            f"{times.shape} beside {shape}"
        )
    steps = np.diff(times, axis=1)
    if lengths is not None and lengths.shape == times.shape[:1]:
        steps = np.where(np.arange(1, times.shape[1]) < lengths[:, None], steps, 1.0)
        used = np.arange(1, times.shape[1]) < lengths[:, None]
    else:
        used = np.ones(steps.shape, bool)
    bad = ~(np.isfinite(steps) & (steps > 0)) & used
    if bad.any():
        m, i = (int(k) for k in np.argwhere(bad)[0])
        raise InputError(
            f"{path}: times must rise, found times[{m}, {i + 1}] = {times[m, i + 1]:g} after "
            f"{times[m, i]:g}"
        )
    usual = float(np.median(steps[used])) if used.any() else np.nan
    slack = TIME_TOLERANCE * usual + 4 * np.finfo(np.float64).eps * np.abs(times[:, 1:])
    even = bool((np.abs(steps - usual) <= slack)[used].all())
    return float(np.mean(steps[used])) if even else np.nan


def _stride(path, shape: tuple[int, ...], steps: np.ndarray) -> float:
    """A prediction file keeps every K-th step, so that its rows are K dt apart: this K."""
    if len(shape) != 3 or steps.shape != shape[1:2] or len(steps) < 2:
        return 1.0
    gaps = np.diff(steps)
    if gaps[0] <= 0 or np.any(gaps != gaps[0]):
        raise InputError(f"{path}: steps must rise by equal amounts")
    return float(gaps[0])


def _pairs_source(
    path, z0: _StoredArray, z1: _StoredArray, dt: float, own_dt=None, params=None, t0=None,
    period: float | None = None,
) -> _Source:  # fmt: skip
    """z0, z1 as sequences of two states. own_dt: of each pair; params: names and values; t0 (N,):
    the time of the drive at z0."""
    if len(z0.shape) != 2 or z0.shape != z1.shape:
        raise InputError(
            f"{path}: z0 and z1 must both have shape (N, 2d), found {z0.shape} and {z1.shape}"
        )
    dim = _check_width(path, "z0", z0.shape)
    times = None
    if own_dt is not None:
        if own_dt.shape != z0.shape[:1]:
            raise InputError(
                f"{path}: dt must be one number or have shape ({z0.shape[0]},), found "
                f"{own_dt.shape}"
            )
        bad = ~(np.isfinite(own_dt) & (own_dt > 0))
        if bad.any():
            row = int(np.argmax(bad))
            raise InputError(
                f"{path}: dt must be finite and above 0, found {int(bad.sum())} that are not, "
                f"first dt[{row}] = {own_dt[row]:g}"
            )
        times = np.stack([np.zeros(len(own_dt)), own_dt], axis=1)
    if t0 is not None:
        times = t0[:, None] + (np.stack([0 * t0, 0 * t0 + dt], axis=1) if times is None else times)
    own = _own_columns(path, times, params, z0.shape[0], "pairs", 2)

    def blocks(rows: int) -> Iterator[_Block]:
        pair = 0
        # Two rows a pair, and at most ``rows`` pairs a block.
        for a, b in zip(z0.read_rows(rows), z1.read_rows(rows), strict=True):
            states = np.stack([a, b], axis=1).reshape(-1, 2 * dim)
            sequence = np.repeat(np.arange(pair, pair + len(a)), 2)
            beside = None if own is None else own[2 * pair : 2 * (pair + len(a))]
            yield _Block(
                states, sequence, lambda r, c, n=pair: f"z{r % 2}[{n + r // 2}, {c}]", beside
            )
            pair += len(a)

    precision = str(np.result_type(z0.dtype, z1.dtype))
    called = () if params is None else params[0]
    uneven = own_dt is not None
    return _Source(dim, dt, precision, {}, True, blocks, called, uneven, period, t0 is not None)


def _array_source(
    path, array: _StoredArray, lengths: np.ndarray | None, dt: float, *, each_row: bool = False,
    times: np.ndarray | None = None, params=None, period: float | None = None,
) -> _Source:  # fmt: skip
    """(L, 2d) or (M, L, 2d); with ``each_row`` every row is a sequence of its own."""
    shape = array.shape
    if len(shape) not in (2, 3) or (each_row and len(shape) != 2):
        wanted = "(B, 2d)" if each_row else "(L, 2d) or (M, L, 2d)"
        raise InputError(f"{path}: {array.name} must have shape {wanted}, found {shape}")
    dim = _check_width(path, array.name, shape)
    count, length = (1, shape[0]) if len(shape) == 2 else shape[:2]
    if lengths is not None:
        lengths = _check_lengths(path, lengths, count, length)
    each = (shape[0], 1) if each_row else (count, length)
    own = _own_columns(path, times, params, each[0], "states" if each_row else "sequences", each[1])

    def locate(row: int, column: int) -> str:
        index = (row, column) if len(shape) == 2 else (*divmod(row, length), column)
        return f"{array.name}[{', '.join(map(str, index))}]"

    def blocks(rows: int) -> Iterator[_Block]:
        start = 0
        for states in array.read_rows(rows):
            row = np.arange(start, start + len(states))
            sequence = row if each_row else row // length
            beside = None if own is None else own[start : start + len(states)]
            block = _Block(states, sequence, lambda r, c, n=start: locate(n + r, c), beside)
            if lengths is not None:
                block = block.rows(np.flatnonzero(row % length < lengths[sequence]))
            start += len(states)
            if len(block.states):
                yield block

    uneven = times is not None and bool(np.isnan(dt))
    called = () if params is None else params[0]
    timed = times is not None
    return _Source(dim, dt, str(array.dtype), {}, True, blocks, called, uneven, period, timed)


def _check_lengths(path, lengths: np.ndarray, count: int, longest: int) -> np.ndarray:
    if lengths.shape != (count,) or lengths.dtype.kind not in "iu":
        raise InputError(
            f"{path}: lengths must be integers of shape ({count},), found {lengths.dtype} of shape "
            f"{lengths.shape}"
        )
    bad = np.flatnonzero((lengths < 1) | (lengths > longest))
    if len(bad):
        raise InputError(
            f"{path}: {len(bad)} of the lengths outside 1..{longest}, first lengths[{bad[0]}] = "
            f"{lengths[bad[0]]}"
        )
    return lengths.astype(np.int64)


# ---------------------------------------------------------------------------------------------
# .csv
# ---------------------------------------------------------------------------------------------

_HEADING = re.compile(r"^\s*([^\[(]*?)\s*(?:\[([^\]]*)\]|\(([^)]*)\))?\s*$")


def _parse_header(line: str) -> tuple[list[str], dict[str, str]] | None:
    """Column names, and units by name; None if this line does not name q and p columns."""
    names, units = [], {}
    for cell in line.strip().lstrip("#").split(","):
        match = _HEADING.match(cell.strip().strip('"'))
        name = match[1].lower() if match else cell.strip()
        if match and (match[2] or match[3]):
            units[name] = (match[2] or match[3]).strip()
        names.append(name)
    return (names, units) if any(re.fullmatch(r"[qp]\d+", n) for n in names) else None


def _open_csv(path: Path, stream, dt, initial: bool, driven: bool) -> _Source:
    stream = TextIOWrapper(stream, encoding="utf-8-sig")
    header, line, line_number = None, "", 0
    with _damage(path, "the header"):
        for line in stream:
            line_number += 1
            header = _parse_header(line)
            # Comments may come first, and np.savetxt writes the header itself as one.
            if header is not None or not line.startswith("#"):
                break
    if header is None:
        raise InputError(
            f"{path}: expected a header t,q1,...,qd,p1,...,pd in line {line_number}, found "
            f"{line.strip()[:60]!r}"
        )
    names, units = header
    dim = sum(bool(re.fullmatch(r"q\d+", name)) for name in names)
    wanted = [_column(c, dim) for c in range(2 * dim)]
    others = [n for n in names if re.fullmatch(r"[qp]\d+", n) and n not in wanted]
    missing = [n for n in wanted if n not in names]
    repeated = [n for n in dict.fromkeys(names) if names.count(n) > 1]
    for columns, what in ((missing, "missing"), (others, "without a partner"), (repeated, "twice")):
        if columns:
            raise InputError(
                f"{path}: the header must name q1..qd and p1..pd once each: {', '.join(columns)} "
                f"{what} in {','.join(names)}"
            )
    further = [n for n in names if n not in (*wanted, "t", "sequence")]
    columns = [names.index(n) for n in wanted]
    each_row = initial and "t" not in names and "sequence" not in names

    tables = _csv_tables(path, stream, names, line_number)
    first = next(tables, None)
    if first is None:
        raise InputError(f"{path}: holds a header and no rows")
    found = None if initial or "t" not in names else _csv_dt(path, names, *first)
    dt = np.nan if initial else _agreed_dt(path, dt, found)
    usual = dt if found is None else found
    sequence = first[0][:, names.index("sequence")] if "sequence" in names else None
    same = slice(0) if each_row else slice(None) if sequence is None else np.diff(sequence) == 0
    moving = [n for n in further if np.any(np.diff(first[0][:, names.index(n)])[same] != 0)]
    if moving:  # no parameters: an energy, say
        warnings.warn(
            f"{path}: columns ignored: {', '.join(moving)} (not constant in a sequence)",
            DataWarning, stacklevel=4,
        )  # fmt: skip
    period = None
    if "period" in further and not initial:
        if "t" not in names:
            raise InputError(f"{path}: expected a column t, the time of the drive of that period")
        values = first[0][:, names.index("period")]
        if "period" in moving or np.ptp(values) != 0:
            raise InputError(f"{path}: the column period must hold the same number in all rows")
        period = _check_dt(values[0], f"{path}: the column period")
    parameters = [n for n in further if n not in (*moving, "period")]
    beside = [names.index(n) for n in parameters]
    with_time = "t" in names and (driven or not initial)

    def blocks(rows: int) -> Iterator[_Block]:
        seen: set[float] = set()
        last = np.full(2, np.nan)  # sequence and time of the row before
        for table, lines in _cut(itertools.chain([first], tables), rows):
            if each_row:
                sequence = lines
            elif "sequence" in names:
                sequence = table[:, names.index("sequence")]
                changes = np.flatnonzero(np.append(last[0], sequence[:-1]) != sequence)
                for row in changes:
                    if sequence[row] in seen or not np.isfinite(sequence[row]):
                        raise InputError(
                            f"{path}: line {lines[row]}: the rows of sequence {sequence[row]:g} "
                            "must stand together"
                        )
                    seen.add(float(sequence[row]))
            else:
                sequence = np.zeros(len(table))
            time = table[:, names.index("t")] if with_time else np.zeros(len(table))
            if with_time:
                before = np.append(last[1], time), np.append(last[0], sequence)
                _check_times_rise(path, *before, lines)
                source.uneven |= not _even(*before, usual)
            if period is not None and np.any(table[:, names.index("period")] != period):
                raise InputError(f"{path}: the column period must hold the same number in all rows")
            values = table[:, beside]
            if not each_row:
                _check_constant(path, parameters, values, sequence, lines)
            last = np.array([sequence[-1], time[-1] if with_time else np.nan])
            yield _Block(
                table[:, columns],
                sequence,
                lambda r, c, lines=lines: f"line {lines[r]}, {wanted[c]}",
                np.column_stack([time, values]),
            )

    called = tuple(re.sub(r"\W+", "_", name) for name in parameters)
    source = _Source(
        dim, float(dt), "float64", units, False, blocks, called, period=period, timed=with_time
    )
    return source


def _check_constant(path, names: list[str], values, sequence, lines) -> None:
    """Raises InputError where a parameter changes within a sequence."""
    changes = (values[1:] != values[:-1]) & (sequence[1:] == sequence[:-1])[:, None]
    bad = changes.any(axis=1) | ~np.isfinite(values).all(axis=1)[1:]
    if bad.any():
        row = int(np.argmax(bad)) + 1
        raise InputError(
            f"{path}: line {lines[row]}: expected {', '.join(names)} finite and constant in each "
            f"sequence, as parameters are, found {', '.join(f'{v:g}' for v in values[row])} after "
            f"{', '.join(f'{v:g}' for v in values[row - 1])}"
        )


def _cut(tables, rows: int):
    for table, lines in tables:
        for start in range(0, len(table), rows):
            yield table[start : start + rows], lines[start : start + rows]


def _csv_tables(path, stream, names: list[str], line_number: int):
    """Tables (n, columns), n at most BLOCK_ROWS, with the line number of every row."""
    while True:
        with _damage(path, f"the text after line {line_number}"):
            text = list(itertools.islice(stream, BLOCK_ROWS))
        if not text:
            return
        lines = np.arange(line_number + 1, line_number + 1 + len(text))
        line_number += len(text)
        filled = np.array([bool(t.strip()) for t in text])
        if not filled.any():
            continue
        try:
            rows = [line for line in text if line.strip()]
            table = np.loadtxt(rows, delimiter=",", comments=None, ndmin=2)
            if table.shape[1] != len(names):
                raise ValueError
        except ValueError:
            raise InputError(_csv_fault(path, names, text, int(lines[0]))) from None
        yield table, lines[filled]


def _csv_fault(path, names: list[str], text: list[str], line_number: int) -> str:
    """The first thing wrong with these lines."""
    for number, line in enumerate(text, line_number):
        cells = line.strip().split(",")
        if line.strip() and len(cells) != len(names):
            return f"{path}: line {number}: {len(names)} columns expected, {len(cells)} found"
        for name, cell in zip(names, cells, strict=False):
            try:
                float(cell)
            except ValueError:
                if line.strip():
                    return f"{path}: line {number}, {name}: {cell.strip()[:40]!r} is not a number"
    return f"{path}: the lines from {line_number} on cannot be read as numbers"


def _csv_dt(path, names: list[str], table: np.ndarray, lines: np.ndarray) -> float | None:
    """The time step of the first rows, NaN where they are uneven; None if no sequence among them
    has two states."""
    time = table[:, names.index("t")]
    sequence = table[:, names.index("sequence")] if "sequence" in names else np.zeros(len(table))
    steps = np.diff(time)[sequence[1:] == sequence[:-1]]
    if len(steps) == 0:
        return None
    # The median ignores a gap; where every step agrees with it, the mean is more accurate.
    usual = float(np.median(steps))
    if not (np.isfinite(usual) and usual > 0):
        raise InputError(f"{path}: the column t must rise, found a usual step of {usual}")
    before = np.append(np.nan, time), np.append(np.nan, sequence)
    _check_times_rise(path, *before, lines)
    return float(np.mean(steps)) if _even(*before, usual) else np.nan


def _only_rounded(time: np.ndarray, sequence: np.ndarray, dt: float) -> bool:
    """Whether the steps differ because the times were printed with few decimals, the last of them
    less than a thousandth of dt: every sequence is then within that unit of a straight line."""
    if np.isnan(time[0]):  # nothing stands before the first row of a file
        time, sequence = time[1:], sequence[1:]
    for decimals in range(max(0, int(np.ceil(3 - np.log10(dt)))), 13):
        unit = 10.0**-decimals
        if np.all(np.abs(time - np.round(time, decimals)) <= 1e-3 * unit):
            break
    else:
        return False
    for rows in np.split(time, np.flatnonzero(sequence[1:] != sequence[:-1]) + 1):
        count = np.arange(len(rows)) - 0.5 * (len(rows) - 1)
        slope = count @ (rows - rows[0]) / max(count @ count, 1)
        if np.ptp(rows - slope * count) > 1.5 * unit:
            return False
        if len(rows) > 1 and abs(slope - dt) > unit:
            return False
    return True


def _check_times_rise(path, time: np.ndarray, sequence: np.ndarray, lines: np.ndarray):
    """Raises InputError where times do not rise in a sequence. ``time`` and ``sequence`` start one
    row before."""
    # "not (... > 0)" so that NaN counts as wrong.
    bad = np.flatnonzero((sequence[1:] == sequence[:-1]) & ~(np.diff(time) > 0))
    if len(bad) or not np.isfinite(time[1:]).all():
        row = bad[0] if len(bad) else int(np.argmin(np.isfinite(time[1:])))
        raise InputError(
            f"{path}: the column t must rise in a sequence, found {time[row + 1]:.9g} in line "
            f"{lines[row]} after {time[row]:.9g}"
        )


def _even(time: np.ndarray, sequence: np.ndarray, dt: float) -> bool:
    """Whether every step within a sequence is dt, but for the rounding of printed times. ``time``
    and ``sequence`` start one row before."""
    if np.isnan(dt):
        return False
    slack = TIME_TOLERANCE * dt + 4 * np.finfo(np.float64).eps * np.abs(time[1:])
    even = np.abs(np.diff(time) - dt) <= slack
    return bool(even[sequence[1:] == sequence[:-1]].all()) or _only_rounded(time, sequence, dt)
