"""Costs of samples, and of networks that are trained together."""

from __future__ import annotations

import time
from typing import Any

# Sets float64, so it comes before all of JAX.
from harness import Numbers

# isort: split
import jax
import numpy as np
from posteriors.calibration import SEED, quietly

import gfnn_jax as gfnn
from gfnn_jax.scenes import henon_heiles

# Samples, states, blocks of steps and their length: a law's step is ten times as dear.
COSTS = {"map": (100, 1_000, 10, 100), "hamiltonian": (100, 1_000, 5, 20)}
# Networks of 16-16-16 units.
NETWORKS = {"family": "mlp", "chart": "midpoint", "ensemble": 8, "max_iterations": 30}


def cost(quick: bool) -> Numbers:
    """Samples of a thousand states beside as many lanes of one map."""
    scene = henon_heiles()
    pairs = gfnn.sample_pairs(scene, 3_000, jax.random.key(SEED))
    found: dict[str, Any] = {}
    for learn, (samples, lanes, blocks, length) in COSTS.items():
        if quick:
            samples, blocks, length = 10, 2, 10
        z0 = np.asarray(gfnn.sample_test_states(scene, lanes, jax.random.key(1)))
        fit = quietly(pairs, scene, learn=learn, tolerance=1e-8)
        drawn, all_lanes = fit.sample(jax.random.key(2), samples), np.tile(z0, (samples, 1))
        taken = _in_turn({"samples": (drawn, z0), "lanes": (fit.map, all_lanes)}, blocks, length)
        found[learn] = {
            "label": f"{fit.chosen.chart} {fit.chosen.label}",
            "samples": samples,
            "lanes": lanes,
            "steps": blocks * length,
            **taken,
        }
        print(f"  {learn}: {found[learn]}", flush=True)
    return found


def _in_turn(maps: dict[str, tuple[Any, Any]], blocks: int, length: int) -> Numbers:
    """Seconds, and processor seconds, that (map, states) take for so many blocks of steps. A block
    of one follows that of another, so that what else the machine does disturbs all alike."""
    lanes = {name: map_.start(z0) for name, (map_, z0) in maps.items()}
    seconds = {name: np.zeros(2) for name in maps}
    for block in range(blocks + 1):  # the first compiles, and counts for nothing
        for name, (map_, _) in maps.items():
            before = np.array([time.perf_counter(), time.process_time()])
            found, _ = map_.advance(lanes[name], 1, save_every=length)
            lanes[name] = jax.block_until_ready(found)
            after = np.array([time.perf_counter(), time.process_time()])
            if block:
                seconds[name] += after - before
    return {
        "seconds": {name: s[0] for name, s in seconds.items()},
        "processor_seconds": {name: s[1] for name, s in seconds.items()},
        "ratio": seconds["samples"][0] / seconds["lanes"][0],
        "processor_ratio": seconds["samples"][1] / seconds["lanes"][1],
    }


def together(quick: bool) -> Numbers:
    """Networks trained together beside one network, the same number of iterations."""
    pairs = gfnn.sample_pairs(henon_heiles(), 500, jax.random.key(SEED))
    options = {**NETWORKS, "max_iterations": 3 if quick else 15}
    found = {
        str(count): quietly(pairs, **{**options, "ensemble": count}).chosen.fit_seconds
        for count in (1, NETWORKS["ensemble"])
    }
    per_second = {count: int(count) / seconds for count, seconds in found.items()}
    return {
        "pairs": 500,
        "iterations": options["max_iterations"],
        "seconds": found,
        "models_per_second": per_second,
    }
