"""What a benchmark of several pieces shares: each has its own JSON, from which tables are made."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

# Sets float64, so it comes before all of JAX.
from targets import RESULTS, Numbers, circumstances

# isort: split
import jax

from gfnn_jax.evaluate import report

Pieces = Mapping[str, Callable[[bool], Numbers]]


def results(pieces: Pieces, prefix: str, folder: Path = RESULTS) -> dict[str, Numbers]:
    """Results so far, in the order of the pieces."""
    paths = {name: folder / f"{prefix}-{name}.json" for name in pieces}
    return {n: json.loads(p.read_text(encoding="utf-8")) for n, p in paths.items() if p.exists()}


def main(
    doc: str,
    pieces: Pieces,
    prefix: str,
    tables: Callable[[], None],
    argv: Sequence[str] | None,
    quick_pieces: Sequence[str] = (),
) -> None:
    """The command line: measure what has no result yet, then make the tables.

    pieces: name -> ``measure(quick)`` -> what was measured. prefix: of the results' file names.
    quick_pieces: those that --quick stands for, where all would take more than a minute.
    """
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    parser.add_argument("--only", metavar="A,B", help=", ".join(pieces))
    parser.add_argument("--quick", action="store_true", help="small sizes; writes no tables")
    parser.add_argument("--overwrite", action="store_true", help="measure finished pieces again")
    parser.add_argument("--tables", action="store_true", help="only make tables and figures again")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the results")
    arguments = parser.parse_args(argv)
    every = quick_pieces if arguments.quick and quick_pieces else pieces
    chosen = arguments.only.split(",") if arguments.only else list(every)
    unknown = [name for name in chosen if name not in pieces]
    if unknown:
        parser.error(f"unknown piece '{unknown[0]}'; pieces: {', '.join(pieces)}")
    folder = arguments.out or (Path("runs") / prefix if arguments.quick else RESULTS)
    folder.mkdir(parents=True, exist_ok=True)
    for name in [] if arguments.tables else chosen:
        path = folder / f"{prefix}-{name}.json"
        if path.exists() and not arguments.overwrite:
            continue
        print(f"{prefix} {name}")
        started = time.perf_counter()
        measured = pieces[name](arguments.quick)
        result = {"piece": name, "quick": arguments.quick, "measured": measured,
                  "seconds": time.perf_counter() - started, **circumstances()}  # fmt: skip
        path.write_text(report.to_json(result), encoding="utf-8")
        print(f"{prefix} {name}: {result['seconds']:.0f} s")
        jax.clear_caches()  # a process may map only so many compiled programs
    if folder == RESULTS:
        tables()
