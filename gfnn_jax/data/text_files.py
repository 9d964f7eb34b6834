"""Tables in text files: their dialect, told by their first lines, and their rows, in blocks."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gfnn_jax.data.blocks import damage
from gfnn_jax.data.roles import is_run, is_time
from gfnn_jax.data.tables import Table
from gfnn_jax.errors import InputError

BLOCK_ROWS = 100_000  # of text that are parsed at a time
_SNIFFED = 1 << 16  # characters of the file's begin that tell its format
_COMMENTS = "#%!"
_MISSING = ("", "nan", "na", "n/a", "null", "none", "-", "--", "?")
_BEYOND = "\0beyond"  # a column after the last, which is empty
_OF_RUN = re.compile(
    r"\s*((?P<before>latest|run\s*#?\d+)\s*:)?\s*(?P<name>.*?)\s*(?P<behind>run\s*#\s*\d+)?\s*",
    re.IGNORECASE,
)
_BRACKETS = re.compile(r"^\s*([^\[(]*?)\s*(?:\[([^\]]*)\]|\(([^)]*)\))?\s*$")
# A name over its unit, as ISO 80000 has it: Zeit/ms, x / mm, v/(m/s).
_OVER = re.compile(
    r"^\s*(?P<name>[^/\[(]+?)\s*/\s*(?P<open>\()?"
    r"(?P<unit>(?:[nµum]?s|[nµumck]?m|m?rad|k?g|[mk]?N|[µumk]?V|[µum]?A|min|h|deg|°|Nm|px)"
    r"(?:/(?:ms|s|min))?)(?(open)\))\s*$"
)


@dataclasses.dataclass(frozen=True)
class _Format:
    """Dialect of a text file, from its first lines."""

    separator: str  # or r"\s+"
    decimal: str
    comment: str | None
    first: int  # lines before the first row of numbers
    names: tuple[str, ...]
    units: dict[str, str]
    text: tuple[str, ...]  # columns that hold words
    notes: tuple[str, ...]


def from_text(
    path: Path,
    columns: Sequence[str] = (),
    *,
    start: float = -np.inf,
    stop: float = np.inf,
    every: int = 1,
) -> Table:
    """The columns of a text file, of which rows between the times ``start`` and ``stop`` (in the
    file's unit), every so many of them, are kept.

    columns: names of those to read, or of all, in order, where the file has no header.
    The file is read in blocks of rows, so that of a file larger than memory a part can be had.
    Raises InputError, with the line, at what is no number and at lines of another width.
    """
    form = _sniffed(path, columns)
    chosen = columns or form.names
    wanted = [n for n in form.names if n in chosen or is_time(n) or is_run(n)]
    wanted = [name for name in wanted if name not in form.text or is_time(name)]
    kept: list[dict[str, np.ndarray]] = []
    numbers: list[np.ndarray] = []  # of the rows that are kept, in the file
    time = next((name for name in wanted if is_time(name)), None)
    passed = 0
    for block in _blocks(path, form, wanted):
        rows = np.arange(len(next(iter(block.values()))))
        keep = (rows + passed) % every == 0
        if time is not None:
            keep &= ~((block[time] < start) | (block[time] > stop))
        kept.append({name: values[keep] for name, values in block.items()})
        numbers.append(rows[keep] + passed)
        passed += len(rows)
    found = {name: np.concatenate([block[name] for block in kept]) for name in wanted}
    row_numbers = np.concatenate(numbers)

    def locate(row: int) -> str:
        stands = itertools.islice(_rows(path, form), int(row_numbers[row]), None)
        return f"line {next(stands)[0]}"

    words = tuple(name for name in form.text if name not in found)
    return Table(found, form.units, str(path), words, form.notes, locate)


def _blocks(path: Path, form: _Format, wanted: list[str]) -> Iterator[dict[str, np.ndarray]]:
    import pandas as pd

    names = [*form.names, _BEYOND]
    words = [n for n in names if n not in wanted or n in form.text or is_run(n)]
    types = {n: str if n in words else np.float64 for n in names}
    options: dict[str, Any] = {
        "sep": form.separator,
        "decimal": form.decimal,
        "comment": form.comment,
        "header": None,
        "names": names,
        "dtype": types,
        "skiprows": form.first,
        "chunksize": BLOCK_ROWS,
        "na_values": list(_MISSING),
        "skipinitialspace": True,
        "encoding": "utf-8-sig",
        "index_col": False,
    }
    last, begin = form.names[-1], None
    try:
        with pd.read_csv(path, **options) as blocks:
            for block in blocks:
                short = last in wanted and block[last].isna().any()
                if short or not block[_BEYOND].isna().all():
                    _check_widths(path, form)
                found = {n: block[n] for n in wanted}
                for name in set(wanted) & set(form.text):  # times of day
                    found[name] = _times_of_day(path, block[name])
                    begin = found[name].iloc[0] if begin is None else begin
                    found[name] = (found[name] - begin).dt.total_seconds()
                yield {
                    name: column.to_numpy(dtype=None if is_run(name) else np.float64)
                    for name, column in found.items()
                }
    except (ValueError, pd.errors.ParserError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            _fault(path, form, wanted) or f"{path}: cannot be read ({error})"
        ) from None


def _times_of_day(path: Path, column: Any) -> Any:
    """Dates and times from their text. Raises InputError where one is not of ISO 8601: others, as
    5/1/2024, can be read in two ways."""
    import pandas as pd

    try:
        return pd.to_datetime(column, utc=True, format="ISO8601")
    except ValueError as error:
        reason = str(error).split(" You might")[0][:120]
        raise InputError(
            f"{path}: {column.name}: expected times like 2024-05-01 23:59:59.5 ({reason})"
        ) from None


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """(number from 1, text) of every line that is not blank."""
    with open(path, encoding="utf-8-sig", errors="replace") as stream:
        for number, line in enumerate(stream, 1):
            if line.strip():
                yield number, line.rstrip("\r\n")


def _rows(path: Path, form: _Format) -> Iterator[tuple[int, list[str]]]:
    for number, line in _lines(path):
        if number > form.first and not (form.comment and line.lstrip().startswith(form.comment)):
            text = line.split(form.comment)[0] if form.comment else line
            cells = _cells(text, form.separator)
            yield number, cells if cells[len(form.names) :] != [""] else cells[:-1]


def _check_widths(path: Path, form: _Format) -> None:
    """Raises InputError at the first row of another width than the header's."""
    for number, cells in _rows(path, form):
        if len(cells) != len(form.names):
            raise InputError(
                f"{path}: line {number}: {len(form.names)} columns expected "
                f"({', '.join(form.names)[:60]}), {len(cells)} found"
            )


def _fault(path: Path, form: _Format, wanted: list[str]) -> str | None:
    """The first cell that is no number."""
    with contextlib.suppress(OSError):
        for number, cells in _rows(path, form):
            if len(cells) != len(form.names):
                return (
                    f"{path}: line {number}: {len(form.names)} columns expected, {len(cells)} found"
                )
            for name, cell in zip(form.names, cells, strict=True):
                is_value = name in wanted and name not in form.text and not is_run(name)
                if is_value and not _is_number(cell, form.decimal):
                    return f"{path}: line {number}, {name}: {cell[:40]!r} is not a number"
    return None


def _cells(line: str, separator: str) -> list[str]:
    """The cells of a line."""
    if separator == r"\s+":
        parts = line.split()
    else:
        parts = next(csv.reader([line.strip(" ")], delimiter=separator, skipinitialspace=True), [])
    return [part.strip().strip("\"'").strip() for part in parts]


def _is_number(cell: str, decimal: str = ".") -> bool:
    if cell.lower() in _MISSING:
        return True
    try:
        float(cell.replace(decimal, ".") if decimal != "." else cell)
    except ValueError:
        return False
    return "_" not in cell


def _sniffed(path: Path, columns: Sequence[str]) -> _Format:
    """The format that the first lines of a file are written in.

    Raises InputError where the file holds no rows of numbers, or they can be read in two ways.
    """
    with damage(path, "the text"), open(path, encoding="utf-8-sig") as stream:
        lines = stream.read(_SNIFFED).split("\n")
    if len(lines) > 2:
        lines.pop()  # perhaps cut
    numbered = [(i, line.rstrip("\r")) for i, line in enumerate(lines, 1) if line.strip()]
    comment = next(
        (line.lstrip()[0] for _, line in numbered if line.lstrip()[0] in _COMMENTS), None
    )
    comments = [(i, line) for i, line in numbered if comment and line.lstrip().startswith(comment)]
    plain = [pair for pair in numbered if pair not in comments]
    if not plain:
        raise InputError(f"{path}: expected rows of numbers below a line of names, found none")
    separator, decimal = _separator(path, [line for _, line in plain])

    def is_data(line: str) -> bool:
        cells = _cells(line, separator)
        numbers = [c for c in cells if c.lower() not in _MISSING and _is_number(c, decimal)]
        return len(numbers) > 0 and 2 * len(numbers) >= len([c for c in cells if c])

    first = next((k for k, (_, line) in enumerate(plain) if is_data(line)), None)
    if first is None:
        raise InputError(
            f"{path}: expected rows of numbers below a line of names, found {plain[0][1][:60]!r}"
        )
    rows = [_cells(line, separator) for _, line in plain[first : first + 50]]
    above = [_cells(line, separator) for _, line in plain[:first]]
    if not above:  # np.savetxt writes the header as a comment
        above = [
            _cells(line.lstrip().lstrip(comment or "").strip(), separator)
            for i, line in comments
            if i < plain[first][0]
        ][-1:]
    width = len(rows[0])
    if not any(row[-1] for row in rows) and all(
        cells[width - 1 :] in ([], [""]) for cells in above
    ):
        width -= 1  # a separator ends every line
        above = [cells[:width] for cells in above]
    notes: tuple[str, ...] = ()
    above = [cells[:width] if not any(cells[width:]) else cells for cells in above]
    named = [cells for cells in above if len(cells) == width]
    while len(named) > 1 and all(named[1]) and not all(named[0]):
        named.pop(0)  # a title
    if named:
        names, units = _named(_undecorated(path, named[0]))
        for cells in named[1:2]:
            units |= {n: _bare(c) for n, c in zip(names, cells, strict=True) if _bare(c)}
            notes = (f"the line below the names holds units: {', '.join(filter(None, cells))}",)
    elif above and plain[:first]:
        raise InputError(
            f"{path}: line {plain[first][0]}: {len(above[-1])} columns expected "
            f"({', '.join(above[-1])[:60]}), {width} found"
        )
    elif len(columns) == width:
        names, units = list(columns), {}
    else:
        raise InputError(
            f"{path}: expected a line of names above {width} columns of numbers, found none; name "
            f"them: --columns {','.join(['t', 'x', 'v', 'u', 'a', 'b', 'c'][:width])}"
        )
    repeated = [name for name in dict.fromkeys(names) if names.count(name) > 1]
    if repeated:
        raise InputError(f"{path}: the header names {', '.join(repeated)} twice")
    missing = [name for name in columns if name not in names]
    if missing:
        raise InputError(f"{path}: no column {', '.join(missing)}, found {', '.join(names)}")
    words = tuple(
        name
        for i, name in enumerate(names)
        if not is_run(name) and not any(_is_number(r[i], decimal) for r in rows if i < len(r))
    )
    before = plain[first][0] - 1
    return _Format(separator, decimal, comment, before, tuple(names), units, words, notes)


def _separator(path: Path, lines: list[str]) -> tuple[str, str]:
    """(separator, decimal sign) that make the last lines rows of numbers of equal width."""
    sample = lines[-1:] if len(lines) == 1 else lines[max(1, len(lines) - 20) :]
    good = []
    for separator, decimal in (
        (";", "."),
        (";", ","),
        ("\t", "."),
        ("\t", ","),
        (",", "."),
        (",", ","),
        (r"\s+", "."),
        (r"\s+", ","),
    ):
        rows = [_cells(line, separator) for line in sample]
        widths = {len(row) for row in rows}
        numbers = sum(_is_number(cell, decimal) for row in rows for cell in row)
        if len(widths) == 1 and widths.pop() > 1:
            good.append((numbers / sum(len(row) for row in rows), separator, decimal))
    if not good:
        widest = max((",", ";", "\t", r"\s+"), key=lambda s: len(_cells(lines[0], s)))
        if len(_cells(lines[0], widest)) == 1:
            raise InputError(f"{path}: expected at least two columns, found {lines[0][:60]!r}")
        return widest, "."  # a row of another width will be named
    share, separator, decimal = max(good, key=lambda found: found[0])
    header = _cells(lines[0], ",")
    if separator == "," and len(_cells(sample[0], ",")) == 2 * len(header) > 2 and share == 1:
        raise InputError(
            f"{path}: commas between columns and decimal commas cannot be distinguished: write "
            "semicolons between columns, or decimal points"
        )
    return separator, decimal


def _undecorated(path: Path, cells: list[str]) -> list[str]:
    """Names without what programs write around them: "Latest: Time", "Angle (rad) Run #1".

    Raises InputError where the columns of several runs stand side by side."""
    parts = [_OF_RUN.fullmatch(cell) for cell in cells]
    assert all(part is not None for part in parts)
    runs = {part["before"] or part["behind"] for part in parts if part}
    if len(runs - {None}) > 1:
        found = ", ".join(sorted(run for run in runs if run))
        raise InputError(
            f"{path}: has columns of several runs side by side ({found}): export one run a file, "
            "and give all files"
        )
    return [part["name"] for part in parts if part]


def _named(cells: list[str]) -> tuple[list[str], dict[str, str]]:
    """Names, and units by name where brackets, or a stroke before them, give them."""
    names, units = [], {}
    for cell in cells:
        over = _OVER.match(cell)
        if over:
            names.append(over["name"])
            units[over["name"]] = over["unit"]
            continue
        match = _BRACKETS.match(cell)
        name = match[1] if match and match[1] else cell
        if match and (match[2] or match[3]):
            units[name] = (match[2] or match[3]).strip()
        names.append(name)
    return names, units


def _bare(cell: str) -> str:
    return cell.strip().strip("[]()").strip()
