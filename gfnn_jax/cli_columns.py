"""Options of the command line about a recording's columns and rows, shared by its commands."""

from __future__ import annotations

import argparse
import math
from typing import Any

from gfnn_jax.data.recording import SECONDS
from gfnn_jax.data.roles import ROLES


def add_column_options(command: argparse.ArgumentParser) -> None:
    """Add the options; `column_options` takes them from what was parsed.

    ``--angles`` are names of columns, or whole numbers, the indices in z of canonical states.
    """
    group = command.add_argument_group(
        "columns of a recording",
        "names separated by commas; without these options the file's names and data decide",
    )
    for role in ROLES:
        group.add_argument(f"--{role}", type=_names, metavar="A,B", help=f"columns of {role}")
    group.add_argument(
        "--angles",
        type=_names_or_indices,
        metavar="A,B",
        help="positions with period 2π; of canonical states indices in z, as 0,2",
    )
    group.add_argument("--degrees", type=_names, metavar="A,B", help="columns in degrees")
    group.add_argument(
        "--columns",
        type=_names,
        metavar="A,B",
        help="columns to read; names of all of them where the file has none",
    )
    group.add_argument("--time-unit", choices=tuple(SECONDS), help="of the times (default s)")
    group.add_argument(
        "--std",
        type=_sigmas,
        action="append",
        metavar="NAME=σ",
        help="noise of a column, known: a number, or the column that holds it for each value",
    )
    group.add_argument(
        "--mass",
        type=_numbers,
        action="append",
        metavar="NAME=m",
        help="known mass, or moment of inertia, of one position, which gives L its unit",
    )
    group.add_argument(
        "--offset", type=_names, metavar="A,B", help="columns whose offset is fitted with the law"
    )
    group.add_argument(
        "--scale", type=_names, metavar="A,B", help="columns whose scale is fitted with the law"
    )
    group.add_argument(
        "--observe",
        type=_formula,
        action="append",
        metavar="COLUMN=TEXT",
        help="what a sensor shows, as 'px = x0 + R*sin(theta + tilt)': its parameters are fitted",
    )
    group.add_argument(
        "--guess",
        type=_guesses,
        action="append",
        metavar="NAME=X",
        help="start values of the parameters of --observe",
    )
    group.add_argument(
        "--coordinates",
        type=_names,
        metavar="A,B",
        help="names of coordinates that --observe is written in, where no column measures them",
    )
    group.add_argument(
        "--from",
        dest="start",
        type=finite,
        metavar="T",
        help="rows from time T on, in the file's unit",
    )
    group.add_argument(
        "--to", dest="stop", type=finite, metavar="T", help="rows up to time T, in that unit"
    )
    group.add_argument("--every", type=_count, metavar="K", help="every K-th row")


def column_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """The options that were given, as keywords of `gfnn_jax.read`; ``mass`` is none of them."""
    names = (
        *ROLES,
        "angles",
        "degrees",
        "columns",
        "time_unit",
        "offset",
        "scale",
        "start",
        "stop",
        "every",
        "coordinates",
    )
    given = {name: getattr(arguments, name) for name in names}
    for name in ("std", "observe", "guess"):
        given[name] = dict(pair for pairs in getattr(arguments, name) or () for pair in pairs)
    return {name: value for name, value in given.items() if value not in (None, {})}


def masses(arguments: argparse.Namespace) -> dict[str, float]:
    """The known masses by name of a position."""
    return dict(pair for pairs in arguments.mass or () for pair in pairs)


def names_roles(options: dict[str, Any]) -> bool:
    """Return whether keywords of `column_options` say what columns are, which makes a file a
    recording."""
    return bool({*ROLES, "columns", "coordinates", "observe"} & set(options))


def _names(text: str) -> tuple[str, ...]:
    names = tuple(part.strip() for part in text.split(",") if part.strip())
    if not names or len(set(names)) < len(names):
        raise argparse.ArgumentTypeError(
            f"expected different names separated by commas, got '{text}'"
        )
    return names


def _names_or_indices(text: str) -> tuple[str, ...] | tuple[int, ...]:
    names = _names(text)
    if len(names) < len(text.split(",")):
        raise argparse.ArgumentTypeError(
            f"expected different names or indices separated by commas, got '{text}'"
        )
    return tuple(map(int, names)) if all(name.isdecimal() for name in names) else names


def _numbers(text: str) -> list[tuple[str, float]]:
    pairs = []
    for part in text.split(","):
        name, equals, number = part.partition("=")
        value = _float(number)
        if not (name.strip() and equals and math.isfinite(value) and value > 0):
            raise argparse.ArgumentTypeError(f"expected NAME=NUMBER above 0, got '{part}'")
        pairs.append((name.strip(), value))
    return pairs


def _sigmas(text: str) -> list[tuple[str, float | str]]:
    """Numbers, or names of columns."""
    named = [part.partition("=") for part in text.split(",")]
    return [
        (name.strip(), column.strip())
        if name.strip() and math.isnan(_float(column)) and column.strip()
        else _numbers(f"{name}{equals}{column}")[0]
        for name, equals, column in named
    ]


def _guesses(text: str) -> list[tuple[str, float]]:
    pairs = [part.partition("=") for part in text.split(",")]
    if not all(name.strip() and math.isfinite(_float(number)) for name, _, number in pairs):
        raise argparse.ArgumentTypeError(f"expected NAME=NUMBER, got '{text}'")
    return [(name.strip(), float(number)) for name, _, number in pairs]


def _formula(text: str) -> list[tuple[str, str]]:
    column, _, formula = text.partition("=")
    if not (column.strip() and formula.strip()):
        raise argparse.ArgumentTypeError(f"expected COLUMN=FORMULA, got '{text}'")
    return [(column.strip(), formula.strip())]


def finite(text: str) -> float:
    """The number that an option's text is."""
    if not math.isfinite(_float(text)):
        raise argparse.ArgumentTypeError(f"expected a finite number, got '{text}'")
    return float(text)


def _count(text: str) -> int:
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"expected a whole number above 0, got '{text}'")
    return int(text)


def _float(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
