"""The columns of a recording: which have which role, which are angles, and their units."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gfnn_jax.data.roles import ROLES, by_name, is_angle, is_time, plain
from gfnn_jax.data.roles_by_data import parameters, positions_and_velocities
from gfnn_jax.errors import InputError

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
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
    varied = parameters(runs, rest)
    if varied:
        roles["parameters"] = (*roles["parameters"], *varied)
        rest = [name for name in rest if name not in varied]
        verbs = ("differs", "is taken as a parameter"), ("differ", "are taken as parameters")
        differ, taken = verbs[len(varied) > 1]
        notes.append(f"{', '.join(varied)} {differ} from run to run, and {taken}")
    if not any(roles[role] for role in ("positions", "velocities", "momenta")):
        found, velocities = positions_and_velocities(source, runs, rest)
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
