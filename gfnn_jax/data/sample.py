"""A random sample of the pairs in files larger than memory, the same for any number of processes.

Arcs of consecutive pairs are kept or left out together: what is fitted to sequences, and held out
by them, needs pairs that go on. Which arcs are kept is told by a hash of their run and place.
"""

from typing import Any

import numpy as np

from gfnn_jax.data import files
from gfnn_jax.data.blocks import ARC, BLOCK_ROWS
from gfnn_jax.errors import InputError
from gfnn_jax.processes import Group

_ARG = "arg "  # before the name of a parameter in a table


def read_sample(
    paths,
    *,
    dt: float | None = None,
    num_pairs: int = 200_000,
    seed: int = 0,
    group: Group | None = None,
) -> files.TrajectoryData:
    """Read a random sample of the pairs of data larger than memory, as `read_trajectories` would.

    paths: a file, or several. group: the processes that each read their own pairs of them, as
    `iterate_pairs` shares them out; the sample, the same for any number, is the first one's, and
    the others get what they have sent.
    The files are read once, block by block, and checked all through; arcs of up to `ARC`
    consecutive pairs of a run are kept with the same probability, in the order of their runs, and
    keep their run and place. Memory is that of the sample and a few blocks. ``digest`` is that of
    the one file, or of several or of a group's the sum of the hashes of all pairs, whatever their
    order.
    """
    alone, group = group is None, group or Group()
    found, checksum, count, extremes = None, np.zeros(1, np.uint64), 0, [np.inf, 0.0]
    for pairs in files.iterate_pairs(paths, BLOCK_ROWS, dt=dt, share=group.share):
        new = _table(pairs, seed)
        args = [column for name, column in new.items() if name.startswith(_ARG)]
        numbers = [*new["pairs"].reshape(len(pairs), -1).T, new["dt"], *args]
        checksum, count = checksum + _mixed(0, numbers).sum(), count + len(pairs)
        extremes = [min(extremes[0], new["dt"].min()), max(extremes[1], new["dt"].max())]
        found = _smallest(_both(found, new), num_pairs)
    of_process = {"count": [count], "hash": checksum, "low": [extremes[0]], "high": [extremes[1]]}
    of_group = group.folded({n: np.array(v) for n, v in of_process.items()}, _both)
    total = group.broadcast({"count": of_group["count"].sum()} if group.first else None)["count"]
    if not total:
        raise InputError(f"{files.named(paths)}: no pair of consecutive states found")
    if group.share.count > 1:  # those that the first will want, and a few more
        more = 10 * np.sqrt(num_pairs * ARC)  # ten deviations of the number below a bound
        part = (num_pairs + more) / max(int(total), 1)
        if found is not None and part < 1:
            found = _taken(found, found["key"] < np.uint64(part * 2.0**64))
        found = group.folded(found or {}, _both)
    with files.opened(files.own_files(paths, group.share)[0][0][1], dt) as source:
        precision, units, period = source.precision, source.units, source.period
        of_pairs_alone, none = source.of_pairs_alone, np.empty((0, 2, 2 * source.dim))
    if not found:  # this process has no pair, and sends none
        no = np.empty(0, int)
        found = {"pairs": none, "dt": none[:, 0, 0], "run": no, "place": no, "key": no}
    found = _smallest(found, num_pairs)
    found = _taken(found, np.lexsort((found["place"], found["run"])))
    if of_pairs_alone:
        # In the order of the file, their arcs were cut at multiples of `ARC`.
        number, pairs = found["run"] + found["place"], found["pairs"]
        begins = np.ones(len(number), bool)
        begins[1:] = (np.diff(number) != 1) | np.any(pairs[:-1, 1] != pairs[1:, 0], axis=1)
        first = np.maximum.accumulate(np.where(begins, np.arange(len(number)), 0))
        found = {**found, "run": number[first], "place": number - number[first]}
    alone = alone and len(files.listed(paths)) == 1
    digest = files.digest_of(files.listed(paths)[0]) if alone else f"{of_group['hash'].sum():016x}"
    same = of_group["low"].min() == of_group["high"].max()
    states = found["pairs"].reshape(-1, found["pairs"].shape[-1])
    args = {n.removeprefix(_ARG): v for n, v in found.items() if n.startswith(_ARG)}
    each = float(found["dt"][0]) if same and len(states) else found["dt"]
    lengths, sources = np.full(len(found["pairs"]), 2), files.named(paths)
    about = digest, precision, units, args or None, period, found["run"], found["place"]
    return files.TrajectoryData(states, lengths, each, sources, *about, sampled=int(total))


def _table(pairs: Any, seed: int) -> dict[str, np.ndarray]:
    """Pairs as arrays by name, with the key of the arc that each is of (N,)."""
    rows = np.stack([pairs.z0, pairs.z1], axis=1)
    each = np.broadcast_to(np.asarray(pairs.dt, np.float64), len(rows))
    args = {_ARG + name: np.asarray(v, np.float64) for name, v in (pairs.args or {}).items()}
    key = _mixed(seed, [pairs.run, pairs.place // ARC])
    own = {"run": pairs.run, "place": pairs.place, "key": key}
    return {"pairs": rows, "dt": each, **own, **args}


def _mixed(seed: int, columns) -> np.ndarray:
    """A hash (N,) of the numbers in each row of the columns, by the finaliser of SplitMix64
    (Steele, Lea & Flood, OOPSLA 2014)."""
    mixed = np.full(len(columns[0]), seed, np.uint64)
    for numbers in columns:
        mixed = mixed + np.uint64(0x9E3779B97F4A7C15)
        mixed ^= np.ascontiguousarray(numbers, np.float64).view(np.uint64)
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
            mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
        mixed ^= mixed >> np.uint64(31)
    return mixed


def _both(one: dict[str, np.ndarray] | None, other: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The rows of both tables, either of which may have none. Raises InputError where they differ
    in what they hold."""
    if not one or not other:
        return one or other
    shapes = [{name: column.shape[1:] for name, column in table.items()} for table in (one, other)]
    if shapes[0] != shapes[1]:
        raise InputError(
            "expected files with the same coordinates and parameters, and all with sequences or "
            "none, got files that differ"
        )
    return {name: np.concatenate([column, other[name]]) for name, column in one.items()}


def _taken(table: dict[str, np.ndarray], rows) -> dict[str, np.ndarray]:
    return {name: column[rows] for name, column in table.items()}


def _smallest(table: dict[str, np.ndarray], most: int) -> dict[str, np.ndarray]:
    """The whole arcs with the smallest keys, as many as make at most so many rows."""
    if len(table["key"]) <= most:
        return table
    keys, lengths = np.unique(table["key"], return_counts=True)
    kept = np.searchsorted(np.cumsum(lengths), most, side="right")
    return _taken(table, table["key"] <= keys[max(kept, 1) - 1])
