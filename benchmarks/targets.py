"""Targets of the project: accuracy and cost of the chosen maps, measured.

    python benchmarks/targets.py                            rows without a result, then the tables
    python benchmarks/targets.py --only pcr3bp --overwrite  one row again
    python benchmarks/targets.py --quick                    small sizes, into runs/targets

A row's result is one JSON file, targets-*.json in benchmarks/results. The tables of
benchmarks/RESULTS.md and of docs/results.md, and the figure of that page, are made from these files
alone; --tables makes them again.
All errors are those of states that no fit has seen.
"""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Callable
from itertools import pairwise
from typing import Any

# Sets float64, so it comes before all of JAX.
from harness import (
    FIGURES,
    PAGE,
    SEED,
    TABLES,
    Numbers,
    angles_of,
    between_markers,
    drawn,
    fitted,
    main,
    markdown,
    number,
    one_step_rms,
    provenance,
    results,
)

# isort: split
import jax
import numpy as np
from systems import bounded_states

import gfnn_jax as gfnn
from gfnn_jax.baselines import Budget, Sequences
from gfnn_jax.baselines.learned import paper_gfnn
from gfnn_jax.coordinates import TWO_PI
from gfnn_jax.evaluate import figures, metrics, report
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.scenes import DrawnFrom, Scene, driven_pendulum, henon_heiles, henon_heiles_section
from gfnn_jax.scenes.systems import FIXED_POINT
from gfnn_jax.solve.status import OK

FIGURE = FIGURES / "two_body_error.png"
NUM_STEPS = 1_000


@dataclasses.dataclass(frozen=True)
class Row:
    """A line of the table.

    title:   what is learned, from what.
    targets: measured quantity -> the most it may be. "pairs" and "fit_seconds" are among them.
    measure: ``measure(quick)`` -> dict of what was measured, with the targets' keys among them.
    """

    title: str
    targets: Numbers
    measure: Callable[[bool], Numbers]


# Measuring


def rolled_out(map_: SymplecticMap, scene: Scene, quick: bool) -> Numbers:
    """Position errors of rollouts from fresh states, at step 1,000 and on the way."""
    key = jax.random.fold_in(jax.random.key(SEED), 1)
    z0 = gfnn.sample_test_states(scene, 10 if quick else 100, key)
    reference = np.asarray(gfnn.reference_trajectories(scene, z0, NUM_STEPS))
    states, info = map_.rollout(z0, NUM_STEPS)
    error = np.asarray(metrics.position_error(np.asarray(states), reference, angles_of(scene)))
    statistics = metrics.error_statistics(error)
    steps = np.unique(np.round(np.geomspace(1, NUM_STEPS, 40)).astype(int))
    return {
        "error_mean": float(statistics.mean[-1]),
        "error_median": float(statistics.median[-1]),
        "error_median_inside": float(np.nanmedian(error[np.asarray(info.status) == OK, -1])),
        "num_trajectories": len(error),
        "num_excluded": statistics.num_excluded,
        "status_counts": report.status_counts(info.status),
        "curve": {
            "steps": steps.tolist(),
            "error": [[float(f"{e:.3e}") for e in lane] for lane in error[:, steps]],
        },
    }


# The scenes


def scene_row(name: str, title: str, pairs: int, seconds: float, rms: float, **targets) -> Row:
    """A scene by its name, at an absolute tolerance equal to the target."""

    def measure(quick: bool) -> Numbers:
        scene = gfnn.scenes.make(name)
        data, fresh = drawn(scene, pairs, quick)
        fit, measured = fitted(data, scene, fresh, absolute_tolerance=rms)
        if targets:
            measured |= rolled_out(fit.map, scene, quick)
        return measured

    limits = {"pairs": pairs, "fit_seconds": seconds, "one_step_rms": rms, **targets}
    return Row(title, limits, measure)


def cartesian_two_body(quick: bool) -> Numbers:
    data, fresh = drawn(gfnn.scenes.two_body(), 10_000, quick)
    return fitted(data, None, fresh, absolute_tolerance=1e-6)[1]


def network_on_two_body(quick: bool) -> Numbers:
    data, fresh = drawn(gfnn.scenes.two_body(), 3_000 if quick else 6_000, quick)
    options = {"max_iterations": 40} if quick else {}
    return fitted(data, None, fresh, family="mlp", absolute_tolerance=2e-6, **options)[1]


def paper_recipe(quick: bool) -> Numbers:
    """The paper's network and training on two bodies: what the figure compares with."""
    scene = gfnn.scenes.two_body()
    data, fresh = drawn(scene, 10_000 if quick else 100_000, quick)
    sequences = Sequences(np.stack([data.z0, data.z1], axis=1), scene.dt)
    learned = paper_gfnn(
        sequences, Budget(jax.random.key(SEED), on_progress=lambda m: print(f"  {m}"))
    )
    return {
        "one_step_rms": one_step_rms(learned.map, fresh),
        "pairs": len(data),
        "fit_seconds": learned.training.seconds,
        "compile_seconds": learned.training.compile_seconds,
        "chart": "type2",
        "label": f"{learned.family.label}, Adam",
        "num_parameters": learned.family.num_parameters,
        "symplecticity_defect": float(np.max(learned.map.defect(fresh.z0[:200]))),
        **rolled_out(learned.map, scene, quick),
    }


# Far from the identity


def pendulum(nu: float) -> Row:
    """The driven pendulum, a whole period per step."""

    def measure(quick: bool) -> Numbers:
        data, fresh = drawn(driven_pendulum(frequency=nu), 3_000, quick)
        return fitted(data, None, fresh, absolute_tolerance=1e-10)[1]

    title = f"driven pendulum, ν = {nu:g}, one period per step, told nothing"
    return Row(title, {"pairs": 3_000, "one_step_rms": 1e-10}, measure)


def return_map(quick: bool) -> Numbers:
    """States out to the rim of the island, farther than the scene's own."""
    num_fresh = 50 if quick else 400
    rng = np.random.default_rng(SEED)
    radius, angle = (
        0.22 * np.sqrt(rng.uniform(size=400 + num_fresh)),
        TWO_PI * rng.uniform(size=400 + num_fresh),
    )
    y, p_y = FIXED_POINT
    z0 = np.stack([y + radius * np.cos(angle), p_y + radius * np.sin(angle)], axis=1)
    z1 = np.asarray(gfnn.reference_trajectories(henon_heiles_section(), z0, 1)[:, 1])
    pairs, fresh = gfnn.Pairs(z0[:400], z1[:400], 1.0), gfnn.Pairs(z0[400:], z1[400:], 1.0)
    # The disc's rim, where the map bends most, is rare among 400 states: asking for more than is
    # there takes the most accurate map instead of the first that looks good enough inside.
    return fitted(pairs, None, fresh, absolute_tolerance=1e-7)[1]


# What the choice does


def long_step(quick: bool) -> Numbers:
    """Hénon–Heiles at dt = 1.3: type 2 is refused with advice, auto succeeds."""
    scene = dataclasses.replace(henon_heiles(1 / 12, 1.3), sampling=DrawnFrom(bounded_states))
    data, fresh = drawn(scene, 4_000, quick)
    try:
        gfnn.fit(data, scene, chart="type2")
        refusal = ""
    except gfnn.FitError as error:
        refusal = str(error)
    _, measured = fitted(data, scene, fresh, absolute_tolerance=1e-6)
    return measured | {"refusal": refusal, "advice_missing": int("midpoint" not in refusal)}


def three_tolerances(quick: bool) -> Numbers:
    """Hénon–Heiles: three tolerances choose three maps of rising cost."""
    scene = gfnn.scenes.make("henon-heiles-regular")
    data, fresh = drawn(scene, 2_000 if quick else 4_000, quick)
    chosen = [fitted(data, scene, fresh, absolute_tolerance=t)[1] for t in (1e-4, 1e-7, 1e-10)]
    cost = [c["kflop_per_step"] for c in chosen]
    return {
        "pairs": len(data),
        "chosen": chosen,
        "label": "; ".join(f"{c['chart']} {c['label']}" for c in chosen),
        "chart": "",
        "tolerances_missed": sum(c["one_step_rms"] > c["tolerance"] for c in chosen),
        "cost_not_rising": sum(b <= a for a, b in pairwise(cost)),
        "fit_seconds": max(c["fit_seconds"] for c in chosen),
    }


ROWS: dict[str, Row] = {
    "two-body": scene_row("two-body", "two-body", 4_000, 10, 1e-10, error_mean=1e-7),
    "henon-heiles-regular": scene_row(
        "henon-heiles-regular", "Hénon–Heiles, regular", 4_000, 10, 1e-12, error_mean=1e-8
    ),
    "henon-heiles-chaotic": scene_row(
        "henon-heiles-chaotic", "Hénon–Heiles, chaotic", 8_000, 20, 1e-10
    ),
    "pcr3bp": scene_row("pcr3bp", "three bodies, planar", 10_000, 60, 5e-7, error_median=3e-4),
    "standard-map-regular": scene_row(
        "standard-map-regular", "standard map, K = 0.6", 1_000, 5, 1e-12, error_mean=1e-8
    ),
    "standard-map-chaotic": scene_row(
        "standard-map-chaotic", "standard map, K = 1.2", 1_000, 5, 1e-12
    ),
    "cartesian-two-body": Row(
        "two-body, Cartesian, told nothing",
        {"pairs": 10_000, "fit_seconds": 60, "one_step_rms": 1e-6},
        cartesian_two_body,
    ),
    "network-two-body": Row(
        "two-body, Cartesian, a network",
        {"pairs": 20_000, "fit_seconds": 120, "one_step_rms": 3e-6},
        network_on_two_body,
    ),
    "driven-pendulum-1": pendulum(1.0),
    "driven-pendulum-1.8": pendulum(1.8),
    "return-map": Row(
        "Hénon–Heiles return map, E = 0.1, told nothing",
        {"pairs": 400, "one_step_rms": 1e-5},
        return_map,
    ),
    "long-step": Row(
        "Hénon–Heiles, E < 1/8, dt = 1.3",
        {"pairs": 4_000, "advice_missing": 0, "one_step_rms": 1e-6},
        long_step,
    ),
    "three-tolerances": Row(
        "Hénon–Heiles at 1e-4, 1e-7, 1e-10",
        {"pairs": 4_000, "tolerances_missed": 0, "cost_not_rising": 0},
        three_tolerances,
    ),
    "paper-recipe": Row("two-body, the paper's network and training", {}, paper_recipe),
}


# Results and tables


def against(measured: Numbers, row: Row, key: str) -> str:
    """Measured (at most target)."""
    value, target = measured.get(key), row.targets.get(key)
    if value is None:
        return "–"
    shown = number(value)
    if target is None:
        return shown
    return f"{shown} (≤ {target:.0e})" if target < 0.01 else f"{shown} (≤ {target:,g})"


def verdict(measured: Numbers, row: Row) -> str:
    missed = [key.replace("_", " ") for key, most in row.targets.items() if measured[key] > most]
    if not row.targets:
        return "–"
    return "no: " + ", ".join(missed) if missed else "yes"


def table(found: dict[str, Numbers], *, full: bool) -> str:
    """Markdown: a line per result, each figure with its target in parentheses."""
    heads = ["what is learned", "pairs", "one-step RMS", "error at step 1,000", "fit, s", "map"]
    heads += ["parameters", "µs/step", "defect", "compile, s", "all of it, s"] if full else []
    heads += ["targets met"]
    rows = []
    for name, result in found.items():
        m, row = result["measured"], ROWS[name]
        at_end = "error_median" if "error_median" in row.targets else "error_mean"
        error = against(m, row, at_end)
        if at_end == "error_median":
            inside = f"{number(m['error_median_inside'])} of those that stayed where the data are"
            error = f"{error} median; {inside}" if full else f"{error} median"
        cells = [
            row.title,
            number(m["pairs"]),
            against(m, row, "one_step_rms"),
            error,
            against(m, row, "fit_seconds"),
            f"{m['chart']} {m['label']}".strip() + (", base map" if m.get("base_map") else ""),
        ]
        if full:
            keys = (
                "num_parameters",
                "microseconds_per_step",
                "symplecticity_defect",
                "compile_seconds",
                "total_seconds",
            )
            cells += [number(m.get(key)) for key in keys]
        rows.append([*cells, verdict(m, row)])
    return markdown(heads, rows)


def tables() -> None:
    """The tables of docs/results.md and RESULTS.md and the figure, from the results."""
    found = results(PIECES, "targets")
    if not found:
        return
    between_markers(TABLES, "targets", f"{table(found, full=True)}\n\n{provenance(found)}")
    between_markers(PAGE, "results", f"{table(found, full=False)}\n\n{provenance(found)}")
    caption = (
        "*Two bodies, 100 orbits that no fit has seen: mean position error, and a band of one "
        "standard deviation. Both maps are exactly symplectic, and the error of both grows in "
        f"proportion to the step number ({figure(found)}). Drawn by "
        "`benchmarks/targets.py`.*"
    )
    between_markers(PAGE, "figure", textwrap.fill(caption, 100, break_long_words=False))


def figure(found: dict[str, Numbers]) -> str:
    """Error against step number of two bodies, into FIGURE; returns its caption."""
    named = {"chosen map": "two-body", "the paper's network": "paper-recipe"}
    curves, sizes = {}, []
    for label, name in named.items():
        if name in found:
            m = found[name]["measured"]
            curves[label] = (np.array(m["curve"]["steps"]), np.array(m["curve"]["error"]))
            sizes.append(
                f"{label}: {m['pairs']:,} pairs, {m['num_parameters']:,} parameters, "
                f"{number(m['fit_seconds'])} s of fitting, {number(m['error_mean'])} at the end"
            )
    if curves:
        FIGURE.parent.mkdir(exist_ok=True)
        axes: Any = figures.error_growth(curves)
        figures.save(axes.figure, FIGURE)
    return "; ".join(sizes)


PIECES = {name: row.measure for name, row in ROWS.items()}


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "targets", tables, None)
