"""Recordings: what sensors gave of a motion, as named columns with roles, run by run.

    recording = gfnn.read("swing.csv", positions=["theta"], velocities=["omega"])
    recording.values("theta", run="0")      # (n,) radians, NaN where missing
    recording.slice(2.0, 5.0)               # by time, both ends included

Times may be uneven and have gaps, runs may differ in length, values may be missing. Nothing here
needs JAX.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, Unpack

import numpy as np

from gfnn_jax.data.columns import (
    SECONDS,
    Names,
    angles_of,
    check_known,
    check_sigmas,
    clock_of,
    crossings_in,
    listed,
    resolved,
    roles_of,
    time_unit_of,
    typical,
    with_crossings,
    with_sigmas,
)
from gfnn_jax.data.roles import (
    ROLES,
    coordinates_in,
    is_run,
    is_wave,
    role_of,
    symbols,
    unit_in,
    wave,
    words_in,
)
from gfnn_jax.data.tables import (
    ARRAYS,
    Rows,
    Table,
    from_arrays,
    from_memory,
    restarts,
    rows_of,
    runs_of,
    second_times,
    with_events,
)
from gfnn_jax.data.text_files import from_text
from gfnn_jax.errors import InputError, unexpected
from gfnn_jax.signals.filters import Options as Filters
from gfnn_jax.signals.filters import turned
from gfnn_jax.signals.wrong_values import TURN

if TYPE_CHECKING:
    from gfnn_jax.data.recording_summary import RecordingSummary


class ReadOptions(TypedDict, total=False):
    """Keywords of `Recording`, and of `read` beside the rows to keep.

    positions … sensors: names of columns. Where any is given, columns without a role are ignored;
             where none is, the names of the columns decide.
    angles:  positions of period 2π; without it those whose name or unit says so; () for none.
    degrees: columns in degrees, or degrees per second; a position among them is an angle.
    time:    the column of times, where its name does not tell.
    time_unit: s, ms, us, ns, min, h, d or year; by default the header's own, else s.
    std:     σ of columns, in their own unit: a number, one for each value (T,) of a table, or the
             name of a column that holds them; of column x also a column x_std.
    columns: those to take beside times and runs; all others are as if they were not there. Of a
             file that names none, all in order.
    dt:      seconds between rows, in place of a column of times.
    offset, scale: columns that a sensor shows shifted, or scaled, by an unknown amount.
    coordinates: what moves, where it is not the positions: ``observe`` then says how columns show
             it; by default those that its formulas name (theta, or omega, which is its velocity).
    observe: column -> text such as "x0 + R*sin(theta + tilt)", or a function of arguments with
             these names: coordinates, velocities, and parameters to be fitted.
    events:  column -> expression h, as {"gate": "theta"} of a photogate: the column holds the times
             at which the motion crosses h = 0, and ``std`` is the noise of these times in s. It is
             short for ``observe={"gate": "crossing(theta)"}``. Several gates are several columns,
             or a column of their names beside the times.
    guess:   where parameters of ``observe`` and ``events`` start.
    """

    positions: Names
    velocities: Names
    momenta: Names
    inputs: Names
    parameters: Names
    sensors: Names
    angles: Names
    degrees: Names
    columns: Names
    time: str | None
    time_unit: str | None
    std: Mapping[str, Any] | None
    dt: float | None
    offset: Names
    scale: Names
    coordinates: Names
    observe: Mapping[str, Any] | None
    events: Mapping[str, str] | None
    guess: Mapping[str, float] | None


@dataclasses.dataclass(frozen=True, init=False, eq=False, repr=False)
class Recording:
    """Runs of a motion: uneven times, named columns with roles, gaps, missing values.

    runs:       names in order of appearance, as the file has them; "0" where it names none.
    positions, velocities, momenta, inputs, parameters: names of columns. The i-th velocity and the
                i-th momentum belong to the i-th position.
    angles:     positions of period 2π, in radians, wrapped or not.
    std:        name -> standard deviation σ of the column's noise, the median where it was given
                for each value (`sigma`), or None where it was not; in radians where the column is.
    units:      name -> unit, as the file gives it, in its header or at the end of the name; of all
                columns: `unit`.
    factors:    name -> value here ÷ number in the file: π/180 of a column in degrees, 2π of one in
                turns, else 1.
    time_unit:  of the file; `times` are in seconds, those of d or year as they are (`clock`).
                time_unit_given: whether it was told, here or by the file, not taken to be s.
    coordinates: what moves, the positions unless other names were given.
    observe:    column -> what its sensor shows: text in coordinates, velocities and parameters that
                are fitted, or a function of these (`maps.observation`).
    guess:      name -> where a parameter of ``observe`` starts.
    offsets, scales: columns that a sensor shows with an unknown offset, or scale, to be fitted.
    sensors:    columns that only ``observe`` explains.
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
    sensors: tuple[str, ...]
    coordinates: tuple[str, ...]
    angles: tuple[str, ...]
    std: dict[str, float | None]
    units: dict[str, str]
    factors: dict[str, float]
    time_unit: str
    time_unit_given: bool
    observe: dict[str, Any]
    guess: dict[str, float]
    offsets: tuple[str, ...]
    scales: tuple[str, ...]
    ignored: tuple[str, ...]
    angles_given: bool
    notes: tuple[str, ...]
    source: str
    _times: dict[str, np.ndarray]
    _values: dict[str, dict[str, np.ndarray]]  # run -> name -> (n,)
    _sigmas: dict[str, str]  # name -> the column of σ of its values

    def __init__(self, table: Any, **options: Unpack[ReadOptions]):
        """The recording of a table in memory; of files: `read`.

        table: a DataFrame, a dict of arrays (T,), or a list of these, one run each (or several,
        told apart by a column run, trial or sequence). A column t or time holds the times, which
        rise in a run; without a column of runs a new run begins where they fall. options:
        `ReadOptions`. Raises InputError where names, times or values do not fit."""
        for name in set(options) - set(ReadOptions.__annotations__):
            raise TypeError(unexpected("Recording", name, [*ReadOptions.__annotations__]))
        by_name: dict[str, Any] = dict(options)
        tables = [from_memory(t) for t in (table if isinstance(table, (list, tuple)) else [table])]
        if not tables:
            raise InputError("expected at least one table, got none")
        every = list(dict.fromkeys(name for t in tables for name in (*t.columns, *t.text)))
        of_columns = (*ROLES, "angles", "degrees", "columns", "offset", "scale")
        names_of = {option: resolved(by_name.get(option), every) for option in of_columns}
        given = {role: names_of[role] for role in ROLES}
        angles = None if options.get("angles") is None else names_of["angles"]
        columns, dt, time = names_of["columns"], options.get("dt"), options.get("time")
        std = options.get("std") or {}
        observe = with_crossings(options.get("observe") or {}, options.get("events") or {})
        tables = [_selected(_timed(t, time), columns) for t in tables]
        tables = [with_events(t, crossings_in(observe)) for t in tables]
        tables, sigmas = with_sigmas(tables, std)
        source = ", ".join(dict.fromkeys(t.source for t in tables))
        names = list(dict.fromkeys(name for t in tables for name in t.columns))
        units = {name: unit_in(name) for name in names if unit_in(name)}
        units |= {name: unit for t in reversed(tables) for name, unit in t.units.items()}
        of_times = list(dict.fromkeys(name for t in tables for name in t.times))
        columned = [name for name in names if not is_run(name) and name not in of_times]
        numbers = [name for name in columned if name not in sigmas.values()]
        check_known(source, "observe", observe, numbers)
        told = time_unit_of(source, of_times[:1], units, options.get("time_unit"))
        unit = told or "s"
        runs = runs_of(tables, columned, SECONDS[unit], dt)
        coordinate_names = listed(options.get("coordinates"))
        if not coordinate_names and not given["positions"]:
            implied = coordinates_in(observe.values())
            coordinate_names = () if {*implied} & {*numbers} else implied
        named = {name for of_role in given.values() for name in of_role}
        if coordinate_names and not given["positions"]:
            given["positions"] = tuple(name for name in coordinate_names if name in numbers)
        if coordinate_names and not given["positions"]:
            given["sensors"] += tuple(name for name in observe if name not in named)
        roles, decided = roles_of(source, numbers, given, runs, units)
        unseen = ", ".join(name for name in coordinate_names if name not in numbers)
        beside = [n for n in numbers if role_of(n) == "positions" and n not in (*observe, *named)]
        if unseen and beside and not by_name.get("coordinates"):
            decided = [*decided, f"{', '.join(beside)}: not used, for observe speaks of {unseen}"]
        # A column that another name explains is a sensor: it gives the velocity no name of its own.
        shown = [n for n in roles["velocities"] if n not in given["velocities"]]
        shown = [n for n in shown if (w := words_in(observe.get(n))) and symbols((n,))[0] not in w]
        roles["velocities"] = tuple(n for n in roles["velocities"] if n not in shown)
        others = [name for of_role in roles.values() for name in of_role]
        more = (name for name in observe if name not in others)
        roles = {**roles, "sensors": (*roles["sensors"], *more)}
        coordinate_names = coordinate_names or roles["positions"]
        with_role = [name for role in ROLES for name in roles[role]]
        empty = [n for n in with_role if not any(np.isfinite(v[n]).any() for _, v in runs.values())]
        if empty:
            raise InputError(f"{source}: no value in column {', '.join(empty)}")
        moving = {**roles, "positions": coordinate_names}
        angular, radians = angles_of(
            source, moving, angles or (), names_of["degrees"], angles is None, units
        )
        factors = {name: radians.get(name, 1.0) for name in numbers}
        factors |= {of: factors[name] for name, of in sigmas.items()}
        values = {
            run: {name: column * factors[name] for name, column in of_run.items()}
            for run, (_, of_run) in runs.items()
        }
        about = {"std": std} | {name: names_of[name] for name in ("offset", "scale")}
        for what, wanted in about.items():
            check_known(source, what, wanted, with_role)
        sigmas = {name: of for name, of in sigmas.items() if name in with_role}
        check_sigmas(source, sigmas, values)
        about_times = (*(second_times(tables) if dt is None else ()), *restarts(tables, runs))
        fields = {
            **roles,
            "runs": tuple(runs),
            "angles": angular,
            "std": typical(std, sigmas, with_role, factors, values),
            "coordinates": coordinate_names,
            "observe": dict(observe),
            "guess": {name: float(value) for name, value in (options.get("guess") or {}).items()},
            "units": {n: u for n, u in units.items() if n in numbers},
            "factors": factors,
            "time_unit": unit,
            "time_unit_given": told is not None,
            "offsets": names_of["offset"],
            "scales": names_of["scale"],
            "ignored": tuple(n for n in numbers if n not in with_role)
            + tuple(dict.fromkeys(n for t in tables for n in t.text)),
            "angles_given": angles is not None or options.get("degrees") is not None,
            "notes": (*(n for t in tables for n in t.notes), *about_times, *decided),
            "source": source,
            "_times": {run: times for run, (times, _) in runs.items()},
            "_values": values,
            "_sigmas": sigmas,
        }
        vars(self).update(fields)
        for run in self.runs:
            for array in (self._times[run], *self._values[run].values()):
                array.flags.writeable = False

    @property
    def events(self) -> tuple[str, ...]:
        """Columns of times at which the motion crosses a zero, as ``observe`` says."""
        return crossings_in(self.observe)

    @property
    def accelerations(self) -> tuple[str, ...]:
        """Columns whose formula in ``observe`` has an acceleration, as x_ddot."""
        return tuple(name for name, one in self.observe.items() if "_ddot" in str(one))

    def __len__(self) -> int:
        """The number of samples of all runs."""
        return sum(len(times) for times in self._times.values())

    def __repr__(self) -> str:
        roles = ", ".join(f"{r} {', '.join(getattr(self, r))}" for r in ROLES if getattr(self, r))
        return f"Recording({self.source}: {len(self.runs)} runs, {len(self)} samples; {roles})"

    @property
    def dim(self) -> int:
        """Degrees of freedom: the number of positions, or of velocities where there are none."""
        return len(self.coordinates) or len(self.velocities) or len(self.momenta)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns that have a role, role by role."""
        return tuple(name for role in ROLES for name in getattr(self, role))

    @property
    def clock(self) -> str:
        """The unit of `times`, and of the law: s, or d or year where the file's times are these."""
        return clock_of(self.time_unit)[0]

    @property
    def second(self) -> float:
        """The file's unit of time, in that of `times`."""
        return SECONDS[self.time_unit]

    @property
    def explained(self) -> frozenset[str]:
        """Columns whose sensor is told by ``observe``, an offset or a scale."""
        return frozenset({*self.observe, *self.offsets, *self.scales})

    def unit(self, name: str) -> str:
        """The unit of a column's numbers in the file, "" where it is not known."""
        if name in self.velocities[: len(self.positions)] and name not in self.units:
            of = self.positions[self.velocities.index(name)]
            known = of in self.angles or of in self.units
            return f"{self.unit(of)}/s" if known and self.factors[of] == self.factors[name] else ""
        plain = "rad" if name in self.angles else ""
        return self.units.get(name) or ("deg" if self.factors.get(name, 1.0) != 1 else plain)

    def times(self, run: str | float) -> np.ndarray:
        """Times (n,) of a run in seconds, rising."""
        return self._times[self._named(run)]

    def values(self, name: str, run: str | float) -> np.ndarray:
        """A column (n,) in a run, NaN where missing; angles in radians, wrapped as they came; or a
        wave, cos(1.37*t)."""
        found = self._values[self._named(run)]
        column = found[name] if name in found else wave(name, self.times(run))
        if column is None:
            raise InputError(f"{self.source}: no column {name}, found {', '.join(found)}")
        return column

    def sigma(self, name: str, run: str | float) -> np.ndarray | None:
        """σ (n,) of the values of a column in a run, None where it was not given."""
        self.values(name, run)  # raises where there is no such column
        if name in self._sigmas:
            return self._values[self._named(run)][self._sigmas[name]]
        known = self.std.get(name)
        return None if known is None else np.full(len(self.times(run)), known)

    def unwrapped(self, name: str, run: str | float) -> np.ndarray:
        """A column (n,) in a run, an angle lifted so that it moves by less than half a turn between
        neighbours. Values that range over more than one turn are such a lift already."""
        values = self.values(name, run)
        if name not in self.angles:
            return values
        known = np.isfinite(values)
        if not known.any() or np.ptp(values[known]) > TURN * (1 + 1e-3):
            return values
        return lift(values)

    def each(self, column: Callable[[str, str], np.ndarray], name: str) -> list[np.ndarray]:
        """A column in each run, (n,) by `values` or by `unwrapped`."""
        return [column(name, run) for run in self.runs]

    def array(self, role: str, run: str | float) -> np.ndarray:
        """The columns of a role (n, k) in a run, as `values`. Raises InputError at no such role."""
        if role not in ROLES:
            raise InputError(f"expected a role among {', '.join(ROLES)}, got {role!r}")
        columns = [self.values(name, run) for name in getattr(self, role)]
        return np.stack(columns, axis=1) if columns else np.empty((len(self.times(run)), 0))

    def driven_by(self, names: Sequence[str]) -> Recording:
        """The recording with these waves, cos(1.37*t), as further inputs."""
        return self._with(inputs=(*self.inputs, *names))

    def behind_filter(self, phase: float) -> Recording:
        """The recording as behind a filter of all columns (`signals.filters.turned`, s³); with
        −``phase`` as before it. Raises InputError where angles are among them, steps are uneven, or
        values are missing."""
        names = [n for n in self.columns if n not in self.parameters and not is_wave(n)]
        if self.angles:
            raise InputError(f"{self.source}: expected no angles, got {', '.join(self.angles)}")
        values = {}
        for run, times in self._times.items():
            own = {name: self._values[run][name] for name in names}
            steps = np.diff(times)
            whole = all(np.isfinite(column).all() for column in own.values())
            if len(steps) < 2 or np.ptp(steps) > Filters.even * steps[0] or not whole:
                raise InputError(
                    f"{self.source}: run {run}: expected even steps and no missing value, as a "
                    "filter of all columns needs"
                )
            behind = {name: turned(x, float(np.mean(steps)), phase) for name, x in own.items()}
            for column in behind.values():
                column.flags.writeable = False
            values[run] = {**self._values[run], **behind}
        return self._with(_values=values)

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
        times = {r: self._times[r][k] for r, k in kept.items()}
        values = {r: {n: v[k] for n, v in self._values[r].items()} for r, k in kept.items()}
        return self._with(runs=tuple(kept), _times=times, _values=values)

    def without(self, rows: Mapping[str, np.ndarray]) -> Recording:
        """The recording without the values of some columns, by name, in rows (k,) of all runs one
        after another: they are missing."""
        begin, values = 0, {}
        for run, of_run in self._values.items():
            count = len(self._times[run])
            values[run] = dict(of_run)
            for name, every in rows.items():
                own = every[(every >= begin) & (every < begin + count)] - begin
                column = of_run[name].copy()
                column[own] = np.nan
                column.flags.writeable = False
                values[run][name] = column
            begin += count
        return self._with(_values=values)

    def _with(self, **changed: Any) -> Recording:
        part = copy.copy(self)
        vars(part).update(changed)
        return part

    def summary(self) -> RecordingSummary:
        """Summary of the samples before anything is fitted: noise, frequencies, friction, mistakes.

        Prints as one screen; `RecordingSummary.as_json` gives plain data.
        """
        from gfnn_jax.data.recording_summary import summarise

        return summarise(self)

    def _repr_html_(self) -> str:
        return self.summary()._repr_html_()

    def _named(self, run: str | float) -> str:
        """The name of a run, given as text or as a number."""
        text = str(run)
        if text in self._times:
            return text
        number = _number(text)
        for name in self.runs:
            if _number(name) == number is not None:
                return name
        raise InputError(f"{self.source}: no run {run}, found {', '.join(self.runs[:12])}")


def read(
    paths: Any,
    *,
    start: float = -np.inf,
    stop: float = np.inf,
    every: int = 1,
    **options: Unpack[ReadOptions],
) -> Recording:
    """The recording that a file holds, or several files, one run each or more, or a table.

    paths:    ``.csv`` and other text, of any encoding (separated by commas, semicolons, tabs or
              blanks; decimal points or commas; lines of comments, preambles, a line of units below
              the names; ``.gz`` and ``.zip`` too), ``.npz`` and ``.mat`` of named arrays, ``.npy``;
              with python-calamine ``.xlsx``, ``.xls`` and ``.ods``. A table, as of `Recording`.
    start, stop, every: rows to keep: between these times (in the file's unit), every so many.
    options:  `ReadOptions`.
    Raises InputError, one line with the file and the line, where a file cannot be used.
    """
    is_table = isinstance(paths, Mapping) or hasattr(paths, "columns")
    several: list[Any] = [paths] if is_table or isinstance(paths, (str, Path)) else list(paths)
    if not all(isinstance(one, (str, Path)) for one in several):
        if every != 1:
            raise InputError("every: only of files")
        found = Recording(paths, **options)
        begin, end = start * found.second, stop * found.second
        return found if start == -stop == -np.inf else found.slice(begin, end)
    chosen, time = listed(options.get("columns")), options.get("time")
    tables, rows = [], Rows(start, stop, every)
    for path in map(Path, several):
        if not path.is_file():
            raise InputError(f"{path}: {'is not a file' if path.exists() else 'no such file'}")
        if path.suffix.lower() in ARRAYS:
            tables.append(rows_of(_timed(from_arrays(path, chosen), time), rows))
        else:
            shown = with_crossings(options.get("observe") or {}, options.get("events") or {})
            words = crossings_in(shown)
            tables.append(from_text(path, chosen, time=time, rows=rows, words=words))
    return Recording(tables, **options)


def _timed(table: Table, time: str | None) -> Table:
    if time is None:
        return table
    check_known(table.source, "time", [time], [*table.columns])
    return dataclasses.replace(table, time=time)


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _selected(table: Table, columns: tuple[str, ...]) -> Table:
    if not columns:
        return table
    check_known(table.source, "columns", columns, [*table.columns, *table.text])
    kept = {n: x for n, x in table.columns.items() if n in (*columns, *table.times) or is_run(n)}
    return dataclasses.replace(table, columns=kept)


def lift(angle: np.ndarray) -> np.ndarray:
    """An angle (n,) that moves by less than half a turn between neighbours."""
    known, lifted = np.isfinite(angle), angle.copy()
    lifted[known] = np.unwrap(angle[known])
    return lifted


def channels_of(
    recording: Recording, names: Sequence[str], run: str
) -> tuple[np.ndarray, np.ndarray]:
    """(n, k) values of columns in a run, angles lifted, and their noise ÷ that of their column: 1
    where σ was not given for each value. A column that is not there is NaN."""
    y = np.full((len(recording.times(run)), len(names)), np.nan)
    noise = np.ones(y.shape)
    for k, name in enumerate(names):
        if name not in recording.columns:
            continue
        y[:, k] = recording.unwrapped(name, run)
        sigma, usual = recording.sigma(name, run), recording.std[name]
        if sigma is not None and usual:
            noise[:, k] = np.where(np.isfinite(sigma), sigma / usual, 1.0)
    return y, noise


def parameters_of(recording: Recording) -> tuple[str, ...]:
    """Parameters that differ between the runs. Raises InputError where one is no number of each
    run."""
    found = []
    for name in recording.parameters:
        columns = recording.each(recording.values, name)
        for run, column in zip(recording.runs, columns, strict=True):
            if not (np.isfinite(column).all() and np.ptp(column) == 0):
                found = f"{recording.source}: parameter {name} is not one number in run {run}"
                raise InputError(f"{found}. Name what changes within a run an input: --inputs")
        if len({float(column[0]) for column in columns}) > 1:
            found.append(name)
    return tuple(found)


def args_of(recording: Recording, run: str, names: Sequence[str]) -> np.ndarray:
    """(k,) these parameters of a run."""
    return np.array([recording.values(name, run)[0] for name in names])
