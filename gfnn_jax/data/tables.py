"""Tables of named columns: those in memory, and those of files of arrays."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gfnn_jax.data.blocks import damage
from gfnn_jax.data.roles import is_run
from gfnn_jax.errors import InputError


@dataclasses.dataclass(frozen=True)
class Table:
    """Columns of equal length by name: (T,) float64, of runs (T,) text.

    units: by column name, as a header or a row of units gave them. text: names of columns that hold
    no numbers. notes: what reading had to decide. locate: says where a row stands, for a message.
    """

    columns: dict[str, np.ndarray]
    units: dict[str, str] = dataclasses.field(default_factory=dict)
    source: str = "the table"
    text: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    locate: Callable[[int], str] = lambda row: f"row {row + 1}"


def from_memory(table: Any) -> Table:
    """The columns of a dict of arrays or of a DataFrame.

    Arrays of a dict are (T,), or (T, k) for the columns name1 … namek.
    Raises InputError where lengths differ or a column holds no numbers.
    """
    if isinstance(table, Table):
        return table
    if isinstance(table, Mapping):
        named = {str(name): np.asarray(values) for name, values in table.items()}
    elif isinstance(table, np.ndarray) and table.dtype.names:
        named = {name: table[name] for name in table.dtype.names}
    elif hasattr(table, "columns") and hasattr(table, "to_numpy"):  # a DataFrame
        frame: Any = table
        named = {str(name): frame[name].to_numpy() for name in frame.columns}
    else:
        raise InputError(
            f"expected a DataFrame, a dict of arrays or a list of these, got {type(table).__name__}"
        )
    found: dict[str, np.ndarray] = {}
    text = []
    for name, values in named.items():
        if values.ndim not in (1, 2):
            raise InputError(f"{name}: expected an array (T,) or (T, k), got shape {values.shape}")
        if is_run(name):
            found[name] = values.astype(str)
            continue
        try:
            numbers = values.astype(np.float64)
        except (TypeError, ValueError):
            text.append(name)
            continue
        each = {name: numbers} if numbers.ndim == 1 else _spread(name, numbers)
        found.update(each)
    lengths = {name: len(values) for name, values in found.items()}
    if len(set(lengths.values())) > 1:
        raise InputError(
            "expected columns of one length, got "
            + ", ".join(f"{name} {length}" for name, length in lengths.items())
        )
    return Table(found, text=tuple(text))


def _spread(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    return {f"{name}{i + 1}": column for i, column in enumerate(values.T)}


def from_arrays(path: Path, columns: Sequence[str]) -> Table:
    """The columns of an ``.npz`` of named arrays or of an ``.npy`` array (T, k), whose ``columns``
    are then named; a structured array names its own."""
    with damage(path, "the array"):
        loaded = np.load(path, allow_pickle=False)
        if not isinstance(loaded, np.ndarray):
            with loaded as archive:
                loaded = dict(archive.items())
    if isinstance(loaded, np.ndarray) and not loaded.dtype.names:
        if loaded.ndim != 2 or loaded.shape[1] != len(columns):
            raise InputError(
                f"{path}: expected --columns with the names of the columns of an array (T, k), got "
                f"{len(columns)} names for shape {loaded.shape}"
            )
        loaded = dict(zip(columns, loaded.T, strict=True))
    return dataclasses.replace(from_memory(loaded), source=str(path))
