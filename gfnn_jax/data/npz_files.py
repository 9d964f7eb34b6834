"""Arrays in .npy and .npz files, opened without loading them whole."""

import dataclasses
import math
import os
import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gfnn_jax.data import blocks
from gfnn_jax.errors import InputError
from gfnn_jax.processes import WHOLE, Share

_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
_PAIRS = {"z0", "z1", "z0_std"}
_SEQUENCES = {"trajectories", "lengths", "steps", "dt", "times"}
_READ = {*_PAIRS, *_SEQUENCES, "t0", "period", "params", "param_names"}
_OF_HEADERS = (TypeError,)  # NumPy sorts the keys of a header, which may be text and bytes


class _StoredArray:
    """An array in an ``.npy`` stream: its header now, its rows in order when asked for.

    The header is checked against the stream's size first, so that a damaged one allocates nothing.
    """

    def __init__(self, path: Path, name: str, stream, size: int):
        self.path, self.name, self.stream = path, name, stream
        with blocks.damage(path, name, *_OF_HEADERS):
            version = np.lib.format.read_magic(stream)
            if version not in _HEADERS:
                raise ValueError(f"version {version} of its format is not known")
            self.shape, self.fortran_order, self.dtype = _HEADERS[version](stream)
        if self.dtype.kind not in "fiu":
            hint = " (save padded sequences with 'lengths')" if self.dtype.hasobject else ""
            raise InputError(f"{path}: {name} must hold real numbers, found {self.dtype}{hint}")
        expected = math.prod(self.shape) * self.dtype.itemsize
        if size - stream.tell() != expected:
            there = (
                f"{expected} bytes expected for shape {self.shape}, {size - stream.tell()} found"
            )
            raise InputError(f"{path}: {name} is damaged: {there}")

    def whole(self) -> np.ndarray:
        with blocks.damage(self.path, self.name):
            data = np.frombuffer(self.stream.read(), self.dtype)
        return data.reshape(self.shape, order="F" if self.fortran_order else "C")

    def read_rows(self, rows: int, part: slice = slice(None)) -> Iterator[np.ndarray]:
        """The array as (-1, 2d) float64, or a part of its rows, in blocks of at most so many."""
        width, number = self.shape[-1], math.prod(self.shape[:-1])
        first, last, _ = part.indices(number)
        if self.fortran_order:
            everything = self.whole().reshape(-1, width)[first:last]
            for start in range(0, len(everything), rows):
                yield everything[start : start + rows].astype(np.float64)
            return
        size = width * self.dtype.itemsize
        with blocks.damage(self.path, self.name):
            self.stream.seek(first * size, os.SEEK_CUR)
            while first < last:
                count = min(rows, last - first)
                block = np.frombuffer(self.stream.read(count * size), self.dtype)
                first += count
                yield block.reshape(count, width).astype(np.float64, copy=False)
            if last == number:
                self.stream.read(1)  # the end of an archive's member: its checksum is compared


class _Archive:
    """The arrays of an ``.npz``, opened when they are asked for."""

    def __init__(self, path: Path, stream):
        self.path = path
        with blocks.damage(path, "the archive"):
            self._zip = zipfile.ZipFile(stream)
        self.names = [name[:-4] for name in self._zip.namelist() if name.endswith(".npy")]

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def array(self, name: str) -> _StoredArray:
        with blocks.damage(self.path, name):
            stream = self._zip.open(f"{name}.npy")
        return _StoredArray(self.path, name, stream, self._zip.getinfo(f"{name}.npy").file_size)

    def whole(self, name: str) -> np.ndarray | None:
        """An array as float64, if it is there."""
        return self.array(name).whole().astype(np.float64) if name in self else None

    def t0(self, count: int) -> np.ndarray:
        """The times (count,) of a drive."""
        t0 = np.atleast_1d(self.array("t0").whole().astype(np.float64))
        if t0.shape != (count,) or not np.isfinite(t0).all():
            found = f"{t0.shape}{'' if np.isfinite(t0).all() else ' with NaN or infinity'}"
            raise InputError(f"{self.path}: t0 must be finite, of shape ({count},), found {found}")
        return t0

    def parameters(self) -> tuple[tuple[str, ...], np.ndarray | None]:
        """The names (k,) and the values (n, k) of the parameters; ((), None) where none are."""
        values = self.whole("params")
        if values is None:
            return (), None
        values = values[:, None] if values.ndim == 1 else values
        if values.ndim != 2 or values.shape[1] == 0:
            raise InputError(f"{self.path}: params must have shape (n, k), found {values.shape}")
        if not np.isfinite(values).all():
            row, column = np.argwhere(~np.isfinite(values))[0]
            raise InputError(f"{self.path}: params not finite, first params[{row}, {column}]")
        names = tuple(f"a{i + 1}" for i in range(values.shape[1]))
        if "param_names" in self:
            with blocks.damage(self.path, "param_names", *_OF_HEADERS), np.load(self.path) as file:
                names = tuple(np.atleast_1d(file["param_names"]).astype(str).tolist())
            if len(names) != values.shape[1] or len(set(names)) < len(names):
                wanted, found = f"{values.shape[1]} different names", ", ".join(names)
                raise InputError(f"{self.path}: param_names must be {wanted}, found {found}")
        return names, values


class _Sequences(NamedTuple):
    """M sequences of L states each, and what stands beside them.

    arrays: one array of the states, or z0 and z1 of pairs. each_row: whether each row of the array
    is a sequence. lengths: (M,) of those used. times: (M, L), or None. uneven: whether their steps
    differ from dt."""

    path: Path
    arrays: tuple[_StoredArray, ...]
    dt: float
    each_row: bool = False
    lengths: np.ndarray | None = None
    times: np.ndarray | None = None
    uneven: bool = False
    parameters: tuple[tuple[str, ...], np.ndarray | None] = ((), None)
    period: float | None = None

    def source(self) -> blocks.Source:
        """Raises InputError where shapes do not fit."""
        array, shape, of_pairs = self.arrays[0], self.arrays[0].shape, len(self.arrays) == 2
        if of_pairs:
            if len(shape) != 2 or shape != self.arrays[1].shape:
                found = f"{shape} and {self.arrays[1].shape}"
                raise InputError(
                    f"{self.path}: z0 and z1 must both have shape (N, 2d), found {found}"
                )
        elif len(shape) not in (2, 3) or (self.each_row and len(shape) != 2):
            wanted = "(B, 2d)" if self.each_row else "(L, 2d) or (M, L, 2d)"
            raise InputError(f"{self.path}: {array.name} must have shape {wanted}, found {shape}")
        dim = blocks.check_width(self.path, array.name, shape)
        if of_pairs or self.each_row:
            count, length = shape[0], 1 + of_pairs
        else:
            count, length = (1, shape[0]) if len(shape) == 2 else shape[:2]
        names, values = self.parameters
        if values is not None and len(values) != count:
            what = "pairs" if of_pairs else "states" if self.each_row else "sequences"
            wanted = f"a row for each of the {count} {what}"
            raise InputError(f"{self.path}: params must have {wanted}, found {values.shape}")
        if self.lengths is not None:
            _check_lengths(self.path, self.lengths, count, length)
        own = None
        if self.times is not None or values is not None:
            times = np.zeros((count, length)) if self.times is None else self.times
            columns = [times.reshape(-1, 1)]
            columns += [] if values is None else [np.repeat(values, length, axis=0)]
            own = np.concatenate(columns, axis=1)

        def locate(row: int, column: int) -> str:
            if of_pairs:
                return f"z{row % 2}[{row // 2}, {column}]"
            index = (row,) if len(shape) == 2 else divmod(row, length)
            return f"{array.name}[{', '.join(map(str, (*index, column)))}]"

        def read(rows: int, share: Share = WHOLE) -> Iterator[blocks.Block]:
            part = share.of(count if of_pairs else count * length, blocks.ARC if of_pairs else 1)
            row = part.start * (1 + of_pairs)
            if not of_pairs:  # the pair that begins in the last row ends in the next
                part = slice(part.start, min(part.stop + 1, count * length))
            parts = (one.read_rows(rows, part) for one in self.arrays)
            for several in zip(*parts, strict=True):
                states = several[0]
                if of_pairs:
                    states = np.stack(several, axis=1).reshape(-1, 2 * dim)
                number = row + np.arange(len(states))
                sequence, place = np.divmod(number, length)
                told = None if own is None else own[number]
                block = blocks.Block(
                    states, sequence, place, lambda r, c, n=row: locate(n + r, c), told
                )
                if self.lengths is not None:
                    kept = block.place < self.lengths[block.sequence]
                    block = block.rows(np.flatnonzero(kept))
                row += len(states)
                if len(block.states):
                    yield block

        precision = str(
            np.result_type(*(a.dtype for a in self.arrays)) if of_pairs else array.dtype
        )
        source = blocks.Source(dim, self.dt, read, precision, parameters=names, uneven=self.uneven)
        timed = self.times is not None
        return dataclasses.replace(source, period=self.period, timed=timed, of_pairs_alone=of_pairs)


def open_npy(request: blocks.Request, stream) -> blocks.Source:
    """The states of one array: (L, 2d) or (M, L, 2d), or of initial states (B, 2d)."""
    array = _StoredArray(request.path, "the array", stream, request.path.stat().st_size)
    each_row = request.initial and len(array.shape) == 2
    return _Sequences(request.path, (array,), request.agreed_dt(None), each_row).source()


def open_npz(request: blocks.Request, stream) -> blocks.Source:
    """Pairs z0 and z1, or trajectories; of initial states z0 alone serves."""
    path, archive = request.path, _Archive(request.path, stream)
    if request.initial and "z0" in archive:
        z0, times = archive.array("z0"), None
        if request.driven and "t0" in archive:
            times = archive.t0(z0.shape[0] if z0.shape else 0)[:, None]
        found = _Sequences(path, (z0,), np.nan, True, times=times, parameters=archive.parameters())
        return found.source()
    is_pairs = "z0" in archive and "z1" in archive
    if is_pairs == ("trajectories" in archive):
        names = archive.names
        found = f"{', '.join(names[:8]) or 'none'}{', ...' * (len(names) > 8)}"
        wanted = "either the arrays z0 and z1, or trajectories"
        raise InputError(f"{path}: expected {wanted}; found {found}")
    further = [name for name in archive.names if name not in _READ]
    if further and "job" not in further:  # other arrays of a prediction are about it
        ignored = f"{path}: arrays ignored: {', '.join(further)} (parameters are in params)"
        warnings.warn(ignored, blocks.DataWarning, stacklevel=4)
    with_t0, period = "t0" in archive and request.with_times, None
    if "period" in archive and not request.initial:
        period = blocks.check_dt(archive.array("period").whole(), f"{path}: period")
        if not (with_t0 or "times" in archive):
            raise InputError(
                f"{path}: expected t0, the time of the drive, beside its period; got none"
            )
    elif with_t0 and not request.initial:
        raise InputError(f"{path}: expected the drive's period beside t0, found none")
    dt = archive.array("dt").whole() if "dt" in archive and request.with_times else None
    if is_pairs:
        found = _pairs(request, archive, dt, period)
    else:
        found = _trajectories(request, archive, dt, with_t0)
    return found._replace(parameters=archive.parameters(), period=period).source()


def _pairs(
    request: blocks.Request, archive: _Archive, dt: np.ndarray | None, period: float | None
) -> _Sequences:
    """z0 and z1, the time of the drive at z0 taken modulo its period."""
    path, z0, times = request.path, archive.array("z0"), None
    each = dt is not None and dt.size > 1
    found = np.nan if each else None if dt is None else blocks.check_dt(dt, f"{path}: dt")
    agreed = request.agreed_dt(found)
    if each:
        assert dt is not None
        if dt.shape != z0.shape[:1]:
            raise InputError(f"{path}: dt must be one number or {z0.shape[:1]}, found {dt.shape}")
        bad = ~(np.isfinite(dt) & (dt > 0))
        if bad.any():
            row = int(np.argmax(bad))
            found = f"{int(bad.sum())} that are not, first dt[{row}] = {dt[row]:g}"
            raise InputError(f"{path}: dt must be finite and above 0, found {found}")
        times = np.stack([np.zeros(len(dt)), dt], axis=1)
    if period is not None:
        t0 = np.mod(archive.t0(z0.shape[0] if z0.shape else 0), period)
        ends = np.stack([0 * t0, 0 * t0 + agreed], axis=1) if times is None else times
        times = t0[:, None] + ends
    return _Sequences(path, (z0, archive.array("z1")), agreed, times=times, uneven=each)


def _trajectories(
    request: blocks.Request, archive: _Archive, dt: np.ndarray | None, with_t0: bool
) -> _Sequences:
    """trajectories, at steps of dt or at times."""
    path, array = request.path, archive.array("trajectories")
    found = None if dt is None else blocks.check_dt(dt, f"{path}: dt")
    if found is not None and "steps" in archive:
        found *= _stride(path, array.shape, archive.array("steps").whole())
    lengths = archive.array("lengths").whole() if "lengths" in archive else None
    times = archive.whole("times") if request.with_times else None
    if times is not None:
        if found is not None:
            raise InputError(f"{path}: expected dt or times, found both")
        found = _times_dt(path, times, array.shape, lengths)
    step = found if request.initial else request.agreed_dt(found)
    uneven = times is not None and step is not None and bool(np.isnan(step))
    if with_t0:
        if times is not None:
            raise InputError(f"{path}: expected t0 or times, found both")
        if step is None:
            raise InputError(f"{path}: expected dt or times, by which t0 increases, found neither")
        count, length = (1, *array.shape)[-3:-1]
        times = archive.t0(count)[:, None] + step * np.arange(length)
    step = np.nan if request.initial or step is None else step
    return _Sequences(path, (array,), step, lengths=lengths, times=times, uneven=uneven)


def _times_dt(path, times, shape, lengths) -> float:
    """The time step of ``times`` (M, L), NaN where they are uneven."""
    times = times[None] if times.ndim == 1 else times
    if times.shape != ((1, *shape[:1]) if len(shape) == 2 else shape[:2]):
        wanted = "the shape of the trajectories without the last axis"
        raise InputError(f"{path}: times must have {wanted}, found {times.shape} beside {shape}")
    steps = np.diff(times, axis=1)
    used = np.ones(steps.shape, bool)
    if lengths is not None and lengths.shape == times.shape[:1]:
        used = np.arange(1, times.shape[1]) < lengths[:, None]
    bad = ~(np.isfinite(steps) & (steps > 0)) & used
    if bad.any():
        m, i = (int(k) for k in np.argwhere(bad)[0])
        found = f"times[{m}, {i + 1}] = {times[m, i + 1]:g} after {times[m, i]:g}"
        raise InputError(f"{path}: times must rise, found {found}")
    usual = float(np.median(steps[used])) if used.any() else np.nan
    slack = blocks.TIME_TOLERANCE * usual + 4 * np.finfo(np.float64).eps * np.abs(times[:, 1:])
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


def _check_lengths(path, lengths: np.ndarray, count: int, longest: int) -> None:
    if lengths.shape != (count,) or lengths.dtype.kind not in "iu":
        found = f"{lengths.dtype} of shape {lengths.shape}"
        raise InputError(f"{path}: lengths must be integers of shape ({count},), found {found}")
    bad = np.flatnonzero((lengths < 1) | (lengths > longest))
    if len(bad):
        first = f"first lengths[{bad[0]}] = {lengths[bad[0]]}"
        raise InputError(f"{path}: {len(bad)} of the lengths outside 1..{longest}, {first}")
