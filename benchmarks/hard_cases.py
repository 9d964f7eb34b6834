"""Hard cases: the digits that are kept, the flags that are raised, and the failures.

    python benchmarks/hard_cases.py                          pieces that have no result yet, tables
    python benchmarks/hard_cases.py --only chaos --overwrite one piece again
    python benchmarks/hard_cases.py --quick                  two small pieces, into runs/hard

A piece's result is one JSON file, hard-*.json in benchmarks/results; the section of
benchmarks/RESULTS.md and the figures are made from these files alone. The long pieces are fastest
with one thread: XLA_FLAGS=--xla_cpu_multi_thread_eigen=false.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

# Sets float64, so it comes before all of JAX.
from harness import FIGURES, TABLES, Numbers, between_markers, markdown, number, provenance, results
from harness import main as run_pieces

# isort: split
import numpy as np
from hard.bad_data import bad_data
from hard.cases import Case
from hard.chaos import chaos
from hard.large_steps import SWEEPS, large_steps
from hard.long_times import long_times
from hard.precision import precision
from hard.singular import singular
from hard.solver import solver
from matplotlib.figure import Figure

from gfnn_jax.evaluate import figures

# One table each: ``measure(quick)`` -> its cases, and numbers for figures and text.
TABLE_OF: dict[str, tuple[str, Callable[[bool], tuple[list[Case], Numbers]]]] = {
    "solver": ("Bad conditions for the solver", solver),
    "bad-data": ("Bad data", bad_data),
    "long-times": ("Long times", long_times),
    "large-steps": ("Large steps and chart singularities", large_steps),
    "chaos": ("Chaos", chaos),
    "singular": ("Singular", singular),
    "precision": ("Precision and platforms", precision),
}


def measure(quick: bool, name: str) -> Numbers:
    cases, numbers = TABLE_OF[name][1](quick)
    silent = [case.name for case in cases if case.silent]
    print(f"  {len(cases)} cases, silent: {silent or 'none'}")
    lines = [dataclasses.asdict(case) | {"silent": case.silent} for case in cases]
    return {"cases": lines, **numbers}


PIECES = {name: functools.partial(measure, name=name) for name in TABLE_OF}


# Tables, figures


def table(result: Numbers) -> str:
    """Markdown: a line per case."""
    heads = ["case", "digits kept", "asked for", "flagged", "failed", "silent"]
    rows = []
    for case in result["measured"]["cases"]:
        silent = "no" if not case["silent"] else f"**{case['wrong'] or 'yes'}**"
        cells = [
            case["name"],
            *(
                number(case[k]) if case[k] is None else f"{case[k]:.1f}"
                for k in ("digits", "asked")
            ),
            case["flagged"] or "–",
            case["failed"] or "–",
            silent,
        ]
        rows.append([cell.replace("|", "/") for cell in cells])
    return markdown(heads, rows)


def tables() -> None:
    """The section of RESULTS.md and the figures, from the results."""
    found = results(PIECES, "hard")
    if not found:
        return
    parts = []
    for name, result in found.items():
        small = " (small sizes)" if result["quick"] else ""
        parts.append(f"### {TABLE_OF[name][0]}{small}\n\n{table(result)}")
    total = sum(len(r["measured"]["cases"]) for r in found.values())
    silent = sum(case["silent"] for r in found.values() for case in r["measured"]["cases"])
    head = f"{total} cases, {silent} of them silent."
    missing = [title for name, (title, _) in TABLE_OF.items() if name not in found]
    if missing:
        parts.append(f"Not measured yet: {'; '.join(missing)}.")
    parts.append(provenance(found))
    between_markers(TABLES, "hard-cases", "\n\n".join([head, *parts]))
    draw(found)


def draw(found: dict[str, Numbers]) -> None:
    """Drift of energy, and digits against the time step by chart."""
    FIGURES.mkdir(exist_ok=True)
    if "long-times" in found:
        curves = {}
        for name, m in found["long-times"]["measured"].items():
            if name != "cases" and "rms" in m:
                curves[name] = (np.array(m["elapsed"]), np.array(m["rms"])[None])
                low = m["float32"]
                curves[f"{name}, float32"] = (np.array(low["elapsed"]), np.array(low["rms"])[None])
        axes: Any = figures.energy_error(curves)
        figures.save(axes.figure, FIGURES / "hard_energy_drift.png")
    if "large-steps" in found:
        swept = {n: m for n, m in found["large-steps"]["measured"].items() if n in SWEEPS}
        figures.save(digits_against_step_size(swept), FIGURES / "hard_large_steps.png")


@figures.style()
def digits_against_step_size(sweeps: Numbers) -> Figure:
    """Digits kept in a step against the time step, a panel for each system, a curve for each chart;
    a fit that was refused is a cross on the axis."""
    figure = Figure(figsize=(2.8 * len(sweeps), 2.9))
    axes = figure.subplots(1, len(sweeps), sharey=True, squeeze=False)[0]
    for ax, (system, curves) in zip(axes, sweeps.items(), strict=True):
        dt = np.asarray(curves["dt"], float)
        digits = {n: np.array(v, float) for n, v in curves.items() if n != "dt"}  # None: NaN
        for place, (name, values) in enumerate(digits.items()):
            (line,) = ax.plot(dt, values, "o-", label=name)
            lost = dt[np.isnan(values)]
            # Crosses of charts that fail alike stand above each other.
            ax.plot(lost, np.full(len(lost), -0.4 * place), "x", color=line.get_color())
        ax.set(title=system, xlabel="time step $dt$")
    axes[0].set_ylabel("digits kept in one step")
    axes[0].plot([], [], "x", color="0.5", label="fit refused")
    axes[0].legend(loc="lower left")
    return figure


def main(argv: Sequence[str] | None = None) -> None:
    run_pieces(__doc__ or "", PIECES, "hard", tables, argv, ("solver", "bad-data"))


if __name__ == "__main__":
    main()
