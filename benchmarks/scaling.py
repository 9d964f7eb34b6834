"""Rollouts shared out among devices: the same bits, and how fast, on 1, 2, 4 and 8 virtual ones.

    python benchmarks/scaling.py             both maps (about three minutes on two cores), table
    python benchmarks/scaling.py --quick     few steps, into runs/scaling

Every number of devices has a process of its own, with so many virtual CPU devices; the digest of
all states says whether the bits are the same. More devices than cores gain nothing: the table says
how many there are. Beside them the map itself, all lanes in one batch, and blocks of other sizes.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from functools import partial

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


PIECES = {"map": partial(measure, learns="map"), "law": partial(measure, learns="hamiltonian")}


def tables() -> None:
    """The table of RESULTS.md."""
    heads = (
        "learned", "cores", "one batch, no blocks", *(f"1 device, blocks of {b}" for b in BLOCKS),
        *(f"{n} devices" for n in DEVICES[1:]), "same bits",
    )  # fmt: skip
    rows, found = [], results(PIECES, "scaling")
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


if __name__ == "__main__":
    if sys.argv[1:2] == ["--here"]:
        print(json.dumps(in_this_process(sys.argv[2], int(sys.argv[3]))))
    else:
        main(__doc__ or "", PIECES, "scaling", tables, None)
