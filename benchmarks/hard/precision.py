"""Precision and platforms: float32, float64 switched off, two versions of JAX."""

from __future__ import annotations

import json
import os
import subprocess
import sys

# Sets float64, so it comes before all of JAX.
from harness import HERE, RESULTS, Numbers, angles_of, drawn, fitted, in_float32

# isort: split
import commits
import jax
import jax.numpy as jnp
import numpy as np
from hard.cases import Case, counts, digits_of, tried

import gfnn_jax as gfnn
from gfnn_jax.coordinates import nearest_image
from gfnn_jax.evaluate import metrics


def fingerprint(quick: bool) -> Numbers:
    """Numbers on which two versions of JAX must agree: a step, and a rollout of 100 steps."""
    scene = gfnn.scenes.make("henon-heiles-regular")
    data, fresh = drawn(scene, 1_000, True)
    fit, _ = fitted(
        data, scene, fresh, absolute_tolerance=1e-7, chart="midpoint", family="polynomial"
    )
    z0 = np.asarray(fresh.z0)[:8]
    states, _ = fit.map.rollout(z0, 100)
    return {
        "image": np.asarray(states)[:, 1].tolist(),
        "after 100 steps": np.asarray(states)[:, -1].tolist(),
        "label": fit.chosen.label,
        "code": commits.code()["commit"],
    }


def precision(quick: bool) -> tuple[list[Case], Numbers]:
    cases = []
    for name, tolerance in (("henon-heiles-regular", 1e-7), ("standard-map-regular", 1e-7)):
        scene = gfnn.scenes.make(name)
        data, fresh = drawn(scene, 1_000, True)
        case, fit = tried(f"{name}, map in float64", data, scene, fresh, tolerance=tolerance)
        assert fit is not None
        cases.append(case)
        single = in_float32(fit.map)
        image, info = single.step(np.asarray(fresh.z0))
        assert image.dtype == jnp.float32
        error = np.asarray(image, float) - np.asarray(fit.map.step(fresh.z0)[0])
        spread = float(np.std(np.asarray(fresh.z1), axis=0).max())
        error = nearest_image(error, angles_of(scene))
        rms = float(np.sqrt(np.mean(error**2))) / spread
        cases.append(
            Case(f"{name}, the same map in float32", digits_of(rms), 6, counts(info.status))
        )
        many, info = single.rollout(np.asarray(fresh.z0)[:50], 1_000, save_every=1_000)
        same, _ = fit.map.rollout(np.asarray(fresh.z0)[:50], 1_000, save_every=1_000)
        error = metrics.position_error(np.asarray(many, float), np.asarray(same), angles_of(scene))
        cases.append(
            Case(
                f"{name}, in float32, 1,000 steps",
                digits_of(np.median(error[:, -1])),
                3,
                counts(info.status),
            )
        )
    code = "import gfnn_jax as g, numpy as n; z = n.random.rand(100, 2); g.fit(g.Pairs(z, z, 1.0))"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=x64_off())
    line = done.stderr.strip().splitlines()[-1] if done.stderr else ""
    cases.append(
        Case(
            "float64 switched off",
            None,
            None,
            failed=line,
            wrong=int(done.returncode == 0 or "float64" not in line),
        )
    )
    mine, version = fingerprint(quick), jax.__version__
    before = RESULTS / "hard-precision.json"
    others = json.loads(before.read_text("utf-8"))["measured"] if before.exists() else {}
    others.pop("cases", None)
    # Another code learns from other rows: what differs then is not the version's.
    others = {v: found for v, found in others.items() if found.get("code") == mine["code"]}
    for other, theirs in others.items():
        if other == version:
            continue
        for what, asked in (("image", 13), ("after 100 steps", 10)):
            error = float(np.abs(np.array(mine[what]) - np.array(theirs[what])).max())
            label = f"jax {version} against {other}, {what}"
            cases.append(Case(label, digits_of(error), asked))
    return cases, others | {version: mine}


def x64_off() -> dict[str, str]:
    return {k: v for k, v in os.environ.items() if k != "JAX_ENABLE_X64"} | {
        "PYTHONPATH": str(HERE.parent)
    }
