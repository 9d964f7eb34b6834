"""The columns of a recording: their roles, which are angles, their units, their σ."""

import dataclasses
import itertools
import math
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.integrate import cumulative_simpson
from scipy.linalg import eigh

from gfnn_jax.arrays import products
from gfnn_jax.data.roles import (
    OF_CALENDAR,
    ROLES,
    by_name,
    derivative_of,
    is_angle,
    is_rate_of_turning,
    plain,
)
from gfnn_jax.data.tables import Table
from gfnn_jax.errors import InputError, advised, as_typed
from gfnn_jax.signals.derivatives import derivatives, window
from gfnn_jax.signals.noise import noise

# Units of time by what one is in the clock of the laws: seconds, or days and years as they are,
# for an orbit in au and days has velocities in au/d.
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
SECONDS |= {"d": 1.0, "year": 1.0}


class _Options:
    """Limits of columns that are told apart by their values, chosen on tops, populations and
    mechanical systems drawn at random (tests of proposals)."""

    like: float = 0.85  # likeness of a column to the derivative of another, that tells
    most_columns: int = 12  # whose names do not tell, that are compared
    alone: float = 1.3  # times the noise, up to which a column's spread is noise alone
    one_axis: float = 0.1  # ratio of strengths of turning, below which one axis is enough
    # share of the rates' variance that functions of the columns explain of states
    first_order: float = 0.6
    runs_of_a_body: int = 3  # whose energies and |M|² determine the law of a body that turns
    lags: tuple[int, ...] = (1, 2, 4, 8, 16, 32)  # samples over which changes are taken
    quarter: float = 1.5  # of the columns' variance that a change may have
    samples: int = 4  # changes for each function, at least
    parts: int = 8  # into which the runs are cut, each judged by the fit to the others
    told_apart: float = 3e-3
    invariant: float = 0.05  # of a function's variance within runs, that noise leaves of a constant
    levels: int = 3  # values of a column that only switches
    rows: int = 10  # that a column numbers, at least
    runs: int = 3
    most: int = 20_000


_STD = "_std"  # end of the name of a column that holds the σ of another
_OF_MOTION = ("positions", "velocities", "momenta", "sensors")  # roles of what shows the motion
Names = Sequence[str] | str | None
Roles = dict[str, tuple[str, ...]]
Units = Mapping[str, str]
Runs = Mapping[str, tuple[np.ndarray, dict[str, np.ndarray]]]


def listed(given: Names) -> tuple[str, ...]:
    """One name or several, or none, as a tuple."""
    return (given,) if isinstance(given, str) else tuple(given or ())


def resolved(given: Names, known: Sequence[str]) -> tuple[str, ...]:
    """Names of columns, those that hold a comma made whole: "Angle", "Ch 1" of Angle, Ch 1."""
    names, found = listed(given), []
    whole = {re.sub(r"\s*,\s*", ",", name): name for name in known if "," in name}
    while names:
        joined = {k: ",".join(names[:k]) for k in range(len(names), 1, -1)}
        length = next((k for k, name in joined.items() if name in whole), 1)
        found.append(whole[joined[length]] if length > 1 else whole.get(names[0], names[0]))
        names = names[length:]
    return tuple(found)


class Undecided(InputError):
    """Columns whose roles nothing tells; ``options`` of `gfnn_jax.read`, or of a fit, may do."""

    def __init__(self, message: str, options: Mapping[str, Any]):
        super().__init__(advised(message, options))
        self.options = dict(options)


def roles_of(
    source: str, names: list[str], given: Roles, runs: Runs, units: Units
) -> tuple[Roles, list[str]]:
    """(the columns of each role, what had to be decided): those given, else by name, else by what
    the columns hold and their units; where only inputs or parameters are given, those of the other
    columns.

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
            raise InputError(f"{source}: expected one role a column, got {', '.join(twice)} twice")
        rest = [name for name in names if name not in wanted]
        if any(given[role] for role in _OF_MOTION) or not rest:
            return given, []
        roles, notes = roles_of(source, rest, dict.fromkeys(ROLES, ()), runs, units)
        return {role: given[role] or roles[role] for role in ROLES}, notes
    every = {name: [values[name] for _, values in runs.values()] for name in names}
    least = _Options.rows
    rows = {
        n: all(len(x) > least and np.all(np.diff(x) == 1) for x in own) for n, own in every.items()
    }
    counts = [name for name, counted in rows.items() if counted]
    names = [name for name in names if name not in counts] or names
    roles, notes = by_name(names), [f"{name} counts the rows, and is put aside" for name in counts]
    rest = [name for name in names if not any(name in roles[role] for role in ROLES)]
    varied = _varied(runs, rest)
    if varied:
        roles["parameters"] = (*roles["parameters"], *varied)
        rest = [name for name in rest if name not in varied]
        verbs = ("differs", "is taken as a parameter"), ("differ", "are taken as parameters")
        differ, taken = verbs[len(varied) > 1]
        notes.append(f"{', '.join(varied)} {differ} from run to run, and {taken}")
    if not roles["positions"] and all(is_rate_of_turning(n) for n in roles["velocities"]):
        rest = [name for name in names if name in (*rest, *roles["velocities"])]
        roles["velocities"] = ()
    if roles["velocities"] and not (roles["positions"] or roles["momenta"] or rest):
        raise _of_speeds(source, roles["velocities"], units)
    if not any(roles[role] for role in ("positions", "velocities", "momenta")):
        if roles["inputs"] and not rest:
            sole = ", ".join(roles["inputs"])
            raise InputError(
                f"{source}: by its name {sole} is what drives a motion, and no column shows what "
                f"moves. If it is what moves, say so: --positions {shlex.quote(sole)}"
            )
        found, told = _by_data(source, runs, rest, units)
        roles |= {role: (*roles[role], *of_role) for role, of_role in found.items()}
        notes += told
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


# Units of what moves, of its rate, and of what drives it.
_OF_LENGTHS = re.compile(r"[nµumckd]?m|km|au|px|pixels?|m?rad|deg|°|degrees?|turns?|revs?")
_OF_TURNING = re.compile(r"(rad|deg|°|degrees?|turns?|revs?) ?(/|per) ?(s|sec)|dps")
_OF_SPEEDS = re.compile(r"[mcdk]?m ?(/|per) ?(s|sec)")
_OF_ACCELERATIONS = re.compile(r"[mc]?m ?/ ?s(\^2|²|\*\*2|2)")
_OF_DRIVES = re.compile(r"[µumk]?V|[nµum]?A|[mk]?N|N ?·? ?m|Nm", re.IGNORECASE)


def _by_data(
    source: str, runs: Runs, names: Sequence[str], units: Units
) -> tuple[Roles, list[str]]:
    """(columns by role, notes) of columns whose names tell nothing: pairs, one the other's
    derivative; lengths and angles by their units; voltages, currents and forces beside these as
    inputs; a column that moves alone.

    Raises Undecided where a column is left over that may be a position or an input."""
    times = [t for t, _ in runs.values()]
    some = names[: _Options.most_columns]
    columns = {n: np.concatenate([values[n] for _, values in runs.values()]) for n in some}
    moving = [name for name, x in columns.items() if np.isfinite(x).any() and np.nanstd(x) > 0]
    if not moving:
        raise InputError(f"{source}: none of the columns {', '.join(names)} varies")
    sizes = noise(times, np.stack([columns[name] for name in moving]))
    still = [  # a constant and noise alone
        name
        for name, size in zip(moving, sizes, strict=True)
        if size.white
        and size.sigma is not None
        and float(np.nanstd(columns[name])) < _Options.alone * size.sigma
    ]
    moving = [name for name in moving if name not in still] or moving
    notes = [f"{name} holds noise alone, and is put aside" for name in still]
    pairs = _pairs(times, {name: columns[name] for name in moving})
    if pairs:
        paired = ", ".join(v for _, v in pairs), ", ".join(x for x, _ in pairs)
        notes.append(f"the data show that {paired[0]} are derivatives of {paired[1]}")
    rest = [name for name in moving if not any(name in pair for pair in pairs)]
    turning = [n for n in rest if _OF_TURNING.fullmatch(units.get(n, ""))]
    turning = turning or [n for n in rest if is_rate_of_turning(n)]
    if turning and not pairs:
        raise _of_rates(source, turning, np.stack([columns[name] for name in turning]), len(runs))
    speeds = [n for n in rest if _OF_SPEEDS.fullmatch(units.get(n, ""))]
    if speeds and len(speeds) == len(rest) and not pairs:
        raise _of_speeds(source, speeds, units)
    shaken = [n for n in rest if _OF_ACCELERATIONS.fullmatch(units.get(n, ""))]
    if shaken and len(shaken) == len(rest) and not pairs:
        raise _of_accelerations(source, {name: columns[name] for name in shaken})
    switches = [n for n in rest if len(np.unique(columns[n])) <= _Options.levels]
    switches = switches if len(switches) < len(rest) else []
    rest = [n for n in rest if n not in switches]
    notes += [f"{name} only switches, and is taken as an input" for name in switches]
    inputs = [n for n in rest if _OF_DRIVES.fullmatch(units.get(n, ""))]
    lengths = [n for n in rest if _OF_LENGTHS.fullmatch(units.get(n, "").lower())]
    unclear = [n for n in rest if n not in (*inputs, *lengths)]
    if not pairs and not lengths and len(rest) == 1:
        lengths, inputs, unclear = rest, [], []
        notes.append(f"{rest[0]} alone moves, and is taken as the position")
    elif lengths and not unclear:
        driving = f", {', '.join(inputs)} inputs" * bool(inputs)
        notes.append(f"by their units {', '.join(lengths)} are positions{driving}")
    if unclear or (inputs and not (pairs or lengths)):
        own = [np.stack([values[n] for n in moving], axis=1) for _, values in runs.values()]
        share = explained(times, own) if len(moving) > 1 else 0.0
        raise _unclear(source, columns, moving, unclear or inputs, share)
    return {
        "positions": (*(x for x, _ in pairs), *lengths),
        "velocities": tuple(v for _, v in pairs),
        "inputs": (*inputs, *switches),
    }, notes


def _of_rates(source: str, names: Sequence[str], columns: np.ndarray, runs: int) -> Undecided:
    """Options for rates of turning whose angles no column shows. runs: number of them."""
    known = columns[:, np.isfinite(columns).all(axis=0)]
    strengths = np.linalg.svd(known, compute_uv=False) if known.size else np.ones(len(names))
    shown = f"{', '.join(names)} {'is a rate' if len(names) == 1 else 'are rates'} of turning"
    if len(names) == 3 and strengths[1] > _Options.one_axis * strengths[0]:
        least = _Options.runs_of_a_body
        wanted = f", from {least} or more runs of different speeds" * (runs < least)
        return Undecided(
            f"{source}: {shown} of a body about three axes. To learn its bracket{wanted}:",
            {"structure": "poisson", "states": tuple(names)},
        )
    main = names[int(np.argmax(known.std(axis=1)))] if known.size else names[0]
    return Undecided(
        f"{source}: {shown}, and no column shows the angle. To learn its law, with an offset b of "
        "the sensor:",
        {"coordinates": ("theta",), "observe": {main: "omega + b"}},
    )


def _of_speeds(source: str, names: Sequence[str], units: Units) -> Undecided:
    """Options for velocities whose positions no column shows."""
    turning = is_angle(str(derivative_of(names[0]))) or "omega" in plain(names[0])
    turning |= bool(_OF_TURNING.fullmatch(units.get(names[0], "")))
    place = [""] if len(names) == 1 else [str(i + 1) for i in range(len(names))]
    q, v = ("theta", "omega") if turning else ("x", "v")
    return Undecided(
        f"{source}: {', '.join(names)}: velocities, and no column shows a position. To learn a "
        "law, with offsets of the sensors:",
        {
            "coordinates": tuple(q + i for i in place),
            "observe": {n: f"{v}{i} + b{i}" for n, i in zip(names, place, strict=True)},
        },
    )


def _of_accelerations(source: str, columns: Mapping[str, np.ndarray]) -> Undecided:
    """Options for accelerations whose positions no column shows: of gravity along a rod where one
    is far from zero, else of a cart."""
    away = {n: abs(np.nanmean(x)) / np.nanstd(x) for n, x in columns.items()}
    name = max(away, key=lambda n: away[n])
    if away[name] > 1:
        what = "along the rod of a pendulum"
        options = {"coordinates": ("theta",), "observe": {name: "A*omega**2 + G*cos(theta)"}}
    else:
        name = max(columns, key=lambda n: np.nanstd(columns[n]))
        what = "of a cart, say, with an offset of the sensor"
        options = {"coordinates": ("x",), "observe": {name: "x_ddot + b"}}
    return Undecided(
        f"{source}: {', '.join(columns)}: accelerations by their units, and no column shows a "
        f"position. To learn a law from one of them, {what}:",
        options,
    )


def _unclear(
    source: str,
    columns: Mapping[str, np.ndarray],
    moving: Sequence[str],
    shown: Sequence[str],
    share: float,
) -> Undecided:
    """Options for columns that nothing tells apart. share: of their rates, that functions of them
    explain."""
    positions = {"positions": tuple(moving)}
    if share > _Options.first_order:
        states = {"structure": "poisson", "states": tuple(moving)}
        return Undecided(
            f"{source}: the names {', '.join(columns)} do not show what was measured; their rates "
            f"are functions of {', '.join(moving)} themselves, as of states without velocities, of "
            f"populations say:{as_typed(states)}. If they are positions:{as_typed(positions)}",
            states,
        )
    return Undecided(
        f"{source}: the names {', '.join(moving)} do not show what was measured, and "
        f"{', '.join(shown)} may be motion or what drives it. Name them:{as_typed(positions)}, or "
        "some of them and --inputs",
        positions,
    )


def _pairs(times: list[np.ndarray], columns: dict[str, np.ndarray]) -> list[tuple[str, str]]:
    """(position, velocity), the most alike first taken, in the order of the columns."""
    names, table = list(columns), np.stack(list(columns.values()))
    noises = noise(times, table)
    local = derivatives(times, table, window(noises), [n.sigma for n in noises])
    if local is None:
        return []
    pairs = itertools.permutations(range(len(names)), 2)
    like = {pair: r.likeness for pair in pairs if (r := local.relation(*pair)) is not None}
    found, used = [], set()
    for (a, b), likeness in sorted(like.items(), key=lambda item: -item[1]):
        if likeness > _Options.like and not {a, b} & used:
            found.append((a, b))
            used |= {a, b}
    return [(names[a], names[b]) for a, b in sorted(found)]


def angles_of(
    source: str,
    roles: Mapping[str, tuple[str, ...]],
    given: tuple[str, ...],
    degrees: tuple[str, ...],
    by_names: bool,
    units: Units,
) -> tuple[tuple[str, ...], dict[str, float]]:
    """(angles in the order of the positions, radians in the units of columns in degrees, turns)."""
    known = (*roles["positions"], *roles["velocities"])
    check_known(source, "angles", given, roles["positions"])
    check_known(source, "degrees", degrees, known)
    in_radians = [n for n in degrees if _unit(units, n).startswith("rad")]
    if in_radians:
        name = in_radians[0]
        raise InputError(f"{source}: degrees: {name} is in {units[name]} by its header")
    others = {n: _unit(units, n) for n in known if n not in degrees}
    factors = {n: np.pi / 180 for n in known if others.get(n, "deg").startswith(("deg", "°"))}
    factors |= {n: 2 * np.pi for n, unit in others.items() if unit.startswith(("turn", "rev"))}
    angles = set(given) | {n for n in roles["positions"] if n in factors}
    if by_names:
        units_of_angles = ("deg", "°", "rad")
        angles |= {
            n
            for n in roles["positions"]
            if (is_angle(n) and not _unit(units, n)) or _unit(units, n).startswith(units_of_angles)
        }
    return tuple(n for n in roles["positions"] if n in angles), factors


def _unit(units: Units, name: str) -> str:
    return units.get(name, "").strip().lower()


def check_known(source: str, what: str, wanted: Any, known: Sequence[str]) -> None:
    """Raises InputError where a wanted name is not a known one."""
    missing = [name for name in wanted if name not in known]
    if missing:
        absent, there = ", ".join(map(str, missing)), ", ".join(known) or "none"
        raise InputError(f"{source}: {what}: no column {absent} among {there}")


def time_unit_of(source: str, times: Sequence[str], units: Units, given: str | None) -> str | None:
    """The unit of these columns of times: the given one, the header's, or that which their name
    says; None where nothing tells. Raises InputError where two of these differ, or one is not
    known."""
    if given is not None and given not in SECONDS:
        raise InputError(f"expected a time unit among {', '.join(SECONDS)}, got {given!r}")
    for name in times:
        told = _time_unit(name, units)
        if told is None and given is None and _unit(units, name):
            asked = f"give it, one of {', '.join(SECONDS)}: --time-unit"
            raise InputError(f"{source}: {name}: unit {units[name]!r} is not known; {asked}")
        if told is not None and given is not None and clock_of(told) != clock_of(given):
            got = f"got the time unit {given} (--time-unit)"
            raise InputError(f"{source}: {name} is in {told} by its header, {got}")
        if told is not None:
            return told
    return given


def clock_of(unit: str) -> tuple[str, float]:
    """(s, d or year, what one of a unit of time is in it)."""
    return unit if unit in ("d", "year") else "s", SECONDS[unit]


_UNITS_OF_TIME = {"seconds": "s", "second": "s", "sec": "s", "msec": "ms", "usec": "us"}
_UNITS_OF_TIME |= {"millis": "ms", "micros": "us", "day": "d", "days": "d", "hours": "h"}
_UNITS_OF_TIME |= {"yr": "year", "years": "year", "a": "year", "μs": "us", "utc": "s"}


def _time_unit(name: str, units: Units) -> str | None:
    words = plain(name).split("_")
    for unit in (_unit(units, name), words[-1], OF_CALENDAR.get(words[0], "")):
        unit = _UNITS_OF_TIME.get(unit, unit)
        if unit in SECONDS:
            return unit
    return "d" if words == ["julian", "date"] else None


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
                got = f"{sigma[bad][0]:g} ({bad.sum()} such rows in run {run})"
                beside = f"beside every value of {name}"
                raise InputError(f"{source}: {of}: expected σ above 0 {beside}, got {got}")


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


def with_crossings(observe: Mapping[str, Any], events: Mapping[str, str]) -> dict[str, Any]:
    """Join what sensors show with columns of ``events``, whose expression h is the formula
    "crossing(h)". Raises InputError where h is no text, or a column stands in both."""
    for name, expression in events.items():
        if not (isinstance(expression, str) and expression.strip()):
            raise InputError(
                f"events: {name}: expected an expression of coordinates as text, as "
                f"{{'{name}': 'theta'}}, got {expression!r}"
            )
        if name in observe:
            raise InputError(f"{name}: expected it in observe or in events, not in both")
    return {**observe, **{name: f"crossing({one})" for name, one in events.items()}}


def crossings_in(observe: Mapping[str, Any]) -> tuple[str, ...]:
    """The columns of which ``observe`` says that they hold times of crossings."""
    return tuple(n for n, one in observe.items() if isinstance(one, str) and "crossing(" in one)


TOLD = 0.9  # share of the changes that quadratic functions explain of no positions


def explained(times: Sequence[np.ndarray], runs: Sequence[np.ndarray]) -> float:
    """Share of the variance of the changes of columns (n_r, k) of runs, at times (n_r,), that
    quadratic functions explain, of the column with the least: the motion of states ẋ = f(x).

    x(t + h) − x(t) = ∫ f dt is fitted with f quadratic, which no noise of a derivative spoils.
    """
    kept = [(t[own], x[own]) for t, x in zip(times, runs, strict=True) if len(own := _whole(x))]
    if not kept:
        return 0.0
    every = np.concatenate([x for _, x in kept])
    size = np.sqrt(np.mean(every**2, axis=0)) + 1e-300
    # One function at a time: those of a long record side by side would fill the memory.
    sums = [
        [cumulative_simpson(f, x=t, initial=0) for f in products(x / size, 2).T] for t, x in kept
    ]
    shares = []
    for k in _Options.lags:
        thin = 1 + sum(max(len(x) - k, 0) for _, x in kept) // _Options.most
        moved = [(x[k:] - x[:-k])[::thin] for _, x in kept]
        rows = [np.stack([(f[k:] - f[:-k])[::thin] for f in own], axis=1) for own in sums]
        shares.append(_explained(moved, rows, -(-k // thin), every))
    return max(shares)


def constants(runs: Sequence[np.ndarray]) -> int:
    """Number of quadratic functions of columns (n_r, k) of runs, or of linear ones with logarithms,
    that are constant in each run and differ between runs."""
    runs = [x[own] for x in runs if len(own := _whole(x))]
    if len(runs) < _Options.runs:
        return 0
    found = [_constant_within([products(x, 2)[:, 1:] for x in runs])]
    if all((x > 0).all() for x in runs):
        found.append(_constant_within([np.concatenate([x, np.log(x)], axis=1) for x in runs]))
    return max(found)


def _whole(x: np.ndarray) -> np.ndarray:
    """The rows of a run (n, k) in which nothing is missing; none of a run that is too short."""
    own = np.flatnonzero(np.isfinite(x).all(axis=1))
    return own if len(own) > 2 * _Options.parts else own[:0]


def _explained(moved: list[np.ndarray], sums: list[np.ndarray], lag: int, every) -> float:
    """The least share of the changes (n_r, k) over ``lag`` that functions (n_r, m) explain, of each
    part by the fit to the others; 0 of changes that are too few or too long."""
    target, rows = np.concatenate(moved), np.concatenate(sums)
    if not len(target):
        return 0.0
    variance = np.var(target, axis=0)
    if np.any(variance > _Options.quarter * np.var(every, axis=0)):
        return 0.0
    left, judged = np.zeros(target.shape[1]), 0
    for own, others in _parts([len(x) for x in moved], lag):
        if len(others) < _Options.samples * rows.shape[1]:
            return 0.0
        c = np.linalg.lstsq(rows[others], target[others], rcond=_Options.told_apart)[0]
        left += np.sum((target[own] - rows[own] @ c) ** 2, axis=0)
        judged += len(own)
    return float(np.min(1 - left / np.maximum(judged * variance, 1e-300)))


def _parts(lengths: list[int], lag: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(changes of a part, those of the others that share no time with them): of many runs a part is
    every eighth run, of few an eighth of each run."""
    run = np.repeat(np.arange(len(lengths)), lengths)
    place = np.concatenate([np.arange(n) for n in lengths])
    for k in range(_Options.parts):
        if len(lengths) >= _Options.runs:
            own = run % _Options.parts == k
            others = ~own
        else:
            edges = np.array([(n * k, n * (k + 1)) for n in lengths])[run] // _Options.parts
            own = (edges[:, 0] <= place) & (place < edges[:, 1])
            others = (place <= edges[:, 0] - lag) | (place >= edges[:, 1] - 1 + lag)
        if own.any():
            yield np.flatnonzero(own), np.flatnonzero(others)


def _constant_within(tables: list[np.ndarray]) -> int:
    """Number of combinations of functions (n_r, m) whose variance is that between runs."""
    every = np.concatenate(tables)
    within = np.concatenate([table - table.mean(axis=0) for table in tables])
    scale = every.std(axis=0) + 1e-300
    within, every = within / scale, (every - every.mean(axis=0)) / scale
    total = every.T @ every
    total += 1e-6 * len(every) * np.eye(len(total))
    parts = eigh(within.T @ within, total, eigvals_only=True)
    return int(np.sum(parts < _Options.invariant))
