"""Rollouts and fits shared out among devices and processes: the same results, and how fast.

    python benchmarks/scaling.py             all of it (about six minutes on two cores), tables
    python benchmarks/scaling.py --quick     few steps, into runs/scaling
    python benchmarks/scaling.py --only fit-map,fit-law,reading
    benchmarks/gpu.sh                        the rows of a GPU, on a machine that has one

Every number of devices has a process of its own, with so many virtual CPU devices; the digest of
all states says whether the bits are the same. More devices than cores gain nothing: the table says
how many there are. Beside them the map itself, all lanes in one batch, and blocks of other sizes.

Fits: the chosen map of a sample is fitted to all rows by 1, 2 and 4 processes of this machine, each
of which reads its own rows of one file: seconds, bytes that the processes send, and how far their
maps are apart. Reading: a file of half a gigabyte, and what memory a process needs for its part.

Fits on devices: the factor of a least-squares problem, one Gauss–Newton problem of a law and some
iterations of an ensemble, by a fit that was told no devices and by 1, 2, 4 and 8 of them, processor
seconds beside.
"""

from __future__ import annotations

import hashlib
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from harness import (
    SEED,
    TABLES,
    Numbers,
    between_markers,
    cores,
    fitted,
    main,
    markdown,
    number,
    once,
    provenance,
    results,
    timed,
)

import gfnn_jax as gfnn
from gfnn_jax import processes
from gfnn_jax.data.files import iterate_pairs
from gfnn_jax.data.sample import read_sample
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.mlp import Mlp, amplitude_of
from gfnn_jax.families.products import Products
from gfnn_jax.families.terms import polynomial_terms
from gfnn_jax.fitting import gauss_newton, least_squares, linear_starts, row_blocks
from gfnn_jax.fitting.levenberg_marquardt import GradientFit, Limits
from gfnn_jax.flows.collocation import Steps
from gfnn_jax.generating.charts import MIDPOINT
from gfnn_jax.learn.refit import help_refit, refit
from gfnn_jax.maps import sharded
from gfnn_jax.scenes import henon_heiles

DEVICES, BLOCKS, LANES, STEPS = (1, 2, 4, 8), (64, 256, 1024), 2_048, 50


def learned(learns: str):
    """The map of Hénon–Heiles, or its law, and states below the energy it was fitted to."""
    scene = henon_heiles(energy=1 / 12)
    pairs = gfnn.sample_pairs(scene, 3_000, jax.random.key(SEED))
    fit, _ = fitted(pairs, scene, pairs, learn=learns, tolerance=1e-9)
    return fit.map, np.resize(gfnn.sample_test_states(scene, 512, jax.random.key(1)), (LANES, 4))


def in_this_process(learns: str, steps: int) -> Numbers:
    """Microseconds per lane and step on all devices of this process, and the states' digest."""
    gfnn.enable_compile_cache()
    map_, z0 = learned(learns)
    devices = len(jax.devices())

    def microseconds(roll) -> tuple[float, Numbers]:
        rolled = timed(lambda: roll(z0, steps, save_every=steps), repeats=2)
        digest = hashlib.sha256(np.asarray(rolled.out[0]).tobytes()).hexdigest()
        return 1e6 * rolled.seconds / (steps * LANES), {"digest": digest}

    each, told = microseconds(map_.sharded().rollout)
    found = {"devices": devices, "microseconds": each, **told}
    if devices == 1:
        found["whole_batch"] = microseconds(map_.rollout)[0]
        for block in BLOCKS:
            sharded._ON_CPU = block
            found[f"block_{block}"] = microseconds(map_.sharded().rollout)[0]
    return found


def measure(quick: bool, *, learns: str) -> Numbers:
    """Measure each number of devices in a process of its own."""
    rows = []
    for devices in DEVICES:
        flags = f"--xla_force_host_platform_device_count={devices}"
        done = subprocess.run(
            [sys.executable, __file__, "--here", learns, str(20 if quick else STEPS)],
            env={**os.environ, "XLA_FLAGS": flags},
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
        rows.append(json.loads(done.stdout.splitlines()[-1]))
        print(f"  {devices}: {rows[-1]['microseconds']:.2f} µs")
    same = len({row["digest"] for row in rows}) == 1
    if not same:
        raise SystemExit("the bits depend on the number of devices")
    return {"lanes": LANES, "cores": cores(), "same_bits": same, "rows": rows}


# Fits on devices.

SHARED = {"rows": (40_000, 8), "gauss-newton": (40_000, 4), "ensemble": (1_000, 8)}


def problem(task: str, quick: bool) -> Callable[[], Any]:
    """A part of a fit, as a function without arguments: arrays that should not depend on who makes
    them. Of so many pairs, and terms of this degree or networks."""
    number, size = SHARED[task]
    scene = henon_heiles(energy=1 / 12)
    pairs = gfnn.sample_pairs(scene, number // (10 if quick else 1), jax.random.key(SEED))
    z0, z1, dt = np.asarray(pairs.z0), np.asarray(pairs.z1), float(pairs.dt)
    w, target = MIDPOINT.evaluation_point(z0, z1), MIDPOINT.target_gradient(z0, z1, dt)
    if task == "rows":
        family = Products(box_inputs(w), size)
        return lambda: least_squares.reduce(family, [(w, target)], np.ones(4)).factor
    if task == "gauss-newton":
        terms = polynomial_terms(2, size)
        own = gauss_newton.Problem(z0, z1, dt, np.ones(4))
        c = linear_starts.midpoint_start(terms, z0, z1, dt, np.ones(4))
        return lambda: own.linearised(terms, c, Steps(5, 1), np.arange(len(z0))).factor
    network = Mlp(box_inputs(w), (16, 16, 16), "gelu", amplitude_of(w, target))
    starts = [network.init(key, np.float64) for key in jax.random.split(jax.random.key(1), size)]
    held = len(w) // 5

    def trained():
        result = GradientFit(
            w[held:],
            target[held:],
            validation=(w[:held], target[:held]),
            limits=Limits(2 if quick else 5),
        ).train_together(network, starts, np.ones((size, len(w) - held)))
        return np.concatenate([np.ravel(a) for a in jax.tree.leaves(result.params)])

    return trained


def on_devices_here(count: int, quick: bool) -> Numbers:
    """Seconds on so many devices of this process, 0 for none told, and digests."""
    gfnn.enable_compile_cache()
    found: Numbers = {"devices": count}
    for task in SHARED:
        work = problem(task, quick)
        with row_blocks.on_devices(jax.local_devices()[:count]):
            work()
            best = min((once(work) for _ in range(3)), key=lambda one: one.seconds)
        found[task] = {
            "seconds": best.seconds,
            "processor_seconds": best.processor_seconds,
            "digest": hashlib.sha256(np.ascontiguousarray(best.out).tobytes()).hexdigest(),
        }
    return found


def measure_fits_on_devices(quick: bool) -> Numbers:
    """Measure without a given number of devices, then each number in a process of its own."""
    rows = []
    for count in (0, *DEVICES):
        flags = f"--xla_force_host_platform_device_count={max(count, 1)}"
        done = subprocess.run(
            [sys.executable, __file__, "--fits-here", str(count), str(int(quick))],
            env={**os.environ, "XLA_FLAGS": flags},
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
        rows.append(json.loads(done.stdout.splitlines()[-1]))
        print(f"  {count}: " + ", ".join(f"{t} {rows[-1][t]['seconds']:.2f} s" for t in SHARED))
    if any(len({row[task]["digest"] for row in rows[1:]}) > 1 for task in SHARED):
        raise SystemExit("the bits depend on the number of devices")
    return {
        "pairs": {t: n // (10 if quick else 1) for t, (n, _) in SHARED.items()},
        "cores": cores(),
        "same_bits": True,
        "rows": rows,
    }


# Fits of several processes.

PROCESSES, SAMPLE, CHUNK = (1, 2, 4), 3_000, 50_000
ROWS = {"map": 100_000, "hamiltonian": 20_000, "reading": 2**23}  # the last: 512 MB


def peak_bytes() -> int:
    """The most memory that this process has had."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM"):  # that of `resource` counts the parent's too
            return 1024 * int(line.split()[1])
    raise SystemExit("expected Linux's /proc")


def in_group(task: str, file: str) -> Numbers:
    """Work of one of several processes on its own rows of a file."""
    gfnn.enable_compile_cache()
    group = processes.Group(processes.join())
    chunks = _Chunks(Path(file), group.share)
    fit, held, found = None, None, {}
    if task != "reading" and group.first:
        pairs = next(iterate_pairs(file, SAMPLE))
        fit, _ = fitted(pairs, None, pairs, learn=task, tolerance=1e-6)
        held = pairs.take(slice(500))
    group.broadcast({})  # the others wait until the sample is fitted
    before, started = peak_bytes(), time.perf_counter()
    if task == "reading":
        read_sample(file, num_pairs=10_000, group=group)
        found["rows"] = sum(len(pairs) for pairs in chunks)
    elif fit is not None and held is not None:
        again = refit(fit, chunks, held, group=group)
        found["digest_states"] = np.asarray(again.map.step(held.z0)[0]).tolist()
        found["parameters"] = again.chosen.num_parameters
    else:
        help_refit(group.broadcast(), chunks, group)
    found |= {
        "seconds": time.perf_counter() - started,
        "sent": group.sent,
        "before": before,
        "peak": peak_bytes(),
    }
    processes.wait_for_all()
    return found


class _Chunks:
    """The pairs of a process, read anew each time."""

    def __init__(self, file: Path, share: processes.Share):
        self.file, self.share = file, share

    def __iter__(self):
        return iterate_pairs(self.file, CHUNK, share=self.share)


def run_group(task: str, file: Path, count: int) -> list[Numbers]:
    """Run ``count`` processes on a file, and return their results."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{one.getsockname()[1]}"
    told = {"JAX_COORDINATOR_ADDRESS": address, "JAX_NUM_PROCESSES": str(count)}
    running = [
        subprocess.Popen(
            [sys.executable, __file__, "--group", task, str(file)],
            stdout=subprocess.PIPE,
            text=True,
            env={"OPENBLAS_NUM_THREADS": "1", **os.environ, **told, "JAX_PROCESS_ID": str(i)},
        )
        for i in range(count)
    ]
    outs = [process.communicate()[0] for process in running]
    if any(process.returncode for process in running):
        raise SystemExit("a process failed")
    return [json.loads(out.splitlines()[-1]) for out in outs]


def measure_group(quick: bool, *, task: str) -> Numbers:
    """Measure the same work by each number of processes."""
    rows, states = [], []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "pairs.npz"
        number = ROWS[task] // (20 if quick else 1)
        scene = henon_heiles(energy=1 / 12)
        pairs = gfnn.sample_pairs(scene, min(number, ROWS["map"]), jax.random.key(SEED))
        z0, z1 = (np.resize(np.asarray(z), (number, 4)) for z in (pairs.z0, pairs.z1))
        np.savez(file, z0=z0, z1=z1, dt=scene.dt)
        size = file.stat().st_size
        for count in PROCESSES:
            found = run_group(task, file, count)
            first = found[0]
            if "digest_states" in first:
                states.append(np.array(first.pop("digest_states")))
            rows.append(
                {
                    "processes": count,
                    "seconds": max(f["seconds"] for f in found),
                    "sent": sum(f["sent"] for f in found),
                    "parameters": first.get("parameters"),
                    "more_memory": max(f["peak"] - f["before"] for f in found),
                }
            )
            print(f"  {rows[-1]}")
    apart = max((float(np.abs(s - states[0]).max()) for s in states), default=None)
    return {"pairs": number, "file_bytes": size, "cores": cores(), "apart": apart, "rows": rows}


ROLLOUTS = {"map": partial(measure, learns="map"), "law": partial(measure, learns="hamiltonian")}
GROUPS = {
    "fit-map": partial(measure_group, task="map"),
    "fit-law": partial(measure_group, task="hamiltonian"),
    "reading": partial(measure_group, task="reading"),
}
ON_DEVICES = {"fit-devices": measure_fits_on_devices}
PIECES = ROLLOUTS | ON_DEVICES | GROUPS


def tables() -> None:
    """The table of RESULTS.md."""
    heads = (
        "learned",
        "cores",
        "one batch, no blocks",
        *(f"1 device, blocks of {b}" for b in BLOCKS),
        *(f"{n} devices" for n in DEVICES[1:]),
        "same bits",
    )
    rows, found = [], results(ROLLOUTS, "scaling")
    for name, result in found.items():
        m = result["measured"]
        one = m["rows"][0]
        rows.append(
            [
                name,
                str(m["cores"]),
                number(one["whole_batch"]),
                *(number(one[f"block_{b}"]) for b in BLOCKS),
                *(number(row["microseconds"]) for row in m["rows"][1:]),
                "yes" if m["same_bits"] else "no",
            ]
        )
    text = f"{markdown(heads, rows)}\n\n{provenance(found)}"
    between_markers(TABLES, "scaling", text)
    heads = (
        "a part of a fit",
        "pairs",
        "cores",
        "devices",
        "seconds",
        "processor seconds",
        "same bits",
    )
    rows, found = [], results(ON_DEVICES, "scaling")
    for result in found.values():
        m = result["measured"]
        rows += [
            [
                task,
                f"{m['pairs'][task]:,}",
                str(m["cores"]),
                str(row["devices"] or "none told"),
                number(row[task]["seconds"]),
                number(row[task]["processor_seconds"]),
                "yes" if m["same_bits"] and row["devices"] else "–",
            ]
            for task in SHARED
            for row in m["rows"]
        ]
    if found:
        text = f"{markdown(heads, rows)}\n\n{provenance(found)}"
        between_markers(TABLES, "scaling-fit-devices", text)
    heads = (
        "all rows",
        "pairs",
        "file, MB",
        "coefficients",
        "processes",
        "seconds",
        "sent, MB",
        "memory beside the start, MB",
        "maps apart by",
    )
    rows, found = [], results(GROUPS, "scaling")
    for name, result in found.items():
        m = result["measured"]
        rows += [
            [
                name,
                f"{m['pairs']:,}",
                f"{m['file_bytes'] / 1e6:.0f}",
                str(row["parameters"] or "–"),
                str(row["processes"]),
                number(row["seconds"]),
                f"{row['sent'] / 1e6:.3g}",
                f"{row['more_memory'] / 1e6:.0f}",
                "–" if m["apart"] is None else f"{m['apart']:.1e}",
            ]
            for row in m["rows"]
        ]
    text = f"{markdown(heads, rows)}\n\n{provenance(found)}"
    between_markers(TABLES, "scaling-fits", text)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--group"]:
        jax.config.update("jax_enable_x64", True)
        print(json.dumps(in_group(*sys.argv[2:])))
        raise SystemExit
    if sys.argv[1:2] == ["--fits-here"]:
        print(json.dumps(on_devices_here(int(sys.argv[2]), sys.argv[3] == "1")))
    elif sys.argv[1:2] == ["--here"]:
        print(json.dumps(in_this_process(sys.argv[2], int(sys.argv[3]))))
    else:
        main(__doc__ or "", PIECES, "scaling", tables, None)
