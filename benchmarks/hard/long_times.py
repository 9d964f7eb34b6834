"""Long times: energy over a million steps, there and back, float32, an invariant curve."""

from __future__ import annotations

import math

# Sets float64, so it comes before all of JAX.
from harness import SEED, Numbers, drawn, fitted, in_float32

# isort: split
import jax
import numpy as np
from hard.cases import Case, counts, digits_of

import gfnn_jax as gfnn
from gfnn_jax.coordinates import TWO_PI
from gfnn_jax.evaluate import metrics
from gfnn_jax.scenes import standard_map

# Long times: orbits and their steps, steps there and back, the single orbit's, the map's.
LANES, STEPS, BACK, SINGLE, MAP_STEPS = 64, 1_000_000, 100_000, 10_000_000, 100_000_000
# Brouwer's law gives ½.
MOST_EXPONENT = 0.6


def drift_of(map_, scene, z0, num_steps, save_every, window):
    """Energy error of rollouts from z0, averaged over blocks of ``window`` saved states: (exponent,
    info, steps since the first block, RMS over orbits of the difference from it)."""
    states, info = map_.rollout(z0, num_steps, save_every=save_every)
    energy = jax.vmap(jax.vmap(scene.invariants["energy"]))(states)
    error = metrics.energy_error(np.asarray(energy))
    steps = save_every * np.arange(error.shape[1])
    num_blocks = error.shape[1] // window
    blocks = error[:, : num_blocks * window].reshape(len(error), num_blocks, window).mean(axis=-1)
    centres = save_every * window * (np.arange(num_blocks) + 0.5)
    exponent = metrics.drift_exponent(steps, error, window) if len(error) > 1 else None
    rms = np.sqrt(np.mean((blocks - blocks[:, :1]) ** 2, axis=0))
    return exponent, info, centres - centres[0], rms


def long_times(quick: bool) -> tuple[list[Case], Numbers]:
    cases, measured = [], {}
    lanes, num_steps = (8, 20_000) if quick else (LANES, STEPS)
    back = 2_000 if quick else BACK
    for name, tolerance in (("henon-heiles-regular", 1e-12), ("two-body", 1e-10)):
        scene = gfnn.scenes.make(name)
        data, fresh = drawn(scene, 4_000, quick)
        fit, _ = fitted(data, scene, fresh, absolute_tolerance=tolerance)
        z0 = np.asarray(gfnn.sample_test_states(scene, lanes, jax.random.key(SEED)))
        print(f"  {name}: {lanes} × {num_steps:,} steps")
        exponent, info, elapsed, rms = drift_of(fit.map, scene, z0, num_steps, 20, 50)
        assert exponent is not None
        low, high = exponent.interval
        said = f"drift exponent {exponent.value:.2f} (95 %: {low:.2f} to {high:.2f})"
        cases.append(
            Case(
                f"{name}, {lanes} × {num_steps:,} steps: energy, {said}",
                digits_of(rms[-1]),
                10,
                counts(info.status),
                wrong=int(low > MOST_EXPONENT),
            )
        )
        measured[name] = {
            "exponent": exponent.value,
            "interval": [low, high],
            "elapsed": elapsed[1:].tolist(),
            "rms": rms[1:].tolist(),
        }
        forward, first = fit.map.rollout(z0, back, save_every=back)
        returned, second = fit.map.reversed().rollout(forward[:, -1], back, save_every=back)
        error = np.asarray(returned[:, -1]) - z0
        worst = float(np.abs(error / np.asarray(fit.map.scale)).max())
        cases.append(
            Case(
                f"{name}, {back:,} steps and back",
                digits_of(worst),
                8,
                counts([first.status, second.status]),
            )
        )
        single = in_float32(fit.map)
        few = min(num_steps, 100_000)
        exponent, info, elapsed, rms = drift_of(single, scene, z0[:16], few, 20, 50)
        cases.append(
            Case(
                f"{name} in float32, {few:,} steps: energy",
                digits_of(rms[-1]),
                3,
                counts(info.status),
            )
        )
        measured[name]["float32"] = {
            "elapsed": elapsed[1:].tolist(),
            "rms": rms[1:].tolist(),
            "exponent": exponent.value if exponent else None,
        }
        if not quick and name == "henon-heiles-regular":
            _, info, elapsed, rms = drift_of(fit.map, scene, z0[:1], SINGLE, 200, 50)
            cases.append(
                Case(
                    f"{name}, 1 × {SINGLE:,} steps: energy",
                    digits_of(rms[-1]),
                    10,
                    counts(info.status),
                )
            )
            measured[name]["single"] = {"elapsed": elapsed[1:].tolist(), "rms": rms[1:].tolist()}
    case, curve = on_invariant_curve(200_000 if quick else MAP_STEPS)
    return [*cases, case], measured | {"standard map": curve}


def on_invariant_curve(num_steps: int) -> tuple[Case, Numbers]:
    """One orbit of the standard map, K = 0.6, on a curve that winds around the cylinder."""
    scene = standard_map(0.6)
    data, fresh = drawn(scene, 1_000, True)
    fit, _ = fitted(data, scene, fresh, absolute_tolerance=1e-12)
    curve = np.empty((5_000, 2))
    theta, p = 0.0, 4.0
    for i in range(len(curve)):
        curve[i] = theta, p
        p += 0.6 * math.sin(theta)
        theta = (theta + p) % TWO_PI
    # The reduced angle itself: beside millions of turns it would lose its last digits.
    lanes, num_blocks, reached = fit.map.start(curve[:1]), 200, []
    for _ in range(num_blocks):
        lanes, _ = fit.map.advance(lanes, 1, save_every=num_steps // num_blocks)
        reached.append(np.asarray(lanes.y)[0] % TWO_PI)
    away = metrics.curve_distance(np.array(reached), curve)
    case = Case(
        f"standard map, K = 0.6, 1 × {num_steps:,} steps: distance from its curve",
        digits_of(float(away[-20:].max())),
        10,
        counts(lanes.status),
    )
    steps = num_steps // num_blocks * np.arange(1, num_blocks + 1)
    return case, {"steps": steps.tolist(), "distance": away.tolist()}
