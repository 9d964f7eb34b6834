"""Cases of a new user: their own pairs, the messages of the fit, and whether these are true.

    python benchmarks/as_a_user.py                          cases that have no result yet, table
    python benchmarks/as_a_user.py --only friction,degrees  these cases again
    python benchmarks/as_a_user.py --old                    those of older code too
    python benchmarks/as_a_user.py --quick                  few short cases, into runs/as-a-user
    python benchmarks/as_a_user.py --tables                 only the table again

Each case (benchmarks/users) makes pairs as a user would have them, calls the public ``gfnn.fit`` or
the command ``gfnn fit``, and measures the true one-step error on fresh states: the RMS over
coordinates of error divided by spread. What was said is then compared with what is true. A mistake
of the user's must be refused in one line. Seconds, of budgets too, are those of the processor. The
result is benchmarks/results/as-a-user.json, and a section of benchmarks/RESULTS.md.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

# Sets float64, so it comes before all of JAX.
from harness import (
    HERE,
    PROCESSOR_TIME,
    RESULTS,
    TABLES,
    Numbers,
    between_markers,
    markdown,
    number,
    provenance,
    read,
    write,
)

# isort: split
import commits
import jax
import numpy as np
import sympy
from users.case import Case, Refused
from users.known import KNOWN
from users.refused import REFUSED
from users.tried import TRIED

import gfnn_jax as gfnn
from gfnn_jax.candidates.assemble import stepped
from gfnn_jax.coordinates import nearest_image
from gfnn_jax.errors import FitError, InputError, WorkError
from gfnn_jax.families.terms import given_terms
from gfnn_jax.phase_space import sizes

# Factors by which claims may differ from the truth: errors of exact data, and the map's own error
# under noise; and parts by which they may: measured noise, and changes of volume.
_AGREES, _OWN_WITHIN = 2.0, 3.0
_NOISE_WITHIN, _VOLUME_WITHIN = 0.3, 0.1
_BEYOND = 0.1  # part of the states that errs by more than nine of ten are said to
_IN_TIME = 1.2  # times the budget, in processor seconds

CASES: dict[str, Callable[[], Case | Refused]] = {**KNOWN, **TRIED, **REFUSED}
QUICK = (
    "single-orbit",
    "micro-units",
    "hidden-parameter",
    "twenty-pairs",
    "friction",
    "degrees",
    "degrees-as-angle",
    "noise-pendulum-1e-03",
    *REFUSED,
)


class Learned(NamedTuple):
    """Result of a case, by Python or the command line. seconds: of the processor. law: the line
    about H, "" where there is none; formula: H, where it is shown. friction: of a map or law that
    has some. noise: (2d,) as `fit.noise`, or None."""

    map: gfnn.SymplecticMap
    seconds: float
    messages: list[str]
    ended: str
    model: str
    claimed: float
    bound: float
    met: bool
    noise: list[float] | None
    law: str = ""
    formula: str | None = None
    friction: str = ""


# What is said and what is true


def by_python(case: Case) -> Learned:
    """The case by `gfnn.fit`."""
    started = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)  # kept in fit.messages
        fit = gfnn.fit(
            case.pairs,
            tolerance=case.tolerance,
            max_seconds=case.max_seconds,
            angles=case.angles,
            clock=time.process_time,
            **case.options,
        )
    seconds, chosen = time.process_time() - started, fit.chosen
    return Learned(
        fit.map,
        seconds,
        list(fit.messages),
        fit.ended,
        f"{chosen.chart} {chosen.label}",
        chosen.validation_relative,
        chosen.validation_bound,
        fit.met,
        None if fit.noise is None else fit.noise.tolist(),
        "" if fit.formula is None else f"H = {fit.formula}",
        fit.formula,
        _of_friction(fit),
    )


def _of_friction(fit: gfnn.Fit) -> str:
    """The friction that was learned, "" of a map or law without."""
    law = fit.hamiltonian if fit.chosen.learns == "hamiltonian" else None
    notes = [] if law is None or not law.friction else list(law.notes)
    told = [*([] if fit.damping is None else [str(fit.damping)]), *notes]
    return f"friction: {'; '.join(told)}" if told else ""


def by_command(case: Case) -> Learned:
    """The case by ``gfnn fit``. What was said is what stood on standard error."""
    with tempfile.TemporaryDirectory() as folder:
        data, model = Path(folder) / "data.csv", Path(folder) / "model"
        data.write_text(case.csv, encoding="utf-8")
        started = _of_children()
        done = subprocess.run(
            [
                sys.executable,
                "-m",
                "gfnn_jax",
                "fit",
                data,
                "--out",
                model,
                "--tolerance",
                f"{case.tolerance:g}",
                "--max-seconds",
                f"{case.max_seconds:g}",
            ],
            capture_output=True,
            text=True,
            check=True,
            env=os.environ | {"PYTHONPATH": str(HERE.parent)},
        )
        seconds = _of_children() - started
        report = json.loads((model / "report.json").read_text(encoding="utf-8"))
        map_ = gfnn.load(model).map
    fit, chosen = report["fit"], report["model"]
    before, lines = "gfnn: warning: ", done.stderr.splitlines()
    said = [line.removeprefix(before) for line in lines if line.startswith(before)]
    law = re.search(r"^.*(H = |partial law).*$", done.stdout, re.MULTILINE)
    return Learned(
        map_,
        seconds,
        said,
        fit["ended"],
        f"{chosen['chart']} {chosen['label']}",
        fit["validation_relative"],
        fit["validation_bound"],
        fit["tolerance_met"],
        report["data"]["noise"],
        law[0] if law else "",
    )


def _of_children() -> float:
    """Processor seconds of the processes that were waited for."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def true_errors(map_: gfnn.SymplecticMap, case: Case) -> np.ndarray:
    """RMS over coordinates of the one-step errors of fresh states (n,) ÷ the spread of the data."""
    fresh = case.fresh
    image = stepped(map_, np.asarray(fresh.z0), fresh.dt, fresh.args, timed=False).images
    error = nearest_image(image - np.asarray(case.fresh.z1), case.angles)
    return np.sqrt(np.mean((error / sizes(case.pairs.z0)) ** 2, axis=1))


def untruths(case: Case, learned: Learned, errors: np.ndarray) -> list[str]:
    """List what the fit said wrongly, or did not say."""
    error = float(np.sqrt(np.mean(errors**2)))
    said = " ".join(
        [*learned.messages, learned.ended, learned.model, learned.law, learned.friction]
    )
    found = [f"not said: {pattern}" for pattern in case.words if not re.search(pattern, said)]
    found += [f"said: {pattern}" for pattern in case.never if re.search(pattern, said)]
    if case.quiet and learned.messages:
        found.append("warned without a reason")
    if case.first and not re.search(case.first, (learned.messages or [""])[0]):
        found.append(f"not said first: {case.first}")
    if not learned.met and "no candidate meets" not in said:
        found.append("not said: no candidate meets the tolerance")
    found += unreadable(case, learned)
    found += wrong_claims(case, learned, errors, said)
    found += wrong_noise(case, learned, error, said)
    return found + wrong_volume(case, said)


def unreadable(case: Case, learned: Learned) -> list[str]:
    """A formula that sympy or ``terms`` does not read."""
    text, names = learned.formula, tuple(case.pairs.args or ())
    if text is None or text.startswith("Legendre"):
        return []
    try:
        sympy.sympify(text)
        given_terms(case.pairs.dim, (text,), names)
    except (sympy.SympifyError, SyntaxError, TypeError, InputError) as error:
        return [f"the formula cannot be read: {error}"]
    return []


def wrong_claims(case: Case, learned: Learned, errors: np.ndarray, said: str) -> list[str]:
    """Claims that differ from the true errors. Where few states make the error no RMS is claimed of
    others, and what nine of ten err by is."""
    found, error = [], float(np.sqrt(np.mean(errors**2)))
    if case.meets is not None and learned.met != case.meets:
        found.append("met" if learned.met else "not met")
    few = re.search(r"nine of ten err by less than (\S+) of", said)
    if few:
        part = float(np.mean(errors > float(few[1])))
        return found if part <= _BEYOND else [*found, f"{part:.0%} err by more than {few[1]}"]
    if not error <= _AGREES * learned.bound:
        found.append(f"the error is {error / learned.bound:.2g} times its bound")
    if not case.sigma and not learned.claimed <= _AGREES * error:
        found.append(f"the claim is {learned.claimed / error:.2g} times the error")
    return found


def wrong_noise(case: Case, learned: Learned, error: float, said: str) -> list[str]:
    """List differences between reported noise and error and the true ones."""
    if not case.sigma or not (case.noise_measured or learned.noise):
        return []
    ratios, told = noise_ratio(case, learned), re.search(r"own error is then about (\S+) of", said)
    if ratios is None:
        return ["the noise was not measured"]
    own = error / float(np.sqrt(np.mean((case.sigma / sizes(case.pairs.z0)) ** 2)))
    off = [ratio for ratio in ratios if abs(ratio - 1) > _NOISE_WITHIN]
    found = [f"noise of {ratio:.2g} times what it is" for ratio in off]
    if told is None:  # a law's own error is not told
        return found
    if not 1 / _OWN_WITHIN < float(told[1]) / own < _OWN_WITHIN:
        found.append(f"own error {told[1]} of the noise, it is {own:.2g} of it")
    return found


def wrong_volume(case: Case, said: str) -> list[str]:
    """A change of volume that differs from the true one."""
    told = re.search(r"volumes change by (\S+)", said)
    if told is None:
        return []
    missed = abs(float(told[1]) - case.volume_change)
    if missed <= _VOLUME_WITHIN * abs(case.volume_change):
        return []
    return [f"volumes change by {case.volume_change:.2g}, not by {told[1]}"]


def noise_ratio(case: Case, learned: Learned) -> list[float] | None:
    """Measured noise over the true one, per coordinate."""
    return [n / case.sigma for n in learned.noise] if case.sigma and learned.noise else None


def measure(name: str) -> Numbers:
    """Learn a case, and say what was said and what is true."""
    case = CASES[name]()
    if isinstance(case, Refused):
        return refused(case)
    learned = (by_command if case.csv else by_python)(case)
    errors = true_errors(learned.map, case)
    wrong, error = untruths(case, learned, errors), float(np.sqrt(np.mean(errors**2)))
    return {
        "seconds": learned.seconds,
        "in_time": learned.seconds <= _IN_TIME * case.max_seconds,
        "budget": case.max_seconds,
        "pairs": len(case.pairs),
        "dim": case.pairs.dim,
        "tolerance": case.tolerance,
        "messages": learned.messages,
        "ended": learned.ended,
        "model": learned.model,
        "law": learned.law,
        "claimed": learned.claimed,
        "bound": learned.bound,
        "true_error": error,
        "met": learned.met,
        "noise_ratio": noise_ratio(case, learned),
        "wrong": wrong,
        "truthful": not wrong,
    }


def refused(case: Refused) -> Numbers:
    """What a mistake was answered with."""
    started = time.process_time()
    try:
        case.call()
        said, wrong = "", ["not refused"]
    except (FitError, InputError, WorkError, ValueError) as error:
        said = str(error)
        wrong = [f"not said: {case.words}"] if case.words not in said else []
        wrong += ["more than one line"] if "\n" in said else []
    except Exception as error:  # whatever else is no answer to a user
        said, wrong = f"{type(error).__name__}: {error}".splitlines()[0], ["no error of one's own"]
    return {
        "seconds": time.process_time() - started,
        "in_time": True,
        "budget": None,
        "pairs": None,
        "dim": None,
        "tolerance": None,
        "messages": [said],
        "ended": "",
        "model": "refused",
        "law": "",
        "claimed": None,
        "bound": None,
        "true_error": None,
        "met": None,
        "noise_ratio": None,
        "wrong": wrong,
        "truthful": not wrong,
    }


# Table


def table(measured: Numbers) -> str:
    """Markdown: a line per case."""
    heads = [
        "case",
        "pairs",
        "CPU s (of)",
        "chosen",
        "claimed",
        "true error",
        "met",
        "noise measured ÷ true",
        "what was said",
        "truthful",
    ]
    rows = []
    for name, m in measured.items():
        said = [message.split(":")[0] for message in m["messages"]]
        said = "; ".join([*said, *filter(None, [m["ended"]])])
        truthful = "yes" if m["truthful"] else f"**no**: {'; '.join(m['wrong'])}"
        noise = ", ".join(f"{ratio:.2f}" for ratio in m["noise_ratio"] or ()) or "–"
        met = {True: "yes", False: "no", None: "–"}[m["met"]]
        within = "" if m["in_time"] else "**"
        seconds = f"{within}{number(m['seconds'])}{within} ({number(m['budget'])})"
        row = [
            name,
            number(m["pairs"]),
            seconds,
            m["model"],
            number(m["claimed"]),
            number(m["true_error"]),
            met,
            noise,
            said,
            truthful,
        ]
        rows.append([cell.replace("|", "/") for cell in row])
    return markdown(heads, rows)


def tables(path: Path) -> None:
    found = read({"as-a-user": path})
    if found:
        text = table(found["as-a-user"]["measured"])
        between_markers(TABLES, "as-a-user", f"{text}\n\n{provenance(found)}")


def is_old(case: Numbers) -> bool:
    """Whether a case was measured by another script than today's."""
    base = case["code"].get("commit")
    if not base or case["code"].get("dirty"):
        return True
    return bool(commits.git("diff", "--name-only", base, "--", "benchmarks/as_a_user.py"))


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", metavar="A,B", help=", ".join(CASES))
    parser.add_argument("--old", action="store_true", help="cases of older code again")
    parser.add_argument("--quick", action="store_true", help="few short cases; no table")
    parser.add_argument("--tables", action="store_true", help="only make the table again")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the result")
    parser.add_argument(
        PROCESSOR_TIME, action="store_true", help="stages too are timed in seconds of the processor"
    )
    arguments = parser.parse_args(argv)
    chosen = (
        arguments.only.split(",") if arguments.only else list(QUICK if arguments.quick else CASES)
    )
    unknown = [name for name in chosen if name not in CASES]
    if unknown:
        parser.error(f"unknown case '{unknown[0]}'; cases: {', '.join(CASES)}")
    folder = arguments.out or (Path("runs/as-a-user") if arguments.quick else RESULTS)
    path = folder / "as-a-user.json"
    measured = read({"": path}).get("", {"measured": {}})["measured"]
    for name in [] if arguments.tables else chosen:
        done = measured.get(name)
        if done and not arguments.only and not (arguments.old and is_old(done)):
            continue
        measured[name] = m = measure(name) | {"code": commits.code()}
        measured = {n: measured[n] for n in CASES if n in measured}
        code = next((m["code"] for m in measured.values() if is_old(m)), m["code"])
        write(path, {"quick": arguments.quick, "measured": measured, "code": code})
        verdict = "; ".join(m["wrong"]) or "truthful"
        print(
            f"{name}: {m['seconds']:.1f} s, {m['model']}, claimed {number(m['claimed'])}, true "
            f"{number(m['true_error'])}, {verdict}",
            flush=True,
        )
        jax.clear_caches()  # a process may map only so many compiled programs
    if folder == RESULTS:
        tables(path)


if __name__ == "__main__":
    main()
