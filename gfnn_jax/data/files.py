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
            source.blocks = lambda rows: (block.checked(path) for block in unchecked(rows))
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
