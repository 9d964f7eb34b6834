"""A GPU beside the processor of its machine: training, the rows of a fit, rollouts, ensembles.

    benchmarks/gpu.sh                     eight minutes at most, on a machine that has a GPU
    python benchmarks/gpu.py --quick      small sizes, into runs/gpu; on the processor alone too

Each device has a process of its own, in which it is JAX's default: what is timed there runs as it
would for a user. Seconds are those of the fastest run after the one that compiles, whose extra
seconds stand beside. The maps, the laws and the starts are the same on both devices; the states
that they reach are compared.

    training    iterations of Adam for S of two shapes, float32, at the paper's and at large batches
    ensemble    Levenberg–Marquardt of eight networks together, float64
    rows        the triangular factor of the rows of a polynomial S, float64
    rollouts    steps of a map, a law and a network, float64, from 1 to a million lanes
    posterior   steps of samples of a map, float64
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import jax
import numpy as np
from harness import (
    SEED,
    TABLES,
    Numbers,
    between_markers,
    fitted,
    main,
    markdown,
    number,
    provenance,
    results,
    timed,
)

import gfnn_jax as gfnn
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.mlp import PAPER_HIDDEN, Mlp, amplitude_of
from gfnn_jax.families.products import Products
from gfnn_jax.fitting import least_squares, row_blocks
from gfnn_jax.fitting.adam import Recipe, Training, gradient_loss
from gfnn_jax.fitting.levenberg_marquardt import GradientFit, Limits
from gfnn_jax.generating.charts import MIDPOINT
from gfnn_jax.generating.generated import Generated
from gfnn_jax.scenes import henon_heiles

LANES = {"gpu": (1, 1_024, 16_384, 131_072, 1_048_576), "processor": (1, 1_024, 16_384)}
BATCHES = (200, 20_000)  # the paper's, and one that fills a GPU
STEPS, ITERATIONS, MEMBERS, SAMPLES = 50, 1_000, 8, 64
PAIRS, SAMPLED_LANES, COMPARED = 100_000, 4_096, 64

Rows = tuple[np.ndarray, np.ndarray]
Row = tuple[str, str, Numbers]  # kind, name, what was measured


class Problem:
    """Pairs of Hénon–Heiles as an S is fitted to, and states below their energy."""

    def __init__(self, quick: bool):
        self.quick, self.scene = quick, henon_heiles(energy=1 / 12)
        number = PAIRS // 50 if quick else PAIRS
        self.pairs = gfnn.sample_pairs(self.scene, number, jax.random.key(SEED))
        z0, z1 = np.asarray(self.pairs.z0), np.asarray(self.pairs.z1)
        self.w = MIDPOINT.evaluation_point(z0, z1)
        self.target = MIDPOINT.target_gradient(z0, z1, float(self.pairs.dt))
        self.states = np.asarray(gfnn.sample_test_states(self.scene, 512, jax.random.key(1)))
        self.held = len(self.w) // 5

    def network(self, hidden: tuple[int, ...], dtype: type, key: int) -> tuple[Mlp, Any]:
        family = Mlp(box_inputs(self.w), hidden, "silu", amplitude_of(self.w, self.target))
        return family, family.init(jax.random.key(key), dtype)

    def rows(self) -> tuple[Rows, Rows]:
        """Those that train, and those that validate."""
        w, target, held = self.w, self.target, self.held
        return (w[held:], target[held:]), (w[:held], target[:held])


def training(problem: Problem, device) -> Iterator[Row]:
    train, validation = problem.rows()
    for hidden in (PAPER_HIDDEN, (512, 512, 512)):
        for batch in BATCHES:
            iterations = ITERATIONS * BATCHES[0] // (batch * (10 if problem.quick else 1))
            recipe = Recipe(min(batch, len(train[0])), 3, 1e-3, "cosine", iterations)
            family, params = problem.network(hidden, np.float32, 0)
            seconds: list[float] = []  # since the start, of each epoch

            def note(*_, seconds=seconds):
                seconds.append(time.perf_counter())

            Training(recipe, jax.random.key(2), on_epoch=note).of_loss(
                gradient_loss(family, 1.0), params, train, validation, 4
            )
            found = {"seconds": min(np.diff(seconds)) / iterations}
            yield "training", f"{'–'.join(map(str, hidden))}, batch {recipe.batch_size:,}", found


def ensemble(problem: Problem, device) -> Iterator[Row]:
    train, validation = problem.rows()
    count = 1_000 if problem.quick else 8_000
    train = train[0][:count], train[1][:count]
    family = problem.network((32, 32, 32), np.float64, 0)[0]
    starts = [problem.network((32, 32, 32), np.float64, key)[1] for key in range(MEMBERS)]
    seconds: list[float] = []
    limits = Limits(4, reports=(lambda _: seconds.append(time.perf_counter()),))
    GradientFit(*train, validation=validation, limits=limits).train_together(
        family, starts, np.ones((MEMBERS, len(train[0])))
    )
    yield (
        "ensemble",
        f"{MEMBERS} × 32–32–32, {len(train[0]):,} pairs",
        {"seconds": min(np.diff(seconds))},
    )


def rows(problem: Problem, device) -> Iterator[Row]:
    some = slice(None if problem.quick else PAIRS // 5)
    for degree in (4, 6) if problem.quick else (6, 10):
        family = Products(box_inputs(problem.w), degree)
        with row_blocks.on_devices([device]):
            done = timed(
                lambda family=family: (
                    least_squares.reduce(
                        family, [(problem.w[some], problem.target[some])], np.ones(4)
                    ).factor
                ),
                repeats=1,
            )
        square = np.triu(done.out).T @ np.triu(done.out)
        found = {
            "seconds": done.seconds,
            "compile_seconds": done.compile_seconds,
            "compared": (square / np.abs(square).max())[:8, -8:].tolist(),
        }
        yield "rows", f"{family.num_parameters} terms, {len(problem.w[some]):,} pairs", found


def learned(problem: Problem, learns: str) -> Any:
    """Made on the processor, in each process alike."""
    with jax.default_device(jax.devices("cpu")[0]):
        few = problem.pairs.take(slice(2_000))
        return fitted(few, problem.scene, few, learn=learns, tolerance=1e-9)[0].map


def rollouts(problem: Problem, device) -> Iterator[Row]:
    map_ = learned(problem, "map")
    family, params = problem.network((64, 64, 64), np.float64, 0)
    piece = Generated(family, params, MIDPOINT, float(problem.pairs.dt), np.asarray(map_.scale))
    maps = {
        "map": map_,
        "law": learned(problem, "hamiltonian"),
        "network 64–64–64": dataclasses.replace(map_, pieces=(piece,), posterior=None),
    }
    counts = LANES["processor" if device.platform == "cpu" else "gpu"]
    for name, map_ in maps.items():
        for lanes in counts[:2] if problem.quick else counts:
            z0 = np.resize(problem.states, (lanes, 4))
            yield "rollouts", f"{name}, {lanes:,} lanes", _rolled(map_, z0, lanes)


def posterior(problem: Problem, device) -> Iterator[Row]:
    samples = learned(problem, "map").sample(jax.random.key(3), SAMPLES)
    lanes = 256 if problem.quick or device.platform == "cpu" else SAMPLED_LANES
    z0 = np.resize(problem.states, (lanes, 4))
    yield "posterior", f"{SAMPLES} samples × {lanes:,} lanes", _rolled(samples, z0, SAMPLES * lanes)


def _rolled(map_: Any, z0: np.ndarray, lanes: int) -> Numbers:
    done = timed(lambda: map_.rollout(z0, STEPS, save_every=STEPS)[0], repeats=2)
    ends = np.asarray(done.out).reshape(-1, z0.shape[-1])[:COMPARED]
    return {
        "seconds": done.seconds / (STEPS * lanes),
        "compile_seconds": done.compile_seconds,
        "compared": ends.tolist(),
    }


PARTS = (training, ensemble, rows, rollouts, posterior)


def on_one_device(quick: bool) -> Numbers:
    """All rows on JAX's default device of this process."""
    device, problem = jax.local_devices()[0], Problem(quick)
    found = []
    for part in PARTS:
        for kind, name, numbers in part(problem, device):
            print(
                f"  {device.platform} {kind}, {name}: {numbers['seconds']:.3g} s", file=sys.stderr
            )
            found.append({"kind": kind, "name": name, **numbers})
    return {"device": device.device_kind, "jax": jax.__version__, "rows": found}


def measure(quick: bool, *, platform: str) -> Numbers:
    """All rows in a process of its own, in which this platform is JAX's default."""
    done = subprocess.run(
        [sys.executable, __file__, "--here", str(int(quick))],
        env={**os.environ, "JAX_PLATFORMS": f"{platform},cpu" if platform != "cpu" else "cpu"},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return json.loads(done.stdout.splitlines()[-1])


PIECES = {name: partial(measure, platform=name) for name in ("cuda", "cpu")}


def tables() -> None:
    """The table of RESULTS.md: one device beside the other."""
    found = results(PIECES, "gpu")
    measured = {name: result["measured"] for name, result in found.items()}
    rows_of = {
        name: {f"{row['kind']}: {row['name']}": row for row in one["rows"]}
        for name, one in measured.items()
    }
    there, here = (rows_of.get(name, {}) for name in ("cuda", "cpu"))
    cells = []
    for name in [*there, *(name for name in here if name not in there)]:
        gpu, cpu = there.get(name, {}), here.get(name, {})
        seconds = [row.get("seconds") for row in (gpu, cpu)]
        apart = "–"
        if "compared" in gpu and "compared" in cpu:
            apart = f"{np.abs(np.subtract(gpu['compared'], cpu['compared'])).max():.1e}"
        cells.append(
            [
                name,
                *("not measured" if s is None else number(1e6 * s) for s in seconds),
                "–" if None in seconds else number(seconds[1] / seconds[0]),
                number(gpu.get("compile_seconds")),
                apart,
            ]
        )
    heads = ("what", "GPU, µs", "processor, µs", "times as fast", "GPU compiles, s", "apart by")
    if found:
        device = measured.get("cuda", {"device": "not measured"})["device"]
        text = f"{markdown(heads, cells)}\n\nGPU: {device}. {provenance(found)}"
        between_markers(TABLES, "gpu", text)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--here"]:
        print(json.dumps(on_one_device(bool(int(sys.argv[2])))))
    else:
        main(__doc__ or "", PIECES, "gpu", tables, None)
