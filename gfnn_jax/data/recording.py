"""Recordings: what sensors gave of a motion, as named columns with roles, run by run.

    recording = gfnn.read("swing.csv", positions=["theta"], velocities=["omega"])
    recording.values("theta", run="0")      # (n,) radians, NaN where missing
    recording.slice(2.0, 5.0)               # by time, both ends included

Times may be uneven and have gaps, runs may differ in length, values may be missing. Nothing here
needs JAX.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gfnn_jax.data.roles import ROLES, by_name, is_angle, is_run, is_time, plain
from gfnn_jax.data.tables import Table, from_arrays, from_memory, from_text
from gfnn_jax.errors import InputError

if TYPE_CHECKING:
    from gfnn_jax.data.recording_summary import RecordingSummary

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
_TURN = 2 * np.pi
Names = Sequence[str] | str | None


@dataclasses.dataclass(frozen=True, init=False, eq=False, repr=False)
class Recording:
    """Runs of a motion: uneven times, named columns with roles, gaps, missing values.

    runs:       names in order of appearance, as the file has them; "0" where it names none.
    positions, velocities, momenta, inputs, parameters: names of columns. The i-th velocity and the
                i-th momentum belong to the i-th position.
    angles:     positions of period 2π, in radians, wrapped or not.
    std:        name -> standard deviation σ of the column's noise, or None where it was not given;
                in radians where the column is.
    units:      name -> unit, as the file gives it.
    factors:    name -> value here ÷ number in the file: π/180 of a column in degrees, else 1.
    time_unit:  of the file; `times` are in seconds.
    offsets, scales: columns that a sensor shows with an unknown offset, or scale, to be fitted.
    ignored:    columns without a role.
    angles_given: whether the angles were told, not read off names and units.
    notes:      what reading had to decide, a line each.
    source:     the files.
    """

    runs: tuple[str, ...]
    positions: tuple[str, ...]
    velocities: tuple[str, ...]
    momenta: tuple[str, ...]
    inputs: tuple[str, ...]
    parameters: tuple[str, ...]
    angles: tuple[str, ...]
    std: dict[str, float | None]
    units: dict[str, str]
    factors: dict[str, float]
    time_unit: str
    offsets: tuple[str, ...]
    scales: tuple[str, ...]
    ignored: tuple[str, ...]
    angles_given: bool
    notes: tuple[str, ...]
    source: str
    _times: dict[str, np.ndarray]
    _values: dict[str, dict[str, np.ndarray]]  # run -> name -> (n,)

    def __init__(
        self, table: Any, *, positions: Names = None, velocities: Names = None,
        momenta: Names = None, inputs: Names = None, parameters: Names = None,
        angles: Names = None, degrees: Names = None, time_unit: str | None = None,
        std: Mapping[str, float] | None = None, columns: Names = None, dt: float | None = None,
        offset: Names = None, scale: Names = None,
    ):  # fmt: skip
        """The recording of a table in memory; of files: `read`.

        table:   a DataFrame, a dict of arrays (T,), or a list of these, one run each (or several,
                 told apart by a column run, trial or sequence). A column t or time holds the times,
                 which rise in a run; without a column of runs a new run begins where they fall.
        positions … parameters: names of columns. Where any is given, columns without a role are
                 ignored; where none is, the names of the columns decide.
        angles:  positions of period 2π; without it those whose name or unit says so.
        degrees: columns in degrees, or degrees per second; a position among them is an angle.
        time_unit: s (the default), ms, us, ns, min or h; a header's own unit serves too.
        std:     σ of columns, in their own unit.
        columns: those to take; all others are as if they were not there.
        dt:      seconds between rows, in place of a column of times.
        offset, scale: columns that a sensor shows shifted, or scaled, by an unknown amount.
        Raises InputError where names, times or values do not fit.
        """
        given = {
            "positions": _names(positions), "velocities": _names(velocities),
            "momenta": _names(momenta), "inputs": _names(inputs),
            "parameters": _names(parameters),
        }  # fmt: skip
        tables = [from_memory(t) for t in (table if isinstance(table, (list, tuple)) else [table])]
        if not tables:
            raise InputError("expected at least one table, got none")
        tables = [_selected(t, _names(columns)) for t in tables]
        source = ", ".join(dict.fromkeys(t.source for t in tables))
        names = list(dict.fromkeys(name for t in tables for name in t.columns))
        units = {name: unit for t in reversed(tables) for name, unit in t.units.items()}
        numbers = [name for name in names if not is_run(name) and not is_time(name)]
        roles = _roles(source, numbers, given, tables)
        with_role = [name for role in ROLES for name in roles[role]]
        angular = _angles(source, roles, _names(angles), _names(degrees), angles is None, units)
        factors = {
            name: math.pi / 180 if name in angular[1] else 1.0 for name in numbers
        }  # fmt: skip
        unit = _time_unit(source, names, units, time_unit)
        runs = _runs(tables, numbers, factors, SECONDS[unit], dt)
        empty = [n for n in with_role if not any(np.isfinite(v[n]).any() for _, v in runs.values())]
        if empty:
            raise InputError(f"{source}: no value in column {', '.join(empty)}")
        std = dict(std or {})
        for what, wanted in (("std", std), ("offset", _names(offset)), ("scale", _names(scale))):
            _check_known(source, what, wanted, with_role)
        bad = {n: s for n, s in std.items() if not (math.isfinite(s) and s >= 0)}
        if bad:
            raise InputError(f"expected a finite σ, 0 or above, got std = {bad}")
        fields = {
            **roles,
            "runs": tuple(runs),
            "angles": angular[0],
            "std": {n: std[n] * factors[n] if n in std else None for n in with_role},
            "units": {n: u for n, u in units.items() if n in numbers},
            "factors": factors,
            "time_unit": unit,
            "offsets": _names(offset),
            "scales": _names(scale),
            "ignored": tuple(n for n in numbers if n not in with_role)
            + tuple(dict.fromkeys(n for t in tables for n in t.text)),
            "angles_given": angles is not None or degrees is not None,
            "notes": (*(n for t in tables for n in t.notes), *_restarts(tables, runs)),
            "source": source,
            "_times": {run: times for run, (times, _) in runs.items()},
            "_values": {run: values for run, (_, values) in runs.items()},
        }
        for name, value in fields.items():
            object.__setattr__(self, name, value)
        for run in self.runs:
            for array in (self._times[run], *self._values[run].values()):
                array.flags.writeable = False

    def __len__(self) -> int:
        """The number of samples of all runs."""
        return sum(len(times) for times in self._times.values())

    def __repr__(self) -> str:
        roles = ", ".join(f"{r} {', '.join(getattr(self, r))}" for r in ROLES if getattr(self, r))
        return f"Recording({self.source}: {len(self.runs)} runs, {len(self)} samples; {roles})"

    @property
    def dim(self) -> int:
        """Degrees of freedom: the number of positions, or of velocities where there are none."""
        return len(self.positions) or len(self.velocities) or len(self.momenta)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns that have a role, role by role."""
        return tuple(name for role in ROLES for name in getattr(self, role))

    def times(self, run: str | float) -> np.ndarray:
        """Times (n,) of a run in seconds, rising."""
        return self._times[self._named(run)]

    def values(self, name: str, run: str | float) -> np.ndarray:
        """A column (n,) in a run, NaN where missing; angles in radians, wrapped as they came."""
        found = self._values[self._named(run)]
        if name not in found:
            raise InputError(f"{self.source}: no column {name}, found {', '.join(found)}")
        return found[name]

    def unwrapped(self, name: str, run: str | float) -> np.ndarray:
        """A column (n,) in a run, an angle lifted so that it moves by less than half a turn between
        neighbours. Values that range over more than one turn are such a lift already."""
        values = self.values(name, run)
        if name not in self.angles:
            return values
        known = np.isfinite(values)
        if not known.any() or np.ptp(values[known]) > _TURN * (1 + 1e-3):
            return values
        lifted = values.copy()
        lifted[known] = np.unwrap(values[known])
        return lifted

    def array(self, role: str, run: str | float) -> np.ndarray:
        """The columns of a role (n, k) in a run, as `values`. Raises InputError at no such role."""
        if role not in ROLES:
            raise InputError(f"expected a role among {', '.join(ROLES)}, got {role!r}")
        names = getattr(self, role)
        columns = [self.values(name, run) for name in names]
        return np.stack(columns, axis=1) if columns else np.empty((len(self.times(run)), 0))

    def slice(
        self, start: float = -np.inf, stop: float = np.inf, run: str | float | None = None
    ) -> Recording:
        """The samples from time ``start`` to ``stop`` (s), both included, of one run or of all.

        run: its name, as text or as a number. Runs without such a sample are left out.
        Raises InputError where nothing is left.
        """
        runs = self.runs if run is None else (self._named(run),)
        kept = {r: (self._times[r] >= start) & (self._times[r] <= stop) for r in runs}
        kept = {r: keep for r, keep in kept.items() if keep.any()}
        if not kept:
            raise InputError(f"{self.source}: no sample from {start:g} s to {stop:g} s")
        part = object.__new__(Recording)
        for field in dataclasses.fields(self):
            object.__setattr__(part, field.name, getattr(self, field.name))
        object.__setattr__(part, "runs", tuple(kept))
        object.__setattr__(part, "_times", {r: self._times[r][k] for r, k in kept.items()})
        values = {r: {n: v[k] for n, v in self._values[r].items()} for r, k in kept.items()}
        object.__setattr__(part, "_values", values)
        return part

    def summary(self) -> RecordingSummary:
        """What the samples tell before anything is fitted: noise, frequencies, friction, mistakes.

        Prints as one screen; `RecordingSummary.as_json` gives plain data.
        """
        from gfnn_jax.data.recording_summary import summarise

        return summarise(self)

    def _repr_html_(self) -> str:
        return self.summary()._repr_html_()

    def _named(self, run: str | float) -> str:
        """The name of a run, given as text or as a number."""
        text = str(run)
        for name in self.runs:
            if name == text or _number(name) == _number(text) is not None:
                return name
        raise InputError(f"{self.source}: no run {run}, found {', '.join(self.runs[:12])}")


def read(
    paths: str | Path | Sequence[str | Path], *, start: float = -np.inf, stop: float = np.inf,
    every: int = 1, columns: Names = None, **options: Any,
) -> Recording:  # fmt: skip
    """The recording that a file holds, or several files, one run each or more.

    paths:    ``.csv`` and other text (separated by commas, semicolons, tabs or blanks; decimal
              points or commas; lines of comments; a line of units below the names), ``.npz`` of
              named arrays, ``.npy``.
    columns:  names of those to read; of all, in order, where a file names none.
    start, stop, every: rows to keep: between these times (in the file's unit), every so many.
    options:  positions, velocities, momenta, inputs, parameters, angles, degrees, time_unit, std,
              dt, offset, scale: as of `Recording`.
    Raises InputError, one line with the file and the line, where a file cannot be used.
    """
    listed = [paths] if isinstance(paths, (str, Path)) else list(paths)
    chosen = _names(columns)
    tables = []
    for path in map(Path, listed):
        if not path.is_file():
            raise InputError(f"{path}: {'is not a file' if path.exists() else 'no such file'}")
        if path.suffix.lower() in (".npz", ".npy"):
            tables.append(_rows_of(from_arrays(path, chosen), start, stop, every))
        else:
            tables.append(from_text(path, chosen, start=start, stop=stop, every=every))
    return Recording(tables, columns=columns, **options)


def _rows_of(table: Table, start: float, stop: float, every: int) -> Table:
    length = len(next(iter(table.columns.values()), ()))
    keep = np.arange(length) % every == 0
    for name, values in table.columns.items():
        if is_time(name):
            keep &= (values >= start) & (values <= stop)
    return dataclasses.replace(table, columns={n: v[keep] for n, v in table.columns.items()})


def _names(given: Names) -> tuple[str, ...]:
    return (given,) if isinstance(given, str) else tuple(given or ())


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _selected(table: Table, columns: tuple[str, ...]) -> Table:
    if not columns:
        return table
    missing = [name for name in columns if name not in table.columns and name not in table.text]
    if missing:
        raise InputError(
            f"{table.source}: no column {', '.join(missing)}, found {', '.join(table.columns)}"
        )
    return dataclasses.replace(table, columns={n: table.columns[n] for n in columns})


def _roles(
    source: str, names: list[str], given: dict[str, tuple[str, ...]], tables: list[Table]
) -> dict[str, tuple[str, ...]]:
    """The columns of each role: those given, or by name; constants of runs are parameters."""
    wanted = [name for of_role in given.values() for name in of_role]
    if wanted:
        for role, of_role in given.items():
            _check_known(source, role, of_role, names)
        twice = [name for name in dict.fromkeys(wanted) if wanted.count(name) > 1]
        if twice:
            raise InputError(
                f"{source}: expected one role of each column, got {', '.join(twice)} twice"
            )
        return given
    roles = by_name(names)
    if not any(roles[role] for role in ("positions", "velocities", "momenta")):
        raise InputError(
            f"{source}: the names {', '.join(names)} do not tell what was measured: say "
            "--positions, --velocities, --inputs (positions=, velocities=, inputs=)"
        )
    for role in ("velocities", "momenta"):
        if len(roles[role]) > len(roles["positions"]) > 0:
            raise InputError(
                f"{source}: {role} by their names {', '.join(roles[role])}, positions "
                f"{', '.join(roles['positions'])}: say which, --positions and --{role}"
            )
    return roles


def _angles(
    source: str, roles: Mapping[str, tuple[str, ...]], given: tuple[str, ...],
    degrees: tuple[str, ...], by_names: bool, units: Mapping[str, str],
) -> tuple[tuple[str, ...], set[str]]:  # fmt: skip
    """(angles in the order of the positions, columns in degrees)."""
    known = (*roles["positions"], *roles["velocities"])
    _check_known(source, "angles", given, roles["positions"])
    _check_known(source, "degrees", degrees, known)
    in_degrees = set(degrees) | {n for n in known if _unit(units, n).startswith(("deg", "°"))}
    angles = set(given) | {n for n in roles["positions"] if n in in_degrees}
    if by_names:
        told = ("deg", "°", "rad")
        angles |= {
            n for n in roles["positions"]
            if (is_angle(n) and not _unit(units, n)) or _unit(units, n).startswith(told)
        }  # fmt: skip
    return tuple(n for n in roles["positions"] if n in angles), in_degrees


def _unit(units: Mapping[str, str], name: str) -> str:
    return units.get(name, "").strip().lower()


def _check_known(source: str, what: str, wanted: Any, known: Sequence[str]) -> None:
    missing = [name for name in wanted if name not in known]
    if missing:
        raise InputError(
            f"{source}: {what}: no column {', '.join(map(str, missing))} among "
            f"{', '.join(known) or 'none'}"
        )


def _time_unit(source: str, names: list[str], units: Mapping[str, str], given: str | None) -> str:
    """The unit of the times: the given one, the header's, that at the end of their name, or s."""
    if given is not None:
        if given not in SECONDS:
            raise InputError(f"expected a time unit among {', '.join(SECONDS)}, got {given!r}")
        return given
    for name in names:
        if is_time(name):
            end = plain(name).rpartition("_")[2]
            for unit in (_unit(units, name), end):
                unit = unit.removesuffix("ec") if unit in ("sec", "msec", "usec") else unit
                if unit in SECONDS:
                    return unit
            if _unit(units, name) and _unit(units, name) not in ("seconds", "second"):
                raise InputError(
                    f"{source}: {name}: unit {units[name]!r} is not known: say --time-unit "
                    f"{'|'.join(SECONDS)}"
                )
    return "s"


def _runs(
    tables: list[Table], names: list[str], factors: Mapping[str, float], second: float,
    dt: float | None,
) -> dict[str, tuple[np.ndarray, dict[str, np.ndarray]]]:  # fmt: skip
    """Run -> times (n,) in seconds and columns (n,) by name, in order of appearance."""
    found: dict[str, tuple[np.ndarray, dict[str, np.ndarray]]] = {}
    stems = [Path(table.source).stem for table in tables]
    for table, stem in zip(tables, stems, strict=True):
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
            values = {
                n: table.columns[n][rows] * factors[n] if n in table.columns else nothing
                for n in names
            }
            _check_finite(table, rows, values)
            found[name] = (times, values)
    return found


def _run_column(table: Table) -> str | None:
    return next((name for name in table.columns if is_run(name)), None)


def _parts(
    table: Table, length: int, dt: float | None, second: float
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Run -> its rows (n,) and their times (n,) in seconds."""
    column = _run_column(table)
    time = next((name for name in table.columns if is_time(name)), None)
    if time is None and dt is None:
        raise InputError(
            f"{table.source}: expected a column t or time, found {', '.join(table.columns)}; give "
            "the time between rows: --dt (dt=)"
        )
    if column is not None:
        labels, first, inverse = np.unique(
            table.columns[column], return_index=True, return_inverse=True
        )
        groups = {str(labels[i]): np.flatnonzero(inverse == i) for i in np.argsort(first)}
    elif dt is None:
        assert time is not None
        falls = np.flatnonzero(np.diff(table.columns[time]) < 0) + 1
        groups = {str(i): rows for i, rows in enumerate(np.split(np.arange(length), falls))}
    else:
        groups = {"0": np.arange(length)}
    if dt is not None:
        return {run: (rows, dt * np.arange(len(rows))) for run, rows in groups.items()}
    assert time is not None
    parts = {}
    for run, rows in groups.items():
        times = table.columns[time][rows]
        _check_times(table, time, rows, times)
        parts[run] = (rows, times * second)
    return parts


def _restarts(tables: list[Table], runs: Mapping[str, Any]) -> list[str]:
    """A note where times that fall have made runs."""
    if len(runs) == len(tables) or any(_run_column(table) for table in tables):
        return []
    return [f"the times run back {len(runs) - len(tables)} times, and a run begins there"]


def _check_times(table: Table, name: str, rows: np.ndarray, times: np.ndarray) -> None:
    """Raises InputError where the times of a run are missing or do not rise."""
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


def _check_finite(table: Table, rows: np.ndarray, values: Mapping[str, np.ndarray]) -> None:
    for name, column in values.items():
        if np.isinf(column).any():
            row = int(rows[np.argmax(np.isinf(column))])
            raise InputError(f"{table.source}: {table.locate(row)}, {name}: infinite")
