"""Return maps and stroboscopic maps in tables, words and figures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

# Sets float64, so it comes before all of JAX.
from harness import FIGURES, Numbers, markdown, number

# isort: split
import numpy as np
from returns.tools import ITERATIONS, SOLVERS

from gfnn_jax.evaluate import figures

TOLERANCES = (1e-4, 1e-7, 1e-10)
ASKED = 10.0  # times as fast as SciPy and diffrax
GROUPS = {
    "DOP853": ("SciPy DOP853",),
    "diffrax": tuple(f"diffrax {s}" for s in SOLVERS),
    "heyoka": ("heyoka",),
}
HEADS = [
    "asked for",
    "map",
    "one-step RMS",
    "error after 1",
    "after 100",
    "µs, one lane",
    "µs, 1,000 lanes",
    "DOP853",
    "diffrax",
    "heyoka",
    "diffrax, lanes",
    "heyoka, lanes",
]


def time_at(points: Sequence[Numbers], error: float, key: str, arrangement: str) -> float | None:
    """Time at which an integrator has this error, between its precisions by powers; None where its
    most precise one is not as accurate. Where all are more accurate, the cheapest one's."""
    rows = sorted(
        (p[key], p[arrangement])
        for p in points
        if p[arrangement] is not None and p[key] is not None and p[key] > 0
    )
    front: list[tuple[float, float]] = []  # by rising error, falling time
    for row in rows:
        if not front or row[1] < front[-1][1]:
            front.append(row)
    if not front or error < front[0][0]:
        return None
    errors, times = np.log(np.array(front)).T
    return float(np.exp(np.interp(np.log(error), errors, times)))


def ratios(measured: Numbers, ours: Numbers, key: str, arrangement: str) -> dict[str, float | None]:
    """Speed of our map ÷ that of each group of integrators, at our map's error."""
    found = {}
    for group, members in GROUPS.items():
        times = [
            time_at(measured["curves"][m], ours[key], key, arrangement)
            for m in members
            if m in measured["curves"]
        ]
        times = [t for t in times if t is not None]
        found[group] = min(times) / ours[arrangement] if times else None
    return found


def row(measured: Numbers, ours: Numbers, key: str) -> list[str]:
    """A map's cells, with its ratios to the integrators at equal error."""
    single, batch = (ratios(measured, ours, key, a) for a in ("single", "batch"))
    asked = number(ours["tolerance"]) + ("" if ours["met"] else " (not met)")
    return [
        asked,
        f"{ours['chart']} {ours['label']}"
        + (", base map" if ours["base_map"] else "")
        + (f", {ours['times']} steps" if ours["times"] > 1 else ""),
        number(ours["one_step_rms"]),
        number(ours["error_1"]),
        number(ours[f"error_{ITERATIONS}"]),
        number(ours["single"]),
        number(ours["batch"]),
        *(number(single[g]) for g in GROUPS),
        number(batch["diffrax"]),
        number(batch["heyoka"]),
    ]


def fastest(measured: Numbers, ours: Numbers, arrangement: str) -> float | None:
    """The ratio to the fastest integrator."""
    known = [r for r in ratios(measured, ours, "error_1", arrangement).values() if r is not None]
    return min(known) if known else None


def passes(found: dict[int, Numbers], arrangement: str) -> str:
    """Smallest number of periods at which the ratio is 10, for each tolerance, in words."""
    said = []
    for tolerance in TOLERANCES:
        reached = []
        for n, measured in found.items():
            ours = [m for m in measured["maps"] if m["tolerance"] == tolerance and m["met"]]
            ratio = fastest(measured, ours[0], arrangement) if ours else None
            reached.append((n, ratio))
        known = [(n, r) for n, r in reached if r is not None]
        first = next((n for n, r in known if r >= ASKED), None)
        shown = ", ".join(f"{number(r)} at {n}" for n, r in known)
        verdict = f"from {first} periods on" if first else "not reached"
        said.append(f"{number(tolerance)}: {verdict} ({shown or 'no map'})")
    return "; ".join(said)


def section_text(measured: Numbers) -> str:
    rows = [row(measured, ours, "error_1") for ours in measured["maps"]]
    verdicts = []
    for arrangement, named in (("single", "one lane"), ("batch", f"{measured['lanes']:,} lanes")):
        found = [ratios(measured, m, "error_1", arrangement) for m in measured["maps"]]
        least = min(v for r in found for g in ("DOP853", "diffrax") if (v := r[g]) is not None)
        met = "met" if least >= ASKED else "**not met**"
        verdicts.append(f"{named}, the smallest ratio is {number(least)}, {met}")
    return (
        "### Hénon–Heiles, return map at E = 0.1\n\n"
        f"{measured['pairs']:,} pairs, {number(measured['fit_seconds'])} s for the fits at "
        f"three tolerances. The columns from DOP853 on: times as fast at equal one-step error.\n\n"
        f"{markdown(HEADS, rows)}\n\n"
        f"Target, one thread, at least {ASKED:g} times as fast as DOP853 and as diffrax: "
        f"{'; '.join(verdicts)} (DOP853 has no lanes).\n\n"
        "![Error against time](figures/return_maps_section.png)"
    )


def counted(periods: int) -> str:
    return f"{periods} period" + "s" * (periods > 1)


def pendulum_text(found: dict[int, Numbers]) -> str:
    rows = [
        [str(n), *row(measured, ours, "error_1")]
        for n, measured in found.items()
        for ours in measured["maps"]
    ]
    first = next(iter(found.values()))
    refused = [
        f"{counted(n)}: {m['refused']}. There the maps of a part are taken several times.\n\n"
        for n, m in found.items()
        if m["refused"]
    ]
    return (
        "### Driven pendulum, stroboscopic map\n\n"
        f"{first['pairs']:,} pairs each; ratios at equal error after one iteration; the one-step "
        f"RMS is that of the map's own step.\n\n{''.join(refused)}"
        f"{markdown(['periods', *HEADS], rows)}\n\n"
        f"Where the ratio to the fastest integrator passes {ASKED:g}, one lane: "
        f"{passes(found, 'single')}. Lanes: {passes(found, 'batch')}.\n\n"
        + "\n".join(
            f"![Error against time, {counted(n)}](figures/return_maps_pendulum_{n}.png)"
            for n in found
        )
    )


def iterations_text(found: Numbers) -> str:
    said = []
    for name, m in found.items():
        counts = ", ".join(f"{count:,} {status}" for status, count in m["status_counts"].items())
        reference = m["reference_seconds"] / m["reference_iterations"] / m["reference_lanes"]
        line = (
            f"- {name}, {m['chart']} {m['label']} (one-step RMS {number(m['one_step_rms'])}): "
            f"{m['iterations']:,} iterations of {m['lanes']:,} states in {number(m['seconds'])} s "
            f"({counts}); the reference, {1e6 * reference:.0f} µs an iteration, would take "
            f"{number(reference * m['iterations'] * m['lanes'] / 3600)} hours."
        )
        if m["distance_from_curves"] is not None:
            line += (
                f" Points of the map lie within {number(m['distance_from_curves'])} of the "
                f"reference's curves ({m['reference_lanes']} states)."
            )
        said.append(line)
    pictures = "\n".join(f"![{name}: sections](figures/return_maps_{name}.png)" for name in found)
    return "### A hundred thousand iterations\n\n" + "\n".join(said) + "\n\n" + pictures


def draw_curves(measured: Numbers, key: str, arrangement: str, name: str) -> None:
    curves = {
        tool: ([p[arrangement] for p in points], [p[key] for p in points])
        for tool, points in measured["curves"].items()
        if points[0][arrangement] is not None
    }
    ours = measured["maps"]
    curves = {"learned maps": ([m[arrangement] for m in ours], [m[key] for m in ours]), **curves}
    axes: Any = figures.work_precision(
        curves, "error after one iteration", "time per iteration of one trajectory (µs)"
    )
    figures.save(axes.figure, FIGURES / f"return_maps_{name}.png")
