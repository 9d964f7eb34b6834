"""Tables of named columns, of memory and of files of arrays; their rows cut into runs whose times
rise."""

import dataclasses
import shlex
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import narwhals.stable.v2 as nw
import numpy as np

from gfnn_jax.data.blocks import damage
from gfnn_jax.data.roles import is_run, is_time
from gfnn_jax.errors import InputError

ARRAYS = (".npz", ".npy", ".mat")  # ends of the names of files of arrays
_MOST_MOVED = 3  # rows in a row that are taken to be out of place; more are a run


@dataclasses.dataclass(frozen=True)
class Table:
    """Columns of equal length by name: (T,) float64, of runs (T,) text.

    units: by column name, as a header or a row of units gave them. text: columns of words, empty
    where these were not read. notes: what reading had to decide. locate: says where a row stands,
    for a message. time: the column of times, where its name does not tell. step: the time between
    rows in s that the file gives beside its columns, and what it calls it.
    """

    columns: dict[str, np.ndarray]
    units: dict[str, str] = dataclasses.field(default_factory=dict)
    source: str = "the table"
    text: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    notes: tuple[str, ...] = ()
    locate: Callable[[int], str] = lambda row: f"row {row + 1}"
    time: str | None = None
    step: tuple[str, float] | None = None

    @property
    def times(self) -> list[str]:
        """Names of the columns of times, the one that is taken first."""
        named = [name for name in self.columns if is_time(name) and name != self.time]
        return named if self.time is None else [self.time, *named]


class Rows(NamedTuple):
    """Rows to keep: between two times, in the unit of a file, every so many of them."""

    start: float
    stop: float
    every: int

    def kept(
        self, columns: Mapping[str, np.ndarray], times: Sequence[str], begin: int = 0
    ) -> np.ndarray:
        """Mask (n,) of the rows of columns (n,) to keep, by the first of these columns of times, if
        any. ``begin``: rows of the table before these."""
        keep = (begin + np.arange(len(next(iter(columns.values()), ())))) % self.every == 0
        for name in times[:1]:
            keep &= ~((columns[name] < self.start) | (columns[name] > self.stop))
        return keep


def rows_of(table: Table, rows: Rows) -> Table:
    """The table with these rows alone."""
    return _kept(table, rows.kept(table.columns, table.times))


def _kept(table: Table, keep: np.ndarray) -> Table:
    """The table with the rows of a mask (n,) alone, which stand where they stood."""
    columns = {n: v[keep] for n, v in table.columns.items()}
    text = {n: v[keep] if len(v) else v for n, v in table.text.items()}
    places = np.flatnonzero(keep)
    return dataclasses.replace(
        table, columns=columns, text=text, locate=lambda row: table.locate(int(places[row]))
    )


def with_events(table: Table, names: Collection[str]) -> Table:
    """The table with a row at each time that stands in columns of events, by ``names``, or in rows
    that a column of words gives such a name. The column of the name is 0 there; elsewhere it is
    missing, and all others are there.

    Raises InputError where the table has several runs.
    """
    time = next(iter(table.times), "t")
    own = table.columns.get(time, np.zeros(0))
    events = {n: table.columns[n] for n in names if n in table.columns}
    for words in table.text.values():
        events |= {n: own[words == n] for n in names if n in words}
    events = {n: times[np.isfinite(times)] for n, times in events.items()}
    if not events:
        return table
    if _run_column(table) is not None:
        raise InputError(f"{table.source}: events of several runs: give a table for each run")
    others = {n: x for n, x in table.columns.items() if n not in (*events, time)}
    every, place = np.unique(np.concatenate([own, *events.values()]), return_inverse=True)
    columns = {time: every} | {n: np.full(len(every), np.nan) for n in (*others, *events)}
    for name, values in others.items():
        columns[name][place[: len(own)]] = values
    for name, times in events.items():
        columns[name][np.isin(every, times)] = 0.0
    return dataclasses.replace(table, columns=columns, text={})


def from_memory(table: Any) -> Table:
    """The columns of a dict of arrays or of a table: of pandas, polars, pyarrow, xarray.

    Arrays of a dict are (T,), or (T, k) for the columns name1 … namek.
    Raises InputError where lengths differ or a column holds no numbers.
    """
    if isinstance(table, Table):
        return table
    if hasattr(table, "to_dataframe"):  # of xarray
        table = table.to_dataframe().reset_index()
    frame = nw.from_native(table, eager_only=True, pass_through=True)
    if isinstance(table, Mapping):
        try:
            named = {str(name): np.asarray(values) for name, values in table.items()}
        except ValueError as error:  # rows of different lengths
            raise InputError(f"expected columns of numbers: {error}") from error
    elif isinstance(table, np.ndarray) and table.dtype.names:
        named = {name: table[name] for name in table.dtype.names}
    elif isinstance(frame, nw.DataFrame):
        named = {str(name): frame[name].to_numpy() for name in frame.columns}
    else:
        raise InputError(f"expected a DataFrame, or arrays by name, got {type(table).__name__}")
    found: dict[str, np.ndarray] = {}
    text: dict[str, np.ndarray] = {}
    for name, values in named.items():
        if values.ndim not in (1, 2):
            raise InputError(f"{name}: expected an array (T,) or (T, k), got shape {values.shape}")
        if is_run(name):
            found[name] = values.astype(str)
            continue
        if values.dtype.kind == "M":  # moments
            values = (values - values[:1]) / np.timedelta64(1, "s")
        if values.dtype.kind == "c":
            raise InputError(f"{name}: expected real numbers, got {values.dtype}")
        try:
            numbers = values.astype(np.float64)
        except (TypeError, ValueError):
            text[name] = values.astype(str)
            continue
        names = [f"{name}{i + 1}" for i in range(numbers.shape[-1])] if numbers.ndim > 1 else [name]
        found.update(zip(names, np.atleast_2d(numbers.T), strict=True))
    lengths = {name: len(values) for name, values in found.items()}
    if len(set(lengths.values())) > 1:
        shown = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise InputError(f"expected columns of one length, got {shown}")
    return Table(found, text=text)


def from_arrays(path: Path, columns: Sequence[str]) -> Table:
    """The columns of an ``.npz`` or ``.mat`` of named arrays, or of an ``.npy`` array (T, k), whose
    ``columns`` are then named; a structured array names its own."""
    if path.suffix.lower() == ".mat":
        return _of_matlab(path)
    with damage(path, "the array"):
        loaded = np.load(path, allow_pickle=False)
        if not isinstance(loaded, np.ndarray):
            with loaded as archive:
                loaded = dict(archive.items())
    if isinstance(loaded, np.ndarray) and not loaded.dtype.names:
        if loaded.ndim != 2 or loaded.shape[1] != len(columns):
            wanted = "--columns with the names of the columns of an array (T, k)"
            got = f"{len(columns)} names for shape {loaded.shape}"
            raise InputError(f"{path}: expected {wanted}, got {got}")
        loaded = dict(zip(columns, loaded.T, strict=True))
    return dataclasses.replace(from_memory(loaded), source=str(path))


def _of_matlab(path: Path) -> Table:
    """The arrays of a MATLAB file that have its most frequent length, those in structures too."""
    from scipy.io import loadmat  # loaded when first needed

    with damage(path, "the file", TypeError):
        try:
            loaded = loadmat(path, simplify_cells=True)
        except NotImplementedError:
            mended = f"write it by save('{path.name}', …, '-v7')"
            raise InputError(f"{path}: is of MATLAB 7.3: {mended}") from None
    arrays = dict(_numeric(loaded))
    lengths = [max(x.shape) for x in arrays.values() if x.size > 1]
    if not lengths:
        raise InputError(f"{path}: expected arrays of numbers, found {', '.join(loaded)[:80]}")
    length = max(set(lengths), key=lambda n: (lengths.count(n), n))
    kept = {n: x if x.shape[0] == length else x.T for n, x in arrays.items() if length in x.shape}
    others = ", ".join(f"{n} {x.shape}" for n, x in arrays.items() if n not in kept)
    notes = (f"arrays of another length than {length} are put aside: {others}",) if others else ()
    columns = {n: x[:, 0] if x.ndim == 2 and x.shape[1] == 1 else x for n, x in kept.items()}
    return dataclasses.replace(from_memory(columns), source=str(path), notes=notes)


def _numeric(value: Mapping[str, Any]) -> Iterator[tuple[str, np.ndarray]]:
    """Arrays of numbers in a dict of dicts, by their own names."""
    for name, inner in value.items():
        if isinstance(inner, dict):
            yield from _numeric(inner)
        elif not name.startswith("__") and isinstance(inner, (np.ndarray, float, int)):
            array = np.atleast_1d(inner)
            if array.dtype.kind in "fiub" and array.ndim <= 2:
                yield name, array


def runs_of(
    tables: list[Table], names: list[str], second: float, dt: float | None
) -> dict[str, tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Run -> times (n,) in seconds and columns (n,) by name, in order of appearance."""
    found: dict[str, tuple[np.ndarray, dict[str, np.ndarray]]] = {}
    stems = [Path(table.source).stem for table in tables]
    for table, stem in zip(tables, stems, strict=True):
        table = _joined(table) if dt is None else table
        length = len(next(iter(table.columns.values()), ()))
        if length == 0:
            raise InputError(f"{table.source}: holds no rows")
        parts = _parts(table, length, dt, second)
        for inner, (rows, times) in parts.items():
            name = inner
            if len(tables) > 1 and len(set(stems)) == len(stems):
                name = stem if len(parts) == 1 and not _run_column(table) else f"{stem}/{inner}"
            elif name in found:
                name = str(len(found))
            nothing = np.full(len(rows), np.nan)
            values = {n: table.columns[n][rows] if n in table.columns else nothing for n in names}
            for n, column in values.items():
                if np.isinf(column).any():
                    row = int(rows[np.argmax(np.isinf(column))])
                    raise InputError(f"{table.source}: {table.locate(row)}, {n}: infinite")
            found[name] = (times, values)
    return found


def _joined(table: Table) -> Table:
    """The table with rows of one time as one row, where no column has two values then: as of
    sensors with clocks of their own, which meet."""
    same = np.flatnonzero(np.diff(table.columns[table.times[0]]) == 0) + 1 if table.times else ()
    if not len(same):
        return table
    columns = {name: values.copy() for name, values in table.columns.items()}
    times, run = columns[table.times[0]], columns.get(_run_column(table) or "")
    kept, cells = np.full(len(times), True), [n for n in columns if not (is_time(n) or is_run(n))]
    for row in same:
        first = row - 1 - int(np.argmax(kept[row - 1 :: -1]))
        both = any(np.isfinite(columns[n][[first, row]]).all() for n in cells)
        if both or (run is not None and run[first] != run[row]):
            continue  # refused where its runs are known
        for n in cells:
            columns[n][first] = columns[n][row if np.isnan(columns[n][first]) else first]
        kept[row] = False
    return _kept(dataclasses.replace(table, columns=columns), kept)


def _run_column(table: Table) -> str | None:
    return next((name for name in table.columns if is_run(name)), None)


def _parts(
    table: Table, length: int, dt: float | None, second: float
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Run -> its rows (n,) and their times (n,) in seconds."""
    column = _run_column(table)
    time = next(iter(table.times), None)
    if time is None and dt is None:
        ways = {n: np.diff(x) for n, x in table.columns.items() if n != column}
        rising = [n for n, way in ways.items() if np.all(way > 0) and not np.all(way == 1)]
        named = f"--time {shlex.quote(rising[0])} if that is it, or " if rising else ""
        step = f" {table.step[1]:g}, its {table.step[0]}" if table.step else ""
        found = f"expected a column t or time, found {', '.join(table.columns)}"
        raise InputError(f"{table.source}: {found}; give {named}the time between rows: --dt{step}")
    if column is not None:
        own = table.columns[column]
        groups = {str(run): np.flatnonzero(own == run) for run in dict.fromkeys(own.tolist())}
    elif dt is None:
        assert time is not None
        falls = _falls(table.columns[time])
        _check_places(table, time, falls)
        groups = {str(i): rows for i, rows in enumerate(np.split(np.arange(length), falls))}
    else:
        groups = {"0": np.arange(length)}
    if dt is not None:
        return {run: (rows, dt * np.arange(len(rows))) for run, rows in groups.items()}
    assert time is not None
    for rows in groups.values():
        _check_times(table, time, rows)
    return {run: (rows, table.columns[time][rows] * second) for run, rows in groups.items()}


def restarts(tables: list[Table], runs: Mapping[str, Any]) -> list[str]:
    """A note where times that fall have made runs."""
    if len(runs) == len(tables) or any(_run_column(table) for table in tables):
        return []
    table = next(t for t in tables if len(_falls(t.columns[t.times[0]])))
    place = table.locate(int(_falls(table.columns[table.times[0]])[0]))
    count = len(runs) - len(tables)
    often = "once, at" if count == 1 else f"{count} times, first at"
    return [f"the times run back {often} {place}, and a run begins there"]


def second_times(tables: list[Table]) -> list[str]:
    """A note where a table has more columns of times than the one that is taken."""
    found = dict.fromkeys((t.times[0], n) for t in tables for n in t.times[1:])
    return [f"{other} is not used, for the times are those of {taken}" for taken, other in found]


def _falls(times: np.ndarray) -> np.ndarray:
    """The rows whose time is before that of the row above."""
    return np.flatnonzero(np.diff(times) < 0) + 1


def _check_places(table: Table, name: str, falls: np.ndarray) -> None:
    """Raises InputError at a row out of place: without up to `_MOST_MOVED` rows the times go on
    rising, and do not begin again from where they began."""
    times, begin = table.columns[name], 0
    for row in falls:
        before, behind = times[begin:row], times[row : row + _MOST_MOVED + 1]
        goes_on = before[-_MOST_MOVED - 1 :].min() < times[row] or behind.max() > before[-1]
        if before[0] < times[row] and goes_on:
            raise InputError(
                f"{table.source}: {table.locate(int(row))}: {name} = {times[row]:.9g} runs back "
                f"from {times[row - 1]:.9g} and goes on from there: sort the rows, or number the "
                "runs in a column run"
            )
        begin = int(row)


def _check_times(table: Table, name: str, rows: np.ndarray) -> None:
    """Raises InputError where the times of a run are missing or do not rise."""
    times = table.columns[name][rows]
    if not np.isfinite(times).all():
        row = int(rows[np.argmin(np.isfinite(times))])
        raise InputError(f"{table.source}: {table.locate(row)}: {name} is missing")
    falls = np.flatnonzero(np.diff(times) <= 0)
    if len(falls):
        row, at = int(rows[falls[0] + 1]), int(falls[0])
        same = times[at + 1] == times[at]
        what = "is the same as" if same else "runs back from"
        remedy = "keep one row of each time" if same else "number the runs in a column run"
        raise InputError(
            f"{table.source}: {table.locate(row)}: {name} = {times[at + 1]:.9g} {what} "
            f"{times[at]:.9g} before it ({len(falls)} such rows): {remedy}"
        )
