"""Tables in text files: their dialect, told by their first lines, and their rows, in blocks.

All text goes through here: recordings, and states q, p (`csv_files`).
"""

from __future__ import annotations

import csv
import dataclasses
import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gfnn_jax.data.blocks import damage
from gfnn_jax.data.roles import is_run, is_time
from gfnn_jax.data.tables import Table
from gfnn_jax.errors import InputError

_COMMENTS = "#%!"
_MISSING = ("", "nan", "na", "n/a", "null", "none", "-", "--", "?")
_BEYOND = "\0beyond"  # a column after the last, which is empty
_BLANKS = r"\s+"
_DIALECTS = tuple(itertools.product((";", "\t", ",", _BLANKS), (".", ",")))
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
class _Options:
    """block_rows: rows of a recording that are parsed at a time. sniffed: characters of the file's
    begin that tell its dialect. last_lines, first_rows: lines that tell the separator, rows that
    tell which columns hold words."""

    block_rows: int = 100_000
    sniffed: int = 1 << 16
    last_lines: int = 20
    first_rows: int = 50


_OPTIONS = _Options()


class TextFile:
    """A table of columns in a text file.

    names: of the columns, in order. units: by name, as brackets, a stroke or a line of units give
    them. text: names of columns that hold words. notes: what reading had to decide.
    """

    def __init__(self, path: Path, columns: Sequence[str] = ()):
        """Tell the dialect of a file from its first lines.

        columns: names of those wanted, or of all, in order, where the file has no header. Raises
        InputError where the file holds no rows of numbers, or they can be read in two ways.
        """
        self.path = path
        with damage(path, "the header"), open(path, encoding="utf-8-sig") as stream:
            lines = stream.read(_OPTIONS.sniffed).split("\n")
        if len(lines) > 2:
            lines.pop()  # perhaps cut
        numbered = [(i, line.rstrip("\r")) for i, line in enumerate(lines, 1) if line.strip()]
        begins = [line.lstrip()[0] for _, line in numbered]
        self._comment = next((sign for sign in begins if sign in _COMMENTS), None)
        of_file = [
            pair for pair, sign in zip(numbered, begins, strict=True) if sign != self._comment
        ]
        if not of_file:
            raise InputError(f"{path}: expected rows of numbers below a line of names, found none")
        self._separator, self._decimal = _dialect(path, [line for _, line in of_file])
        first = next((k for k, (_, line) in enumerate(of_file) if self._is_data(line)), None)
        if first is None:
            raise InputError(
                f"{path}: expected rows of numbers below a line of names, found "
                f"{of_file[0][1][:60]!r}"
            )
        self._first = of_file[first][0] - 1  # lines before the first row of numbers
        rows = [self._cells(line) for _, line in of_file[first : first + _OPTIONS.first_rows]]
        above = [self._cells(line) for _, line in of_file[:first]]
        commented = not above and self._comment  # np.savetxt writes the header as a comment
        if commented:
            above = [
                self._cells(line.lstrip().lstrip(commented).strip())
                for i, line in numbered
                if i <= self._first and line.lstrip().startswith(commented)
            ][-1:]
        width = len(rows[0])
        if not any(row[-1] for row in rows) and not any(any(c[width - 1 :]) for c in above):
            width -= 1  # a separator ends every line
        above = [cells if any(cells[width:]) else cells[:width] for cells in above]
        if of_file[:first] and not any(len(cells) == width for cells in above):
            raise InputError(
                f"{path}: line {of_file[first][0]}: {len(above[-1])} columns expected "
                f"({', '.join(above[-1])[:60]}), {width} found"
            )
        self.notes: tuple[str, ...] = ()
        self.names, self.units = self._header(above, width, columns)
        self.text = tuple(
            name
            for i, name in enumerate(self.names)
            if not is_run(name)
            and not any(_is_number(row[i], self._decimal) for row in rows if i < len(row))
        )

    def _header(
        self, above: list[list[str]], width: int, columns: Sequence[str]
    ) -> tuple[tuple[str, ...], dict[str, str]]:
        """Names and units of ``width`` columns, from the cells of the lines above the rows."""
        named = [cells for cells in above if len(cells) == width]
        while len(named) > 1 and all(named[1]) and not all(named[0]):
            named.pop(0)  # a title
        if named:
            names, units = _named(_undecorated(self.path, named[0]))
            for cells in named[1:2]:
                below = [cell.strip().strip("[]()").strip() for cell in cells]
                units |= {n: unit for n, unit in zip(names, below, strict=True) if unit}
                shown = ", ".join(filter(None, cells))
                self.notes = (f"the line below the names holds units: {shown}",)
        elif len(columns) == width:
            names, units = list(columns), {}
        else:
            raise InputError(
                f"{self.path}: expected a line of names above {width} columns of numbers, found "
                f"none; name them: --columns {','.join(['t', 'x', 'v', 'u', 'a', 'b'][:width])}"
            )
        repeated = [name for name in dict.fromkeys(names) if names.count(name) > 1]
        if repeated:
            raise InputError(f"{self.path}: the header names {', '.join(repeated)} twice")
        missing = [name for name in columns if name not in names]
        if missing:
            raise InputError(
                f"{self.path}: no column {', '.join(missing)}, found {', '.join(names)}"
            )
        return tuple(names), units

    def blocks(
        self, wanted: Sequence[str], rows: int, as_text: Sequence[str] = ()
    ) -> Iterator[dict[str, np.ndarray]]:
        """The wanted columns by name, ``rows`` rows at a time: float64, NaN where missing.

        as_text: columns whose cells are kept as text. Times of day become seconds since the first.
        Raises InputError, with the line, at what is no number and at lines of another width.
        """
        import pandas as pd

        names = [*self.names, _BEYOND]
        words = {n for n in names if n not in wanted or n in self.text or n in as_text}
        options: dict[str, Any] = {
            "sep": self._separator,
            "decimal": self._decimal,
            "comment": self._comment,
            "header": None,
            "names": names,
            "dtype": {n: str if n in words else np.float64 for n in names},
            "skiprows": self._first,
            "chunksize": rows,
            "na_values": list(_MISSING),
            "skipinitialspace": True,
            "encoding": "utf-8-sig",
            "index_col": False,
        }
        last, begin = self.names[-1], None
        try:
            with pd.read_csv(self.path, **options) as blocks:
                for block in blocks:
                    short = last in wanted and block[last].isna().any()
                    if short or not block[_BEYOND].isna().all():
                        self._check_widths()
                    found = {n: block[n] for n in wanted}
                    for name in (n for n in wanted if n in self.text and n not in as_text):
                        times = self._times_of_day(block[name])
                        begin = times.iloc[0] if begin is None else begin
                        found[name] = (times - begin).dt.total_seconds()
                    yield {
                        name: column.to_numpy(dtype=None if name in as_text else np.float64)
                        for name, column in found.items()
                    }
        except InputError:
            raise
        except (ValueError, OverflowError) as error:  # pandas' errors of parsing are ValueErrors
            self._check_widths()
            self._check_numbers([n for n in wanted if n not in words])
            detail = str(error).splitlines()[0][:120]
            raise InputError(f"{self.path}: cannot be read ({detail})") from None

    def locate(self, row: int) -> str:
        """The line of a row, counted from 0, for a message."""
        return f"line {next(itertools.islice(self._rows(), row, None))[0]}"

    def _times_of_day(self, column: Any) -> Any:
        """Dates and times from their text. Raises InputError where one is not of ISO 8601: others,
        as 5/1/2024, can be read in two ways."""
        import pandas as pd

        try:
            return pd.to_datetime(column, utc=True, format="ISO8601")
        except ValueError as error:
            reason = str(error).split(" You might")[0][:120]
            raise InputError(
                f"{self.path}: {column.name}: expected times like 2024-05-01 23:59:59.5 ({reason})"
            ) from None

    def _is_data(self, line: str) -> bool:
        """Return whether at least half of a line's cells are numbers."""
        cells = [cell for cell in self._cells(line) if cell]
        numbers = [c for c in cells if c.lower() not in _MISSING and _is_number(c, self._decimal)]
        return len(numbers) > 0 and 2 * len(numbers) >= len(cells)

    def _cells(self, line: str) -> list[str]:
        return _cells(line, self._separator)

    def _rows(self) -> Iterator[tuple[int, list[str]]]:
        """(number of the line from 1, cells) of every row."""
        comment = self._comment
        with open(self.path, encoding="utf-8-sig", errors="replace") as stream:
            for number, line in enumerate(stream, 1):
                if number <= self._first or not line.strip():
                    continue
                if comment and line.lstrip().startswith(comment):
                    continue
                cells = self._cells((line.split(comment)[0] if comment else line).rstrip("\r\n"))
                yield number, cells if cells[len(self.names) :] != [""] else cells[:-1]

    def _check_widths(self) -> None:
        """Raises InputError at the first row of another width than the header's."""
        for number, cells in self._rows():
            if len(cells) != len(self.names):
                raise InputError(
                    f"{self.path}: line {number}: {len(self.names)} columns expected "
                    f"({', '.join(self.names)[:60]}), {len(cells)} found"
                )

    def _check_numbers(self, columns: Sequence[str]) -> None:
        """Raises InputError at the first cell of these columns that is no number."""
        for number, cells in self._rows():
            for name, cell in zip(self.names, cells, strict=False):
                if name in columns and not _is_number(cell, self._decimal):
                    raise InputError(
                        f"{self.path}: line {number}, {name}: {cell[:40]!r} is not a number"
                    )


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
    text = TextFile(path, columns)
    wanted = [n for n in text.names if n in (columns or text.names) or is_time(n) or is_run(n)]
    wanted = [name for name in wanted if name not in text.text or is_time(name)]
    runs = [name for name in wanted if is_run(name)]
    kept: list[dict[str, np.ndarray]] = []
    numbers: list[np.ndarray] = []  # of the rows that are kept, in the file
    time = next((name for name in wanted if is_time(name)), None)
    passed = 0
    for block in text.blocks(wanted, _OPTIONS.block_rows, runs):
        rows = np.arange(len(next(iter(block.values()))))
        keep = (rows + passed) % every == 0
        if time is not None:
            keep &= ~((block[time] < start) | (block[time] > stop))
        kept.append({name: values[keep] for name, values in block.items()})
        numbers.append(rows[keep] + passed)
        passed += len(rows)
    found = {name: np.concatenate([block[name] for block in kept]) for name in wanted}
    row_numbers = np.concatenate(numbers)
    return Table(
        found,
        text.units,
        str(path),
        tuple(name for name in text.text if name not in found),
        text.notes,
        lambda row: text.locate(int(row_numbers[row])),
    )


def to_text(columns: Mapping[str, np.ndarray]) -> str:
    """Text of columns (n,) of numbers, with ten digits, or of words: commas between them."""
    import pandas as pd

    return pd.DataFrame(dict(columns)).to_csv(index=False, float_format="%.10g", na_rep="nan")


def _cells(line: str, separator: str) -> list[str]:
    """The cells of a line, without blanks and quotes around them."""
    if separator == _BLANKS:
        parts = line.split()
    else:
        try:
            reader = csv.reader([line.strip(" ")], delimiter=separator, skipinitialspace=True)
            parts = next(reader, [])
        except csv.Error:  # a carriage return inside a line
            parts = line.split(separator)
    return [part.strip().strip("\"'").strip() for part in parts]


def _is_number(cell: str, decimal: str = ".") -> bool:
    if cell.lower() in _MISSING:
        return True
    try:
        float(cell.replace(decimal, ".") if decimal != "." else cell)
    except ValueError:
        return False
    return "_" not in cell


def _dialect(path: Path, lines: list[str]) -> tuple[str, str]:
    """(separator, decimal sign) that make the last lines rows of numbers of equal width."""
    sample = lines[-1:] if len(lines) == 1 else lines[max(1, len(lines) - _OPTIONS.last_lines) :]
    good = []
    for separator, decimal in _DIALECTS:
        rows = [_cells(line, separator) for line in sample]
        widths = {len(row) for row in rows}
        numbers = sum(_is_number(cell, decimal) for row in rows for cell in row)
        if len(widths) == 1 and widths.pop() > 1:
            good.append((numbers / sum(len(row) for row in rows), separator, decimal))
    if not good:
        widest = max((",", ";", "\t", _BLANKS), key=lambda s: len(_cells(lines[0], s)))
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
    parts = [part for part in map(_OF_RUN.fullmatch, cells) if part is not None]
    runs = {run for part in parts if (run := part["before"] or part["behind"])}
    if len(runs) > 1:
        raise InputError(
            f"{path}: has columns of several runs side by side ({', '.join(sorted(runs))}): export "
            "one run a file, and give all files"
        )
    return [part["name"] for part in parts]


def _named(cells: list[str]) -> tuple[list[str], dict[str, str]]:
    """Names, and units by name where brackets, or a stroke before them, give them."""
    names, units = [], {}
    for cell in cells:
        if over := _OVER.match(cell):
            name, unit = over["name"], over["unit"]
        else:
            match = _BRACKETS.match(cell)
            name = match[1] if match and match[1] else cell
            unit = (match[2] or match[3] or "").strip() if match else ""
        names.append(name)
        if unit:
            units[name] = unit
    return names, units
