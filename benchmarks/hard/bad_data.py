"""Bad data: wrong rows, noise, few pairs, float32 numbers, friction, clusters."""

from __future__ import annotations

import math

# Sets float64, so it comes before all of JAX.
from harness import SEED, Numbers, drawn

# isort: split
import jax.numpy as jnp
import numpy as np
from hard.cases import Case, tried
from systems import pendulum_scene

import gfnn_jax as gfnn


def bad_data(quick: bool) -> tuple[list[Case], Numbers]:
    scene = pendulum_scene(0.4)
    data, fresh = drawn(scene, 300 if quick else 1_000, quick)
    z0, z1 = np.asarray(data.z0), np.asarray(data.z1)
    rng = np.random.default_rng(SEED)
    options = {"chart": "midpoint", "family": "polynomial"}
    cases, measured = [], {}

    def add(name, states, images, truth=fresh, **more):
        pairs = gfnn.Pairs(states, images, scene.dt)
        case, fit = tried(name, pairs, None, truth, **options, **more)
        cases.append(case)
        measured[name] = {"messages": list(fit.messages) if fit else [case.failed]}
        if fit is not None and fit.noise is not None:
            measured[name]["noise"] = np.asarray(fit.noise).tolist()

    wrong = z1.copy()
    rows = rng.permutation(len(z1))[: len(z1) // 100]
    wrong[rows] = z1[np.roll(rows, 1)]
    add("1 % of the pairs wrong", z0, wrong)
    for sigma in (1e-2,) if quick else (1e-6, 1e-4, 1e-2, 1e-1):
        noise = sigma * rng.standard_normal((2, *z0.shape))
        add(f"noise, σ = {sigma:g}", z0 + noise[0], z1 + noise[1])
    if not quick:
        add("50 pairs", z0[:50], z1[:50])
        single = [z.astype("f4").astype(float) for z in (z0, z1)]
        add("float32 numbers, 1e-8 asked for", single[0], single[1], tolerance=1e-8)
    for rate in (0.1,) if quick else (1e-3, 0.1, 1.0):
        loss = np.array([1, math.exp(-rate * scene.dt)])
        damped = gfnn.Pairs(fresh.z0, np.asarray(fresh.z1) * loss, scene.dt)
        add(f"friction, rate {rate:g}", z0, z1 * loss, damped)
    if quick:
        return cases, measured
    clusters = 0.05 * z0 + np.where(np.arange(len(z0)) % 2, 0.8, -0.8)[:, None] * [1, 0]
    images = gfnn.reference_trajectories(scene, jnp.asarray(clusters), 1)[:, 1]
    add("two clusters, judged all over the disc", clusters, np.asarray(images))
    return cases, measured
