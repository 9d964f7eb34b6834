"""Rollouts shared out among devices, fits among processes: the same results, and how fast.

    python benchmarks/scaling.py             all of it (about six minutes on two cores), tables
    python benchmarks/scaling.py --quick     few steps, into runs/scaling
    python benchmarks/scaling.py --only fit-map,fit-law,reading

Every number of devices has a process of its own, with so many virtual CPU devices; the digest of
all states says whether the bits are the same. More devices than cores gain nothing: the table says
how many there are. Beside them the map itself, all lanes in one batch, and blocks of other sizes.

Fits: the chosen map of a sample is fitted to all rows by 1, 2 and 4 processes of this machine, each
of which reads its own rows of one file: seconds, bytes that the processes send, and how far their
maps are apart. Reading: a file of half a gigabyte, and what memory a process needs for its part.
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
from functools import partial
from pathlib import Path

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
    provenance,
    results,
    timed,
)

import gfnn_jax as gfnn
from gfnn_jax import processes
from gfnn_jax.data.files import iterate_pairs, read_sample
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
    """Each number of devices in a process of its own."""
    rows = []
    for devices in DEVICES:
        flags = f"--xla_force_host_platform_device_count={devices}"
        ran = subprocess.run(
            [sys.executable, __file__, "--here", learns, str(20 if quick else STEPS)],
            env={**os.environ, "XLA_FLAGS": flags}, stdout=subprocess.PIPE, text=True, check=True,
        )  # fmt: skip
        rows.append(json.loads(ran.stdout.splitlines()[-1]))
        print(f"  {devices}: {rows[-1]['microseconds']:.2f} µs")
    same = len({row["digest"] for row in rows}) == 1
    if not same:
        raise SystemExit("the bits depend on the number of devices")
    return {"lanes": LANES, "cores": cores(), "same_bits": same, "rows": rows}


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
    """What one of several processes does with its own rows of a file."""
    gfnn.enable_compile_cache()
    group = processes.Group(processes.join())
    chunks = _Chunks(Path(file), group.share)
    fit, held, found = None, None, {}
    if task != "reading" and group.first:
        pairs = next(iterate_pairs(file, SAMPLE))
        fit, _ = fitted(pairs, None, pairs, learn=task, tolerance=1e-6)
        held = pairs.take(slice(500))
    group.told({})  # the others wait until the sample is fitted
    before, started = peak_bytes(), time.perf_counter()
    if task == "reading":
        read_sample(file, num_pairs=10_000, group=group)
        found["rows"] = sum(len(pairs) for pairs in chunks)
    elif fit is not None and held is not None:
        again = refit(fit, chunks, held, group=group)
        found["digest_states"] = np.asarray(again.map.step(held.z0)[0]).tolist()
        found["parameters"] = again.chosen.num_parameters
    else:
        help_refit(group.told(), chunks, group)
    found |= {
        "seconds": time.perf_counter() - started, "sent": group.sent, "before": before,
        "peak": peak_bytes(),
    }  # fmt: skip
    processes.wait_for_all()
    return found


class _Chunks:
    """The pairs of a process, read anew each time."""

    def __init__(self, file: Path, share: processes.Share):
        self.file, self.share = file, share

    def __iter__(self):
        return iterate_pairs(self.file, CHUNK, share=self.share)


def run_group(task: str, file: Path, count: int) -> list[Numbers]:
    """What so many processes have found."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{one.getsockname()[1]}"
    told = {"JAX_COORDINATOR_ADDRESS": address, "JAX_NUM_PROCESSES": str(count)}
    running = [
        subprocess.Popen(
            [sys.executable, __file__, "--group", task, str(file)], stdout=subprocess.PIPE,
            text=True,
            env={"OPENBLAS_NUM_THREADS": "1", **os.environ, **told, "JAX_PROCESS_ID": str(i)},
        )
        for i in range(count)
    ]  # fmt: skip
    outs = [process.communicate()[0] for process in running]
    if any(process.returncode for process in running):
        raise SystemExit("a process failed")
    return [json.loads(out.splitlines()[-1]) for out in outs]


def measure_group(quick: bool, *, task: str) -> Numbers:
    """The same work by each number of processes."""
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
            rows.append({
                "processes": count, "seconds": max(f["seconds"] for f in found),
                "sent": sum(f["sent"] for f in found), "parameters": first.get("parameters"),
                "more_memory": max(f["peak"] - f["before"] for f in found),
            })  # fmt: skip
            print(f"  {rows[-1]}")
    apart = max((float(np.abs(s - states[0]).max()) for s in states), default=None)
    return {"pairs": number, "file_bytes": size, "cores": cores(), "apart": apart, "rows": rows}


ROLLOUTS = {"map": partial(measure, learns="map"), "law": partial(measure, learns="hamiltonian")}
GROUPS = {
    "fit-map": partial(measure_group, task="map"),
    "fit-law": partial(measure_group, task="hamiltonian"),
    "reading": partial(measure_group, task="reading"),
}
PIECES = ROLLOUTS | GROUPS


def tables() -> None:
    """The table of RESULTS.md."""
    heads = (
        "learned", "cores", "one batch, no blocks", *(f"1 device, blocks of {b}" for b in BLOCKS),
        *(f"{n} devices" for n in DEVICES[1:]), "same bits",
    )  # fmt: skip
    rows, found = [], results(ROLLOUTS, "scaling")
    for name, result in found.items():
        m = result["measured"]
        one = m["rows"][0]
        rows.append([
            name, str(m["cores"]), number(one["whole_batch"]),
            *(number(one[f"block_{b}"]) for b in BLOCKS),
            *(number(row["microseconds"]) for row in m["rows"][1:]),
            "yes" if m["same_bits"] else "no",
        ])  # fmt: skip
    text = f"{markdown(heads, rows)}\n\n{provenance(found)}"
    between_markers(TABLES, "scaling", text)
    heads = (
        "all rows", "pairs", "file, MB", "coefficients", "processes", "seconds", "sent, MB",
        "memory beside the start, MB", "maps apart by",
    )  # fmt: skip
    rows, found = [], results(GROUPS, "scaling")
    for name, result in found.items():
        m = result["measured"]
        rows += [
            [
                name, f"{m['pairs']:,}", f"{m['file_bytes'] / 1e6:.0f}",
                str(row["parameters"] or "–"), str(row["processes"]), number(row["seconds"]),
                f"{row['sent'] / 1e6:.3g}", f"{row['more_memory'] / 1e6:.0f}",
                "–" if m["apart"] is None else f"{m['apart']:.1e}",
            ]
            for row in m["rows"]
        ]  # fmt: skip
    text = f"{markdown(heads, rows)}\n\n{provenance(found)}"
    between_markers(TABLES, "scaling-fits", text)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--group"]:
        jax.config.update("jax_enable_x64", True)
        print(json.dumps(in_group(*sys.argv[2:])))
        raise SystemExit
    if sys.argv[1:2] == ["--here"]:
        print(json.dumps(in_this_process(sys.argv[2], int(sys.argv[3]))))
    else:
        main(__doc__ or "", PIECES, "scaling", tables, None)
