"""How fast: the first answer, predicted steps, a training step, growth with the size.

    python benchmarks/speed.py                    pieces that have no result yet, then the tables
    python benchmarks/speed.py --only step --overwrite
    python benchmarks/speed.py --quick            small sizes, into runs/speed, no tables

A piece's result is one JSON file, speed-*.json in benchmarks/results; the section of
benchmarks/RESULTS.md is made from these files alone. Times of steps are the best of several and
without compilation; those of whole processes the median of a few; ratios are of times taken in one
run.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

# Sets float64, so it comes before all of JAX.
from harness import (
    HERE,
    SEED,
    TABLES,
    Numbers,
    between_markers,
    cores,
    drawn,
    fitted,
    markdown,
    number,
    provenance,
    results,
    timed,
)
from harness import main as run_pieces

# isort: split
import jax
import jax.numpy as jnp
import numpy as np

import gfnn_jax as gfnn
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.mlp import PAPER_HIDDEN, Mlp
from gfnn_jax.families.products import Products
from gfnn_jax.fitting import least_squares
from gfnn_jax.fitting.adam import PAPER, adam
from gfnn_jax.generating.charts import MIDPOINT, TYPE2
from gfnn_jax.generating.generated import Generated
from gfnn_jax.maps.rollout import rollout
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.scenes import henon_heiles
from gfnn_jax.solve import newton
from gfnn_jax.solve.linear import small_solve

LANES = 1_000
# scene, absolute tolerance, pairs, and how many microseconds a step may take: of a batch, alone.
STEPS = {
    "henon-heiles-regular": (1e-10, 4_000, 2.0, 12.0),
    "two-body": (1e-9, 4_000, None, None),
    "standard-map-regular": (1e-12, 1_000, None, 5.0),
    "pcr3bp": (1e-6, 10_000, None, None),
}
FEWER_STEPS = {"pcr3bp": 50}  # a batch of it has a solve that fails at nearly every step
TARGETS = {"evaluations": 3.5, "defect": 1e-12, "against_newton": 4.0, "training_rate": 0.6,
           "torch": {"original": 4.0, "careful": 2.0}}  # fmt: skip


# Predicted steps


def textbook(map_: SymplecticMap) -> Callable:
    """``step(z)`` as it is written first: Newton from z itself, a fresh Jacobian every time, until
    the residual is at roundoff; for a map without coordinates of its own."""
    (piece,) = map_.pieces
    assert isinstance(piece, Generated)
    gradient = functools.partial(piece.family.gradient, piece.params)

    def step(z):
        free = piece.chart.free(z.shape[0] // 2)
        known = piece.chart.first_guess(z)

        def residual(x):
            w = known.at[free].set(x)
            return piece.chart.residual(z, w, gradient(w), piece.dt)

        def update(state):
            x, r, count = state
            x = x - small_solve(jax.jacfwd(residual)(x), r)
            return x, residual(x), count + 1

        def is_open(state):
            return (jnp.max(jnp.abs(state[1])) > 1e-15) & (state[2] < 8)

        x = known[free]
        x, _, _ = jax.lax.while_loop(is_open, update, (x, residual(x), 0))
        w = known.at[free].set(x)
        return piece.chart.image(z, w, gradient(w), piece.dt)

    return step


def evaluations(map_: SymplecticMap, states) -> Numbers:
    """Evaluations of ∇S per step, what else is done counted as parts of one by its operations."""
    piece = next(p for p in map_.pieces if isinstance(p, Generated))
    gradient, with_jacobian = piece.family.operations
    updates = np.asarray(map_.step(states)[1].iterations)
    start = 0 if piece.predictor is None else piece.predictor.forward.operations
    return {
        "updates_mean": float(updates.mean()),
        "updates_max": int(updates.max()),
        "start": start / gradient,
        "evaluations": float((with_jacobian + start) / gradient + updates.mean()),
        "flop": float(with_jacobian + start + gradient * updates.mean()),
    }


def step(quick: bool) -> Numbers:
    measured = {}
    for name in ["standard-map-regular"] if quick else STEPS:
        num_steps = 200 if quick else FEWER_STEPS.get(name, 500)
        tolerance, num_pairs, _, _ = STEPS[name]
        scene = gfnn.scenes.make(name)
        pairs, fresh = drawn(scene, num_pairs, quick)
        fit, about = fitted(pairs, scene, fresh, absolute_tolerance=tolerance)
        z = gfnn.sample_test_states(scene, LANES, jax.random.key(SEED))
        states, info = fit.map.rollout(z, num_steps, save_every=num_steps // 10)
        inside = np.asarray(info.status) == 0
        visited = np.asarray(states)[inside].reshape(-1, z.shape[1])[::10]
        lanes = fit.map.start(z)

        def together(map_=fit.map, lanes=lanes, num_steps=num_steps):
            return map_.advance(lanes, 1, save_every=num_steps)[1]

        one = fit.map.start(z[:1])

        def alone(map_=fit.map, one=one, num_steps=num_steps):
            return map_.advance(one, 1, save_every=10 * num_steps)[1]

        batch, single = timed(together, 5).seconds, timed(alone, 5).seconds
        row = {
            **evaluations(fit.map, visited),
            "one_step_rms": about["one_step_rms"],
            "label": about["label"],
            "chart": about["chart"],
            "defect": float(np.max(fit.map.defect(visited[:500]))),
            "microseconds_batch": 1e6 * batch / num_steps / LANES,
            "microseconds_single": 1e6 * single / (10 * num_steps),
            "bytes_saved_per_lane": 8 * z.shape[1],
            "against_newton": None,
            "against_waiting": waiting(together) / batch,
        }
        if len(fit.map.pieces) == 1 and not fit.map.coordinates.angles:
            plain = textbook(fit.map)
            fresh_newton = timed(lambda: rollout(plain, z, num_steps, save_every=num_steps), 3)  # noqa: B023
            row["against_newton"] = fresh_newton.seconds / batch
        measured[name] = row
    return measured


def waiting(batch: Callable[[], Any]) -> float:
    """Seconds of a rollout in which every lane of a batch waits for the one that takes longest."""
    with mock.patch.object(newton, "_FEWEST", LANES):
        jax.clear_caches()
        seconds = timed(batch, 3).seconds
    jax.clear_caches()
    return seconds


# A training step


def training(quick: bool) -> Numbers:
    """The paper's network, batches of 200, float32: its rate against that of its own products."""
    scene = henon_heiles()
    pairs, _ = drawn(scene, 2_000 if quick else 20_000, quick=True)
    z0, z1 = np.asarray(pairs.z0), np.asarray(pairs.z1)
    w, target = TYPE2.evaluation_point(z0, z1), TYPE2.target_gradient(z0, z1, scene.dt)
    family = Mlp(box_inputs(w), PAPER_HIDDEN, "tanh")
    runs, length = (3, 20) if quick else (10, 100)
    recipe = dataclasses.replace(PAPER, epochs=runs + 1, epoch_length=length)
    ends = []
    adam(
        family, family.init(jax.random.key(SEED), jnp.float32), (w, target), (w[:10], target[:10]),
        scene.dt * np.ones(4), recipe=recipe, key=jax.random.key(SEED),
        on_epoch=lambda *_: ends.append(time.perf_counter()),
    )  # fmt: skip
    seconds = float(np.diff(ends).min()) / length
    weights = [jnp.ones(shape, jnp.float32) for shape in pairwise((4, *PAPER_HIDDEN, 1))]
    # Two products make ∇S, one each way; its slope in the weights takes each of them twice more.
    flop = 6 * 2 * 200 * sum(m.size for m in weights)
    layers = [(jnp.ones((200, m.shape[0]), jnp.float32), m) for m in weights]

    def products(_, carry):
        """Every layer's product, its transpose and the one that gives the weights' slope."""
        out = carry
        for x, matrix in layers:
            x = x + out
            y = jnp.dot(x, matrix, precision="highest")
            back = jnp.dot(y, matrix.T, precision="highest")
            slope = jnp.dot(x.T, y, precision="highest")
            out = out + 1e-30 * (back[0, 0] + slope[0, 0])
        return out

    repeats = 20 if quick else 200
    loop = jax.jit(lambda c: jax.lax.fori_loop(0, repeats, products, c))
    plain = timed(lambda: loop(jnp.float32(0.0)), 7).seconds / repeats
    product_flop = 6 * 200 * sum(m.size for m in weights)
    return {
        "microseconds": 1e6 * seconds,
        "mflop": flop / 1e6,
        "gflops": flop / seconds / 1e9,
        "gflops_of_products": product_flop / plain / 1e9,
        "training_rate": (flop / seconds) / (product_flop / plain),
        "torch": in_torch(w, target, scene.dt, runs, length),
        "models_per_second": models_per_second(family, w, target, scene.dt, quick),
    }


def in_torch(w, target, dt: float, runs: int, length: int) -> Numbers | None:
    """The same step in PyTorch, on as many threads; None where it is not installed."""
    try:
        import torch_loops
    except ImportError:
        return None
    threads = cores() or 1
    widths = (w.shape[1], *PAPER_HIDDEN, 1)
    return torch_loops.measure(w, target, widths, dt, PAPER.batch_size, runs, length, threads)


def models_per_second(family, w, target, dt: float, quick: bool) -> Numbers:
    """Steps of several networks trained at once, by vmap: number -> steps of one model a second.

    Plain descent instead of Adam, whose own work is small beside that of the network.
    """
    w, target = (np.asarray(a[: PAPER.batch_size], np.float32) for a in (w, target))

    def loss(params):
        error = dt * (family.gradient(params, jnp.asarray(w)) - target)
        return jnp.mean(jnp.sum(error**2, axis=-1))

    def descend(_, params):
        return jax.tree.map(lambda a, slope: a - 1e-3 * slope, params, jax.grad(loss)(params))

    steps, found = 10 if quick else 100, {}
    for models in (1, 2) if quick else (1, 4, 16):
        keys = jax.random.split(jax.random.key(SEED), models)
        params = jax.vmap(lambda key: family.init(key, jnp.float32))(keys)
        train = jax.jit(jax.vmap(lambda p: jax.lax.fori_loop(0, steps, descend, p)))
        seconds = timed(lambda: train(params), 3).seconds  # noqa: B023
        found[str(models)] = models * steps / seconds
    return found


# The first answer


# row -> (title, the release before, as its issue was filed, the most it may be)
START: dict[str, tuple[str, str, float]] = {
    "run_warm": ("`gfnn run two-body --quick`, compile cache warm: time ÷ time of importing its "
                 "libraries", "16–20", 5),
    "run_cold": ("the same, compile cache empty", "60", 10),
    "run_compilations": ("XLA compilations in it", "392", 60),
    "run_calls": ("Python calls in it (cProfile), millions", "47", 12),
    "fit_command": ("`gfnn fit` of 4,000 pairs, d = 2, tolerance 1e-7, warm, seconds", "30–100", 8),
    "first_fit": ("first `gfnn.fit` of 2,000 pairs, d = 2, in Python without a compile cache, "
                  "seconds", "76–170", 12),
    "second_fit": ("second `gfnn.fit` of the same shapes in one process, seconds", "2", 1),
    "second_compilations": ("compilations in it", "3", 3),
    "first_rollout": ("first `map.rollout` of 1,000 steps after a fit, seconds", "11–19", 3),
}  # fmt: skip
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
    compilations += event == "/jax/core/compile/backend_compile_duration"
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
    compilations += event == "/jax/core/compile/backend_compile_duration"
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
    env |= {"PYTHONPATH": str(HERE.parent), "MPLBACKEND": "agg"}
    if cache is not None:
        env["JAX_COMPILATION_CACHE_DIR"] = str(cache)
        env["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    started, before = time.perf_counter(), os.times()
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, env=env,
                          check=False)  # fmt: skip
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


# Growth with the size


def scaling(quick: bool) -> Numbers:
    """Seconds against pairs, terms, degrees of freedom, trajectories and steps, memory against
    pairs, with fitted slopes."""
    rng = np.random.default_rng(SEED)

    def polynomial(dim, degree):
        w = rng.uniform(-1, 1, (64, 2 * dim))
        family = Products(box_inputs(w), degree)
        return family, family.unflatten(1e-3 * rng.standard_normal(family.num_parameters))

    def timed_fit(num_pairs, degree):
        family, _ = polynomial(2, degree)
        w = rng.uniform(-1, 1, (num_pairs, 4))
        taken = timed(lambda: least_squares.fit(family, (w, w), (w[:100], w[:100]), np.ones(4)), 1)
        return taken.seconds, family.num_parameters

    def step_seconds(dim, lanes, num_steps=100):
        family, params = polynomial(dim, 4)
        piece = Generated(family, params, MIDPOINT, 0.1, np.ones(2 * dim))
        z = jnp.asarray(rng.uniform(-0.5, 0.5, (lanes, 2 * dim)))

        @jax.jit
        def run(piece, z):
            return jax.lax.fori_loop(0, num_steps, lambda _, y: piece.step(y)[0], z)

        return timed(lambda: run(piece, z), 3).seconds / num_steps

    scene = gfnn.scenes.make("henon-heiles-regular")

    def selection_seconds(num_pairs):
        pairs = gfnn.sample_pairs(scene, num_pairs, jax.random.key(SEED))
        gfnn.fit(pairs, scene, learn="map", absolute_tolerance=1e-6)  # compiles
        return gfnn.fit(pairs, scene, learn="map", absolute_tolerance=1e-6)

    def rollout_seconds(map_, z0, num_steps):
        return timed(lambda: map_.rollout(z0, num_steps, save_every=num_steps)[0], 2).seconds

    sizes = (1_000, 10_000) if quick else (1_000, 10_000, 100_000, 1_000_000)
    degrees = (3, 5) if quick else (3, 4, 5, 6, 7, 8)
    lanes = (1, 100, 1_000) if quick else (1, 10, 100, 1_000, 10_000, 100_000)
    dims = (1, 2) if quick else (1, 2, 4)
    pairs_rows = [(n, timed_fit(n, 4)[0]) for n in sizes]
    terms_rows = [(terms, s) for s, terms in (timed_fit(4_000, d) for d in degrees)]
    lane_rows = [(n, step_seconds(2, n)) for n in lanes]
    dim_rows = [(d, step_seconds(d, 1_000)) for d in dims]
    fits = [(n, selection_seconds(n)) for n in sizes[:3]]
    z0 = gfnn.sample_test_states(scene, 100, jax.random.key(SEED))
    lengths = (100, 1_000) if quick else (100, 1_000, 10_000, 100_000)
    length_rows = [(n, rollout_seconds(fits[0][1].map, z0, n)) for n in lengths]
    return {
        "fit seconds against pairs": described(pairs_rows),
        "fit seconds against terms": described(terms_rows),
        "step seconds against trajectories": described(lane_rows),
        "step seconds of 1,000 trajectories against d": described(dim_rows),
        "selection seconds against pairs": described([(n, f.seconds) for n, f in fits]),
        "rollout seconds of 100 trajectories against steps": described(length_rows),
        "peak GB of a fit of 69 terms against pairs": described([(n, peak(n)) for n in sizes]),
    }


def peak(num_pairs: int) -> float:
    """Peak memory of a process that fits a polynomial of degree 4 to so many pairs, in GB."""
    script = f"""
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
from gfnn_jax.fitting import least_squares
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products
w = np.random.default_rng(0).uniform(-1, 1, ({num_pairs}, 4))
least_squares.fit(Products(box_inputs(w[:64]), 4), (w, w), (w[:100], w[:100]), np.ones(4))
print(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1])
"""
    out = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return int(out.stdout) / 2**20


def described(rows: list[tuple[int, float]]) -> Numbers:
    size, measured = np.array(rows).T
    slope = float(np.polyfit(np.log(size[-3:]), np.log(measured[-3:]), 1)[0])
    return {"size": size.tolist(), "measured": measured.tolist(), "slope_of_largest": slope}


PIECES = {
    "start": start, "step": step, "training": training, "startup": startup, "scaling": scaling,
}  # fmt: skip


# Tables


def met(value, limit, *, least: bool = False) -> str:
    """A figure beside its target."""
    if value is None or limit is None:
        return number(value)
    good, sign = (value >= limit, "≥") if least else (value <= limit, "≤")
    shown = number(value) if good or number(value) != number(limit) else f"{value:.3g}"
    return f"{shown} ({sign} {number(limit)}: {'met' if good else '**not met**'})"


def step_table(measured: Numbers) -> str:
    heads = ["scene", "map", "one-step RMS", "∇S evaluations per step", "defect",
             "µs per step, 1,000 lanes", "µs per step, one lane",
             "times as fast as Newton with fresh Jacobians",
             "times as fast as with all lanes waiting for the last"]  # fmt: skip
    rows = []
    for name, m in measured.items():
        _, _, batch, single = STEPS[name]
        cells = [name, f"{m['chart']} {m['label']}", number(m["one_step_rms"]),
                 met(m["evaluations"], TARGETS["evaluations"]),
                 met(m["defect"], TARGETS["defect"]), met(m["microseconds_batch"], batch),
                 met(m["microseconds_single"], single),
                 met(m["against_newton"], TARGETS["against_newton"], least=True),
                 number(m["against_waiting"])]  # fmt: skip
        rows.append(cells)
    return markdown(heads, rows)


def start_table(m: Numbers) -> str:
    """The first answer, beside the release before and the targets."""
    rows = []
    for key, (title, before, most) in START.items():
        value, cpu = m[key], m.get(f"{key}_cpu")
        if key in ("run_warm", "run_cold"):  # in times of importing the libraries
            value, cpu = value / m["libraries"], m[f"{key}_cpu"] / m["libraries_cpu"]
        rows.append([title, before, met(value, most), number(cpu)])
    seconds = ", ".join(
        f"{name} {number(m[key])} ({number(m[f'{key}_cpu'])})" for name, key in (
            ("libraries", "libraries"), ("the command warm", "run_warm"), ("cold", "run_cold"),
        )
    )  # fmt: skip
    return (
        markdown(["", "release before", "now", "the same in processor time"], rows)
        + f"\n\nSeconds, and processor seconds of all threads: {seconds}."
    )


def beside_torch(m: Numbers) -> str:
    """The training step against PyTorch's, in words."""
    if m["torch"] is None:
        return "PyTorch was not there to compare with."
    ratios = {name: m["torch"][name] / m["microseconds"] for name in TARGETS["torch"]}
    shown = [f"{number(m['torch'][name])} µs, {met(r, TARGETS['torch'][name], least=True)} times "
             "as long" for name, r in ratios.items()]  # fmt: skip
    return (
        f"PyTorch {m['torch']['version']} on as many threads ({m['torch']['threads']}): a loop in "
        f"the style of the paper's original (DataLoader, double backward, Adam) {shown[0]}; a "
        f"careful one (indexed batches, fused Adam) {shown[1]}."
    )


def several_models(m: Numbers) -> str:
    """Ensembles in words; a result of an older script has none."""
    rates = m.get("models_per_second")
    if not rates:
        return ""
    shown = ", ".join(f"{n}: {number(rate)}" for n, rate in rates.items())
    return f" Several models at once by vmap, steps of one model a second: {shown}."


def tables() -> None:
    found = results(PIECES, "speed")
    parts = []
    if "start" in found:
        parts.append("### The first answer\n\n" + start_table(found["start"]["measured"]))
    if "step" in found:
        parts.append("### A predicted step\n\n" + step_table(found["step"]["measured"]))
    if "training" in found:
        m = found["training"]["measured"]
        parts.append(
            "### A training step of the paper's network (batch 200, float32)\n\n"
            f"{number(m['microseconds'])} µs, {number(m['gflops'])} GFLOP/s; plain products of its "
            f"sizes {number(m['gflops_of_products'])} GFLOP/s; ratio "
            f"{met(m['training_rate'], TARGETS['training_rate'], least=True)}. "
            + beside_torch(m) + several_models(m)
        )  # fmt: skip
    if "startup" in found:
        m = found["startup"]["measured"]
        rows = [[f"`{name}`", number(value)] for name, value in m.items()]
        parts.append("### The start\n\n" + markdown(["a fresh process", "seconds"], rows))
    if "scaling" in found:
        rows = [
            [name, ", ".join(number(int(size)) for size in m["size"]),
             ", ".join(map(number, m["measured"])), number(m["slope_of_largest"])]
            for name, m in found["scaling"]["measured"].items()
        ]  # fmt: skip
        heads = ["", "sizes", "measured", "slope of the largest three"]
        parts.append("### Growth with the size\n\n" + markdown(heads, rows))
    if found:
        parts.append(provenance(found))
        between_markers(TABLES, "speed", "\n\n".join(parts))


def main(argv: Sequence[str] | None = None) -> None:
    run_pieces(__doc__ or "", PIECES, "speed", tables, argv)


if __name__ == "__main__":
    main()
