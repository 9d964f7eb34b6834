"""Arrays in .npy and .npz files, opened without loading them whole."""

from __future__ import annotations

import contextlib
import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from gfnn_jax.data.blocks import (
    ARC,
    TIME_TOLERANCE,
    Block,
    DataWarning,
    Source,
    agreed_dt,
    check_dt,
    check_width,
    damage,
)
from gfnn_jax.errors import InputError
from gfnn_jax.processes import WHOLE, Share

_LOCAL_HEADER = 30  # bytes before the name of a member of a .zip
_SKIPPED = 2**20  # bytes at a time
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
_READ = {
    "z0",
    "z1",
    "z0_std",
    "trajectories",
    "lengths",
    "steps",
    "dt",
    "times",
    "t0",
    "period",
    "params",
    "param_names",
}
_OF_HEADERS = (TypeError,)  # NumPy sorts the keys of a header, which may be text and bytes


class _StoredArray:
    """An array in an ``.npy`` stream: its header now, its rows in order when asked for.

    The header is checked against the stream's size first, so that a damaged one allocates nothing.
    begin: of the stream, in the file; None where that holds it compressed.
    """

    def __init__(self, path, name: str, stream, size: int, begin: int | None):
        self.path, self.name, self.stream, self.begin = path, name, stream, begin
        with damage(path, name, *_OF_HEADERS):
            version = np.lib.format.read_magic(stream)
            if version not in _HEADERS:
                raise ValueError(f"version {version} of its format is not known")
            read_header = _HEADERS[version]
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
        with damage(self.path, self.name):
            data = np.frombuffer(self.stream.read(), self.dtype)
        return data.reshape(self.shape, order="F" if self.fortran_order else "C")

    def read_rows(self, rows: int, part: slice = slice(None)) -> Iterator[np.ndarray]:
        """The array as (-1, 2d) float64, or a part of its rows, in blocks of at most so many."""
        width, number = self.shape[-1], int(np.prod(self.shape[:-1], dtype=object))
        first, last, _ = part.indices(number)
        if self.fortran_order:
            everything = self.whole().reshape(-1, width)[first:last]
            for start in range(0, len(everything), rows):
                yield everything[start : start + rows].astype(np.float64)
            return
        size = width * self.dtype.itemsize
        with self._from(first * size) as stream:
            while first < last:
                count = min(rows, last - first)
                with damage(self.path, self.name):
                    block = np.frombuffer(stream.read(count * size), self.dtype)
                    block = block.reshape(count, width)
                first += count
                yield block.astype(np.float64, copy=False)
            if last == number:
                with damage(self.path, self.name):
                    stream.read(1)  # the end of an archive's member: its checksum is compared

    @contextlib.contextmanager
    def _from(self, offset: int) -> Iterator[Any]:
        """The data from this byte on: the file itself, or what is left after unpacking the rest."""
        if not offset:
            yield self.stream
        elif self.begin is None:
            with damage(self.path, self.name):
                while offset:
                    offset -= len(self.stream.read(min(offset, _SKIPPED)) or self._short())
            yield self.stream
        else:
            begin = self.begin + self.stream.tell()  # after the header
            with open(self.path, "rb") as own:
                own.seek(begin + offset)
                yield own

    def _short(self):
        raise InputError(f"{self.path}: {self.name} is damaged: it ends before its rows do")


def open_npy(path: Path, stream, dt, initial: bool, driven: bool) -> Source:
    array = _StoredArray(path, "the array", stream, path.stat().st_size, 0)
    dt = np.nan if initial else agreed_dt(path, dt, None)
    return _array_source(path, array, None, dt, each_row=initial and len(array.shape) == 2)


def open_npz(path: Path, stream, dt, initial: bool, driven: bool) -> Source:
    with damage(path, "the archive"):
        archive = zipfile.ZipFile(stream)
    names = [name[:-4] for name in archive.namelist() if name.endswith(".npy")]

    def member(name: str) -> _StoredArray:
        with damage(path, name):
            opened = archive.open(f"{name}.npy")
            info = archive.getinfo(f"{name}.npy")
            begin = _begin_of(path, info)
        return _StoredArray(path, name, opened, info.file_size, begin)

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
    further = [name for name in names if name not in _READ]
    if further and "job" not in further:  # other arrays of a prediction are about it
        warnings.warn(
            f"{path}: arrays ignored: {', '.join(further)} (parameters are in params)",
            DataWarning,
            stacklevel=4,
        )
    found, own_dt, period = None, None, None
    if "period" in names and not initial:
        period = check_dt(member("period").whole(), f"{path}: period")
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
            found = check_dt(value, f"{path}: dt")
    trajectories = None if is_pairs else member("trajectories")
    if trajectories is not None and found is not None and "steps" in names:
        found *= _stride(path, trajectories.shape, member("steps").whole())
    params = _read_params(path, names, member)
    if trajectories is None:
        dt, z0 = agreed_dt(path, dt, found), member("z0")
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
    dt = found if initial else agreed_dt(path, dt, found)
    if with_t0:
        if times is not None:
            raise InputError(f"{path}: expected t0 or times, found both")
        if dt is None:
            raise InputError(f"{path}: expected dt or times, by which t0 goes on, found neither")
        count, length = (1, *trajectories.shape)[-3:-1]
        times = _read_t0(path, member, count)[:, None] + dt * np.arange(length)
    dt = np.nan if initial or dt is None else dt
    return _array_source(path, trajectories, lengths, dt, times=times, params=params, period=period)


def _begin_of(path: Path, info: zipfile.ZipInfo) -> int | None:
    """The byte of the file at which a member begins; None where it is compressed."""
    if info.compress_type != zipfile.ZIP_STORED:
        return None
    with open(path, "rb") as own:
        own.seek(info.header_offset)
        header = own.read(_LOCAL_HEADER)
    lengths = (int.from_bytes(header[i : i + 2], "little") for i in (26, 28))  # name, extra field
    return info.header_offset + _LOCAL_HEADER + sum(lengths)


def _rows_of(array: _StoredArray) -> int:
    """Rows of this sequence."""
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
        with damage(path, "param_names", *_OF_HEADERS), np.load(path, allow_pickle=False) as file:
            called = tuple(np.atleast_1d(file["param_names"]).astype(str).tolist())
        if len(called) != values.shape[1] or len(set(called)) < len(called):
            raise InputError(
                f"{path}: param_names must be {values.shape[1]} different names, found "
                f"{', '.join(called)}"
            )
    return called, values


def _own_columns(path, times, params, count: int, what: str, repeat: int):
    """Columns of rows beside their states (rows, 1 + k), or None: times of all rows, and params of
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
    path,
    z0: _StoredArray,
    z1: _StoredArray,
    dt: float,
    own_dt=None,
    params=None,
    t0=None,
    period: float | None = None,
) -> Source:
    """z0, z1 as sequences of two states. own_dt: of each pair; params: names and values; t0 (N,):
    the time of the drive at z0."""
    if len(z0.shape) != 2 or z0.shape != z1.shape:
        raise InputError(
            f"{path}: z0 and z1 must both have shape (N, 2d), found {z0.shape} and {z1.shape}"
        )
    dim = check_width(path, "z0", z0.shape)
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

    def blocks(rows: int, share: Share = WHOLE) -> Iterator[Block]:
        part = share.of(z0.shape[0], ARC)
        pair = part.start
        # Two rows a pair, and at most ``rows`` pairs a block.
        for a, b in zip(z0.read_rows(rows, part), z1.read_rows(rows, part), strict=True):
            states = np.stack([a, b], axis=1).reshape(-1, 2 * dim)
            sequence = np.repeat(np.arange(pair, pair + len(a)), 2)
            beside = None if own is None else own[2 * pair : 2 * (pair + len(a))]
            yield Block(
                states,
                sequence,
                np.tile([0, 1], len(a)),
                lambda r, c, n=pair: f"z{r % 2}[{n + r // 2}, {c}]",
                beside,
            )
            pair += len(a)

    precision = str(np.result_type(z0.dtype, z1.dtype))
    called = () if params is None else params[0]
    uneven = own_dt is not None
    return Source(
        dim,
        dt,
        precision,
        {},
        True,
        blocks,
        called,
        uneven,
        period,
        t0 is not None,
        of_pairs_alone=True,
    )


def _array_source(
    path,
    array: _StoredArray,
    lengths: np.ndarray | None,
    dt: float,
    *,
    each_row: bool = False,
    times: np.ndarray | None = None,
    params=None,
    period: float | None = None,
) -> Source:
    """(L, 2d) or (M, L, 2d); with ``each_row`` every row is a sequence of its own."""
    shape = array.shape
    if len(shape) not in (2, 3) or (each_row and len(shape) != 2):
        wanted = "(B, 2d)" if each_row else "(L, 2d) or (M, L, 2d)"
        raise InputError(f"{path}: {array.name} must have shape {wanted}, found {shape}")
    dim = check_width(path, array.name, shape)
    count, length = (1, shape[0]) if len(shape) == 2 else shape[:2]
    if lengths is not None:
        lengths = _check_lengths(path, lengths, count, length)
    each = (shape[0], 1) if each_row else (count, length)
    own = _own_columns(path, times, params, each[0], "states" if each_row else "sequences", each[1])

    def locate(row: int, column: int) -> str:
        index = (row, column) if len(shape) == 2 else (*divmod(row, length), column)
        return f"{array.name}[{', '.join(map(str, index))}]"

    def blocks(rows: int, share: Share = WHOLE) -> Iterator[Block]:
        part = share.of(count * length, 1)
        start = part.start
        # The pair that begins in the last row ends in the next.
        for states in array.read_rows(rows, slice(start, min(part.stop + 1, count * length))):
            row = np.arange(start, start + len(states))
            sequence, place = (row, 0 * row) if each_row else (row // length, row % length)
            beside = None if own is None else own[start : start + len(states)]
            block = Block(states, sequence, place, lambda r, c, n=start: locate(n + r, c), beside)
            if lengths is not None:
                block = block.rows(np.flatnonzero(place < lengths[sequence]))
            start += len(states)
            if len(block.states):
                yield block

    uneven = times is not None and bool(np.isnan(dt))
    called = () if params is None else params[0]
    timed = times is not None
    return Source(dim, dt, str(array.dtype), {}, True, blocks, called, uneven, period, timed)


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
