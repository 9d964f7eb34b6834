"""Large steps and chart singularities: digits against the time step, chart by chart."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

# Sets float64, so it comes before all of JAX.
from harness import Numbers, drawn

# isort: split
import jax
import numpy as np
from hard.cases import Case, counts, digits_of, tried
from systems import oscillator_scene, pendulum_scene, well

import gfnn_jax as gfnn
from gfnn_jax.scenes import Scene, two_body

SWEEPS: dict[str, tuple[Callable[[float], Scene], tuple[float, ...]]] = {
    "oscillator": (oscillator_scene, (0.5, 1.5, math.pi / 2, 2.0, 3.0, math.pi)),
    "pendulum": (pendulum_scene, (0.5, 1.5, 2.0, 2.6, 3.0, 4.0, 6.0)),
    "Hénon–Heiles": (well, (0.1, 0.5, 1.0, 1.3, 2.0, 3.0)),
    "two bodies": (two_body, (0.1, 0.4, 0.8, 1.2, math.pi / 2)),
}


def large_steps(quick: bool) -> tuple[list[Case], Numbers]:
    cases, measured = [], {}
    for system, (make, steps) in SWEEPS.items():
        if quick and system not in ("oscillator", "pendulum"):
            continue
        measured[system] = {"dt": list(steps)}
        jax.clear_caches()  # a process may hold so many compiled programs, and no more
        kept: dict[float, gfnn.Fit] = {}
        for chart in ("type2", "midpoint", "auto"):
            found = []
            for dt in steps[::2] if quick else steps:
                scene = make(dt)
                data, fresh = drawn(scene, 400 if scene.dim == 1 else 2_000, True)
                case, fit = tried(
                    f"{system}, dt = {dt:.3g}, {chart}",
                    data,
                    scene,
                    fresh,
                    chart=chart,
                    family="polynomial",
                )
                if fit is not None:
                    if chart == "auto":
                        kept[dt] = fit
                    note = f"{fit.chosen.chart}{', base map' if fit.base_map else ''}"
                    flagged = "; ".join(part for part in (case.flagged, note) if part)
                    shown = flagged if chart == "auto" or fit.base_map else case.flagged
                    case = dataclasses.replace(case, flagged=shown)
                cases.append(case)
                found.append(case.digits)
                print(f"  {case}")
            measured[system][chart] = found
        cases += composed(system, make, steps, kept)
    return cases, measured


def composed(system, make, steps, kept) -> list[Case]:
    """The largest step that is a multiple of a shorter one, taken by the shorter map."""
    for dt in reversed(steps):
        for shorter in sorted(kept, reverse=True):
            times = round(dt / shorter)
            if times > 1 and abs(times * shorter - dt) < 1e-9:
                scene = make(dt)
                _, fresh = drawn(scene, 10, True)
                states, info = kept[shorter].map.rollout(fresh.z0, times)
                error = np.asarray(states)[:, -1] - np.asarray(fresh.z1)
                spread = float(np.std(np.asarray(fresh.z1), axis=0).max())
                rms = float(np.sqrt(np.mean(error**2))) / spread
                name = f"{system}, dt = {dt:.3g} as {times} steps of {shorter:.3g}"
                return [Case(name, digits_of(rms), 5, counts(info.status))]
    return []
