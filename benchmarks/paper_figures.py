"""The paper's figures and the tables behind them: every scene through every method.

    python benchmarks/paper_figures.py                  what has no result yet, then the tables
    python benchmarks/paper_figures.py two-body --overwrite   one scene again
    python benchmarks/paper_figures.py --quick          small sizes, into runs/paper-figures-quick

Each scene and seed is a piece, made by what `gfnn compare SCENE --seed N` runs; a piece that was
interrupted goes on with its next method. Reports are kept in benchmarks/results, figures (of the
first seed) in benchmarks/figures/compare; the section of RESULTS.md and the figures of errors are
made from the reports alone.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

# Sets float64, so it comes before all of JAX.
import harness
import numpy as np
from harness import RESULTS, TABLES, Numbers, between_markers, markdown, number, read, write

from gfnn_jax.evaluate import figures
from gfnn_jax.jobs.compare import CAP, OURS, PAPER_GFNN, compare
from gfnn_jax.jobs.output import Output
from gfnn_jax.jobs.progress import Progress

FIGURES = harness.FIGURES / "compare"
WORK = Path("runs") / "paper-figures"
# The seeds of a scene, and the paper's figure.
SCENES: dict[str, tuple[tuple[int, ...], str]] = {
    "two-body": ((0, 1, 2), "Fig. 2"),
    "henon-heiles-regular": ((0, 1, 2), "Fig. 3"),
    "henon-heiles-chaotic": ((0,), "Fig. 4"),
    "pcr3bp": ((0,), "Fig. 5"),
    "standard-map-chaotic": ((0,), "Fig. 6"),
    "standard-map-regular": ((0,), "Fig. 7"),
}


PREFIX = "compare"  # of the results' file names


def pieces() -> list[tuple[str, int]]:
    """List (scene, seed), each scene's first seed before any second one."""
    most = max(len(seeds) for seeds, _ in SCENES.values())
    return [
        (name, seeds[i])
        for i in range(most)
        for name, (seeds, _) in SCENES.items()
        if i < len(seeds)
    ]


def result_path(folder: Path, name: str, seed: int) -> Path:
    return folder / f"{PREFIX}-{name}-{seed}.json"


def run(name: str, seed: int, folder: Path, work: Path, **options) -> None:
    """Compare one piece in ``work``, and copy its report and its figures from there."""
    print(f"{name}, seed {seed}", flush=True)
    started = time.perf_counter()
    out = work / f"{name}-{seed}"

    def say(line: str) -> None:
        print(f"  [{time.perf_counter() - started:6.1f} s] {line}", flush=True)

    compare(name, Output(out, resume=True, progress=Progress(say, say)), seed=seed, **options)
    write(result_path(folder, name, seed), json.loads((out / "report.json").read_text("utf-8")))
    if folder == RESULTS and seed == SCENES[name][0][0]:
        FIGURES.mkdir(parents=True, exist_ok=True)
        for figure in out.glob("*.png"):
            shutil.copy(figure, FIGURES / f"{name}-{figure.name}")


# Tables


def over_seeds(reports: list[Numbers], method: str, *path: str) -> float | None:
    """A figure's geometric mean over the seeds; arithmetic where it may be negative."""
    values = []
    for found in reports:
        value: Any = found["methods"].get(method)
        for key in path:
            value = value[key] if value is not None else None
        values.append(value)
    if any(v is None for v in values):
        return None
    positive = all(v > 0 for v in values)
    return float(np.exp(np.mean(np.log(values))) if positive else np.mean(values))


def scene_table(name: str, reports: list[Numbers]) -> str:
    """Markdown: a line per method."""
    first = reports[0]
    chaotic = any(m["kl"] for m in first["methods"].values())
    heads = ["method", "parameters", "pairs", "training, s", "compile, s", "µs/step", "one step"]
    heads += [] if chaotic else ["step 10", "step 100", "step 1,000", "median", "growth α"]
    heads += ["energy drift", "defect"]
    labels = list(next(iter(first["methods"].values()))["kl"] or ())
    heads += [f"KL of {label}" for label in labels]
    rows = []
    for method, m in first["methods"].items():

        def mean(*path, method=method):
            return number(over_seeds(reports, method, *path))

        growth = over_seeds(reports, method, "rollout", "growth_exponent")
        stopped = m["fit"].get("stopped_because", "epochs")
        training = mean("fit", "seconds") + (
            " (cap)" if m["fit"]["capped"] else " (diverged)" if "finite" in stopped else ""
        )
        cells = [
            m["title"],
            f"{m['model']['num_parameters']:,}",
            f"{m['data']['num_pairs']:,}",
            training,
            mean("fit", "compile_seconds"),
            mean("rollout", "microseconds_per_step"),
            mean("fit", "validation_rms"),
        ]
        if not chaotic:
            cells += [mean("rollout", "error", str(n)) for n in (10, 100, 1000)]
            cells += [mean("rollout", "error_median", "1000")]
            cells += ["–" if growth is None else f"{growth:.2f}"]
        unsolved = max(r["methods"][method]["map"].get("unsolved", 0.0) for r in reports)
        cells += [
            mean("rollout", "energy_drift"),
            mean("map", "symplecticity_defect")
            + (f" ({100 * unsolved:.0f} % unsolved)" if unsolved else ""),
        ]
        cells += [mean("kl", label) for label in labels]
        rows.append(cells)
    return markdown(heads, rows)


def ranking(reports: list[Numbers], *path: str) -> list[str]:
    """Methods by this figure, the smallest first; what is lost comes last."""

    def figure(method: str) -> float:
        value = over_seeds(reports, method, *path)
        return math.inf if value is None else value

    return sorted(reports[0]["methods"], key=figure)


def place(order: list[str], method: str, without: Sequence[str] = ()) -> str:
    """Rank of a method, in words."""
    rest = [m for m in order if m not in without]
    if method not in rest:
        return "was not run"
    names = {1: "first", 2: "second", 3: "third"}
    position = rest.index(method) + 1
    return f"{names.get(position, f'{position}th')} of {len(rest)}"


AFTER_PAPER = ("p-sympnet", OURS)  # what the paper could not compare with


def claims(found: dict[str, list[Numbers]]) -> list[str]:
    """The paper's claims, each with what was measured."""
    said = []
    for name in ("two-body", "henon-heiles-regular", "pcr3bp"):
        if name not in found:
            continue
        order = ranking(found[name], "rollout", "error_median", "1000")
        title = {m: found[name][0]["methods"][m]["title"] for m in order}
        growth = over_seeds(found[name], PAPER_GFNN, "rollout", "growth_exponent")
        ours = over_seeds(found[name], OURS, "rollout", "growth_exponent")
        exponents = ", ".join("–" if g is None else f"{g:.2f}" for g in (growth, ours))
        best = next(m for m in order if m not in (PAPER_GFNN, OURS))
        said.append(
            f"{name}, *GFNN has the smallest error, and it grows linearly*: by the median error at "
            f"step 1,000 the paper's recipe is {place(order, PAPER_GFNN, AFTER_PAPER)} among the "
            f"paper's methods and {place(order, PAPER_GFNN, (OURS,))} with P-SympNet; ours is "
            f"{place(order, OURS)}. The best of the other methods is {title[best]}. Growth "
            f"exponents of the two GFNN rows: {exponents}."
        )
    for name in ("henon-heiles-chaotic", "standard-map-chaotic"):
        if name not in found:
            continue
        labels = next(iter(found[name][0]["methods"].values()))["kl"] or {}
        places = "; ".join(
            f"{label}: the recipe {place(ranking(found[name], 'kl', label), PAPER_GFNN, (OURS,))}"
            f", ours {place(ranking(found[name], 'kl', label), OURS)}"
            for label in labels
        )
        said.append(f"{name}, *GFNN has the smallest KL divergences*: {places}.")
    if "standard-map-regular" in found:
        reports = found["standard-map-regular"]
        small = [
            reports[0]["methods"][m]["title"]
            for m in reports[0]["methods"]
            if (over_seeds(reports, m, "rollout", "error_median", "100") or math.inf) < 0.3
        ]
        said.append(
            "standard-map-regular, *only GFNN jumps between the two islands as the map does*: "
            f"methods whose median error at step 100 is below 0.3: {', '.join(small) or 'none'}."
        )
    return said


def section(found: dict[str, list[Numbers]]) -> str:
    """Markdown of all results."""
    lines: list[str] = ["**Claims of the paper, and what was measured:**", ""]
    lines += [f"- {claim}" for claim in claims(found)]
    for name, reports in found.items():
        first, (_, figure) = reports[0], SCENES[name]
        seeds = ", ".join(str(r["seed"]) for r in reports)
        caps = sorted({r["cap"] for r in reports})
        lines += [
            "",
            f"### {name} ({figure})",
            "",
            f"`gfnn compare {name} --cap {caps[0]:g}`, seed {seeds}; "
            f"{first['methods'][PAPER_GFNN]['rollout']['num_trajectories']} test states.",
            "",
            scene_table(name, reports),
            "",
        ]
        for path in sorted(FIGURES.glob(f"{name}-*.png")):
            lines.append(f"![{path.stem}](figures/compare/{path.name})")
    loads = [r["machine"]["load"] for reports in found.values() for r in reports]
    some = next(iter(found.values()))[0]
    lines += [
        "",
        f"Measured on {some['machine']['processor']}, {some['machine']['cores']} of its cores, "
        f"{some['device']}, jax {some['versions']['jax']}, float64 predictions of networks trained "
        f"in float32, {some['date']}; load average {min(loads):.1f} to {max(loads):.1f}. KL: 50 "
        "bins.",
    ]
    return "\n".join(lines)


def curves(methods: Numbers, *path: str) -> dict[str, tuple]:
    """Title -> steps and two lanes that have the curve's mean and deviation, until one was lost."""
    drawn = {}
    for m in methods.values():
        curve = m
        for key in path:
            curve = curve[key]
        length = sum(v is not None for v in curve["mean"])
        mean, std = (np.array(curve[k][:length], float) for k in ("mean", "std"))
        lost = m["rollout"]["num_lost"]
        title = f"{m['title']}, {lost} lost" if lost else m["title"]
        drawn[title] = np.array(curve["steps"][:length]), np.stack([mean - std, mean + std])
    return drawn


def draw(name: str, methods: Numbers) -> None:
    """The figures of errors against the step number, from a report."""
    if not any(m["kl"] for m in methods.values()):
        error: Any = figures.error_growth(curves(methods, "curve"))
        figures.save(error.figure, FIGURES / f"{name}-error.png")
    if all(m["elements"] for m in methods.values()):
        axis, shape = (curves(methods, "elements", k) for k in ("axis", "eccentricity"))
        both = {
            n: (axis[n][0], axis[n][1], shape[n][1])
            for n in axis
            if axis[n][1].shape == shape[n][1].shape
        }
        elements: Any = figures.element_errors(both)[0]
        figures.save(elements.figure, FIGURES / f"{name}-elements.png")


def tables() -> None:
    found: dict[str, list[Numbers]] = {}
    for name, (seeds, _) in SCENES.items():
        paths = [result_path(RESULTS, name, seed) for seed in seeds]
        reports = list(read({p.name: p for p in paths}).values())
        if reports:
            found[name] = reports
            draw(name, reports[0]["methods"])
    if found:
        between_markers(TABLES, "compare", section(found))


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "scenes", nargs="*", choices=[[], *SCENES], metavar="SCENE", help=", ".join(SCENES)
    )
    parser.add_argument("--only", metavar="SCENE-SEED", help="one of a scene's seeds")
    parser.add_argument("--quick", action="store_true", help="two bodies only, small sizes")
    parser.add_argument(
        "--cap",
        type=float,
        metavar="SECONDS",
        default=CAP,
        help="most training of a method (default %(default)g)",
    )
    parser.add_argument(
        "--work",
        type=Path,
        default=WORK,
        metavar="DIR",
        help="where comparisons are made (default %(default)s)",
    )
    parser.add_argument("--overwrite", action="store_true", help="compare again what is finished")
    parser.add_argument("--tables", action="store_true", help="only make the tables again")
    arguments = parser.parse_args(argv)
    if arguments.quick:
        work = Path("runs") / "paper-figures-quick"
        run("two-body", 0, work, work, quick=True)
        return
    for name, seed in [] if arguments.tables else pieces():
        asked = not arguments.scenes or name in arguments.scenes
        asked &= arguments.only in (None, f"{name}-{seed}")
        path = result_path(RESULTS, name, seed)
        if asked and (arguments.overwrite or not path.exists()):
            if arguments.overwrite:
                shutil.rmtree(arguments.work / f"{name}-{seed}", ignore_errors=True)
            run(name, seed, RESULTS, arguments.work, cap=arguments.cap)
            tables()
    tables()


if __name__ == "__main__":
    main()
