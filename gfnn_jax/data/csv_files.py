"""States q, p in text files of any dialect: columns t, q1 …, p1 …, a sequence, parameters."""

import contextlib
import re
import warnings
from collections.abc import Generator, Iterator, Sequence
from functools import partial

import numpy as np

from gfnn_jax.data import blocks
from gfnn_jax.data.text_files import TextFile
from gfnn_jax.errors import InputError

_STATE = re.compile(r"[qp]\d+")


def are_states(names: Sequence[str]) -> bool:
    """Return whether columns with these names hold states: there are q1 … and p1 …."""
    found = [name.strip().lower() for name in names]
    return {name[0] for name in found if _STATE.fullmatch(name)} == {"q", "p"}


def open_csv(request: blocks.Request, _stream: object) -> blocks.Source:
    """Open a text file of states. Raises InputError where its columns are not those of states."""
    return _StatesInText(request).source


class _StatesInText:
    """Rows of states in a text file, read from the begin for each iteration of their blocks."""

    def __init__(self, request: blocks.Request):
        self.path, self.file = request.path, TextFile(request.path)
        # Names of columns in lower case -> as the file has them.
        self.names = {name.lower(): name for name in self.file.names}
        dim = sum(bool(re.fullmatch(r"q\d+", name)) for name in self.names)
        self.states = [blocks.column(c, dim) for c in range(2 * dim)]
        self._check_header()
        self.each_row = request.initial and not {"t", "sequence"} & set(self.names)
        self.with_time = "t" in self.names and request.with_times
        with contextlib.closing(self._tables(blocks.BLOCK_ROWS)) as tables:
            first = next(tables)
        found = _first_dt(self, first) if "t" in self.names and not request.initial else None
        dt = request.agreed_dt(found)
        self.usual = dt if found is None else found
        self.period = None
        moving = self._moving(first)
        if "period" in self.names and not request.initial:
            if "t" not in self.names:
                raise InputError(f"{self.path}: expected a column t, the time of its drive")
            self._check_period(first, first["period"][0])
            self.period = blocks.check_dt(first["period"][0], f"{self.path}: the column period")
        further = (*self.states, "t", "sequence", "period")
        self.parameters = [n for n in self.names if n not in (*further, *moving)]
        self.source = blocks.Source(dim, dt, self.blocks, period=self.period, timed=self.with_time)
        self.source.units = {n.lower(): unit for n, unit in self.file.units.items()}
        self.source.parameters = tuple(re.sub(r"\W+", "_", name) for name in self.parameters)

    def _check_header(self) -> None:
        """Raises InputError where columns are missing, or are without a partner."""
        others = [n for n in self.names if _STATE.fullmatch(n) and n not in self.states]
        missing = [n for n in self.states if n not in self.names]
        words = [n.lower() for n in self.file.text if n.lower() in (*self.states, "t", "sequence")]
        found = {"missing": missing, "without a partner": others, "without numbers": words}
        for what, columns in found.items():
            if columns or not self.states:
                found = f"{', '.join(columns)} {what} in {','.join(self.file.names)}"
                wanted = "the header must name q1..qd and p1..pd once each"
                raise InputError(f"{self.path}: {wanted}: {found}")

    def _tables(self, rows: int) -> Generator[dict[str, np.ndarray], None, None]:
        """All columns of numbers by name, a block of rows at a time; sequences as numbers."""
        of_file = [name for name in self.names.values() if name not in self.file.text]
        for table in self.file.blocks(of_file, rows):
            yield {name.lower(): values for name, values in table.items()}

    def _moving(self, table: dict[str, np.ndarray]) -> list[str]:
        """Columns that are no parameters, an energy, say: they change within a sequence."""
        known = (*self.states, "t", "sequence")
        steps = {n: np.diff(x) for n, x in table.items() if n not in known}
        same = np.diff(table["sequence"]) == 0 if "sequence" in table else slice(None)
        same = slice(0) if self.each_row else same
        moving = [n for n, step in steps.items() if np.any(step[same] != 0)]
        ignored = [*moving, *(n.lower() for n in self.file.text)]
        if ignored:
            names = f"{', '.join(ignored)} (not constant in a sequence)"
            what = f"{self.path}: columns ignored: {names}"
            warnings.warn(what, blocks.DataWarning, stacklevel=6)
        return ignored

    def _check_period(self, table: dict[str, np.ndarray], period: float) -> None:
        if np.any(table["period"] != period):
            raise InputError(f"{self.path}: the column period must hold one number in all rows")

    def blocks(self, rows: int) -> Iterator[blocks.Block]:
        """The rows in blocks of at most so many. Raises InputError, with the line, where the rows
        of a sequence do not stand together, times do not rise or a parameter changes."""
        earlier: set[float] = set()
        last, count = np.full((1, 2 + len(self.parameters)), np.nan), 0  # the row before; its place
        passed = 0
        for table in self._tables(min(rows, blocks.BLOCK_ROWS)):
            length, begin = len(table["q1"]), passed
            nothing = np.zeros(length)
            sequence = (
                begin + np.arange(length) if self.each_row else table.get("sequence", nothing)
            )
            time = table["t"] if self.with_time else nothing
            told = np.stack([sequence, time, *(table[n] for n in self.parameters)], axis=1)
            both = np.concatenate([last, told])
            begins = both[1:, 0] != both[:-1, 0]
            for row in np.flatnonzero(begins):
                if sequence[row] in earlier or not np.isfinite(sequence[row]):
                    place = f"{self.path}: {self.file.locate(begin + int(row))}"
                    rows_of = f"the rows of sequence {sequence[row]:g}"
                    raise InputError(f"{place}: {rows_of} must stand together")
                if "sequence" in table:
                    earlier.add(float(sequence[row]))
            if self.with_time:
                self._check_times_rise(both[:, 1], both[:, 0], begin)
                self.source.uneven |= not _even(both[:, 1], both[:, 0], self.usual)
            if self.period is not None:
                self._check_period(table, self.period)
            if not self.each_row:
                self._check_constant(both[:, 2:], begins, begin)
            row = np.arange(length)  # along its sequence; the first row may go on with one
            place = row - np.maximum.accumulate(np.where(begins, row, -count))
            last, count = told[-1:], int(place[-1]) + 1
            passed += length
            states = np.stack([table[name] for name in self.states], axis=1)
            locate = partial(self._locate, begin)
            yield blocks.Block(states, sequence, place, locate, told[:, 1:])

    def _locate(self, begin: int, row: int, column: int) -> str:
        return f"{self.file.locate(begin + row)}, {self.states[column]}"

    def _check_constant(self, values: np.ndarray, begins: np.ndarray, begin: int) -> None:
        """Raises InputError where a parameter (1 + n, k) changes within a sequence. ``values``
        start one row before the row ``begin``."""
        changes = np.any(values[1:] != values[:-1], axis=1) & ~begins
        bad = changes | ~np.isfinite(values[1:]).all(axis=1)
        if bad.any():
            row = int(np.argmax(bad))
            before, now = (", ".join(f"{v:g}" for v in values[r]) for r in (row, row + 1))
            raise InputError(
                f"{self.path}: {self.file.locate(begin + row)}: expected "
                f"{', '.join(self.parameters)} finite and constant in each sequence, as parameters "
                f"are, found {now} after {before}"
            )

    def _check_times_rise(self, time: np.ndarray, sequence: np.ndarray, begin: int) -> None:
        """Raises InputError where times do not rise in a sequence. ``time`` and ``sequence`` start
        one row before the row ``begin``."""
        # "not (... > 0)" so that NaN counts as wrong.
        bad = ((sequence[1:] == sequence[:-1]) & ~(np.diff(time) > 0)) | ~np.isfinite(time[1:])
        if bad.any():
            row = int(np.argmax(bad))
            where = f"in {self.file.locate(begin + row)} after {time[row]:.9g}"
            found = f"found {time[row + 1]:.9g} {where}"
            raise InputError(f"{self.path}: the column t must rise in a sequence, {found}")


def _first_dt(states: _StatesInText, table: dict[str, np.ndarray]) -> float | None:
    """The time step of the first rows, NaN where they are uneven; None if no sequence among them
    has two states."""
    time = table["t"]
    sequence = table.get("sequence", np.zeros(len(time)))
    steps = np.diff(time)[sequence[1:] == sequence[:-1]]
    if len(steps) == 0:
        return None
    before = np.append(np.nan, time), np.append(np.nan, sequence)
    states._check_times_rise(*before, 0)
    # The median ignores a gap; where every step agrees with it, the mean is more accurate.
    return float(np.mean(steps)) if _even(*before, float(np.median(steps))) else np.nan


def _even(time: np.ndarray, sequence: np.ndarray, dt: float) -> bool:
    """Return whether every step within a sequence is dt, but for the rounding of printed times.
    ``time`` and ``sequence`` start one row before."""
    if np.isnan(dt):
        return False
    slack = blocks.TIME_TOLERANCE * dt + 4 * np.finfo(np.float64).eps * np.abs(time[1:])
    even = np.abs(np.diff(time) - dt) <= slack
    return bool(even[sequence[1:] == sequence[:-1]].all()) or _only_rounded(time, sequence, dt)


def _only_rounded(time: np.ndarray, sequence: np.ndarray, dt: float) -> bool:
    """Return whether the steps differ because the times were printed with few decimals, the last of
    them less than a thousandth of dt: every sequence is then within that unit of a straight line.
    """
    if np.isnan(time[0]):  # nothing stands before the first row of a file
        time, sequence = time[1:], sequence[1:]
    units = (10.0**-n for n in range(max(0, int(np.ceil(3 - np.log10(dt)))), 13))
    rounded = (u for u in units if np.all(np.abs(time - np.round(time / u) * u) <= 1e-3 * u))
    unit = next(rounded, None)
    if unit is None:
        return False
    for rows in np.split(time, np.flatnonzero(sequence[1:] != sequence[:-1]) + 1):
        count = np.arange(len(rows)) - 0.5 * (len(rows) - 1)
        slope = count @ (rows - rows[0]) / max(count @ count, 1)
        if np.ptp(rows - slope * count) > 1.5 * unit or (len(rows) > 1 and abs(slope - dt) > unit):
            return False
    return True
