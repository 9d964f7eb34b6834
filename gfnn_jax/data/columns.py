"""The columns of a recording: their roles, which are angles, their units, their σ."""

from __future__ import annotations

import dataclasses
import itertools
import math
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gfnn_jax.data.roles import ROLES, by_name, is_angle, is_time, plain
from gfnn_jax.data.tables import Table
from gfnn_jax.errors import InputError
from gfnn_jax.signals.derivatives import derivatives, window
from gfnn_jax.signals.noise import noise

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
_LIKE = 0.85  # likeness of a column to the derivative of another, that tells
_MOST_COLUMNS = 12  # whose names do not tell, that are compared
_STD = "_std"  # end of the name of a column that holds the σ of another
Names = Sequence[str] | str | None
Runs = Mapping[str, tuple[np.ndarray, dict[str, np.ndarray]]]


def listed(given: Names) -> tuple[str, ...]:
    """One name or several, or none, as a tuple."""
    return (given,) if isinstance(given, str) else tuple(given or ())


def roles_of(
    source: str, names: list[str], given: dict[str, tuple[str, ...]], runs: Runs
) -> tuple[dict[str, tuple[str, ...]], list[str]]:
    """(the columns of each role, what had to be decided): those given, else by name, else by what
    the columns hold.

    Raises InputError where a name is unknown or has two roles, or where nothing tells.
    """
    wanted = [name for of_role in given.values() for name in of_role]
    if not names:
        raise InputError(f"{source}: expected columns of numbers beside the times, found none")
    if wanted:
        for role, of_role in given.items():
            check_known(source, role, of_role, names)
        twice = [name for name in dict.fromkeys(wanted) if wanted.count(name) > 1]
        if twice:
            raise InputError(
                f"{source}: expected one role of each column, got {', '.join(twice)} twice"
            )
        return given, []
    roles, notes = by_name(names), []
    rest = [name for name in names if not any(name in roles[role] for role in ROLES)]
    varied = _varied(runs, rest)
    if varied:
        roles["parameters"] = (*roles["parameters"], *varied)
        rest = [name for name in rest if name not in varied]
        verbs = ("differs", "is taken as a parameter"), ("differ", "are taken as parameters")
        differ, taken = verbs[len(varied) > 1]
        notes.append(f"{', '.join(varied)} {differ} from run to run, and {taken}")
    if not any(roles[role] for role in ("positions", "velocities", "momenta")):
        found, velocities = _positions_and_velocities(source, runs, rest)
        roles |= {"positions": found, "velocities": velocities}
        notes.append(
            f"the data show that {', '.join(velocities)} are derivatives of {', '.join(found)}"
        )
    for role in ("velocities", "momenta"):
        if len(roles[role]) > len(roles["positions"]) > 0:
            raise InputError(
                f"{source}: by their names {', '.join(roles[role])} are {role} and only "
                f"{', '.join(roles['positions'])} positions. Name each pair: --positions and "
                f"--{role}, in one order"
            )
    return roles, notes


def _varied(runs: Runs, names: Sequence[str]) -> tuple[str, ...]:
    """Columns that are constant in every run and differ between runs."""
    found = []
    for name in names:
        columns = [values[name] for _, values in runs.values()]
        constant = all(np.isfinite(x).all() and np.ptp(x) == 0 for x in columns)
        if constant and len({float(x[0]) for x in columns}) > 1:
            found.append(name)
    return tuple(found)


def _positions_and_velocities(
    source: str, runs: Runs, names: Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Columns that make pairs, one the other's derivative.

    Raises InputError where a column is left over that may be a position or an input.
    """
    times = [t for t, _ in runs.values()]
    some = names[:_MOST_COLUMNS]
    columns = {n: np.concatenate([values[n] for _, values in runs.values()]) for n in some}
    moving = [name for name, x in columns.items() if np.isfinite(x).any() and np.nanstd(x) > 0]
    pairs = _pairs(times, {name: columns[name] for name in moving}) if moving else []
    rest = [name for name in moving if not any(name in pair for pair in pairs)]
    if rest or not pairs:
        shown, typed = ", ".join(rest or names), shlex.quote(",".join(moving))
        if not moving:
            raise InputError(f"{source}: none of the columns {', '.join(names)} varies")
        raise InputError(
            f"{source}: the names {', '.join(names)} do not show what was measured, and {shown} "
            f"may be motion or what drives it. Name them: --positions {typed}, or some "
            "of them and --inputs"
        )
    return tuple(x for x, _ in pairs), tuple(v for _, v in pairs)


def _pairs(times: list[np.ndarray], columns: dict[str, np.ndarray]) -> list[tuple[str, str]]:
    """(position, velocity), the most alike first taken, in the order of the columns."""
    names, table = list(columns), np.stack(list(columns.values()))
    noises = noise(times, table)
    local = derivatives(times, table, window(noises), [n.sigma for n in noises])
    if local is None:
        return []
    related = {
        (a, b): local.relation(a, b) for a, b in itertools.permutations(range(len(names)), 2)
    }
    like = {pair: r.likeness for pair, r in related.items() if r is not None}
    found, used = [], set()
    for (a, b), likeness in sorted(like.items(), key=lambda item: -item[1]):
        if likeness > _LIKE and not {a, b} & used:
            found.append((a, b))
            used |= {a, b}
    return [(names[a], names[b]) for a, b in sorted(found)]


def angles_of(
    source: str,
    roles: Mapping[str, tuple[str, ...]],
    given: tuple[str, ...],
    degrees: tuple[str, ...],
    by_names: bool,
    units: Mapping[str, str],
) -> tuple[tuple[str, ...], set[str]]:
    """(angles in the order of the positions, columns in degrees)."""
    known = (*roles["positions"], *roles["velocities"])
    check_known(source, "angles", given, roles["positions"])
    check_known(source, "degrees", degrees, known)
    in_radians = [n for n in degrees if _unit(units, n).startswith("rad")]
    if in_radians:
        name = in_radians[0]
        raise InputError(f"{source}: degrees: {name} is in {units[name]} by its header")
    in_degrees = set(degrees) | {n for n in known if _unit(units, n).startswith(("deg", "°"))}
    angles = set(given) | {n for n in roles["positions"] if n in in_degrees}
    if by_names:
        units_of_angles = ("deg", "°", "rad")
        angles |= {
            n
            for n in roles["positions"]
            if (is_angle(n) and not _unit(units, n)) or _unit(units, n).startswith(units_of_angles)
        }
    return tuple(n for n in roles["positions"] if n in angles), in_degrees


def factors_of(names: Sequence[str], in_degrees: set[str]) -> dict[str, float]:
    """Factors of the numbers in the file, by column: π/180 for degrees, else 1."""
    return {name: math.pi / 180 if name in in_degrees else 1.0 for name in names}


def _unit(units: Mapping[str, str], name: str) -> str:
    return units.get(name, "").strip().lower()


def check_known(source: str, what: str, wanted: Any, known: Sequence[str]) -> None:
    """Raises InputError where a wanted name is not a known one."""
    missing = [name for name in wanted if name not in known]
    if missing:
        raise InputError(
            f"{source}: {what}: no column {', '.join(map(str, missing))} among "
            f"{', '.join(known) or 'none'}"
        )


def time_unit_of(
    source: str, names: list[str], units: Mapping[str, str], given: str | None
) -> str | None:
    """The unit of the times: the given one, the header's, or that at the end of their name; None
    where nothing tells. Raises InputError where two of these differ, or one is not known."""
    if given is not None and given not in SECONDS:
        raise InputError(f"expected a time unit among {', '.join(SECONDS)}, got {given!r}")
    for name in filter(is_time, names):
        told = _time_unit(name, units)
        if told is None and given is None and _unit(units, name):
            raise InputError(
                f"{source}: {name}: unit {units[name]!r} is not known: give --time-unit "
                f"{'|'.join(SECONDS)}"
            )
        if told is not None and given is not None and SECONDS[told] != SECONDS[given]:
            raise InputError(
                f"{source}: {name} is in {told} by its header, got the time unit {given} "
                "(--time-unit, time_unit=)"
            )
        if told is not None:
            return told
    return given


def _time_unit(name: str, units: Mapping[str, str]) -> str | None:
    """The unit of a column of times, by its header or the end of its name."""
    end = plain(name).rpartition("_")[2]
    end = {"millis": "ms", "micros": "us"}.get(end, end)
    for unit in (_unit(units, name), end):
        unit = {"seconds": "s", "second": "s"}.get(unit, unit)
        unit = unit.removesuffix("ec") if unit in ("sec", "msec", "usec") else unit
        if unit in SECONDS:
            return unit
    return None


def with_sigmas(
    tables: Sequence[Table], std: Mapping[str, Any]
) -> tuple[list[Table], dict[str, str]]:
    """The tables with a column for every σ that was given for each value, and the names of these
    columns by that of the column they belong to.

    std: name -> number, (T,) values, or the name of a column. A column x_std beside x is taken for
    the σ of x. Raises InputError where one is no size or belongs to nothing.
    """
    names = list(dict.fromkeys(name for table in tables for name in table.columns))
    found = {n.removesuffix(_STD): n for n in names if n.endswith(_STD)}
    found = {name: of for name, of in found.items() if name in names and name not in std}
    tables = list(tables)
    for name, given in std.items():
        if isinstance(given, str):
            if given not in names:
                raise InputError(f"std: no column {given} for the σ of {name}")
            found[name] = given
        elif np.ndim(given):
            values = np.asarray(given, np.float64)
            length = len(next(iter(tables[0].columns.values()), ()))
            if len(tables) > 1 or values.shape != (length,):
                raise InputError(
                    f"std of {name}: expected a number, or one for each of the {length} rows of "
                    f"one table, got shape {values.shape} for {len(tables)} tables"
                )
            found[name] = name + _STD
            columns = {**tables[0].columns, found[name]: values}
            tables[0] = dataclasses.replace(tables[0], columns=columns)
        elif not (math.isfinite(given) and given >= 0):
            raise InputError(f"expected a finite σ, 0 or above, got std = {given} of {name}")
    return tables, found


def check_sigmas(source: str, sigmas: Mapping[str, str], values: Mapping[str, Any]) -> None:
    """Raises InputError where a value (run -> name -> (n,)) has no σ above 0 beside it."""
    for name, of in sigmas.items():
        for run, columns in values.items():
            sigma = columns[of]
            bad = np.isfinite(columns[name]) & ~(np.isfinite(sigma) & (sigma > 0))
            if bad.any():
                raise InputError(
                    f"{source}: {of}: expected σ above 0 beside every value of {name}, got "
                    f"{sigma[bad][0]:g} ({bad.sum()} such rows in run {run})"
                )


def typical(
    std: Mapping[str, Any],
    sigmas: Mapping[str, str],
    names: Sequence[str],
    factors: Mapping[str, float],
    values: Mapping[str, Any],
) -> dict[str, float | None]:
    """σ of each column: as given, the median of those of its values, or None."""
    found: dict[str, float | None] = dict.fromkeys(names)
    for name in names:
        if name in sigmas:
            every = np.concatenate([columns[sigmas[name]] for columns in values.values()])
            found[name] = float(np.nanmedian(every))
        elif name in std:
            found[name] = float(std[name]) * factors[name]
    return found
