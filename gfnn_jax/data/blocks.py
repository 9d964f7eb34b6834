"""Rows of states as they come out of a file: what every kind of file is turned into."""

from __future__ import annotations

import contextlib
import dataclasses
import lzma
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from gfnn_jax.errors import InputError

# Times in text files carry few digits: relative agreement asked of time steps.
TIME_TOLERANCE = 1e-5
# A larger number overflows in the squares, products and sums of squares that a fit makes.
LARGEST = 1e100
# Rows read at a time when no chunk is asked for; 16k rows of four numbers are 6 MB as text.
BLOCK_ROWS = 16_384
TIME = "t"  # `phase_space.TIME`, which brings JAX
# Consecutive pairs of a run that a sample of a large file keeps or leaves together.
ARC = 50
# What flipped bits and cuts in files made zipfile, its decompressors, NumPy and the decoding of
# text raise; a flipped bit in a header may ask for an unknown compression or for a password.
_OF_DAMAGE = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, OSError, EOFError, ValueError),
    *(tokenize.TokenError, SyntaxError, RuntimeError, MemoryError),
)


class DataWarning(UserWarning):
    """Data that can be used but look odd: constant, duplicated or unknown columns."""


@dataclasses.dataclass
class Block:
    """Consecutive rows. ``sequence`` (n,) is the number, or the label, of the sequence that each is
    of, ``place`` (n,) its number along that; ``locate(row, column)`` says where in the file a
    number stands. ``own`` (n, 1 + k): the row's time and parameters, where the file has these."""

    states: np.ndarray
    sequence: np.ndarray
    place: np.ndarray
    locate: Callable[[int, int], str] = lambda row, column: f"row {row}, column {column}"
    own: np.ndarray | None = None

    def rows(self, index: np.ndarray) -> Block:
        locate = self.locate  # `self` would keep all rows in memory
        columns = self.states[index], self.sequence[index], self.place[index]
        own = None if self.own is None else self.own[index]
        return Block(*columns, lambda r, c: locate(int(index[r]), c), own)

    @property
    def going(self) -> np.ndarray:
        """The rows (n',) with which the next one goes on."""
        return np.flatnonzero(self.sequence[1:] == self.sequence[:-1])

    def checked(self, path) -> Block:
        """Itself, if every number is finite and not too large; else InputError."""
        bad_of = {"not finite (NaN or infinity)": ~np.isfinite(self.states)}
        bad_of[f"too large (above {LARGEST:.0e})"] = np.abs(self.states) > LARGEST
        for what, bad in bad_of.items():
            if bad.any():
                row, column = (int(i) for i in np.argwhere(bad)[0])
                count = int(bad.sum())
                first = f"{self.locate(row, column)} = {self.states[row, column]}"
                values = f"{count} value{'s' * (count != 1)}"
                raise InputError(f"{path}: {values} {what}, first {first}")
        return self


def joined(blocks: Iterable[Block], dim: int) -> Block:
    """Checked blocks of states (n, 2 · dim) one behind another; none may be there."""
    parts = [Block(np.empty((0, 2 * dim)), np.empty(0), np.empty(0, int)), *blocks]
    own = [block.own for block in parts if block.own is not None]
    columns = zip(*((one.states, one.sequence, one.place) for one in parts), strict=True)
    states, sequence, place = map(np.concatenate, columns)
    return Block(states, sequence, place, own=np.concatenate(own) if own else None)


@dataclasses.dataclass(frozen=True)
class Request:
    """Request for a file of states.

    dt: given by the user, or None. initial: only the last state of each sequence, and no time step.
    driven: its time too.
    """

    path: Path
    dt: float | None = None
    initial: bool = False
    driven: bool = False

    @property
    def with_times(self) -> bool:
        return self.driven or not self.initial

    def agreed_dt(self, found: float | None) -> float:
        """The time step, of those given and found: NaN of initial states and of uneven times.
        Raises InputError where they disagree, or where there is none."""
        given = self.dt
        if self.initial:
            return np.nan
        if given is None and found is None:
            raise InputError(f"{self.path}: holds no time step. Give it: --dt")
        if given is None or found is None:
            return given if found is None else found  # pyright: ignore[reportReturnType]
        if not abs(given - found) <= TIME_TOLERANCE * found:
            own = "times that are uneven" if np.isnan(found) else f"the file's dt = {found}"
            raise InputError(f"{self.path}: the given dt = {given} disagrees with {own}. Omit --dt")
        return given


@dataclasses.dataclass
class Source:
    """An open file: what its header says, and its rows, or those of a process's share of the pairs,
    in blocks of at most so many.

    uneven: whether the times that were read so far are not dt apart. parameters: names of those
    that the rows have. period: of a drive, whose time the rows' times are. timed: whether they have
    times at all. of_pairs_alone: whether the sequences are single pairs, z0 and z1, whose order in
    the file is all that is known of their runs.
    """

    dim: int
    dt: float  # NaN where initial states need none, or the times say it
    blocks: Callable[..., Iterator[Block]]
    precision: str = "float64"
    units: dict[str, str] = dataclasses.field(default_factory=dict)
    parameters: tuple[str, ...] = ()
    uneven: bool = False
    period: float | None = None
    timed: bool = False
    of_pairs_alone: bool = False

    def of_pairs(self, own: np.ndarray | None, rows) -> tuple[Any, dict[str, np.ndarray] | None]:
        """(dt, args) of the pairs that begin in these rows."""
        if own is None:
            return self.dt, None
        dt = own[rows + 1, 0] - own[rows, 0] if self.uneven else self.dt
        args = {name: own[rows, 1 + i] for i, name in enumerate(self.parameters)}
        if self.period is not None:
            args[TIME] = own[rows, 0]
        return dt, args or None


def check_dt(dt: Any, what: str) -> float:
    array = np.asarray(dt)
    if array.size != 1 or array.dtype.kind not in "fiu":
        raise InputError(f"{what} must be one number, got {array.dtype} of shape {array.shape}")
    value = float(array.reshape(())[()])
    if not (np.isfinite(value) and value > 0):
        raise InputError(f"{what} must be finite and above 0, got {value}")
    return value


def check_width(path, name: str, shape: tuple[int, ...]) -> int:
    """d of an array of shape (..., 2d)."""
    width = shape[-1]
    if width == 0 or width % 2:
        raise InputError(
            f"{path}: {name} of shape {shape} must have an even last dimension 2d (q first, then "
            f"p), found {width}. Of states with another bracket, as angular velocities, in Python: "
            'gfnn.fit(gfnn.Pairs(z0, z1, dt, structure="poisson"))'
        )
    return width // 2


def column(index: int, dim: int) -> str:
    return f"q{index + 1}" if index < dim else f"p{index - dim + 1}"


@contextlib.contextmanager
def damage(path, name: str, *more: type[Exception]) -> Iterator[None]:
    """Turn what a damaged file makes its readers raise into one line; a mistake of ours goes
    through. more: what only this reader raises."""
    try:
        yield
    except InputError:
        raise
    except (*_OF_DAMAGE, *more) as error:
        detail = (str(error) or type(error).__name__)[:120]
        raise InputError(f"{path}: {name} cannot be read: damaged? ({detail})") from error
