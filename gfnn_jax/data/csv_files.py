"""Tables in .csv files: the header, the times, the rows."""

from __future__ import annotations

import itertools
import re
import warnings
from collections.abc import Iterator
from io import TextIOWrapper
from pathlib import Path

import numpy as np

from gfnn_jax.data.blocks import (
    BLOCK_ROWS,
    TIME_TOLERANCE,
    Block,
    DataWarning,
    Source,
    agreed_dt,
    check_dt,
    column,
    damage,
)
from gfnn_jax.errors import InputError

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


def open_csv(path: Path, stream, dt, initial: bool, driven: bool) -> Source:
    stream = TextIOWrapper(stream, encoding="utf-8-sig")
    header, line, line_number = None, "", 0
    with damage(path, "the header"):
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
    wanted = [column(c, dim) for c in range(2 * dim)]
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
    dt = np.nan if initial else agreed_dt(path, dt, found)
    usual = dt if found is None else found
    sequence = first[0][:, names.index("sequence")] if "sequence" in names else None
    same = slice(0) if each_row else slice(None) if sequence is None else np.diff(sequence) == 0
    moving = [n for n in further if np.any(np.diff(first[0][:, names.index(n)])[same] != 0)]
    if moving:  # no parameters: an energy, say
        warnings.warn(
            f"{path}: columns ignored: {', '.join(moving)} (not constant in a sequence)",
            DataWarning,
            stacklevel=4,
        )
    period = None
    if "period" in further and not initial:
        if "t" not in names:
            raise InputError(f"{path}: expected a column t, the time of the drive of that period")
        values = first[0][:, names.index("period")]
        if "period" in moving or np.ptp(values) != 0:
            raise InputError(f"{path}: the column period must hold the same number in all rows")
        period = check_dt(values[0], f"{path}: the column period")
    parameters = [n for n in further if n not in (*moving, "period")]
    beside = [names.index(n) for n in parameters]
    with_time = "t" in names and (driven or not initial)

    def blocks(rows: int) -> Iterator[Block]:
        earlier: set[float] = set()
        last, count = np.full(2, np.nan), 0  # sequence and time of the row before; its place
        for table, lines in _cut(itertools.chain([first], tables), rows):
            if each_row:
                sequence = lines
            elif "sequence" in names:
                sequence = table[:, names.index("sequence")]
                changes = np.flatnonzero(np.append(last[0], sequence[:-1]) != sequence)
                for row in changes:
                    if sequence[row] in earlier or not np.isfinite(sequence[row]):
                        raise InputError(
                            f"{path}: line {lines[row]}: the rows of sequence {sequence[row]:g} "
                            "must stand together"
                        )
                    earlier.add(float(sequence[row]))
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
            begins = np.append(last[0], sequence[:-1]) != sequence
            place = _places(begins, count)
            last = np.array([sequence[-1], time[-1] if with_time else np.nan])
            count = int(place[-1]) + 1
            yield Block(
                table[:, columns],
                sequence,
                place,
                lambda r, c, lines=lines: f"line {lines[r]}, {wanted[c]}",
                np.column_stack([time, values]),
            )

    called = tuple(re.sub(r"\W+", "_", name) for name in parameters)
    source = Source(
        dim, float(dt), "float64", units, False, blocks, called, period=period, timed=with_time
    )
    return source


def _places(begins: np.ndarray, first: int) -> np.ndarray:
    """The number (n,) of each row along its sequence, which begins at some of the rows; the first
    row has the number ``first`` if its sequence has begun before it."""
    row = np.arange(len(begins))
    return row - np.maximum.accumulate(np.where(begins, row, -first))


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
        with damage(path, f"the text after line {line_number}"):
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
    """Return whether the steps differ because the times were printed with few decimals, the last of
    them less than a thousandth of dt: every sequence is then within that unit of a straight line.
    """
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
    """Return whether every step within a sequence is dt, but for the rounding of printed times.
    ``time`` and ``sequence`` start one row before."""
    if np.isnan(dt):
        return False
    slack = TIME_TOLERANCE * dt + 4 * np.finfo(np.float64).eps * np.abs(time[1:])
    even = np.abs(np.diff(time) - dt) <= slack
    return bool(even[sequence[1:] == sequence[:-1]].all()) or _only_rounded(time, sequence, dt)
