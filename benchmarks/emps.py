"""EMPS, a drive axis with friction: the law of one record, forecasts of the record of another day.

    python benchmarks/emps.py TRAIN.csv PULSES.mat
    python benchmarks/emps.py TRAIN.csv PULSES.mat --quick     a third of the record, into runs/

TRAIN.csv has t (s), x (m) and u (V) of the benchmark's training record; PULSES.mat its test record,
with t, qm and vir (nonlinearbenchmark.org; forgi86/sysid-neural-continuous has it). The law is
learned by the roles of columns and the kinds of friction of such an axis; and once more with its
terms named: a constant force, by which Coulomb friction differs by direction, and a weak spring of
the cable beside them. From 2 s of samples the
state is estimated, and the test record forecast by its own input: medians over windows that begin
every 0.8 s. And a free run of the whole test record from its first 20 samples, by the law's own
friction.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

# Sets float64, so it comes before all of JAX.
from harness import (
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
from scipy.io import loadmat

# isort: split
import gfnn_jax as gfnn

LEVEL = 0.03  # by which friction of a drive differs from day to day
AHEAD, WINDOW, EVERY = (0.1, 0.5, 1.0, 2.0, 5.0), 2.0, 0.8  # s
FRICTION = "linear+dry+one-sided"
TERMS = ["v**2", "V: x", "V: x**2", "R: v**2", "R: abs(v)", "R: (abs(v) - v)**2"]
ASKED = {0.5: 0.6, 1.0: 1.2, 5.0: 3.5}  # mm


def recording(t: np.ndarray, x: np.ndarray, u: np.ndarray) -> gfnn.Recording:
    return gfnn.Recording({"t": t, "x": x, "u": u}, positions=["x"], inputs=["u"])


def errors(map_: Any, t: np.ndarray, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Errors (windows, times ahead) of forecasts, in mm."""
    step, found = float(np.median(np.diff(t))), []
    length, far, ahead = round(WINDOW / step), round(AHEAD[-1] / step) + 2, np.array(AHEAD)
    for end in range(length, len(t) - far, round(EVERY / step)):
        before = slice(end - length, end + 1)
        inputs = recording(*(a[end : end + far] for a in (t, x, u)))
        one = map_.forecast(recording(*(a[before] for a in (t, x, u))), t[end] + ahead, inputs)
        found.append(one.values["x"][0] - np.interp(t[end] + ahead, t, x))
    return 1e3 * np.array(found)


def measured(train: Path, pulses: Path, quick: bool) -> Numbers:
    """Measure the law and its forecasts."""
    data = gfnn.read(train, positions=["x"], inputs=["u"])
    data = data.slice(stop=8.0) if quick else data
    test = loadmat(pulses)
    pulsed = tuple(test[name].ravel().astype(float) for name in ("t", "qm", "vir"))
    return {
        "kinds": _of_fit(lambda: gfnn.fit(data, friction=FRICTION), *pulsed),
        "terms": _of_fit(lambda: gfnn.fit(data, terms=TERMS), *pulsed),
    }


def _of_fit(make: Callable[[], Any], t: np.ndarray, x: np.ndarray, u: np.ndarray) -> Numbers:
    """A law and its forecasts of the test record."""
    begun = time.process_time()
    fit = make()
    taken = time.process_time() - begun
    stiff = dataclasses.replace(fit.map.sensors, level=0.0)
    plain, warm = dataclasses.replace(fit.map, sensors=stiff), fit.map.with_friction_level(LEVEL)
    free = plain.forecast(recording(t[:20], x[:20], u[:20]), t[20:], recording(t, x, u))
    left = free.values["x"][0] - x[20:]
    found: Numbers = {"seconds": taken, "law": fit.law.line, "verdict": fit.verdict}
    found["free run"] = 1e3 * float(np.sqrt(np.mean(left**2)))
    found["held"] = float(np.mean(np.abs(left) < 2 * free.std["x"][0]))
    for name, map_ in (("level", warm), ("no level", plain)):
        off = np.abs(errors(map_, t, x, u))
        found[f"medians, {name}"] = np.median(off, axis=0).tolist()
        found["windows"] = len(off)
    return found


def tables() -> None:
    found = read({"emps": RESULTS / "emps.json"})
    if not found:
        return
    told = {"kinds": "kinds of friction named", "terms": "terms named"}
    ways = {"level": "level of friction by the window", "no level": "none"}
    rows, said = [], []
    for name, own in found["emps"]["measured"].items():
        rows += [
            [f"{told[name]}; {words}", *(number(v) for v in own[f"medians, {key}"])]
            for key, words in ways.items()
        ]
        said.append(
            f"{told[name].capitalize()}: {own['law']}; {own['verdict']}. Free run of the whole "
            f"test record: {number(own['free run'])} mm rms, {own['held']:.0%} of it within two "
            f"standard deviations. {number(own['seconds'])} s of a processor."
        )
    rows.append(["asked", *(number(ASKED.get(ahead)) for ahead in AHEAD)])
    heads = ["medians, mm", *(f"{ahead:g} s ahead" for ahead in AHEAD)]
    paragraphs = "\n\n".join(said)
    text = f"{markdown(heads, rows)}\n\n{paragraphs}\n\n{provenance(found)}"
    between_markers(TABLES, "emps", text)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("train", type=Path, metavar="TRAIN.csv")
    parser.add_argument("pulses", type=Path, metavar="PULSES.mat")
    parser.add_argument("--quick", action="store_true", help="a third of the record, no table")
    arguments = parser.parse_args()
    out = Path("runs") / "emps" if arguments.quick else RESULTS
    begun = time.perf_counter()
    result = measured(arguments.train, arguments.pulses, arguments.quick)
    seconds = time.perf_counter() - begun
    piece = {"piece": "emps", "quick": arguments.quick, "measured": result, "seconds": seconds}
    write(out / "emps.json", piece)
    if out == RESULTS:
        tables()


if __name__ == "__main__":
    main()
