"""Bands: their coverage of the true error, the cost of samples, and fits to noisy sequences.

    python benchmarks/bands.py                       pieces that have no result yet, tables, figure
    python benchmarks/bands.py --only cost,henon-heiles-1e-4 --overwrite
    python benchmarks/bands.py --quick               small sizes, into runs/bands

Bands are twice the standard deviation of rollouts of maps drawn from the posterior, about that of
the fitted map; the true error is that map's own, against the reference, from clean states that no
fit has seen. σ is the noise on every number of both states of a pair, ÷ the coordinate's spread.
"""

from __future__ import annotations

from functools import partial
from typing import Any

# Sets float64, so it comes before all of JAX.
from harness import TABLES, Numbers, between_markers, main, markdown, number, results

# isort: split
from posteriors.calibration import (
    COVERED,
    DATA_SETS,
    SIGMAS,
    STEPS,
    WIDEST,
    Cell,
    calibrated,
    cells,
    pendulum,
)
from posteriors.costs import COSTS, NETWORKS, cost, together
from posteriors.figure import figure
from posteriors.kinds import KINDS, of_kind
from posteriors.kinds import STEPS as KIND_STEPS
from posteriors.sequences import sequences
from posteriors.told import told

from gfnn_jax.scenes import froeschle, henon_heiles, two_body

# Of two bodies, whose H is no sum of products of coordinates.
KEPLER_TERMS = ["p1**2 + p2**2", "1/sqrt(q1**2 + q2**2)"]
# Few coefficients make all errors of a law's fit.
SETS_OF_LAWS = {size: 2 * count for size, count in DATA_SETS.items()}
# Of S there have to be more pairs than 100 in four dimensions, of a ring fewer tell it.
SETS_OF_S = {size: DATA_SETS[size] for size in (1_000, 10_000)}
SETS_OF_RINGS = {size: DATA_SETS[size] for size in (100, 1_000)}
_S_OF_HENON_HEILES = {"learn": "map", "family": "polynomial", "chart": "midpoint"}

# A piece for each σ.
CASES = {
    "henon-heiles-law": partial(
        calibrated, henon_heiles, lend=False, data_sets=SETS_OF_LAWS, learn="hamiltonian"
    ),
    "two-body-law": partial(
        calibrated,
        two_body,
        lend=False,
        data_sets=SETS_OF_LAWS,
        learn="hamiltonian",
        terms=KEPLER_TERMS,
    ),
    "pendulum-law": partial(
        calibrated, pendulum, lend=False, data_sets=SETS_OF_LAWS, learn="hamiltonian"
    ),
    "henon-heiles": partial(
        calibrated, henon_heiles, lend=False, data_sets=SETS_OF_S, **_S_OF_HENON_HEILES
    ),
    "two-body": partial(calibrated, two_body, lend=True, learn="map"),
    "pendulum": partial(calibrated, pendulum, lend=False, learn="map"),
    "ring-32": partial(
        calibrated, partial(froeschle, 32), lend=True, data_sets=SETS_OF_RINGS, learn="map"
    ),
    "ensemble": partial(calibrated, henon_heiles, lend=False, data_sets={500: 10}, **NETWORKS),
}
PIECES = {
    **{
        f"{case}-{sigma}": partial(calibrate, sigma=SIGMAS[sigma])
        for case, calibrate in CASES.items()
        for sigma in SIGMAS
    },
    "noise-dt-0.5": partial(sequences, 0.5),
    "noise-dt-0.05": partial(sequences, 0.05),
    "noise-told": told,
    **{f"kind-{name}": partial(of_kind, name) for name in KINDS},
    "cost": cost,
    "together": together,
}
QUICK = ("henon-heiles-law-1e-4", "two-body-law-1e-4", "pendulum-1e-4", "cost")


def calibration() -> dict[str, list[dict[str, Any]]]:
    """The rows of each case, as far as there are results."""
    found = results(PIECES, "bands")
    return {
        case: [
            row
            for sigma in SIGMAS
            if (name := f"{case}-{sigma}") in found
            for row in found[name]["measured"]["rows"]
        ]
        for case in CASES
    }


def _calibration_table(found: dict[str, list[dict[str, Any]]]) -> str:
    head = ["case", "σ ÷ spread", "pairs × data sets", "chosen"]
    head += [f"step {k:,}: covered %, width ÷ RMS, RMS" for k in STEPS]
    rows = [
        [
            case,
            f"{row['sigma']:g}",
            f"{row['pairs']:,} × {sum(row['labels'].values())}",
            _labels(row["labels"]),
            *(_cell(c) for c in cells(row)),
        ]
        for case, of_case in found.items()
        for row in of_case
    ]
    return markdown(head, rows)


def _labels(counts: dict[str, int]) -> str:
    """The two that were chosen most often, how often where there are several."""
    if len(counts) == 1:
        return next(iter(counts))
    some = [f"{name} ({count})" for name, count in counts.items()][:2]
    return ", ".join([*some, "…"] if len(counts) > 2 else some)


def _cell(cell: Cell | str) -> str:
    if isinstance(cell, str):
        return cell or "–"
    by_chance = "" if cell.coverage_error is None else f" ± {100 * cell.coverage_error:.0f}"
    covered = _marked(100 * cell.coverage, 100 * COVERED[0], 100 * COVERED[1], ".0f")
    return f"{covered}{by_chance}, {_marked(cell.width, 0.0, WIDEST, '.2g')}, {cell.rms:.0e}"


def _marked(value: float, low: float, high: float, form: str) -> str:
    """Format a value, in bold where it misses its target."""
    text = format(value, form)
    return text if low <= value <= high else f"**{text}**"


def _noise_table(found: dict[str, Numbers]) -> str:
    head = ["dt", "terms of H", "noise measured ÷ true", *(f"RMS at step {k:,}" for k in STEPS)]
    rows = []
    for name in ("noise-dt-0.5", "noise-dt-0.05"):
        m = found[name]["measured"] if name in found else {"runs": ()}
        for run in m["runs"]:
            noise = ", ".join(f"{1e3 * s:.2f}" for s in run["noise"] or ()) or "–"
            rows.append(
                [str(m["dt"]), str(run["terms"]), noise, *(f"{r:.1e}" for r in run["rms_of_all"])]
            )
        if m["runs"]:
            rows.append(
                [
                    str(m["dt"]),
                    "all",
                    "bands: covered %, width ÷ RMS, RMS",
                    *(_cell(c) for c in cells(m)),
                ]
            )
        if "whole" in m:
            held = f"{100 * m['whole']:.0f} % of whole trajectories of 100 steps"
            rows.append([str(m["dt"]), "all", "tube of 95 %", held, "", "", ""])
    return markdown(head, rows)


def _told_table(found: dict[str, Numbers]) -> str:
    head = ["what is learned", "σ ÷ spread", "fits that tell noise", "noise told ÷ noise put in"]
    rows = []
    for row in found["noise-told"]["measured"]["rows"] if "noise-told" in found else ():
        ratios = [r for of_fit in row["ratios"] for r in of_fit or ()]
        known = sum(r is not None for r in row["ratios"])
        span = f"{min(ratios):.2f} to {max(ratios):.2f}" if ratios else "–"
        rows.append([row["case"], f"{row['sigma']:g}", f"{known} of {len(row['ratios'])}", span])
    return markdown(head, rows)


def _kinds_table(found: dict[str, Numbers]) -> str:
    head = ["kind of data, noise 1e-3", "data sets", "chosen"]
    head += [f"step {k}: covered %, width ÷ RMS, RMS" for k in KIND_STEPS]
    rows = []
    for name in (n for n in KINDS if f"kind-{n}" in found):
        m = found[f"kind-{name}"]["measured"]
        chance = m["coverage_error"] or [None] * len(KIND_STEPS)
        each = zip(KIND_STEPS, m["coverage"], chance, m["width"], m["rms"], strict=True)
        rows.append(
            [
                name,
                str(m["data_sets"]),
                _labels(m["labels"]),
                *(_cell(Cell(*values)) for values in each),
            ]
        )
    return markdown(head, rows)


def _cost_table(found: dict[str, Numbers]) -> str:
    m = found["cost"]["measured"] if "cost" in found else {}
    head = [
        "map",
        "samples × states × steps",
        "as samples, s (CPU s)",
        "as lanes of one map, s (CPU s)",
        "ratio (of CPU s)",
    ]
    rows = [
        [
            m[k]["label"],
            f"{m[k]['samples']} × {m[k]['lanes']:,} × {m[k]['steps']:,}",
            *(
                f"{number(m[k]['seconds'][c])} ({number(m[k]['processor_seconds'][c])})"
                for c in ("samples", "lanes")
            ),
            f"{number(m[k]['ratio'])} ({number(m[k]['processor_ratio'])})",
        ]
        for k in COSTS
        if k in m
    ]
    return markdown(head, rows)


def _together_table(found: dict[str, Numbers]) -> str:
    head = ["networks trained together", "pairs", "iterations", "s", "models per second"]
    m = found["together"]["measured"] if "together" in found else {"seconds": {}}
    rows = [
        [
            count,
            str(m["pairs"]),
            str(m["iterations"]),
            number(seconds),
            number(m["models_per_second"][count]),
        ]
        for count, seconds in m["seconds"].items()
    ]
    return markdown(head, rows)


def tables() -> None:
    """The section of RESULTS.md, and the figure."""
    found, rows = results(PIECES, "bands"), calibration()
    parts = [_calibration_table(rows)]
    parts += [
        part(found)
        for part in (_kinds_table, _noise_table, _told_table, _cost_table, _together_table)
    ]
    between_markers(TABLES, "bands", "\n\n".join(parts))
    figure(rows)


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "bands", tables, None, QUICK)
