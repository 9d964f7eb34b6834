"""The first answer: seconds, compilations and Python calls of fresh processes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

# Sets float64, so it comes before all of JAX.
from harness import HERE, SEED, Numbers

# isort: split
import jax
import numpy as np

import gfnn_jax as gfnn

# row -> (title, the release before, as its issue was filed, the most it may be)
START: dict[str, tuple[str, str, float]] = {
    "run_warm": (
        "`gfnn run two-body --quick`, compile cache warm: time ÷ time of importing its libraries",
        "16–20",
        5,
    ),
    "run_cold": ("the same, compile cache empty", "60", 10),
    "run_compilations": ("XLA compilations in it", "392", 60),
    "run_calls": ("Python calls in it (cProfile), millions", "47", 12),
    "fit_command": ("`gfnn fit` of 4,000 pairs, d = 2, tolerance 1e-7, warm, seconds", "30–100", 8),
    "first_fit": (
        "first `gfnn.fit` of 2,000 pairs, d = 2, in Python without a compile cache, seconds",
        "76–170",
        12,
    ),
    "second_fit": ("second `gfnn.fit` of the same shapes in one process, seconds", "2", 1),
    "second_compilations": ("compilations in it", "3", 3),
    "first_rollout": ("first `map.rollout` of 1,000 steps after a fit, seconds", "11–19", 3),
}

# What the command imports, and nothing of its own work.
LIBRARIES = """
import diffrax, flax.nnx, jax, matplotlib.pyplot, optax, orbax.checkpoint, scipy.linalg, scipy.stats
import rich.console, rich.progress, rich.table
"""

COUNTED_RUN = """
import cProfile, json, pstats, sys
import jax
compilations = 0
def listen(event, seconds, **_):
    global compilations
    compilations += event == "/jax/core/compile/jaxpr_to_mlir_module_duration"
jax.monitoring.register_event_duration_secs_listener(listen)
profile = cProfile.Profile()
profile.enable()
try:
    from gfnn_jax.cli import main
    main(["run", "two-body", "--quick", "--out", sys.argv[1]])
except SystemExit as ended:
    assert not ended.code, ended.code
profile.disable()
print(json.dumps({"run_compilations": compilations,
                  "run_calls": pstats.Stats(profile).total_calls / 1e6}))
"""

FITS_IN_PYTHON = """
import json, time
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
import gfnn_jax as gfnn
compilations = 0
def listen(event, seconds, **_):
    global compilations
    compilations += event == "/jax/core/compile/jaxpr_to_mlir_module_duration"
jax.monitoring.register_event_duration_secs_listener(listen)
scene = gfnn.scenes.make("henon-heiles-regular")
found = {}
def take(name, call):
    global compilations
    compilations, started, cpu = 0, time.perf_counter(), time.process_time()
    out = jax.block_until_ready(call())
    found[name] = time.perf_counter() - started
    found[name + "_cpu"] = time.process_time() - cpu
    found[name.replace("_fit", "") + "_compilations"] = compilations
    return out
one, other = (gfnn.sample_pairs(scene, 2_000, jax.random.key(seed)) for seed in (0, 1))
z0 = gfnn.sample_test_states(scene, 25, jax.random.key(2))
fit = take("first_fit", lambda: gfnn.fit(one, scene, tolerance=1e-7))
take("second_fit", lambda: gfnn.fit(other, scene, tolerance=1e-7))
take("first_rollout", lambda: fit.map.rollout(z0, 1_000))
print(json.dumps(found))
"""


class Process(NamedTuple):
    """Seconds, processor seconds and standard output of a finished process."""

    seconds: float
    cpu: float
    out: str


def process(arguments: Sequence[str], cache: Path | None) -> Process:
    """A fresh Python process with this compile cache, or none."""
    env = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    env.pop("PYTHONDONTWRITEBYTECODE", None)  # an installed package has its byte code
    env |= {"PYTHONPATH": str(HERE.parent), "MPLBACKEND": "agg"}
    if cache is not None:
        env["JAX_COMPILATION_CACHE_DIR"] = str(cache)
        env["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    started, before = time.perf_counter(), os.times()
    done = subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, env=env, check=False
    )
    seconds, after = time.perf_counter() - started, os.times()
    if done.returncode:
        raise RuntimeError(f"{arguments[:4]} failed: {done.stderr.strip().splitlines()[-1:]}")
    used = after.children_user - before.children_user
    used += after.children_system - before.children_system
    return Process(seconds, used, done.stdout)


def start(quick: bool) -> Numbers:
    """The first answer of fresh processes: medians of three, counts of one.

    Processor seconds stand beside the seconds: on a machine that others use too they say more.
    """
    repeats = 1 if quick else 3
    with tempfile.TemporaryDirectory() as name:
        folder, count = Path(name), iter(range(100))
        warm, data = folder / "warm", folder / "pairs.npz"
        scene = gfnn.scenes.make("henon-heiles-regular")
        pairs = gfnn.sample_pairs(scene, 4_000, jax.random.key(SEED))
        np.savez(data, z0=pairs.z0, z1=pairs.z1, dt=pairs.dt)

        def command(*arguments: str, cache: Path) -> Process:
            out = folder / f"out{next(count)}"
            return process(["-m", "gfnn_jax", *arguments, "--out", str(out)], cache)

        def run(cache: Path) -> Process:
            return command("run", "two-body", "--quick", cache=cache)

        def fit() -> Process:
            return command("fit", str(data), "--tolerance", "1e-7", cache=warm)

        process(["-c", LIBRARIES], None)
        run(warm)
        fit()
        taken = {
            "libraries": [process(["-c", LIBRARIES], None) for _ in range(repeats)],
            "run_warm": [run(warm) for _ in range(repeats)],
            "run_cold": [run(folder / f"cold{i}") for i in range(repeats)],
            "fit_command": [fit() for _ in range(repeats)],
        }
        counted = process(["-c", COUNTED_RUN, str(folder / "counted")], warm).out
        in_python = [process(["-c", FITS_IN_PYTHON], None).out for _ in range(repeats)]
    measured = json.loads(counted.splitlines()[-1])
    python = [json.loads(out.splitlines()[-1]) for out in in_python]
    measured |= {key: float(np.median([p[key] for p in python])) for key in python[0]}
    for key, processes in taken.items():
        measured[key] = float(np.median([p.seconds for p in processes]))
        measured[f"{key}_cpu"] = float(np.median([p.cpu for p in processes]))
        measured[f"{key}_all"] = [p.seconds for p in processes]
    return measured


def startup(quick: bool) -> Numbers:
    """Seconds of fresh processes, the best of three."""
    names = list(gfnn.__all__)
    commands = {
        "import jax": ["-c", "import jax"],
        "import gfnn_jax": ["-c", "import jax, gfnn_jax"],
        "all public names": ["-c", f"import jax, gfnn_jax as g; [getattr(g, n) for n in {names}]"],
        "gfnn --help": ["-m", "gfnn_jax", "--help"],
        "gfnn scenes": ["-m", "gfnn_jax", "scenes"],
        "gfnn run nowhere": ["-m", "gfnn_jax", "run", "nowhere"],
    }

    def seconds(arguments):
        started = time.perf_counter()
        subprocess.run([sys.executable, *arguments], capture_output=True, check=False)
        return time.perf_counter() - started

    repeats = 1 if quick else 3
    found = {name: min(seconds(a) for _ in range(repeats)) for name, a in commands.items()}
    return {**found, "added by gfnn_jax": found["import gfnn_jax"] - found["import jax"]}
