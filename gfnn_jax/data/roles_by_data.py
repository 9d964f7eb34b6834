"""The roles of a recording's columns, by what they hold, where names do not tell."""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Mapping, Sequence

import numpy as np

from gfnn_jax.errors import InputError
from gfnn_jax.signals.derivatives import NARROWEST, derivatives
from gfnn_jax.signals.noise import noise

_LIKE = 0.85  # likeness of a column to the derivative of another, that tells
_MOST = 12  # columns

Runs = Mapping[str, tuple[np.ndarray, dict[str, np.ndarray]]]


def parameters(runs: Runs, names: Sequence[str]) -> tuple[str, ...]:
    """Columns that are constant in every run and differ between runs."""
    found = []
    for name in names:
        columns = [values[name] for _, values in runs.values()]
        constant = all(np.isfinite(x).all() and np.ptp(x) == 0 for x in columns)
        if constant and len({float(x[0]) for x in columns}) > 1:
            found.append(name)
    return tuple(found)


def positions_and_velocities(
    source: str, runs: Runs, names: Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Columns that make pairs, one the other's derivative.

    Raises InputError where a column is left over that may be a position or an input.
    """
    times = [t for t, _ in runs.values()]
    some = names[:_MOST]
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
    size = max(min(n.size for n in noises) // 2, NARROWEST)
    local = derivatives(times, table, size, [n.sigma for n in noises])
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
