"""Columns that a sensor did not measure, or measured badly."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from gfnn_jax.data.faults.angles import TURN
from gfnn_jax.data.faults.fault import Fault
from gfnn_jax.data.traits import Traits
from gfnn_jax.data.wrong_values import in_words

_REMEDY = "Leave these samples out: --from, --to, or NaN in them"
_FLAT = 3  # equal extremes in a row that a sensor's limit makes


def constant(traits: Traits) -> Iterator[Fault]:
    recording = traits.recording
    for role in ("positions", "velocities", "momenta", "inputs"):
        for name in getattr(recording, role):
            values = traits.columns[name]
            if np.isfinite(values).any() and np.nanmin(values) == np.nanmax(values):
                shown = np.nanmin(values) / recording.factors[name]
                yield Fault(
                    "constant",
                    f"{name} is {shown:g} {recording.unit(name)}".rstrip() + " in all rows",
                    f"Leave it out of --{role}",
                    wrong=role != "inputs",
                )


def repeated(traits: Traits) -> Iterator[Fault]:
    for one, other in itertools.combinations(traits.recording.columns, 2):
        a, b = traits.columns[one], traits.columns[other]
        if np.nanmin(a) < np.nanmax(a) and np.array_equal(a, b, equal_nan=True):
            yield Fault(
                "repeated", f"{one} and {other} are equal in all rows", f"Leave {other} out"
            )


def clipped(traits: Traits) -> Iterator[Fault]:
    """Columns that stay at their very extreme, entering it by steps that a smooth turn has not."""
    recording = traits.recording
    for name in (*recording.positions, *recording.velocities):
        values = traits.columns[name]
        if name in recording.angles and np.nanmax(values) - np.nanmin(values) > 0.95 * TURN:
            continue
        step = traits.resolution[name] or 0.0
        for extreme in (np.nanmin(values), np.nanmax(values)):
            count = _flats(
                traits.by_run(name), extreme, max(4 * step, 1e-9 * float(np.nanstd(values)))
            )
            if count > 1:
                shown = extreme / recording.factors[name]
                yield Fault(
                    "clipped",
                    f"{name} saturates: {count} times it stays at its extreme, {shown:.6g} "
                    f"{recording.unit(name)}".rstrip(),
                    _REMEDY,
                )


def _flats(runs: list[np.ndarray], extreme: float, step: float) -> int:
    """Stretches of equal extremes whose neighbours are more than a step away."""
    count = 0
    for x in runs:
        at = np.concatenate([[False], x == extreme, [False]])
        begins = np.flatnonzero(at[1:] & ~at[:-1])
        ends = np.flatnonzero(~at[1:] & at[:-1])
        for begin, end in zip(begins, ends, strict=True):
            sides = [abs(x[k] - extreme) for k in (begin - 1, end) if 0 <= k < len(x)]
            count += int(end - begin >= _FLAT and max(sides, default=0.0) > step)
    return count


def missing(traits: Traits) -> Iterator[Fault]:
    recording = traits.recording
    for name in recording.columns:
        gone = [
            run
            for run, x in zip(recording.runs, traits.by_run(name), strict=True)
            if not np.isfinite(x).any()
        ]
        cells = int(np.sum(~np.isfinite(traits.columns[name])))
        if gone:
            found = f"{name} has no values in run {', '.join(gone[:8])}"
            yield Fault("missing column", found, "", wrong=False)
        elif cells:
            rows = "1 row, which is" if cells == 1 else f"{cells} rows, which are"
            found = f"{name} has no value in {rows} not used for it"
            yield Fault("missing", found, "", wrong=False)


def wrong(traits: Traits) -> Iterator[Fault]:
    """Sensors that repeat one value while the motion goes on, and samples far from where those
    around them lead."""
    each = (in_words(traits.recording, name, of) for name, of in traits.wrong.items())
    told = [one for of_column in each for one in of_column]
    for kind in ("stuck", "outliers"):
        for one in told:
            if one.kind == kind:
                yield Fault(kind, one.text, "Left out of a fit", wrong=False)
