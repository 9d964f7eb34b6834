"""A user's trajectories and initial states in: reading and checking.

Three kinds of file hold the same thing, sequences of states z = (q, p), q first, and the time
between them, one number where it is always the same:

- ``.npz``: ``z0``, ``z1`` of shape (N, 2d) with ``dt``, a number or (N,); or ``trajectories`` of
  shape (M, L, 2d) with optional ``lengths`` (M,), rows beyond a length ignored, and ``dt`` or
  ``times`` (M, L). Optional ``params``, parameters of the system, (N, k) or (M, k), with
  ``param_names``; and of a driven system its ``period``, with ``t0``, the time of the drive at each
  z0 (N,) or at the begin of each sequence (M,), unless ``times`` say it.
- ``.npy``: one array of shape (L, 2d) or (M, L, 2d).
- ``.csv``: text of any dialect (`text_files`) whose header names the columns ``t, q1..qd, p1..pd``
  in any order, optionally ``sequence``; units as in ``q1 [km]`` or ``q1 (km)``. Every further
  column is a parameter, where it is constant in each sequence; one named ``period`` makes ``t`` the
  time of a drive.

All are read as blocks of consecutive rows, so that a whole file and a file larger than memory go
through the same checks. Every refusal is an `InputError`: one line that says what was expected
and what came. Nothing here needs JAX, so that a refusal comes at once.
"""

import contextlib
import dataclasses
import hashlib
import itertools
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gfnn_jax.data import blocks
from gfnn_jax.data.csv_files import are_states, open_csv
from gfnn_jax.data.npz_files import open_npy, open_npz
from gfnn_jax.data.text_files import TextFile
from gfnn_jax.errors import InputError
from gfnn_jax.processes import WHOLE, Share
from gfnn_jax.signals.steps import longest_step

_OPENERS = {".npz": open_npz, ".npy": open_npy, ".csv": open_csv}
FILE_STEP = 2**40  # between the labels of the runs of one file and those of the next


@dataclasses.dataclass(frozen=True)
class TrajectoryData:
    """Sequences of states, one after the other.

    states:    (T, 2d) float64, q first: the sequences' states, concatenated.
    lengths:   (M,) the number of states in each sequence. Pairs z0, z1 are sequences of two.
    dt:        time between consecutive states, in the user's unit of time; one of each pair
               (num_pairs,) where it is not always the same.
    args:      parameters, name -> (num_pairs,), or None; by the name t the time of a drive.
    period:    of the drive.
    run, place: of each pair the run that it is of, as the file labels it, and the number of its
               first state along that (num_pairs,); None where the file holds single pairs, whose
               runs are told by those that go on with the next.
    source:    the file it came from; digest: the SHA-256 of that file.
    precision: the dtype that the file stores, "float32" say; ``states`` is float64 always.
    units:     units by column name, as a CSV header gave them.
    sampled:   the pairs of the files that these are a sample of; None: these are all.
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
    run: np.ndarray | None = None
    place: np.ndarray | None = None
    sampled: int | None = None

    @property
    def dim(self) -> int:
        """Degrees of freedom d."""
        return self.states.shape[1] // 2

    @property
    def num_pairs(self) -> int:
        return len(self.states) - len(self.lengths)

    def pairs(self):
        """All pairs of consecutive states, as `Pairs` of shape (num_pairs, 2d)."""
        from gfnn_jax.phase_space import Pairs  # brings JAX

        rows = np.delete(np.arange(len(self.states)), np.cumsum(self.lengths) - 1)
        z0, z1, run, place = self.states[rows], self.states[rows + 1], self.run, self.place
        return Pairs(z0, z1, self.dt, self.args, period=self.period, run=run, place=place)


def read_trajectories(
    path, *, dt: float | None = None, fewest: int | None = None
) -> TrajectoryData:
    """Read and check a trajectory file.

    dt: the time step for a file that holds none; it must agree with one that a file holds.
    fewest: pairs that are needed at least; None: those that determine an affine map.
    Raises InputError where the file cannot be used; warns (DataWarning) about constant or
    duplicated columns and about states that never move.
    """
    with opened(path, dt) as source:
        whole = blocks.joined(source.blocks(2**62), source.dim)
    states, sequence, going = whole.states, whole.sequence, whole.going
    dt, args = source.of_pairs(whole.own, going)
    begins = np.flatnonzero(np.diff(sequence, prepend=np.nan) != 0)
    lengths, pairs = np.diff(begins, append=len(sequence)), len(going)
    needed = 2 * source.dim + 1 if fewest is None else fewest
    if pairs < needed:
        found = f"{pairs} pair{'s' * (pairs != 1)} of consecutive states found"
        raise InputError(f"{path}: {found}, at least {needed} are needed for d = {source.dim}")
    for odd in _odd_columns(states, going):
        warnings.warn(f"{path}: {odd}", blocks.DataWarning, stacklevel=2)
    known = (labels(sequence[going]), whole.place[going])
    identities = (None, None) if source.of_pairs_alone else known
    told = source.precision, source.units, args, source.period
    return TrajectoryData(states, lengths, dt, str(path), digest_of(path), *told, *identities)


def labels(sequence: np.ndarray) -> np.ndarray:
    """Labels of sequences (n,), as integers where they are whole numbers."""
    whole = sequence.astype(np.int64)
    return whole if np.array_equal(whole, sequence) else sequence


def listed(paths) -> list[Path]:
    return [Path(paths)] if isinstance(paths, (str, Path)) else [Path(path) for path in paths]


def named(paths) -> str:
    return ", ".join(str(path) for path in listed(paths))


def own_files(paths, share: Share) -> tuple[list[tuple[int, Path]], Share]:
    """The files of a process, each with its number among all, and its share of each of them."""
    files = list(enumerate(listed(paths)))
    if len(files) >= share.count:
        return files[share.of(len(files), 1)], WHOLE
    return files, share


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

    Of several files the labels of runs begin with the file's number, times `FILE_STEP`. Single
    pairs z0, z1 are in runs of at most `ARC` rows, each of which goes on with the next: they are
    numbered by their first pair, and are the same for every number of processes.
    """
    from gfnn_jax.phase_space import Pairs

    own, of_rows = own_files(paths, share)
    for number, path in own:
        if of_rows.count > 1 and path.suffix.lower() == ".csv":
            raise InputError(
                f"{path}: expected .npz or .npy, whose rows {share.count} processes can share, or "
                "as many files as processes"
            )
        with opened(path, dt) as source:
            last: list[blocks.Block] = []  # the row before the next block
            last_arc = (0, np.empty(2 * source.dim))
            for new in source.blocks(chunk, *([of_rows] if of_rows.count > 1 else [])):
                block = blocks.joined([*last, new], source.dim)
                last, rows = [block.rows(np.array([-1]))], block.going
                if len(rows):
                    z0, z1 = block.states[rows], block.states[rows + 1]
                    run, along = labels(block.sequence[rows]), block.place[rows]
                    if source.of_pairs_alone:
                        pair, run = run, _arcs_of_pairs(run, z0, z1, *last_arc)
                        along, last_arc = pair - run, (int(run[-1]), z1[-1])
                    run, given = run + number * FILE_STEP, source.of_pairs(block.own, rows)
                    yield Pairs(z0, z1, *given, period=source.period, run=run, place=along)


def _arcs_of_pairs(pair: np.ndarray, z0, z1, last_arc: int, last_image) -> np.ndarray:
    """The number of the first pair of the arc that each pair (n,) is of: consecutive pairs, each
    the state of the one before's image, cut where `ARC` divides their numbers. last_arc,
    last_image: of the pair before these."""
    before = np.concatenate([last_image[None], z1[:-1]])
    begins = (pair % blocks.ARC == 0) | np.any(before != z0, axis=1)
    return np.maximum.accumulate(np.where(begins, pair, last_arc))


def read_initial(
    path, dim: int, parameters: tuple[str, ...] = ()
) -> tuple[np.ndarray, np.ndarray | None]:
    """Initial states (B, 2d) float64 to predict from, for a map of ``dim`` degrees of freedom, and
    the values (B, k) of these parameters, which the file must hold; None where there are none.

    An ``.npy`` of shape (B, 2d), an ``.npz`` with ``z0``, or a ``.csv`` without a column ``t``
    holds one state a row; of any other trajectory file each sequence gives its last state. t among
    the parameters is the time of a drive: t0 of the file, or the time of the last state.
    """
    driven = blocks.TIME in parameters
    with opened(path, None, initial=True, driven=driven) as source:
        if source.dim != dim:
            wanted, got = (f"{2 * d} columns (d = {d})" for d in (dim, source.dim))
            raise InputError(f"{path}: expected states of {wanted}, found {got}")
        columns = {name: 1 + i for i, name in enumerate(source.parameters)}
        if driven and "t0" in columns:
            columns[blocks.TIME] = columns["t0"]
        elif driven and source.timed:
            columns[blocks.TIME] = 0
        if driven and blocks.TIME not in columns:
            t0 = "t0, the time of the drive that the model was learned with"
            raise InputError(f"{path}: expected {t0}, beside the states; found none")
        missing = [name for name in parameters if name not in columns]
        if missing:
            raise InputError(
                f"{path}: expected the parameter{'s' * (len(missing) > 1)} {', '.join(missing)}, "
                "which the model was learned with, beside the states; found "
                f"{', '.join(source.parameters) or 'none'}"
            )
        found: list[blocks.Block] = []
        held: blocks.Block | None = None  # the last row so far: the end of its sequence, or not
        for block in source.blocks(blocks.BLOCK_ROWS):
            if held is not None and held.sequence[0] != block.sequence[0]:
                found.append(held.checked(path))
            ends = np.flatnonzero(block.sequence[1:] != block.sequence[:-1])
            found.append(block.rows(ends).checked(path))
            held = block.rows(np.array([len(block.sequence) - 1]))
        if held is None:
            raise InputError(f"{path}: holds no states")
        found.append(held.checked(path))
    ends = blocks.joined(found, dim)
    if not parameters:
        return ends.states, None
    assert ends.own is not None
    return ends.states, ends.own[:, [columns[name] for name in parameters]]


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
def opened(
    path, dt: float | None, *, initial: bool = False, driven: bool = False
) -> Iterator[blocks.Source]:
    """Open a trajectory file, its header checked. ``initial``: only its last states are wanted, and
    their times where ``driven``."""
    path = Path(path)
    opener = _OPENERS.get(path.suffix.lower())
    if opener is None:
        raise InputError(f"{path}: expected a .npz, .npy or .csv file")
    dt = None if dt is None else blocks.check_dt(dt, "the given dt")
    request = blocks.Request(path, dt, initial, driven)
    try:
        if not path.is_file():
            raise InputError(f"{path}: {'is not a file' if path.exists() else 'no such file'}")
        if path.stat().st_size == 0:
            raise InputError(f"{path}: is empty")
        stream = open(path, "rb")  # noqa: SIM115, closed below
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    with stream:
        source = opener(request, stream)
        unchecked = source.blocks
        if not initial:  # of initial states only the rows that are used are checked
            source.blocks = lambda *given: (block.checked(path) for block in unchecked(*given))
        yield source


def are_recordings(paths: str | Path | Sequence[str | Path], *, with_roles: bool = False) -> bool:
    """Return whether files are to be read by `gfnn_jax.read` (True) or as canonical trajectories
    (False).

    Canonical are an ``.npz`` with ``z0`` or ``trajectories``, a plain ``.npy``, and text with
    columns q1 … and p1 …. All else is a recording; so is every file but these two kinds of ``.npz``
    where roles are given (``with_roles``). Raises InputError where files are of both kinds.
    """
    kinds = {path: _is_recording(path, with_roles) for path in listed(paths)}
    if len(set(kinds.values())) > 1:
        one = next(path for path, is_one in kinds.items() if is_one)
        other = next(path for path, is_one in kinds.items() if not is_one)
        raise InputError(f"expected files of one kind, got a recording, {one}, and states, {other}")
    return any(kinds.values())


def _is_recording(path: Path, with_roles: bool) -> bool:
    if not path.is_file():
        return False  # the reader of trajectories says what is the matter
    suffix = path.suffix.lower()
    if suffix == ".npz":
        with blocks.damage(path, "the archive"), zipfile.ZipFile(path) as archive:
            return not {"z0.npy", "trajectories.npy"} & set(archive.namelist())
    if with_roles or suffix == ".mat":
        return True
    if suffix == ".npy":
        with blocks.damage(path, "the array"):
            return np.load(path, mmap_mode="r", allow_pickle=False).dtype.names is not None
    try:
        return not are_states(TextFile(path).names)
    except InputError:
        return True  # the reader of recordings says what is the matter


def _odd_columns(states: np.ndarray, going: np.ndarray) -> Iterator[str]:
    """Odd things in states (T, 2d), of which the rows ``going`` are followed by the next."""
    dim = states.shape[1] // 2
    if np.array_equal(states[going + 1], states[going]):
        yield "every state equals the one before it"
        return
    constant = [c for c in range(2 * dim) if np.all(states[:, c] == states[0, c])]
    if constant:
        names = ", ".join(blocks.column(c, dim) for c in constant)
        yield f"constant column(s) {names}. A conserved momentum is constant; else check them"
    for a, b in itertools.combinations(range(2 * dim), 2):
        if a not in constant and np.array_equal(states[:, a], states[:, b]):
            both = " and ".join(blocks.column(c, dim) for c in (a, b))
            yield f"columns {both} are equal in every row"


def digest_of(path) -> str:
    """SHA-256 of a file."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


_MOST_COLUMNS = 40  # lines; of more columns those of the first degrees of freedom


def summary(data: TrajectoryData) -> list[str]:
    """Lines of text: how many pairs, of each column its range, spread and movement in a step, of
    each parameter its range.

    spread: the standard deviation. movement: the root mean square of the change in one step. An
    error relative to the spread is what a tolerance is for.
    """
    pairs, lengths = data.pairs(), data.lengths
    both = np.concatenate([pairs.z0, pairs.z1], axis=1)
    copies = len(both) - len(np.unique(both, axis=0))
    of = "–".join(map(str, sorted({int(lengths.min()), int(lengths.max())})))
    dt = np.asarray(data.dt)
    every = f"{dt:g}" if dt.ndim == 0 else f"{dt.min():g} to {dt.max():g}"
    sampled = "" if data.sampled is None else f" (a sample of {data.sampled})"
    parts = [f"{data.num_pairs} pairs{sampled}, d = {data.dim}, dt = {every}"]
    if data.sampled is None:  # the pairs of a sample stand alone
        parts.append(f"sequences: {len(lengths)}, each of {of} states")
    if dt.ndim:
        parts.append(f"gaps: {np.count_nonzero(dt > longest_step(dt))}")
    lines = ["; ".join([*parts, f"copies: {copies}"])]
    move = np.sqrt(np.mean((pairs.z1 - pairs.z0) ** 2, axis=0))
    low, high = data.states.min(axis=0), data.states.max(axis=0)
    names = [blocks.column(c, data.dim) for c in range(2 * data.dim)]
    columns = list(zip(names, low, high, data.states.std(axis=0), move, strict=True))
    if len(columns) > _MOST_COLUMNS:
        some = _MOST_COLUMNS // 4
        columns = columns[:some] + columns[data.dim : data.dim + some]
        lines.append(f"the first {some} of {data.dim} degrees of freedom:")
    for name, *numbers in columns:
        unit = f" {data.units[name]}" if name in data.units else ""
        a, b, spread, step = (f"{x:.4g}" for x in numbers)
        lines.append(f"{name}: {a} to {b}{unit}, spread {spread}, movement in a step {step}")
    for name, values in (data.args or {}).items():
        count = len(np.unique(values))
        drive = f"time t of a drive of period {data.period}"
        what = drive if name == "t" else f"parameter {name}"
        lines.append(f"{what}: {values.min():.4g} to {values.max():.4g}, {count} values")
    return lines
