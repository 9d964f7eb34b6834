"""The lines on top of RESULTS.md, and five of them in README.md: claim, figure, command.

    python benchmarks/summary.py

Measures nothing: every figure is read from the JSON files in benchmarks/results.
"""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
from bands import calibration
from harness import README, RESULTS, TABLES, Numbers, between_markers, markdown, number
from posteriors.calibration import WIDEST, Cell, cells


def measured(name: str) -> Numbers:
    """Read the measurements in results/``name``.json."""
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))["measured"]


def accuracy() -> str:
    ours, paper = measured("targets-two-body"), measured("targets-paper-recipe")
    return (
        f"{number(ours['one_step_rms'])}; the paper's network and training, from "
        f"{paper['pairs']:,} pairs, {number(paper['one_step_rms'])}"
    )


def million_steps() -> str:
    methods = measured("kepler-million-steps")["methods"]
    ours, known = methods["learned map"], methods["integrator, H known"]
    return (
        f"position off by {number(ours['error_end'])}, semi-major axis by "
        f"{number(ours['axis_end'])}; an integrator of order 4 that is told H: "
        f"{number(known['error_end'])}"
    )


def law() -> str:
    m = measured("laws-henon-heiles-regular")
    return (
        f"{m['num_terms']} terms, coefficients to {number(m['coefficient_error'])}; step 1,000 to "
        f"{number(m['error_median'])}"
    )


def long_step() -> str:
    m = measured("laws-henon-heiles-dt-3")
    return f"the same {m['num_terms']} terms; one-step error {number(m['one_step_rms'])}"


def parameter() -> str:
    m = measured("args-pendulum-length")
    return f"H = {m['formula']}; step 1,000 at new lengths to {number(m['error_median'])}"


def ring() -> str:
    m = measured("many-fput-1000")
    return (
        f"{m['terms']} terms in {number(m['fit_seconds'])} s; step 1,000 to "
        f"{number(m['error_median'])}"
    )


def storage_ring() -> str:
    m, long = measured("ring-turn"), measured("ring-long")
    pieces = [row for row in m["rows"] if "microseconds_per_turn" in row]
    said = "; ".join(
        f"{number(row['one_turn'])} of the spread, "
        f"{number(m['tracking_microseconds_per_turn'] / row['microseconds_per_turn'])} times faster"
        for row in (pieces[0], pieces[-1])
    )
    return (
        f"{said} than tracking its {m['num_elements']:,} elements; over {long['turns']:,} turns "
        f"the action drifts with the power {number(long['drift_exponent'])}"
    )


def bands() -> str:
    rows = [row for of_case in calibration().values() for row in of_case]
    judged = [cell for row in rows for cell in cells(row) if isinstance(cell, Cell)]
    return (
        f"{sum(c.covers for c in judged)} of {len(judged)} (system, noise, pairs, step) cover 90 % "
        f"of the errors or more; {sum(c.narrow for c in judged)} do by bands of at most {WIDEST:g} "
        f"RMS errors, {sum(c.meets for c in judged)} hold 99.5 % at most too"
    )


def first_answer() -> str:
    m = measured("speed-start")
    return (
        f"first fit {number(m['first_fit'])} s, first 1,000 steps of 25 orbits "
        f"{number(m['first_rollout'])} s, compilation included"
    )


def truthful() -> str:
    cases = measured("as-a-user").values()
    true, in_time = (sum(c[key] for c in cases) for key in ("truthful", "in_time"))
    return f"{true} of {len(cases)} verdicts are true, {in_time} in their time"


def transits() -> str:
    own, other, ahead = (measured(f"trappist-{n}") for n in ("flat", "published", "first-80"))
    masses = [np.array(fit["found"])[:7] for fit in (own, other)]
    apart = number(100 * float(np.max(np.abs(masses[0] / masses[1] - 1))))
    return (
        f"masses within {apart} % of the fit from the published ones; from the first 80 % the rest "
        f"to {number(ahead['median_seconds'])} s in the median (straight lines "
        f"{number(ahead['straight_seconds'])}), {100 * ahead['within']:.0f} % within 95 % bands"
    )


def public_flows() -> str:
    found = [measured(path.stem) for path in sorted(RESULTS.glob("public-dysts-*.json"))]
    seen = [(m["smape"], m["best_of_the_table"]) for m in found if m.get("smape") is not None]
    better = [own for own, best in seen if own < best]
    most = number(max(better))
    return f"{len(better)} of {len(found)}, {most} at most; no law is claimed of the others"


def odebench() -> str:
    said = []
    for gamma in ("0", "0.05"):
        systems = measured(f"public-odebench-{gamma}")["systems"].values()
        said.append(f"{sum(m.get('right', False) for m in systems)} of {len(systems)}")
    return f"{said[0]} without noise, {said[1]} with 5 %"


# claim, its figure, the study that measures it; True: in the README too.
LINES: list[tuple[str, Callable[[], str], str, bool]] = [
    ("Two bodies, one step, from 4,000 pairs", accuracy, "targets", True),
    ("A million steps of two bodies", million_steps, "kepler", False),
    ("A law from 100 raw pairs: Hénon–Heiles", law, "laws", True),
    ("The same at a step of half a period, 400 pairs", long_step, "laws", False),
    ("A pendulum's length as a parameter, told nothing", parameter, "args", False),
    ("A ring of 1,000 springs from 40 pairs, given that it is a ring", ring, "many", True),
    ("One turn of a storage ring", storage_ring, "storage_ring", True),
    ("Bands of two standard deviations, with noise and without", bands, "bands", True),
    ("The first answer, nothing compiled before", first_answer, "speed", False),
    ("What a new user is told of data of all kinds", truthful, "as_a_user", False),
    ("TRAPPIST-1 from 447 transit times, the law given, flat starts", transits, "trappist", False),
    ("Flows of dysts, 200 steps: sMAPE below the best of its table", public_flows, "public", False),
    ("ODEBench, systems of our kind: R² > 0.9 of another orbit", odebench, "public", False),
]


def main() -> None:
    rows = [
        ([claim, figure(), f"`python -m benchmarks {study}`"], shown)
        for claim, figure, study, shown in LINES
    ]
    heads = ["claim", "measured", "command"]
    between_markers(TABLES, "summary", markdown(heads, [cells for cells, _ in rows]))
    between_markers(README, "five", markdown(heads, [cells for cells, shown in rows if shown]))


if __name__ == "__main__":
    main()
