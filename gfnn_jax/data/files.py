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
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from gfnn_jax.data.blocks import BLOCK_ROWS, TIME, Block, DataWarning, Source, check_dt, column
from gfnn_jax.data.csv_files import open_csv
from gfnn_jax.data.npz_files import open_npy, open_npz
from gfnn_jax.errors import InputError
from gfnn_jax.processes import WHOLE, Group, Share


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
    paths, *, dt: float | None = None, num_pairs: int = 200_000, seed: int = 0,
    group: Group | None = None,
) -> TrajectoryData:  # fmt: skip
    """As `read_trajectories`, of data larger than memory: a random sample of their pairs.

    paths: a file, or several. group: the processes that each read their own pairs of them, as
    `iterate_pairs` shares them out; the sample, the same for any number, is the first one's, and
    the others get what they have sent.
    The files are read once, block by block, and checked all through; each pair is kept with the
    same probability, as a sequence of two states. Memory is that of the sample and a few blocks.
    Which pairs are kept is told by a hash of their numbers. ``digest`` is that of the one file, or
    of several or of a group's the sum of the hashes of all pairs, whatever their order.
    """
    alone, group = group is None, group or Group()
    found, checksum, count, seen = None, np.zeros(1, np.uint64), 0, [np.inf, 0.0]
    for pairs in iterate_pairs(paths, BLOCK_ROWS, dt=dt, share=group.share):
        new = _table(pairs, seed)
        checksum, count = checksum + new["hash"].sum(), count + len(pairs)
        seen = [min(seen[0], new["dt"].min()), max(seen[1], new["dt"].max())]
        found = _smallest(_both(found, new), num_pairs)
    told = {"count": [count], "hash": checksum, "low": [seen[0]], "high": [seen[1]]}
    all_told = group.folded({n: np.array(v) for n, v in told.items()}, _both)
    total = group.told({"count": all_told["count"].sum()} if group.first else None)["count"]
    if not total:
        raise InputError(f"{_named(paths)}: no pair of consecutive states found")
    if group.share.count > 1:  # those that the first will want, and a few more
        part = (num_pairs + _MORE * np.sqrt(num_pairs)) / max(int(total), 1)
        if found is not None and part < 1:
            found = _taken(found, found["hash"] < np.uint64(part * 2.0**64))
        found = group.folded(found or {}, _both)
    with _open(_own(paths, group.share)[0][0], dt) as source:
        precision, units, period = source.precision, source.units, source.period
        none = np.empty((0, 2, 2 * source.dim))
    if not found:  # this process has no pair, and sends none
        found = {"pairs": none, "dt": none[:, 0, 0], "hash": np.empty(0, np.uint64)}
    if total > num_pairs or not alone:
        found = _taken(found, np.argsort(found["hash"], kind="stable")[:num_pairs])
    alone = alone and len(_listed(paths)) == 1
    digest = _digest(_listed(paths)[0]) if alone else f"{all_told['hash'].sum():016x}"
    same = all_told["low"].min() == all_told["high"].max()
    states = found["pairs"].reshape(-1, found["pairs"].shape[-1])
    args = {n.removeprefix(_ARG): v for n, v in found.items() if n.startswith(_ARG)}
    each = float(found["dt"][0]) if same and len(states) else found["dt"]
    return TrajectoryData(
        states, np.full(len(found["pairs"]), 2), each, _named(paths), digest, precision, units,
        args or None, period,
    )  # fmt: skip


_ARG = "arg "  # before the name of a parameter in a table
_MORE = 10  # standard deviations of the number of pairs that fall below a bound


def _table(pairs: Any, seed: int) -> dict[str, np.ndarray]:
    """Pairs as arrays by name, with a hash of all numbers of each (N,)."""
    rows = np.stack([pairs.z0, pairs.z1], axis=1)
    each = np.broadcast_to(np.asarray(pairs.dt, np.float64), len(rows))
    args = {_ARG + name: np.asarray(v, np.float64) for name, v in (pairs.args or {}).items()}
    columns = [*rows.reshape(len(rows), -1).T, each, *args.values()]
    mixed = np.full(len(rows), seed, np.uint64)
    for numbers in columns:  # Steele, Lea & Flood, OOPSLA 2014: SplitMix64's finaliser
        mixed = mixed + np.uint64(0x9E3779B97F4A7C15)
        mixed ^= np.ascontiguousarray(numbers, np.float64).view(np.uint64)
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
            mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
        mixed ^= mixed >> np.uint64(31)
    return {"pairs": rows, "dt": each, "hash": mixed, **args}


def _both(one: dict[str, np.ndarray] | None, other: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The rows of both tables, either of which may have none. Raises InputError where they differ
    in what they hold."""
    if not one or not other:
        return one or other
    shapes = [{name: column.shape[1:] for name, column in table.items()} for table in (one, other)]
    if shapes[0] != shapes[1]:
        raise InputError(
            "expected files with the same coordinates and parameters, found "
            f"{' and '.join(str(s) for s in shapes)}"
        )
    return {name: np.concatenate([column, other[name]]) for name, column in one.items()}


def _taken(table: dict[str, np.ndarray], rows) -> dict[str, np.ndarray]:
    return {name: column[rows] for name, column in table.items()}


def _smallest(table: dict[str, np.ndarray], most: int) -> dict[str, np.ndarray]:
    """At most so many rows, those with the smallest hashes."""
    if len(table["hash"]) <= most:
        return table
    return _taken(table, np.argpartition(table["hash"], most)[:most])


def _listed(paths) -> list[Path]:
    return [Path(paths)] if isinstance(paths, (str, Path)) else [Path(path) for path in paths]


def _named(paths) -> str:
    return ", ".join(str(path) for path in _listed(paths))


def _own(paths, share: Share) -> tuple[list[Path], Share]:
    """The files of a process, and its share of each of them."""
    listed = _listed(paths)
    if len(listed) >= share.count:
        return listed[share.of(len(listed), 1)], WHOLE
    return listed, share


def iterate_pairs(
    paths, chunk: int, *, dt: float | None = None, share: Share = WHOLE
) -> Iterator[Any]:
    """The pairs of files larger than memory, as `Pairs` of at most ``chunk`` pairs each.

    paths: a file, or several. share: of them that are wanted: whole files where there are enough of
    them, else rows of each file. Rows of a compressed array are unpacked from its beginning on;
    those of a .csv cannot be shared out.

    Memory stays within a few chunks, whatever the files' size, except for arrays stored in
    Fortran order, which are read whole, as are times and parameters. The same checks as in
    `read_trajectories`, block by block: a NaN far into the file is found only when it is reached.
    """
    from gfnn_jax.phase_space import Pairs

    own, of_rows = _own(paths, share)
    for path in own:
        if of_rows.count > 1 and path.suffix.lower() == ".csv":
            raise InputError(
                f"{path}: expected .npz or .npy, whose rows {share.count} processes can share, or "
                "as many files as processes"
            )
        with _open(path, dt) as source:
            last_state, last_sequence = np.empty((0, 2 * source.dim)), np.empty(0)
            last_own: list[np.ndarray | None] = []
            for block in source.blocks(chunk, *([of_rows] if of_rows.count > 1 else [])):
                states = np.concatenate([last_state, block.states])
                sequence = np.concatenate([last_sequence, block.sequence])
                beside = joined([*last_own, block.own])
                rows = np.flatnonzero(sequence[1:] == sequence[:-1])
                if len(rows):
                    z0, z1, given = states[rows], states[rows + 1], source.of_pairs(beside, rows)
                    yield Pairs(z0, z1, *given, period=source.period)
                last_state, last_sequence = states[-1:], sequence[-1:]
                last_own = [None if beside is None else beside[-1:]]


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
    driven = TIME in parameters
    with _open(path, None, initial=True, driven=driven) as source:
        if source.dim != dim:
            raise InputError(
                f"{path}: expected states of {2 * dim} columns (d = {dim}), found "
                f"{2 * source.dim} columns (d = {source.dim})"
            )
        columns = {name: 1 + i for i, name in enumerate(source.parameters)}
        if driven and "t0" in columns:
            columns[TIME] = columns["t0"]
        elif driven and source.timed:
            columns[TIME] = 0
        if driven and TIME not in columns:
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
        found: list[Block] = []
        held: Block | None = None  # the last row so far: the end of its sequence, or not
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


@contextlib.contextmanager
def _open(
    path, dt: float | None, *, initial: bool = False, driven: bool = False
) -> Iterator[Source]:
    """Open a trajectory file, its header checked. ``initial``: only its last states are wanted, and
    their times where ``driven``."""
    path = Path(path)
    kinds = {".npz": open_npz, ".npy": open_npy, ".csv": open_csv}
    if path.suffix.lower() not in kinds:
        raise InputError(f"{path}: expected a .npz, .npy or .csv file")
    if dt is not None:
        dt = check_dt(dt, "the given dt")
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
            source.blocks = lambda *given: (block.checked(path) for block in unchecked(*given))
        yield source


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
        names = ", ".join(column(c, dim) for c in constant)
        warnings.warn(
            f"{path}: constant column(s) {names}; a conserved momentum may be, other columns "
            "should not",
            DataWarning,
            stacklevel=3,
        )
    for a, b in itertools.combinations(range(2 * dim), 2):
        if a not in constant and np.array_equal(states[:, a], states[:, b]):
            warnings.warn(
                f"{path}: columns {column(a, dim)} and {column(b, dim)} are equal in every row",
                DataWarning,
                stacklevel=3,
            )


def _digest(path) -> str:
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
