"""A map in C: the time of a step of one state alone, beside ours in a batch of one and of 1,000.

    python benchmarks/export.py                 pieces without a result, then the table
    python benchmarks/export.py --only section --overwrite
    python benchmarks/export.py --quick         small sizes, into runs/export, no table

A piece's result is one JSON file, export-*.json in benchmarks/results; the section of
benchmarks/RESULTS.md is made from these alone. The process is kept on one core. The C file is
compiled by ``cc``; one state is stepped in a loop that is in C too. heyoka's figures are those of
benchmarks/return_maps.py, at the precision that is closest to our map's own error.
"""

from __future__ import annotations

import ctypes
import functools
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from harness import RESULTS as FOLDER

# Sets float64, so it comes before all of JAX.
from harness import (
    SEED,
    TABLES,
    Numbers,
    between_markers,
    drawn,
    fitted,
    markdown,
    number,
    on_one_core,
    provenance,
    read,
    results,
    timed,
)
from harness import main as run_pieces

# isort: split
import jax
import numpy as np

import gfnn_jax as gfnn
from gfnn_jax.scenes import Scene, driven_pendulum, henon_heiles, henon_heiles_section
from gfnn_jax.solve.status import LEFT_DOMAIN

FLAGS = {"portable": ("-O3", "-std=c99"), "this processor": ("-O3", "-std=c99", "-march=native")}
LOOP = """
void map_many(double *z, long steps) { for (long i = 0; i < steps; i++) map_step(z, z); }
"""
TOLERANCE = 1e-7
SCENES: dict[str, tuple[Callable[[], Scene], dict]] = {
    "section": (henon_heiles_section, {}),
    "pendulum-1": (functools.partial(driven_pendulum, 1), {}),
    "henon-heiles": (functools.partial(henon_heiles, energy=1 / 12), {}),
    "henon-heiles-law": (functools.partial(henon_heiles, energy=1 / 12), {"learn": "hamiltonian"}),
}


def measured(quick: bool, name: str) -> Numbers:
    """Measure one map: agreement over its states, and times of a step."""
    if shutil.which("cc") is None:
        raise SystemExit("expected a C compiler named cc")
    make, options = SCENES[name]
    scene = make()
    pairs, fresh = drawn(scene, 300 if quick else 3_000, quick)
    fit, about = fitted(pairs, scene, fresh, absolute_tolerance=TOLERANCE, **options)
    z0 = np.asarray(gfnn.sample_test_states(scene, 64 if quick else 1_000, jax.random.key(SEED)))
    steps, repeats = (2_000, 1) if quick else (10_000, 20)  # short: other work is beside
    found: Numbers = {"in_c": {}, **about}
    with tempfile.TemporaryDirectory() as folder:
        path = gfnn.export(fit.map, "c", Path(folder) / "map.c")
        found["kilobytes"] = path.stat().st_size / 1e3
        for kind, flags in FLAGS.items():
            found["in_c"][kind] = in_c(path, flags, fit.map, z0, steps, repeats)
    for lanes in (1, len(z0)):
        start, count = fit.map.start(z0[:lanes]), max(steps // lanes, 200)
        advance = functools.partial(fit.map.advance, start, 1, save_every=count)
        taken = timed(lambda advance=advance: advance()[1], repeats).seconds
        found[f"lanes_{'one' if lanes == 1 else 'many'}"] = 1e6 * taken / count / lanes
    step = timed(lambda: fit.map.step(z0[0]), repeats if quick else 200).seconds
    return {**found, "lanes": len(z0), "one_call": 1e6 * step}


def in_c(path: Path, flags: Sequence[str], map_, z0, steps: int, repeats: int) -> Numbers:
    """The compiled file: how it agrees, and the microseconds of a step."""
    # A library that is loaded stays loaded under its name.
    whole = path.with_name(f"{path.stem}{len(flags)}.c")
    library = whole.with_suffix(".so")
    whole.write_text(path.read_text(encoding="utf-8") + LOOP, encoding="utf-8")
    command = ["cc", *flags, "-shared", "-fPIC", str(whole), "-o", str(library), "-lm"]
    before = os.times().children_user
    subprocess.run(command, check=True)
    compiled = os.times().children_user - before  # of the processor: other work is beside
    functions, pointer = ctypes.CDLL(str(library)), ctypes.POINTER(ctypes.c_double)
    images, status = np.array(z0), np.empty(len(z0), int)
    for lane, row in enumerate(images):
        at = row.ctypes.data_as(pointer)
        status[lane] = functions.map_step(at, at)
    expected, info = map_.step(z0)
    good = status <= LEFT_DOMAIN
    z = np.array(z0[0])

    def many():
        z[:] = z0[0]
        functions.map_many(z.ctypes.data_as(pointer), ctypes.c_long(steps))

    return {
        "difference": float(np.abs(images - np.asarray(expected))[good].max()),
        "same_status": bool((status == np.asarray(info.status)).all()),
        "microseconds": 1e6 * timed(many, repeats).seconds / steps,
        "compile_seconds": compiled,
    }


PIECES = {name: functools.partial(measured, name=name) for name in SCENES}


def by_heyoka(name: str, error: float) -> float | None:
    """heyoka's microseconds of one trajectory alone, at its cheapest precision that is as accurate
    as this, or at its best."""
    path = FOLDER / f"return-maps-{name}.json"
    points = read({name: path}).get(name, {}).get("measured", {}).get("curves", {}).get("heyoka")
    if not points:
        return None
    exact = [p for p in points if p["error_1"] <= error]
    return min(p["single"] for p in exact or points[-1:])


HEADS = [
    "map",
    "one-step RMS",
    "C, kB",
    "`cc`, s",
    "agrees to",
    "C, µs",
    "C, `-march=native`",
    "ours, 1 lane in a rollout",
    "ours, one `map.step`",
    "ours, a lane of 1,000",
    "heyoka, 1 lane",
]


def row(name: str, m: Numbers) -> list[str]:
    plain, native = (m["in_c"][kind] for kind in FLAGS)
    same = "" if plain["same_status"] else ", statuses differ"
    return [
        f"{name}: {m['chart']} {m['label']}" + (", base map" if m["base_map"] else ""),
        number(m["one_step_rms"]),
        number(m["kilobytes"]),
        number(plain["compile_seconds"]),
        number(plain["difference"]) + same,
        number(plain["microseconds"]),
        number(native["microseconds"]),
        number(m["lanes_one"]),
        number(m["one_call"]),
        number(m["lanes_many"]),
        number(by_heyoka(name, m["one_step_rms"])),
    ]


def tables() -> None:
    found = results(PIECES, "export")
    if found:
        rows = [row(name, r["measured"]) for name, r in found.items()]
        text = f"{markdown(HEADS, rows)}\n\n{provenance(found)}"
        between_markers(TABLES, "export", text)


def main(argv: Sequence[str] | None = None) -> None:
    on_one_core()
    run_pieces(__doc__ or "", PIECES, "export", tables, argv)


if __name__ == "__main__":
    main()
