"""Tools of all benchmarks: data and fits, times, results as JSON, tables between markers.

The import sets float64, so it comes before all of JAX. With ``--processor-time`` among a study's
arguments it also puts the processor's clock in place of the wall's, before the package binds one:
seconds and budgets then do not depend on what else the machine does.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import re
import sys
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

PROCESSOR_TIME = "--processor-time"
if PROCESSOR_TIME in sys.argv:
    time.perf_counter = time.monotonic = time.process_time

import commits  # noqa: E402
import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import gfnn_jax as gfnn  # noqa: E402
from gfnn_jax.coordinates import CARTESIAN  # noqa: E402
from gfnn_jax.evaluate import metrics, report  # noqa: E402
from gfnn_jax.maps.saved import versions  # noqa: E402
from gfnn_jax.maps.symplectic_map import SymplecticMap  # noqa: E402
from gfnn_jax.scenes import Scene  # noqa: E402

HERE = Path(__file__).resolve().parent
RESULTS, TABLES, README = HERE / "results", HERE / "RESULTS.md", HERE.parent / "README.md"
PAGE = HERE.parent / "docs" / "results.md"
FIGURES = HERE / "figures"
SEED = 0

Numbers = dict[str, Any]
Pieces = Mapping[str, Callable[[bool], Numbers]]


# Times


class Timed(NamedTuple):
    """Result of a call, seconds of the fastest call, and extra seconds of the first."""

    out: Any
    seconds: float
    compile_seconds: float


def timed(function: Callable[[], Any], repeats: int | None = None) -> Timed:
    """The fastest of so many calls after one that compiles; unless told how many, of as many as fit
    into a good half second."""

    def once() -> tuple[Any, float]:
        started = time.perf_counter()
        out = jax.block_until_ready(function())
        return out, time.perf_counter() - started

    out, first = once()
    _, seconds = once()
    if repeats is None:
        repeats = 1 + int(np.clip(0.6 / seconds, 1, 40))
    fastest = min([seconds, *(once()[1] for _ in range(repeats - 1))])
    return Timed(out, fastest, max(0.0, first - fastest))


class Once(NamedTuple):
    """Result of a single call, its seconds, and the processor seconds of all its threads.

    Other work on the machine changes processor seconds less.
    """

    out: Any
    seconds: float
    processor_seconds: float


def once(function: Callable[[], Any]) -> Once:
    """A call that takes too long to be repeated, compilation included."""
    started, busy = time.perf_counter(), time.process_time()
    out = jax.block_until_ready(function())
    return Once(out, time.perf_counter() - started, time.process_time() - busy)


# Data and fits


def angles_of(scene: Scene | None) -> tuple[int, ...]:
    """Indices of the user's coordinates that are angles."""
    if scene is None or scene.coordinates.forward is not CARTESIAN.forward:
        return ()
    return scene.coordinates.angles


def finite(pairs: gfnn.Pairs) -> gfnn.Pairs:
    """Leave out the pairs whose state collides or escapes within the step."""
    return pairs.take(np.flatnonzero(np.isfinite(np.asarray(pairs.z1)).all(axis=1)))


def drawn(scene: Scene, num_pairs: int, quick: bool) -> tuple[gfnn.Pairs, gfnn.Pairs]:
    """Pairs to learn from, and fresh ones of another key to judge by."""
    key, fresh = jax.random.split(jax.random.key(SEED))
    pairs = gfnn.sample_pairs(scene, num_pairs, key)
    return finite(pairs), finite(gfnn.sample_pairs(scene, 200 if quick else 2_000, fresh))


def one_step_rms(map_: SymplecticMap, fresh: gfnn.Pairs, angles=()) -> float:
    """RMS per component of the one-step state error."""
    return metrics.one_step_rms(np.asarray(map_.step(fresh.z0)[0]), fresh.z1, angles)


def in_float32(map_: SymplecticMap) -> SymplecticMap:
    """Round all arrays of a map to float32."""

    def rounded(leaf):
        is_double = getattr(leaf, "dtype", None) == np.float64
        return jnp.asarray(leaf, jnp.float32) if is_double else leaf

    return jax.tree.map(rounded, map_)


def fitted(pairs: gfnn.Pairs, scene: Scene | None, fresh: gfnn.Pairs, **options):
    """(fit, what was measured of it). The options are those of `gfnn.fit`; the benchmarks' targets
    are absolute errors, so most ask for an ``absolute_tolerance``. Maps are learned, not laws,
    which have a benchmark of their own; without a budget, which would make results depend on what
    else the machine does."""
    options = {"learn": "map", "max_seconds": None, **options}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)  # kept in fit.messages
        fit = gfnn.fit(pairs, scene, seed=SEED, on_progress=lambda m: print(f"  {m}"), **options)
    return fit, {
        "one_step_rms": one_step_rms(fit.map, fresh, angles_of(scene)),
        "pairs": len(pairs),
        "fit_seconds": fit.chosen.fit_seconds,
        "compile_seconds": fit.compile_seconds,
        "total_seconds": fit.seconds,
        **described(fit),
    }


def described(fit: gfnn.Fit) -> Numbers:
    """The chosen candidate."""
    return {
        "chart": fit.chosen.chart,
        "label": fit.chosen.label,
        "base_map": fit.base_map,
        "num_parameters": fit.chosen.num_parameters,
        "kflop_per_step": fit.chosen.operations / 1e3,
        "microseconds_per_step": fit.chosen.microseconds_per_step,
        "validation_rms": fit.chosen.validation_rms,
        "validation_relative": fit.chosen.validation_relative,
        "validation_bound": fit.chosen.validation_bound,
        "tolerance": fit.tolerance,
        "symplecticity_defect": fit.symplecticity_defect,
        "determinants": {name: j.low for name, j in fit.determinants.items()},
        "messages": list(fit.messages),
        "ended": fit.ended,
    }


# Results


def processor_model() -> str:
    """The processor's name where the system tells it, else its architecture."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            names = [line.partition(":")[2].strip() for line in lines if "model name" in line]
    except OSError:
        names = []
    return names[0] if names else platform.machine()


def cores() -> int | None:
    """Processor cores that this process may use, where the system tells."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None


def on_one_core() -> None:
    """Keep this process on one processor core, where the system can."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def circumstances() -> Numbers:
    """Seed, machine, versions, date and code of a measurement."""
    return {
        "seed": SEED,
        "dtype": "float64",
        "device": report.device(),
        "machine": {
            "processor": platform.machine(),
            "model": processor_model(),
            "cores": cores(),
            "load": os.getloadavg()[0],
        },
        "clock": "processor" if time.perf_counter is time.process_time else "wall",
        "python": platform.python_version(),
        "versions": versions(),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "code": commits.code(),
    }


def write(path: Path, result: Numbers) -> None:
    """Write a result with its circumstances as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(report.to_json({**circumstances(), **result}), encoding="utf-8")


def read(paths: Mapping[str, Path]) -> dict[str, Numbers]:
    """The results that there are, in the order of their names."""
    return {n: json.loads(p.read_text(encoding="utf-8")) for n, p in paths.items() if p.exists()}


def results(pieces: Pieces, prefix: str, folder: Path = RESULTS) -> dict[str, Numbers]:
    """Results so far, in the order of the pieces."""
    return read({name: folder / f"{prefix}-{name}.json" for name in pieces})


def main(
    doc: str,
    pieces: Pieces,
    prefix: str,
    tables: Callable[[], None],
    argv: Sequence[str] | None,
    quick_pieces: Sequence[str] = (),
) -> None:
    """The command line of a benchmark: measure what has no result yet, then make the tables.

    pieces: name -> ``measure(quick)`` -> what was measured. prefix: of the results' file names.
    quick_pieces: those that --quick stands for, where all would take more than a minute.
    """
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    parser.add_argument("--only", metavar="A,B", help=", ".join(pieces))
    parser.add_argument("--quick", action="store_true", help="small sizes; writes no tables")
    parser.add_argument("--overwrite", action="store_true", help="measure finished pieces again")
    parser.add_argument("--tables", action="store_true", help="only make tables and figures again")
    parser.add_argument(
        PROCESSOR_TIME, action="store_true", help="seconds of the processor in place of the wall's"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the results")
    arguments = parser.parse_args(argv)
    every = quick_pieces if arguments.quick and quick_pieces else pieces
    chosen = arguments.only.split(",") if arguments.only else list(every)
    unknown = [name for name in chosen if name not in pieces]
    if unknown:
        parser.error(f"unknown piece '{unknown[0]}'; pieces: {', '.join(pieces)}")
    folder = arguments.out or (Path("runs") / prefix if arguments.quick else RESULTS)
    for name in [] if arguments.tables else chosen:
        path = folder / f"{prefix}-{name}.json"
        if path.exists() and not arguments.overwrite:
            continue
        print(f"{prefix} {name}", flush=True)
        started = time.perf_counter()
        measured = pieces[name](arguments.quick)
        seconds = time.perf_counter() - started
        write(
            path,
            {"piece": name, "quick": arguments.quick, "measured": measured, "seconds": seconds},
        )
        print(f"{prefix} {name}: {seconds:.0f} s", flush=True)
        jax.clear_caches()  # a process may map only so many compiled programs
    if folder == RESULTS:
        tables()


# Tables


def number(value) -> str:
    """Format a number for the tables."""
    if value is None:
        return "–"
    if isinstance(value, int) or (isinstance(value, float) and 99.5 <= value < 1e6):
        return f"{value:,.0f}"
    return f"{value:.2g}" if 0.01 <= abs(value) < 1000 or value == 0 else f"{value:.1e}"


def markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of these heads and rows of cells."""
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(cells) + " |" for cells in rows)])


def between_markers(path: Path, name: str, text: str) -> None:
    """Put ``text`` between <!-- name --> and <!-- /name --> of a file, and renew the numbers in the
    prose of README and docs that name a result."""
    before, after = f"<!-- {name} -->\n", f"<!-- /{name} -->"
    whole = path.read_text(encoding="utf-8")
    start, end = whole.index(before) + len(before), whole.index(after)
    path.write_text(whole[:start] + text + "\n" + whole[end:], encoding="utf-8")
    for page in [README, *(README.parent / "docs").glob("*.md")]:
        prose = page.read_text(encoding="utf-8")
        if (renewed := in_prose(prose)) != prose:
            page.write_text(renewed, encoding="utf-8")


_IN_PROSE = re.compile(r"[^\s(]+(?=<!--\s([\w.-]+)/([^>]+?)\s-->)")


def in_prose(text: str) -> str:
    """The text with each number before a <!-- RESULT/KEY/KEY --> as the result's file has it."""

    def shown(found: re.Match[str]) -> str:
        value = json.loads((RESULTS / f"{found[1]}.json").read_text(encoding="utf-8"))["measured"]
        for key in " ".join(found[2].split()).split("/"):
            value = value[key]
        return number(value)

    return _IN_PROSE.sub(shown, text)


def provenance(found: Mapping[str, Numbers]) -> str:
    """Sentence on where and when the numbers were taken."""
    cores: dict[str, set[int]] = {}
    for r in found.values():
        machine = r["machine"]
        where = r["device"].partition(": ")[2]
        where = machine.get("model", machine["processor"]) if where in ("cpu", "") else where
        cores.setdefault(where, set()).add(machine["cores"])
    machines = [f"{name} ({' or '.join(map(str, sorted(n)))} cores)" for name, n in cores.items()]
    dates = sorted({r["date"] for r in found.values()})
    jaxes = sorted({r["versions"]["jax"] for r in found.values()})
    loads = [r["machine"]["load"] for r in found.values()]
    span = dates[0] if len(dates) == 1 else f"{dates[0]} to {dates[-1]}"
    by_processor = sum(r.get("clock") == "processor" for r in found.values())
    clock = f"; {by_processor} of {len(found)} timed in processor seconds" if by_processor else ""
    return (
        f"Measured {span} on {' and '.join(sorted(machines))}, jax {', '.join(jaxes)}, float64, "
        f"seed {SEED}; other work on the machine at the time: load average {min(loads):.1f} to "
        f"{max(loads):.1f}{clock}."
    )
