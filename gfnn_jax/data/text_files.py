"""Tables in text files: their dialect, told by their first lines, and their rows, in blocks.

All text goes through here: recordings, and states q, p (`csv_files`).
"""

import csv
import itertools
import re
import shlex
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gfnn_jax.data.blocks import damage
from gfnn_jax.data.columns import check_known, resolved
from gfnn_jax.data.roles import is_run, is_time, split_unit
from gfnn_jax.data.tables import Rows, Table, rows_of
from gfnn_jax.data.texts import text_of
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


class _Options:
    """Sizes by which text is read."""

    block_rows: int = 100_000  # of a recording that are parsed at a time
    sniffed: int = 1 << 17  # characters of the file's begin that tell its dialect
    last_lines: int = 20  # that tell the separator
    shown: int = 3  # lines of a refusal
    daily: float = 43_200.0  # s: steps from which on the times of dates are in days


# What begins as dates and times of day do: 2024-05-01, 5/7/2021, 7.5.2021, 09:33:31.
_DATE = re.compile(r"\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}(\D|$)|\d{1,2}:\d{2}(:\d|$)")
# Names of the time between rows, and of its inverse, in what instruments write above a table.
_STEP = re.compile(r"(?i)(sampl\w+ |horizontal )?(interval|increment|period)|xincr|delta ?t|dt")
_RATE = re.compile(r"(?i)sampl\w+ (rate|frequency)")


class TextFile:
    """A table of columns in a text file.

    names: of the columns, in order. units: by name, as brackets, a stroke or a line of units give
    them. text: names of columns that hold words. times: those that tell the time, two where one
    holds dates and the other times of day. runs: of columns of several runs side by side (name,
    run), by their own name. notes: what reading had to decide.
    """

    def __init__(self, path: Path, columns: Sequence[str] = (), time: str | None = None):
        """Tell the dialect of a file from its first lines.

        columns: names of those wanted, or of all, in order, where the file has no header. time:
        name of the column of times. Raises InputError where the file holds no rows of numbers, or
        they can be read in two ways."""
        self.path = path
        text = text_of(path)
        self._open, self.notes = text.open, text.notes
        with damage(path, "the header"), self._open() as stream:
            head = stream.read(_Options.sniffed)
        lines = head.split("\n")
        if len(head) == _Options.sniffed and len(lines) > 2:
            lines.pop()  # cut
        numbered = [(i, line.rstrip("\r")) for i, line in enumerate(lines, 1) if line.strip()]
        begins = [line.lstrip()[0] for _, line in numbered]
        self._comment = next((sign for sign in begins if sign in _COMMENTS), None)
        of_file = [p for p, sign in zip(numbered, begins, strict=True) if sign != self._comment]
        if not of_file:
            raise InputError(f"{path}: expected rows of numbers below a line of names, found none")
        self._separator, self._decimal = _dialect(path, [line for _, line in of_file])
        cells = [self._cells(line) for _, line in of_file]
        first = self._first_row(cells)
        if first is None:
            found = _shown(of_file[: _Options.shown])
            raise InputError(
                f"{path}: expected rows of numbers below a line of names, found {found}"
            )
        self._first = of_file[first][0] - 1  # lines before the first row of numbers
        rows, above = cells[first:], cells[:first]
        # A blank line ends what instruments write above the names.
        gaps = [k for k in range(1, first) if of_file[k][0] > of_file[k - 1][0] + 1]
        if gaps and any(len(one) == len(rows[0]) for one in above[gaps[-1] :]):
            above = above[gaps[-1] :]
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
        above = [one if any(one[width:]) else one[:width] for one in above]
        if above[-1:] and len(above[-1]) > 1 and not any(len(one) == width for one in above):
            raise InputError(
                f"{path}: line {of_file[first][0]}: {len(above[-1])} columns expected "
                f"({', '.join(above[-1])[:60]}), {width} found"
            )
        self.step = self._step(cells[:first])
        self.runs: dict[str, tuple[str, str]] = {}
        self.names, self.units = self._header(above, width, columns)
        known = [[row[i] for row in rows if i < len(row)] for i in range(width)]
        held = [[c for c in of if c.lower() not in _MISSING] for of in known]
        self.text = tuple(
            name
            for name, of in zip(self.names, held, strict=True)
            if not is_run(name) and 2 * sum(_is_number(c, self._decimal) for c in of) < len(of)
        )
        self.times = self._times(dict(zip(self.names, held, strict=True)), time)
        # Words of a file in which the time is told by dates: (how they are read, s in their unit).
        self._dates: tuple[Callable[[Any], Any], float] | None = None
        if self.times and self.times[0] in self.text:
            places = [self.names.index(name) for name in self.times]
            moments = [" ".join(row[i] for i in places) for row in rows if len(row) > max(places)]
            self._dates = self._how_dated(moments)

    def _first_row(self, cells: list[list[str]]) -> int | None:
        """The place of the first row of numbers among lines; None where there is none.

        Instruments write numbers into their preambles too: a row that does not fit the last ones is
        of the preamble where a line without numbers, the names, stands between."""
        tail = cells[-_Options.last_lines :]
        widths = [len(one) for one in tail]
        width = max(set(widths), key=lambda w: (widths.count(w), w))
        columns = list(zip(*(one for one in tail if len(one) == width), strict=True))
        held = [[c for c in column if c.lower() not in _MISSING] for column in columns]
        numbers = [self._numbers(column) * 2 > len(column) for column in held]
        dates = [sum(map(bool, map(_DATE.match, of))) * 2 > len(of) for of in held]

        def fits(one: list[str]) -> bool:
            if len(one) != width:
                return False
            each = [(c, n, d and not n) for c, n, d in zip(one, numbers, dates, strict=True)]
            return all(
                (not n or _is_number(c, self._decimal)) and (not d or _DATE.match(c))
                for c, n, d in each
            )

        rows = [k for k, one in enumerate(cells) if self._is_data(one)]
        whole = next((k for k in rows if fits(cells[k])), None)
        if whole is None:
            return rows[0] if rows else None
        words = [k for k in range(whole) if not self._numbers(cells[k])]
        return next(k for k in rows if k > max(words, default=-1))

    def _step(self, above: list[list[str]]) -> tuple[str, float] | None:
        """The time between rows that the lines above a table give behind or below its name."""
        for row, below in itertools.pairwise([*above, []]):
            for i, cell in enumerate(row):
                name = split_unit(cell.rstrip(": "))[0]
                power = 1 if _STEP.fullmatch(name) else -1 if _RATE.fullmatch(name) else 0
                for told in (*row[i + 1 : i + 2], *below[i : i + 1]) if power else ():
                    number = told.replace(self._decimal, ".") if self._numbers([told]) else "0"
                    if float(number) > 0:
                        return name, float(number) ** power
        return None

    def _header(
        self, above: list[list[str]], width: int, columns: Sequence[str]
    ) -> tuple[tuple[str, ...], dict[str, str]]:
        """Names and units of ``width`` columns, from the cells of the lines above the rows."""
        named = [one for one in above if len(one) == width]
        if len(above) > 1 and len(above[-1]) == width:  # lines of another width end a preamble
            last = max((k for k, one in enumerate(above) if len(one) != width), default=-1)
            named = above[last + 1 :]
        while len(named) > 1 and all(c[-1:] in "])" and split_unit(c)[1] for c in named[1]):
            del named[0]  # of a preamble that is as wide: names with their units follow
        titles: list[str] = []
        while len(named) > 1 and all(named[1]) and not all(named[0]):
            titles = named.pop(0)
        if named:
            told, notes = _titled(titles, named[0])
            self.notes += notes
            names, units = self._undecorated(told)
            for cells in named[1:2]:
                below = [cell.strip().strip("[]()").strip() for cell in cells]
                units |= {n: unit for n, unit in zip(names, below, strict=True) if unit}
                shown = ", ".join(filter(None, cells))
                self.notes += (f"the line below the names holds units: {shown}",)
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
        known = [self.runs[name][0] if self.runs else name for name in names]
        check_known(str(self.path), "columns", resolved(columns, known), known)
        return tuple(names), units

    def _undecorated(self, cells: list[str]) -> tuple[list[str], dict[str, str]]:
        """(names, units by name) where brackets or a stroke before them give these, without what
        programs write around them: "Latest: Time", "Angle (rad) Run #1".

        Columns of several runs side by side keep their run behind the name, and are in ``runs``."""
        parts = [part for part in map(_OF_RUN.fullmatch, cells) if part is not None]
        labels = [part["before"] or part["behind"] or "" for part in parts]
        split = [split_unit(part["name"]) for part in parts]
        names = [name for name, _ in split]
        if len(set(filter(None, labels))) > 1:
            runs = [re.sub(r"\D", "", label) or label for label in labels]
            of_runs = list(zip(names, runs, strict=True))
            names = [f"{name} {run}".strip() for name, run in of_runs]
            self.runs = dict(zip(names, of_runs, strict=True))
        return names, {n: unit for n, (_, unit) in zip(names, split, strict=True) if unit}

    def _times(self, held: Mapping[str, list[str]], time: str | None) -> tuple[str, ...]:
        """The columns that tell the time: the given one, else by name, numbers before dates, else
        the first that holds dates."""
        if time is not None:
            return tuple(n for n in held if time in (n, self.runs.get(n, ("", ""))[0]))
        named = [name for name in held if is_time(self.runs.get(name, (name, ""))[0])]
        numbers = [name for name in named if name not in self.text]
        if numbers:
            return tuple(numbers)
        dated = [n for n in self.text if held[n] and all(map(_DATE.match, held[n]))]
        words = [name for name in named if name in dated] or dated[:1]
        with_day = [":" in held[name][0] for name in words]
        if len(words) > 1 and with_day[:2] == [False, True]:
            return tuple(words[:2])
        return tuple(words[:1] or named[:1])

    def blocks(
        self, wanted: Sequence[str], rows: int, as_text: Sequence[str] = ()
    ) -> Iterator[dict[str, np.ndarray]]:
        """The wanted columns by name, ``rows`` rows at a time: float64, NaN where missing.

        as_text: columns whose cells are kept as text. Dates become times since the first of them.
        Raises InputError, with the line, at what is no number and at lines of another width.
        """
        import pandas as pd

        names = [*self.names, _BEYOND]
        words = {n for n in names if n not in wanted or n in self.text or n in as_text}
        kinds = {n: str if n in words else np.float64 for n in names}
        options: dict[str, Any] = {"sep": self._separator, "decimal": self._decimal}
        options |= {"comment": self._comment, "header": None, "names": names, "dtype": kinds}
        options |= {"skiprows": self._first, "chunksize": rows, "na_values": list(_MISSING)}
        options |= {"skipinitialspace": True, "index_col": False}
        last, begin = self.names[-1], None
        try:
            with self._open() as stream, pd.read_csv(stream, **options) as blocks:
                for block in blocks:
                    short = last in wanted and block[last].isna().any()
                    if short or not block[_BEYOND].isna().all():
                        self._check_widths()
                    found = {n: block[n] for n in wanted}
                    if self._dates and self.times[0] in wanted and self.times[0] not in as_text:
                        times = self._moments(block[list(self.times)])
                        begin = times.iloc[0] if begin is None else begin
                        seconds = (times - begin).dt.total_seconds()
                        found[self.times[0]] = seconds / self._dates[1]
                    kinds = {name: None if name in as_text else np.float64 for name in found}
                    yield {name: x.to_numpy(dtype=kinds[name]) for name, x in found.items()}
        except InputError:
            raise
        except UnicodeDecodeError as error:
            raise InputError(f"{self.path}: cannot be read: damaged? ({error})"[:300]) from None
        except (ValueError, OverflowError) as error:  # pandas' errors of parsing are ValueErrors
            self._check_widths()
            self._check_numbers([n for n in wanted if n not in words])
            detail = str(error).splitlines()[0][:120]
            raise InputError(f"{self.path}: cannot be read ({detail})") from None

    def locate(self, row: int) -> str:
        """The line of a row, counted from 0, for a message."""
        return f"line {next(itertools.islice(self._rows(), row, None))[0]}"

    def _how_dated(self, cells: list[str]) -> tuple[Callable[[Any], Any], float]:
        """The reader of dates and times of day, and the unit in s of the times that it gives.

        5/7/2021 is July or May, whichever makes the steps more even. Raises InputError where they
        are of no kind that is known."""
        import pandas as pd
        from pandas.tseries.api import guess_datetime_format as guess

        column = _cleaned(pd.Series(cells))

        def of_day(x: Any) -> Any:
            found = pd.to_timedelta(x)
            return found + pd.to_timedelta((found.diff() < pd.Timedelta("-12h")).cumsum(), "D")

        def by(form: str, day_first: bool = False) -> Callable[[Any], Any]:
            return lambda x: pd.to_datetime(x, utc=True, format=form, dayfirst=day_first)

        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # 2024-05-01 has no day first
            forms = [(guess(column[0], dayfirst=first), first) for first in (False, True)]
        numeric = re.match(r"\d{1,2}:", cells[0])
        ways = [of_day] if numeric else [by("ISO8601"), *(by(f or "mixed", d) for f, d in forms)]
        found: list[tuple[float, float, Callable[[Any], Any]]] = []
        reason = ""
        for way in ways:
            try:
                steps = way(column).diff().dt.total_seconds().to_numpy()[1:]
            except ValueError as error:
                reason = reason or str(error).split(" You might")[0][:120]
                continue
            spread = float(np.std(steps)) if len(steps) else 0.0
            found.append((spread, float(np.median(steps)), way))
        if not found:
            wanted = "expected times like 2024-05-01 23:59:59.5"
            raise InputError(f"{self.path}: {self.times[0]}: {wanted} ({reason})")
        _, step, way = min(found, key=lambda one: one[0])
        second = 24 * 3600.0 if step >= _Options.daily else 1.0
        unit = "s" if second == 1 else "d"
        self.units[self.times[0]] = unit
        self.notes += (f"times are {unit} since the first of {' '.join(self.times)}: {cells[0]}",)
        return way, second

    def _moments(self, columns: Any) -> Any:
        """Dates and times from their words. Raises InputError where one is none."""
        assert self._dates is not None
        joined = columns.iloc[:, 0].str.cat([columns[n] for n in columns.columns[1:]], sep=" ")
        try:
            return self._dates[0](_cleaned(joined))
        except ValueError as error:
            reason = str(error).split(" You might")[0][:120]
            raise InputError(
                f"{self.path}: {self.times[0]}: expected times like the first of them ({reason})"
            ) from None

    def _is_data(self, cells: list[str]) -> bool:
        """Return whether at least half of a line's cells are numbers."""
        held = [cell for cell in cells if cell]
        numbers = self._numbers(held)
        dates = sum(bool(_DATE.match(cell)) for cell in held)
        return numbers > 0 and 2 * (numbers + dates) >= len(held)

    def _numbers(self, cells: Sequence[str]) -> int:
        """The number of cells that are numbers."""
        return sum(c.lower() not in _MISSING and _is_number(c, self._decimal) for c in cells)

    def _cells(self, line: str) -> list[str]:
        return _cells(line, self._separator)

    def _rows(self) -> Iterator[tuple[int, list[str]]]:
        """(number of the line from 1, cells) of every row."""
        comment = self._comment
        with self._open() as stream:
            for number, line in enumerate(stream, 1):
                if number <= self._first or not line.strip():
                    continue
                if comment and line.lstrip().startswith(comment):
                    continue
                cells = self._cells((line.split(comment)[0] if comment else line).rstrip("\r\n"))
                yield number, cells if cells[len(self.names) :] != [""] else cells[:-1]

    def _check_widths(self) -> None:
        """Raises InputError at the first rows of another width than the header's."""
        count = len(self.names)
        wrong = ((n, cells) for n, cells in self._rows() if len(cells) != count)
        found = list(itertools.islice(wrong, _Options.shown))
        if found:
            number, cells = found[0]
            raise InputError(
                f"{self.path}: line {number}: {count} columns expected "
                f"({', '.join(self.names)[:60]}), {len(cells)} found"
                f"{_more([(n, ', '.join(c)) for n, c in found])}"
            )

    def _check_numbers(self, columns: Sequence[str]) -> None:
        """Raises InputError at the first cells of these columns that are no numbers."""
        wrong = (
            (number, name, cell)
            for number, cells in self._rows()
            for name, cell in zip(self.names, cells, strict=False)
            if name in columns and not _is_number(cell, self._decimal)
        )
        found = list(itertools.islice(wrong, _Options.shown))
        if found:
            number, name, cell = found[0]
            others = ",".join(n for n in self.names if n != name and n not in self.text)
            raise InputError(
                f"{self.path}: line {number}, {name}: {cell[:40]!r} is not a number"
                f"{_more([(n, f'{name} {cell}') for n, name, cell in found])}. "
                f"Without that column: --columns {shlex.quote(others)}"
            )


def from_text(
    path: Path,
    columns: Sequence[str] = (),
    *,
    time: str | None = None,
    rows: Rows,
    words: Collection[str] = (),
) -> Table:
    """The columns of a text file, in these rows.

    columns: names of those to read, or of all, in order, where the file has no header. time: name
    of the column of times. words: columns of these are read too. The file is read in blocks of
    rows, so that of a file larger than memory a part can be had. Raises InputError, with the line,
    at what is no number and at lines of another width.
    """
    text = TextFile(path, columns, time)
    columns = resolved(columns, [text.runs.get(name, (name,))[0] for name in text.names])
    if text.runs:
        return rows_of(_stacked(text, columns), rows)
    wanted = [n for n in text.names if n in (columns or text.names) or n in text.times or is_run(n)]
    wanted = [name for name in wanted if name not in text.text or name in text.times[:1]]
    words_of = [name for name in text.text if name not in text.times]
    read = words_of if words else []
    if not wanted:
        raise InputError(f"{path}: no column of numbers: {', '.join(text.names)} hold words")
    runs = [name for name in wanted if is_run(name)]
    kept: list[dict[str, np.ndarray]] = []
    numbers: list[np.ndarray] = []  # of the rows that are kept, in the file
    passed = 0
    for block in text.blocks([*wanted, *read], _Options.block_rows, [*runs, *read]):
        keep = rows.kept(block, text.times, passed)
        kept.append({name: values[keep] for name, values in block.items()})
        numbers.append(np.flatnonzero(keep) + passed)
        passed += len(keep)
    found = {name: np.concatenate([block[name] for block in kept]) for name in kept[0]}
    of_words = {name: found.pop(name, np.array([], str)) for name in words_of}
    aside = [name for name, cells in of_words.items() if not {*words} & {*cells}]
    row_numbers = np.concatenate(numbers)
    return Table(
        found,
        text.units,
        str(path),
        of_words,
        (*text.notes, *_put_aside(aside)),
        lambda row: text.locate(int(row_numbers[row])),
        next(iter(text.times), None),
        text.step,
    )


def _put_aside(names: Sequence[str]) -> tuple[str, ...]:
    """A note about columns that hold words."""
    verbs = "holds words and is" if len(names) == 1 else "hold words and are"
    return (f"{', '.join(names)} {verbs} put aside",) if names else ()


def _stacked(text: TextFile, columns: Sequence[str]) -> Table:
    """The table of a file whose runs stand side by side, the runs one after another."""
    import pandas as pd

    wanted = [name for name in text.names if name not in text.text]
    aside = [name for name in text.text if name not in text.times]
    blocks = list(text.blocks(wanted, _Options.block_rows))
    raw = {name: np.concatenate([block[name] for block in blocks]) for name in wanted}
    runs = [run for run in dict.fromkeys(run for _, run in text.runs.values()) if run]
    parts = []
    for run in runs:
        of_run = {text.runs[n][0]: x for n, x in raw.items() if text.runs[n][1] in ("", run)}
        parts.append(pd.DataFrame(of_run).dropna(how="all").assign(run=run))
    found = pd.concat(parts)
    time = text.runs[text.times[0]][0] if text.times else None
    kept = [str(n) for n in found if not columns or n in (*columns, time, "run")]
    return Table(
        {name: found[name].to_numpy() for name in kept},
        {text.runs[name][0]: unit for name, unit in text.units.items()},
        str(text.path),
        {},
        (*text.notes, *_put_aside(aside), f"the runs {', '.join(runs)} stand side by side"),
        time=time,
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


def _shown(lines: Sequence[tuple[int, str]]) -> str:
    return "; ".join(f"line {number}: {line.strip()[:60]!r}" for number, line in lines)


def _more(lines: Sequence[tuple[int, str]]) -> str:
    """The lines behind the first one, for the end of a message about it."""
    return f" ({_shown(lines[1:])})" if lines[1:] else ""


def _dialect(path: Path, lines: list[str]) -> tuple[str, str]:
    """(separator, decimal sign) that make the last lines rows of numbers of equal width."""
    sample = lines[-1:] if len(lines) == 1 else lines[max(1, len(lines) - _Options.last_lines) :]
    good = []
    for separator, decimal in _DIALECTS:
        rows = [_cells(line, separator) for line in sample]
        widths = {len(row) for row in rows}
        numbers = sum(_is_number(cell, decimal) for row in rows for cell in row)
        if len(widths) == 1 and widths.pop() > 1:
            good.append((numbers / sum(len(row) for row in rows), separator, decimal))
    if not good:
        widest = max((",", ";", "\t", _BLANKS), key=lambda s: len(_cells(lines[0], s)))
        if len(_cells(lines[0], widest)) > 1:
            return widest, "."  # a row of another width will be named
        one = next((d for d in ".," if all(_is_number(x.strip(), d) for x in sample)), None)
        if one is None:
            numbered = list(enumerate(lines[: _Options.shown], 1))
            raise InputError(f"{path}: expected columns of numbers, found {_shown(numbered)}")
        return (",", ".") if one == "." else (";", ",")  # a single column
    share, separator, decimal = max(good, key=lambda found: found[0])
    header = _cells(lines[0], ",")
    if separator == "," and len(_cells(sample[0], ",")) == 2 * len(header) > 2 and share == 1:
        raise InputError(
            f"{path}: commas between columns and decimal commas cannot be distinguished: write "
            "semicolons between columns, or decimal points"
        )
    return separator, decimal


def _titled(titles: list[str], names: list[str]) -> tuple[list[str], tuple[str, ...]]:
    """(names, notes): those that repeat below different titles are numbered, as x1 of mass_A."""
    if len(set(names)) == len(names) or len(titles) != len(names):
        return names, ()
    spread = list(itertools.accumulate(titles, lambda before, title: title or before))
    bodies = list(
        dict.fromkeys(t for t, n in zip(spread, names, strict=True) if names.count(n) > 1)
    )
    found = [
        f"{n}{bodies.index(t) + 1}" if names.count(n) > 1 else n
        for t, n in zip(spread, names, strict=True)
    ]
    return found, (f"the columns 1, 2 … are of {', '.join(bodies)}",)


def _cleaned(column: Any) -> Any:
    """Words of dates with single blanks and decimal points."""
    return column.str.strip().str.replace(r"\s+", " ", regex=True).str.replace(",", ".")
