"""Return maps and stroboscopic maps: one learned step against a whole integration.

    python benchmarks/return_maps.py                 pieces without a result, then the tables
    python benchmarks/return_maps.py --only pendulum-4 --overwrite
    python benchmarks/return_maps.py --quick         small sizes, into runs/return-maps, no tables

A piece's result is one JSON file, return-maps-*.json in benchmarks/results; the figures and the
section of benchmarks/RESULTS.md are made from these files alone. The process is kept on one core
before JAX starts its threads, so that everything runs on one thread. Times are per iteration and
trajectory, the best of several, compilation apart; finding the crossing is part of an iteration.
heyoka is in the extra ``benchmarks``; without it its rows say so.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from typing import Any

# Sets float64, so it comes before all of JAX.
from harness import (
    FIGURES,
    SEED,
    TABLES,
    Numbers,
    between_markers,
    drawn,
    fitted,
    on_one_core,
    once,
    one_step_rms,
    provenance,
    results,
    timed,
)
from harness import main as run_pieces

# isort: split
import jax
import numpy as np
from returns.tables import TOLERANCES, draw_curves, iterations_text, pendulum_text, section_text
from returns.tools import ITERATIONS, PRECISIONS, Sizes, Tool, tools

import gfnn_jax as gfnn
from gfnn_jax.evaluate import figures, metrics, report
from gfnn_jax.scenes import Scene, driven_pendulum, henon_heiles_section
from gfnn_jax.scenes.systems import FIXED_POINT

PERIODS = (1, 2, 4, 8, 16)
FULL = Sizes(3_000, 1_000, 50, 2, 200, 7, PRECISIONS)
QUICK = Sizes(300, 64, 8, 2, 50, 1, (1e-4, 1e-8))


# Measuring


def distance(states, reference) -> float:
    """RMS over the states (B, 2) of the Euclidean error."""
    return float(np.sqrt(np.mean(np.sum((np.asarray(states) - reference) ** 2, axis=1))))


def seconds(iterate, z0, iterations, precision, repeats) -> float:
    """Seconds per iteration and trajectory, the best of several after one that compiles."""
    taken = timed(lambda: iterate(z0, iterations, precision), repeats)
    return taken.seconds / taken.out[1]


def curve(name: str, tool: Tool, z0, reference, end: float, sizes: Sizes) -> list[Numbers]:
    """Error and time of an integrator for every precision; reference: after 1 and ITERATIONS."""
    points = []
    slow = name.startswith("SciPy")
    for tolerance in tool.precisions:
        precision, states = (tolerance, end), z0[: tool.judged]
        started = time.perf_counter()
        iterate = tool.batch if tool.batch is not None and not slow else tool.single
        errors = {}
        for i, iterations in enumerate((1, ITERATIONS)):
            if iterate is tool.single:
                ended = np.concatenate([iterate(z[None], iterations, precision)[0] for z in states])
            else:
                ended = iterate(states, iterations, precision)[0]
            errors[f"error_{iterations}"] = distance(ended, reference[: len(ended), i])
        single = seconds(tool.single, z0[:1], 5 if slow else ITERATIONS, precision, sizes.repeats)
        batch = None
        if tool.batch is not None:
            batch = seconds(tool.batch, z0, 1 if slow else 4, precision, sizes.repeats)
        points.append(
            {
                "tolerance": tolerance,
                **errors,
                "single": 1e6 * single,
                "batch": None if batch is None else 1e6 * batch,
            }
        )
        print(f"  {name} {tolerance:.0e}: {time.perf_counter() - started:.0f} s")
    return points


def maps(scene: Scene, z0, reference, sizes: Sizes, times: int = 1) -> Numbers:
    """Our maps of this scene, one for each tolerance. An iteration is so many steps of them."""
    pairs, fresh = drawn(scene, sizes.pairs, sizes is QUICK)
    found: list[Numbers] = []
    fits = []
    for tolerance in TOLERANCES:
        fit, about = fitted(pairs, scene, fresh, absolute_tolerance=tolerance)
        fits.append(fit)
        if found and found[-1]["label"] == about["label"]:
            continue  # the most accurate one has been measured
        map_ = fit.map
        states, info = map_.rollout(z0, times * ITERATIONS, save_every=times)
        states = np.asarray(states)
        errors = {
            f"error_{n}": distance(states[: len(reference), n], reference[:, i])
            for i, n in enumerate((1, ITERATIONS))
        }

        def taking(lanes, num_steps, map_=map_):
            seconds = timed(
                lambda: map_.advance(lanes, 1, save_every=num_steps)[1], sizes.repeats
            ).seconds
            return 1e6 * times * seconds / num_steps / len(lanes.status)

        found.append(
            {
                "tolerance": tolerance,
                "met": fit.met,
                "chart": about["chart"],
                "label": about["label"],
                "base_map": fit.base_map,
                "times": times,
                "num_parameters": about["num_parameters"],
                "one_step_rms": one_step_rms(map_, fresh),
                **errors,
                "defect": float(np.max(map_.defect(fresh.z0[:200]))),
                "status_counts": report.status_counts(info.status),
                "single": taking(map_.start(z0[:1]), 10 * sizes.steps),
                "batch": taking(map_.start(z0), sizes.steps),
            }
        )
        print(f"  {about['label']}: {found[-1]['single']:.1f}, {found[-1]['batch']:.1f} µs")
    return {
        "pairs": len(pairs),
        "fit_seconds": sum(fit.seconds for fit in fits),
        "maps": found,
        "determinants": {n: j.low for n, j in fits[0].determinants.items()},
    }


def compared(
    scene: Scene,
    found: dict[str, Tool],
    sizes: Sizes,
    shorter: Callable[[int], Scene] | None = None,
) -> Numbers:
    """Our maps and all integrators on one scene; where no chart covers it, the maps of the longest
    part of it that one does, ``shorter(times)``, taken so many times."""
    z0 = gfnn.sample_test_states(scene, sizes.lanes, jax.random.key(SEED))
    orbits = gfnn.reference_trajectories(scene, z0[: sizes.judged], ITERATIONS)
    reference = np.asarray(orbits)[:, [1, ITERATIONS]]
    part, times, refused = scene, 1, None
    while True:
        try:
            ours = maps(part, z0, reference, sizes, times)
            break
        except gfnn.FitError as error:
            if shorter is None:
                raise
            times, refused = 2 * times, refused or str(error)
            part = shorter(times)
    curves = {
        name: curve(name, tool, np.asarray(z0), reference, scene.dt, sizes)
        for name, tool in found.items()
    }
    return {
        **ours,
        "refused": refused,
        "lanes": len(z0),
        "judged": len(reference),
        "curves": curves,
    }


def section(quick: bool) -> Numbers:
    sizes = QUICK if quick else FULL
    return compared(henon_heiles_section(), tools("section", sizes), sizes)


def pendulum(quick: bool, periods: int) -> Numbers:
    sizes = QUICK if quick else FULL
    scene, found = driven_pendulum(periods), tools("pendulum", sizes)
    return compared(scene, found, sizes, lambda times: driven_pendulum(periods // times))


# Many iterations


def iterations(quick: bool) -> Numbers:
    """The most accurate map of either scene, iterated 10⁵ times from 1,000 states, and the
    reference as far as is worth waiting for: points of both for a picture."""
    num, lanes, most, seen = (1_000, 50, 200, 10) if quick else (100_000, 1_000, 1_000, 30)
    return {
        scene.name: iterated(scene, num, lanes, most, seen, quick)
        for scene in (henon_heiles_section(), driven_pendulum())
    }


def iterated(scene: Scene, num: int, lanes: int, most: int, seen: int, quick: bool) -> Numbers:
    pairs, fresh = drawn(scene, (QUICK if quick else FULL).pairs, quick)
    fit, about = fitted(pairs, scene, fresh, absolute_tolerance=TOLERANCES[-1])
    z0 = gfnn.sample_test_states(scene, lanes, jax.random.key(SEED))
    points = 100
    (states, info), ours, _ = once(lambda: fit.map.rollout(z0, num, save_every=num // points))
    exact, theirs, _ = once(lambda: gfnn.reference_trajectories(scene, z0[:seen], most))
    print(f"  {scene.name}: {ours:.0f} s and {theirs:.0f} s")
    states, exact = np.asarray(states[:seen, 1:]), np.asarray(exact)
    curves = metrics_of_curves(states, exact) if scene.section is not None else None
    shown = exact[:, 1 :: most // points]
    return {
        "label": about["label"],
        "chart": about["chart"],
        "one_step_rms": about["one_step_rms"],
        "iterations": num,
        "lanes": lanes,
        "seconds": ours,
        "status_counts": report.status_counts(info.status),
        "reference_iterations": most,
        "reference_lanes": seen,
        "reference_seconds": theirs,
        "distance_from_curves": curves,
        "points": {"map": rounded(states), "reference": rounded(shown)},
    }


def metrics_of_curves(states, exact) -> float:
    """Largest distance of our points from the reference's closed curves around the fixed point, in
    the plane (angle, radius) of (y, 1.8 p_y), where these curves are nearly circles."""

    def polar(z):
        x = (z - np.array(FIXED_POINT)) * np.array([1.0, 1.8])
        return np.stack([np.arctan2(x[..., 1], x[..., 0]), np.hypot(x[..., 0], x[..., 1])], axis=-1)

    return float(
        max(
            metrics.curve_distance(polar(a), polar(b), 32).max()
            for a, b in zip(states, exact, strict=True)
        )
    )


def rounded(states) -> list:
    """x and y of all points to four decimals, enough for a picture."""
    return [[round(float(v), 4) for v in states[..., i].ravel()] for i in (0, 1)]


PIECES = {
    "section": section,
    **{f"pendulum-{n}": functools.partial(pendulum, periods=n) for n in PERIODS},
    "iterations": iterations,
}


# Tables and figures


def tables() -> None:
    found = {n: r["measured"] for n, r in results(PIECES, "return-maps").items()}
    parts = []
    if "section" in found:
        draw_curves(found["section"], "error_1", "single", "section")
        parts.append(section_text(found["section"]))
    pendulums = {n: found[f"pendulum-{n}"] for n in PERIODS if f"pendulum-{n}" in found}
    if pendulums:
        for n, measured in pendulums.items():
            draw_curves(measured, "error_1", "single", f"pendulum_{n}")
        parts.append(pendulum_text(pendulums))
    if "iterations" in found:
        for name, m in found["iterations"].items():
            points = {}
            for title, key, most in (
                ("reference", "reference", "reference_iterations"),
                ("learned map", "map", "iterations"),
            ):
                shown = m["points"][key]
                every = m[most] * m["reference_lanes"] // len(shown[0])
                points[f"{title}, every {every:,}th of {m[most]:,}"] = shown
            labels = ("$y$", "$p_y$") if "section" in name else ("$q$", "$p$")
            panels = {n: (np.array(x), np.array(y)) for n, (x, y) in points.items()}
            axes: Any = figures.sections(panels, labels)
            figures.save(axes[0].figure, FIGURES / f"return_maps_{name}.png")
        parts.append(iterations_text(found["iterations"]))
    if parts:
        parts.append(provenance(results(PIECES, "return-maps")))
        between_markers(TABLES, "return-maps", "\n\n".join(parts))


def main(argv: Sequence[str] | None = None) -> None:
    on_one_core()
    run_pieces(__doc__ or "", PIECES, "return-maps", tables, argv)


if __name__ == "__main__":
    main()
