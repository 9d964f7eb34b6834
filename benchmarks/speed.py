"""How fast: predicted steps, a training step, the start of the program, growth with the size.

    python benchmarks/speed.py                    pieces that have no result yet, then the tables
    python benchmarks/speed.py --only step --overwrite
    python benchmarks/speed.py --quick            small sizes, into runs/speed, no tables

A piece's result is one JSON file, speed-*.json in benchmarks/results; the section of
benchmarks/RESULTS.md is made from these files alone. Times are the best of several and without
compilation; ratios are of times taken in one run.
"""

from __future__ import annotations

import dataclasses
import functools
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any
from unittest import mock

# Sets float64, so it comes before all of JAX.
from pieces import main as run_pieces
from pieces import results
from targets import (
    SEED,
    TABLES,
    Numbers,
    between_markers,
    circumstances,
    drawn,
    fitted,
    number,
    provenance,
)

# isort: split
import jax
import jax.numpy as jnp
import numpy as np

import gfnn_jax as gfnn
from gfnn_jax.solve import newton as implicit
from gfnn_jax.generating.charts import MIDPOINT, TYPE2
from gfnn_jax.fitting import least_squares
from gfnn_jax.fitting.adam import PAPER, adam
from gfnn_jax.solve.newton import small_solve
from gfnn_jax.maps.symplectic_map import Generated, SymplecticMap
from gfnn_jax.maps.symplectic_map.rollout import rollout
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.mlp import PAPER_HIDDEN, Mlp
from gfnn_jax.families.products import Products
from gfnn_jax.scenes import henon_heiles

LANES = 1_000
# scene, tolerance, pairs, and how many microseconds a step may take: of a batch, of one trajectory.
STEPS = {
    "henon-heiles-regular": (1e-10, 4_000, 2.0, 12.0),
    "two-body": (1e-9, 4_000, None, None),
    "standard-map-regular": (1e-12, 1_000, None, 5.0),
    "pcr3bp": (1e-6, 10_000, None, None),
}
FEWER_STEPS = {"pcr3bp": 50}  # a batch of it has a solve that fails at nearly every step
TARGETS = {"evaluations": 3.5, "defect": 1e-12, "against_newton": 4.0, "training_rate": 0.6,
           "torch": {"original": 4.0, "careful": 2.0}}  # fmt: skip


def best(function: Callable[[], Any], repeats: int = 7) -> float:
    """Seconds of the fastest of some calls, after one that compiles."""
    jax.block_until_ready(function())
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        jax.block_until_ready(function())
        times.append(time.perf_counter() - started)
    return min(times)


# Predicted steps


def textbook(map_: SymplecticMap) -> Callable:
    """``step(z)`` as it is written first: Newton from z itself, a fresh Jacobian every time, until
    the residual is at roundoff; for a map without coordinates of its own."""
    (piece,) = map_.pieces
    assert isinstance(piece, Generated)
    gradient = jax.grad(functools.partial(piece.scalar, piece.params))

    def step(z):
        free = np.array(piece.chart.free(z.shape[0] // 2))
        known = piece.chart.start(z)

        def residual(x):
            w = known.at[free].set(x)
            return piece.chart.residual(z, w, gradient(w), piece.dt)

        def newton(state):
            x, r, count = state
            x = x - small_solve(jax.jacfwd(residual)(x), r)
            return x, residual(x), count + 1

        def is_open(state):
            return (jnp.max(jnp.abs(state[1])) > 1e-15) & (state[2] < 8)

        x = known[free]
        x, _, _ = jax.lax.while_loop(is_open, newton, (x, residual(x), 0))
        w = known.at[free].set(x)
        return piece.chart.image(z, w, gradient(w), piece.dt)

    return step


def evaluations(map_: SymplecticMap, states) -> Numbers:
    """Evaluations of ∇S per step, what else is done counted as parts of one by its operations."""
    piece = next(p for p in map_.pieces if isinstance(p, Generated))
    gradient, with_jacobian = piece.scalar.operations
    updates = np.asarray(map_.step(states)[1].iterations)
    start = 0 if piece.there is None else piece.there.operations
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
        num_steps = 200 if quick else FEWER_STEPS.get(name, 2_000)
        tolerance, num_pairs, _, _ = STEPS[name]
        scene = gfnn.scenes.make(name)
        pairs, fresh = drawn(scene, num_pairs, quick)
        fit, about = fitted(pairs, scene, fresh, tolerance=tolerance)
        z = jnp.asarray(gfnn.sample_test_states(scene, LANES, jax.random.key(SEED)))
        states, info = fit.map.rollout(z, num_steps, save_every=num_steps // 10)
        inside = np.asarray(info.status) == 0
        visited = np.asarray(states)[inside].reshape(-1, z.shape[1])[::10]
        lanes = fit.map.start(z)
        batch = best(lambda: fit.map.advance(lanes, 1, save_every=num_steps)[1])  # noqa: B023
        one = fit.map.start(z[:1])
        single = best(lambda: fit.map.advance(one, 1, save_every=10 * num_steps)[1])  # noqa: B023
        row = {
            **evaluations(fit.map, visited),
            "one_step_rms": about["one_step_rms"],
            "label": about["label"],
            "chart": about["chart"],
            "defect": float(jnp.max(fit.map.defect(visited[:500]))),
            "microseconds_batch": 1e6 * batch / num_steps / LANES,
            "microseconds_single": 1e6 * single / (10 * num_steps),
            "bytes_saved_per_lane": 8 * z.shape[1],
            "against_newton": None,
            "against_waiting": waiting(lambda: fit.map.advance(lanes, 1, save_every=num_steps)[1])  # noqa: B023
            / batch,
        }
        if len(fit.map.pieces) == 1 and not fit.map.coordinates.angles:
            plain = textbook(fit.map)
            newton = best(lambda: rollout(plain, z, num_steps, save_every=num_steps))  # noqa: B023
            row["against_newton"] = newton / batch
        measured[name] = row
    return measured


def waiting(batch: Callable[[], Any]) -> float:
    """Seconds of a rollout in which every lane of a batch waits for the one that takes longest."""
    with mock.patch.object(implicit, "_few_together", implicit._each):
        jax.clear_caches()
        seconds = best(batch)
    jax.clear_caches()
    return seconds


# A training step


def training(quick: bool) -> Numbers:
    """The paper's network, batches of 200, float32: its rate against that of its own products."""
    scene = henon_heiles()
    pairs, _ = drawn(scene, 2_000 if quick else 20_000, quick=True)
    z0, z1 = jnp.asarray(pairs.z0), jnp.asarray(pairs.z1)
    w, wanted = TYPE2.point(z0, z1), TYPE2.wanted(z0, z1, scene.dt)
    family = Mlp(box_inputs(w), PAPER_HIDDEN, "tanh")
    runs, length = (3, 20) if quick else (10, 100)
    recipe = dataclasses.replace(PAPER, epochs=runs + 1, epoch_length=length)
    ends = []
    adam(
        family, family.init(jax.random.key(SEED), jnp.float32), (w, wanted), (w[:10], wanted[:10]),
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
    plain = best(lambda: loop(jnp.float32(0.0))) / repeats
    product_flop = 6 * 200 * sum(m.size for m in weights)
    return {
        "microseconds": 1e6 * seconds,
        "mflop": flop / 1e6,
        "gflops": flop / seconds / 1e9,
        "gflops_of_products": product_flop / plain / 1e9,
        "training_rate": (flop / seconds) / (product_flop / plain),
        "torch": in_torch(np.asarray(w), np.asarray(wanted), scene.dt, runs, length),
        "models_per_second": models_per_second(family, w, wanted, scene.dt, quick),
    }


def in_torch(w, wanted, dt: float, runs: int, length: int) -> Numbers | None:
    """The same step in PyTorch, on as many threads; None where it is not installed."""
    try:
        import torch_loops
    except ImportError:
        return None
    threads = circumstances()["machine"]["cores"] or 1
    widths = (w.shape[1], *PAPER_HIDDEN, 1)
    return torch_loops.measure(w, wanted, widths, dt, PAPER.batch_size, runs, length, threads)


def models_per_second(family, w, wanted, dt: float, quick: bool) -> Numbers:
    """Steps of several networks trained at once, by vmap: number -> steps of one model a second.

    Plain descent instead of Adam, whose own work is small beside that of the network.
    """
    w, wanted = (jnp.asarray(a[: PAPER.batch_size], jnp.float32) for a in (w, wanted))
    gradient = jax.vmap(jax.grad(family, argnums=1), (None, 0))

    def loss(params):
        return jnp.mean(jnp.sum((dt * (gradient(params, w) - wanted)) ** 2, axis=-1))

    def descend(_, params):
        return jax.tree.map(lambda a, slope: a - 1e-3 * slope, params, jax.grad(loss)(params))

    steps, found = 10 if quick else 100, {}
    for models in (1, 2) if quick else (1, 4, 16):
        keys = jax.random.split(jax.random.key(SEED), models)
        params = jax.vmap(lambda key: family.init(key, jnp.float32))(keys)
        train = jax.jit(jax.vmap(lambda p: jax.lax.fori_loop(0, steps, descend, p)))
        seconds = best(lambda: train(params), 3)  # noqa: B023
        found[str(models)] = models * steps / seconds
    return found


# The start


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
        return family, family.unflatten(
            jnp.asarray(1e-3 * rng.standard_normal(family.num_parameters))
        )

    def fit_seconds(num_pairs, degree):
        family, _ = polynomial(2, degree)
        w = jnp.asarray(rng.uniform(-1, 1, (num_pairs, 4)))
        return least_squares.fit(family, (w, w), (w[:100], w[:100]), np.ones(4)), family

    def timed_fit(num_pairs, degree):
        fit_seconds(num_pairs, degree)  # compiles
        started = time.perf_counter()
        _, family = fit_seconds(num_pairs, degree)
        return time.perf_counter() - started, family.num_parameters

    def step_seconds(dim, lanes, num_steps=100):
        family, params = polynomial(dim, 4)
        piece = Generated(family, params, MIDPOINT, 0.1, jnp.ones(2 * dim))
        z = jnp.asarray(rng.uniform(-0.5, 0.5, (lanes, 2 * dim)))

        def lane(z):
            return jax.lax.fori_loop(0, num_steps, lambda _, y: piece(y)[0], z)

        run = jax.jit(jax.vmap(lane))
        return best(lambda: run(z), 3) / num_steps

    scene = gfnn.scenes.make("henon-heiles-regular")

    def selection_seconds(num_pairs):
        pairs = gfnn.sample_pairs(scene, num_pairs, jax.random.key(SEED))
        gfnn.fit(pairs, scene, tolerance=1e-6)  # compiles
        return gfnn.fit(pairs, scene, tolerance=1e-6)

    def rollout_seconds(map_, z0, num_steps):
        return best(lambda: map_.rollout(z0, num_steps, save_every=num_steps)[0], 2)

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


PIECES = {"step": step, "training": training, "startup": startup, "scaling": scaling}


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
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for name, m in measured.items():
        _, _, batch, single = STEPS[name]
        cells = [name, f"{m['chart']} {m['label']}", number(m["one_step_rms"]),
                 met(m["evaluations"], TARGETS["evaluations"]),
                 met(m["defect"], TARGETS["defect"]), met(m["microseconds_batch"], batch),
                 met(m["microseconds_single"], single),
                 met(m["against_newton"], TARGETS["against_newton"], least=True),
                 number(m["against_waiting"])]  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


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
        lines = ["| a fresh process | seconds |", "|---|---|"]
        lines += [f"| `{name}` | {number(value)} |" for name, value in m.items()]
        parts.append("### The start\n\n" + "\n".join(lines))
    if "scaling" in found:
        lines = ["| | sizes | measured | slope of the largest three |", "|---|---|---|---|"]
        for name, m in found["scaling"]["measured"].items():
            lines.append(
                f"| {name} | {', '.join(number(int(s)) for s in m['size'])} | "
                f"{', '.join(number(s) for s in m['measured'])} | {number(m['slope_of_largest'])} |"
            )
        parts.append("### Growth with the size\n\n" + "\n".join(lines))
    if found:
        parts.append(provenance(found))
        between_markers(TABLES, "speed", "\n\n".join(parts))


def main(argv: Sequence[str] | None = None) -> None:
    run_pieces(__doc__ or "", PIECES, "speed", tables, argv)


if __name__ == "__main__":
    main()
