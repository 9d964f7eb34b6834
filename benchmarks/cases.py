"""Small recordings as users bring them: whether what `gfnn FILE` says is right, and how soon.

    python benchmarks/cases.py DIR                       all files of the folder DIR that are known
    python benchmarks/cases.py DIR --only part_orbit     one of them
    python benchmarks/cases.py DIR --tables              only the table again

Each file has at most 200 rows of synthetic data, with a mistake or a peculiarity of a real export.
One command runs on it, with the option that the first refusal names where reading needs one, in a
process of its own on one core. Right is a law whose terms are those that made the data, with their
coefficients, or the verdict that is true of the file. Seconds, of the wall and of the processor,
count from the command on, until the law is on screen and until the report is written; the
compiled kernel is on disk already.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from harness import RESULTS, TABLES, Numbers, between_markers, markdown, provenance, read, write

NAME = "cases"
FOUND = {NAME: RESULTS / f"{NAME}.json"}
MOST_SECONDS = 180


@dataclasses.dataclass(frozen=True)
class Case:
    """A file's right answer.

    terms: of L, or of H of states, by coefficient; NaN where any is right, 0 for a term that may be
    there. friction: of R; None where it is not asked.
    gains: of an input. verdicts: beginnings of right ones. says: words that the screen must have.
    options: that reading needs. tolerance: relative, of coefficients of L; frictions may be off by
    three times as much.
    """

    terms: Mapping[str, float] = dataclasses.field(default_factory=dict)
    friction: Mapping[str, float] | None = None
    gains: Mapping[str, float] = dataclasses.field(default_factory=dict)
    verdicts: tuple[str, ...] = ("identified", "one of several")
    says: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    tolerance: float = 0.03


KEPLER = {"vx**2": 0.5, "vy**2": 0.5, "1/sqrt(x**2 + y**2)": 2.9591e-4}
SPRING = Case({"v**2": 0.5, "x**2": -10.0}, {"v**2": 0.15})
TORSION = Case({"disk_dot**2": 0.5, "disk**2": -10.0}, {"disk_dot**2": 0.25})
ANGLE = "Angle__Ch_1"
CASES = {
    "wide_runs.csv": Case(
        {f"{ANGLE}_dot**2": 0.5, f"{ANGLE}**2": -10.0}, {f"{ANGLE}_dot**2": 0.15}
    ),
    "comma_in_name.csv": Case(
        {f"{ANGLE}_dot**2": 0.5, f"{ANGLE}**2": -10.0}, {f"{ANGLE}_dot**2": 0.15}
    ),
    "no_header.csv": dataclasses.replace(SPRING, options=("--columns", "t,x")),
    "one_column.csv": dataclasses.replace(SPRING, options=("--dt", "0.05")),
    "no_time.csv": Case(
        {"y_dot**2": 0.5, "y": 0.0}, {}, {"u": 4.7}, options=("--dt", "0.1"), tolerance=0.05
    ),
    "scope_dates.csv": Case(
        {"V_C_dot**2": 0.5, "V_C": 3.2e10, "V_C**2": -3.2e9}, {"V_C_dot**2": 7.5e3}
    ),
    "ephemeris.txt": Case({name.upper().replace("SQRT", "sqrt"): c for name, c in KEPLER.items()}),
    "ephemeris_clean.csv": Case(KEPLER),
    "part_orbit.csv": Case({**KEPLER, "1/sqrt(x**2 + y**2)": 398600.44}),
    "circle_xy.csv": Case({"omega**2": 0.5, "cos(theta)": 6.673}, {"omega**2": 0.015}),
    "angle_called_position.csv": Case(
        {"position_dot**2": 0.5, "cos(position)": 20.0},
        {"position_dot**2": 0.15, "abs(position_dot)": 0.5},
        {"torque": 6.0},
    ),
    "torsion_rad.csv": dataclasses.replace(TORSION, says=("--from", "moves the body")),
    "torsion_rad_released.csv": TORSION,
    "voltage_called_v.csv": Case(
        {"z_dot**2": 0.5, "phi_dot**2": 0.5, "cos(phi)": 30.0, "z_dot*phi_dot*cos(phi)": 3.0},
        None,
        {"v": 9.0},
    ),
    # No mechanical law: populations, of first order. 10 % of noise leaves coefficients open.
    "predator_prey.csv": Case(
        dict.fromkeys(("log(Prey)", "log(Predator)", "Prey", "Predator"), math.nan),
        says=("states without velocities, of populations",),
    ),
    "predator_prey_qp.csv": Case(
        {"q1": 0.8, "exp(q1)": -0.02, "p1": 0.9, "exp(p1)": -0.03}, tolerance=0.2
    ),
    "gyro_only.csv": Case({"omega**2": 0.5, "cos(theta)": 23.0}, {"omega**2": 0.05}),
    "ball_beam_disturbed.csv": Case(
        {"y_dot**2": 0.5, "y": 0.0}, {}, {"u": 4.6}, verdicts=("partly",), tolerance=0.25
    ),
    "hand_then_free.csv": Case(
        {"omega**2": 0.5, "cos(theta)": 33.3},
        {"omega**2": 0.01, "abs(omega)": 0.06},
        says=("--from", "moves the body"),
    ),
}


def main() -> None:
    """Run the cases, and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", metavar="DIR")
    parser.add_argument("--only", metavar="A,B", help="files, without their endings")
    parser.add_argument("--tables", action="store_true", help="only make the table again")
    parser.add_argument("--out", type=Path, default=FOUND[NAME], metavar="FILE")
    asked = parser.parse_args()
    if not asked.tables:
        if asked.folder is None:
            parser.error("expected the folder of the files")
        measured = read(FOUND).get(NAME, {}).get("cases", {}) if asked.only else {}
        for name, case in CASES.items():
            if asked.only and Path(name).stem not in asked.only.split(","):
                continue
            if (asked.folder / name).exists():
                measured[name] = one = run(asked.folder / name, case)
                print(f"{name:28s} {one}", flush=True)
                write(asked.out, {"cases": measured, **totals(measured)})
    if asked.out == FOUND[NAME]:
        tables()


def run(path: Path, case: Case) -> Numbers:
    """What one command makes of a file."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        command = [sys.executable, "-m", "gfnn_jax", str(path), *case.options, "--out", str(out)]
        started = time.perf_counter()
        # One core: this process and all that it starts.
        if hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
        # As an installed package, with its bytecode on disk.
        kept = {n: value for n, value in os.environ.items() if n != "PYTHONDONTWRITEBYTECODE"}
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=kept
        )
        lines, law = [], None
        assert process.stdout is not None
        for line in process.stdout:
            lines.append(line)
            if "law (its bands follow)" in line and law is None:
                law = time.perf_counter() - started, processor_seconds(process.pid)
            if time.perf_counter() - started > MOST_SECONDS:
                process.kill()
        busy = processor_seconds(process.pid)
        process.wait()
        whole = time.perf_counter() - started, busy
        report = out / "report.json"
        result = json.loads(report.read_text(encoding="utf-8")) if report.exists() else None
    screen = "".join(lines)
    wrong = faults(case, result, screen)
    return {
        "right": not wrong,
        "wrong": wrong,
        "verdict": verdict(result, screen),
        "law": "" if result is None else shown(law_in(result)),
        "seconds_law": (law or whole)[0],
        "processor_law": (law or whole)[1],
        "seconds": whole[0],
        "processor": whole[1],
    }


def law_in(result: Numbers) -> Numbers:
    """L or H of a report, with its terms."""
    return result.get("lagrangian") or result.get("hamiltonian") or {"terms": []}


def shown(law: Numbers) -> str:
    """The law as text."""
    return law.get("text") or law.get("formula") or "map"


def processor_seconds(pid: int) -> float | None:
    """Seconds of the processor that a process has used; None where the system does not tell."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    except OSError:
        return None
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def verdict(result: Numbers | None, screen: str) -> str:
    """The verdict of the report, or of the line of a refusal."""
    if result is not None:
        return result["verdict"] or ""
    lines = (line for line in screen.splitlines() if line.startswith("gfnn: "))
    refusal = next((line for line in lines if not line.startswith("gfnn: warning")), "")
    mechanical = "first order" not in refusal and "chance" not in refusal
    return ("no law: " if mechanical else "not mechanical: ") + refusal.removeprefix("gfnn: ")


def faults(case: Case, result: Numbers | None, screen: str) -> list[str]:
    """What is not as it ought to be."""
    found = verdict(result, screen)
    wrong = [] if found.startswith(case.verdicts) else [f"verdict {found[:80]}"]
    wrong += [f"does not say {word}" for word in case.says if word not in screen]
    if not case.terms:
        return wrong
    if result is None:
        return [*wrong, "no law"]
    wrong += differences(law_in(result)["terms"], case.terms, case.tolerance)
    if case.friction is not None:
        wrong += differences(result["friction"]["terms"], case.friction, 3 * case.tolerance)
    for name, asked in case.gains.items():
        gains = result["inputs"]["gains"].get(name, {})
        near = [
            abs(one["gain"] - asked) < max(case.tolerance * asked, 3 * one["std"])
            for one in gains.values()
        ]
        if not any(near):
            wrong.append(f"gain of {name}")
    return wrong


def differences(found: list[Any], asked: Mapping[str, float], tolerance: float) -> list[str]:
    """Terms that are absent, that are too many, and coefficients that are off by more than the
    tolerance and three standard errors."""
    known = {one["term"]: one for one in found}
    wrong = [f"without {name}" for name in asked if name not in known and asked[name]]
    wrong += [f"with {name}" for name in known if name not in asked]
    for name, value in asked.items():
        if name in known and value:
            off = abs(known[name]["coefficient"] - value)
            if off > max(tolerance * abs(value), 3 * (known[name]["std"] or 0.0)):
                wrong.append(f"{name}: {known[name]['coefficient']:.6g}, not {value:.6g}")
    return wrong


def totals(measured: Mapping[str, Numbers]) -> Numbers:
    """Counts and medians over the cases."""
    found: Numbers = {"right": sum(one["right"] for one in measured.values()), "of": len(measured)}
    for name in ("seconds_law", "processor_law", "seconds", "processor"):
        known = [one[name] for one in measured.values() if one[name] is not None]
        found[f"median_{name}"] = float(np.median(known)) if known else None
    return found


def tables() -> None:
    """The table of RESULTS.md."""
    found = read(FOUND)
    if not found:
        return
    result = found[NAME]
    rows = [
        [
            name,
            "yes" if one["right"] else "; ".join(one["wrong"]),
            (one["law"] or one["verdict"])[:110].replace("|", "∣"),
            f"{one['processor_law']:.1f}",
            f"{one['processor']:.1f}",
        ]
        for name, one in result["cases"].items()
    ]
    heads = ("file", "right", "law, or verdict", "law on screen, s", "report, s")
    text = (
        f"{result['right']} of {result['of']} are right. Median seconds of one processor core, "
        f"from the command on: {result['median_processor_law']:.1f} until the law is on screen, "
        f"{result['median_processor']:.1f} until the report is written. {provenance(found)}"
    )
    between_markers(TABLES, NAME, f"{markdown(heads, rows)}\n\n{text}")


if __name__ == "__main__":
    main()
