"""σ of columns: one number, or one for each value, as a column of its own."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gfnn_jax.data.tables import Table
from gfnn_jax.errors import InputError

_ENDING = "_std"  # of the name of a column that holds the σ of another


def with_sigmas(
    tables: Sequence[Table], std: Mapping[str, Any]
) -> tuple[list[Table], dict[str, str]]:
    """The tables with a column for every σ that was given for each value, and the names of these
    columns by that of the column they belong to.

    std: name -> number, (T,) values, or the name of a column. A column x_std beside x is taken for
    the σ of x. Raises InputError where one is no size or belongs to nothing.
    """
    names = list(dict.fromkeys(name for table in tables for name in table.columns))
    found = {n.removesuffix(_ENDING): n for n in names if n.endswith(_ENDING)}
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
            found[name] = name + _ENDING
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
