"""Measured records: the law of each from positions alone, and its forecasts of a part held out.

    python benchmarks/measured.py DIR                     all records of the folder DIR
    python benchmarks/measured.py DIR --only arm2 --fold 1
    python benchmarks/measured.py DIR --quick             the four short records of 2009

DIR holds the records by name (pendulum.csv, arm1.csv, …); those that are not there are left out. Of
each a third is held out: every third run, or the last third of each run (``--fold`` 0, 1, 2 is the
first, middle or last). From 20 samples before a time in it the state is estimated, and the
forecast compared with what was measured: medians over windows of the worst coordinate's error, by
the time ahead; the rest of the record from one state; the share of errors within two standard
deviations; seconds of the processor.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

import gfnn_jax as gfnn
from gfnn_jax.dataset.stretches import stretches
from gfnn_jax.maps.estimates import Window, estimate_states, law_of, propagate

jax.config.update("jax_enable_x64", True)

OUT = Path(__file__).resolve().parent / "results" / "measured.json"
SHORT = ("pendulum", "air_track", "two_carts", "double_pendulum")
# name -> (times ahead in s, unit, {time or "rest": asked}, most seconds of the processor)
RECORDS: dict[str, tuple[tuple[float, ...], float, dict[Any, float], float]] = {
    "pendulum": ((0.5, 1, 2, 5), 1e3, {1: 8, "rest": 18}, 15),
    "air_track": ((0.5, 1, 5), 1, {"rest": 0.9}, 15),
    "two_carts": ((0.5, 1, 2), 1, {"rest": 1.4}, 15),
    "double_pendulum": ((0.1, 0.5, 1), 1e3, {0.5: 3.5, 1: 4.5}, 15),
    "arm1": ((0.1, 0.5, 1, 5), 1e3, {1: 1.0, 5: 4}, 60),
    "arm2": ((0.1, 0.5, 1, 2), 1e3, {1: 1.0, 2: 1.8}, 60),
    "arm3": ((0.1, 0.5, 1), 1e3, {1: 1.4}, 60),
    "video_double_pendulum": ((0.1, 0.25, 0.5, 1), 1e3, {0.25: 20, 0.5: 50}, 120),
    "robot_arm": ((0.1, 0.5, 1), 1e3, {1: 50}, 60),
    "silverbox": ((0.1, 0.5, 1), 1e3, {"rest": 0.24}, 60),
}
SAMPLES, WINDOWS = 20, 120


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, metavar="DIR")
    parser.add_argument("--only", nargs="*", default=[], metavar="NAME")
    parser.add_argument("--fold", type=int, choices=(0, 1, 2), default=2)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--verbose", action="store_true")
    arguments = parser.parse_args()
    names = arguments.only or (SHORT if arguments.quick else tuple(RECORDS))
    found = {}
    for name in names:
        path = arguments.folder / f"{name}.csv"
        if path.is_file():
            found[name] = measure(name, path, arguments.fold, print if arguments.verbose else None)
            print(line(name, found[name]), flush=True)
    if not arguments.only:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n")


def measure(name: str, path: Path, fold: int, told: Any = None) -> dict[str, Any]:
    """Fit two thirds of a record, and judge forecasts of the rest."""
    columns: dict[str, Any] = {"inputs": ["u"], "positions": ["y"]} if name == "silverbox" else {}
    if name == "robot_arm":
        columns = {"positions": ["theta1", "theta2"], "inputs": ["tau1", "tau2"],
                   "angles": ["theta1", "theta2"]}  # fmt: skip
    recording = gfnn.read(path, **columns)
    training, held = split(recording, fold)
    started = time.process_time()
    fit = gfnn.fit(training, on_progress=told or (lambda line: None))
    seconds = time.process_time() - started
    times, unit, asked, most = RECORDS[name]
    errors, within = forecasts(fit.map, held, times)
    rest = rest_of_record(fit.map, held)
    return {
        "formula": fit.formula, "friction": fit.friction.formula, "text": fit.table.split("\n")[:2],
        "seconds": seconds, "most_seconds": most, "unit": unit,
        "asked": {str(k): v for k, v in asked.items()},
        "median": {str(t): e * unit for t, e in zip(times, errors, strict=True)},
        "within_two_deviations": {str(t): w for t, w in zip(times, within, strict=True)},
        "rest": [r * unit for r in rest],
        "residual": {k: v * unit for k, v in fit.residual.items()},
        "horizon": [h._asdict() for h in fit.horizon], "num_training": len(training),
    }  # fmt: skip


def split(recording: Any, fold: int) -> tuple[Any, list[Any]]:
    """The training part, and held-out parts: runs, or a third of each run."""
    if len(recording.runs) > 4:
        kept = [r for k, r in enumerate(recording.runs) if k % 3 != fold]
        held = [recording.slice(run=r) for k, r in enumerate(recording.runs) if k % 3 == fold]
        return gfnn.Recording(
            [table(recording.slice(run=r), r, r) for r in kept], **roles(recording)
        ), held
    tables, held = [], []
    for run in recording.runs:
        t = recording.times(run)
        cuts = np.linspace(0, len(t), 4).astype(int)
        for k in range(3):
            part = recording.slice(t[cuts[k]], t[cuts[k + 1] - 1], run=run)
            if k == fold:
                held.append(part)
            else:
                tables.append(table(part, run, f"{run}-{k}"))
    return gfnn.Recording(tables, **roles(recording)), held


def roles(recording: Any) -> dict[str, Any]:
    return {
        "positions": recording.positions,
        "inputs": recording.inputs,
        "angles": recording.angles,
    }


def table(part: Any, run: str, label: str) -> dict[str, Any]:
    names = (*part.positions, *part.inputs)
    t = part.times(run)
    return {"run": np.full(len(t), label), "t": t, **{n: part.values(n, run) for n in names}}


def forecasts(
    map_: Any, held: list[Any], times: tuple[float, ...]
) -> tuple[list[float], list[float]]:
    """Median over windows of the worst coordinate's error at each time ahead, and the share within
    two standard deviations."""
    law = law_of(map_)
    parts = [s for recording in held for s in stretches(recording)]
    places = [(s, k) for s in parts for k in range(SAMPLES - 1, len(s.t) - 1)
              if s.t[k] + times[0] <= s.t[-1]]  # fmt: skip
    places = places[:: max(1, len(places) // WINDOWS)]
    windows, ahead, measured = [], [], []
    for s, k in places:
        rows = slice(k - SAMPLES + 1, k + 1)
        windows.append(Window(s.t[rows], s.y[rows], s.t, s.u))
        at = np.searchsorted(s.t, s.t[k] + np.array(times) - 1e-9)
        inside = at < len(s.t)
        at = np.minimum(at, len(s.t) - 1)
        ahead.append(np.where(inside, s.t[at], s.t[at[inside][-1]] if inside.any() else s.t[k]))
        measured.append(np.where(inside[:, None], s.y[at], np.nan))
    x, covariance = estimate_states(law, windows)
    last = np.array([w.t[-1] for w in windows])
    orbits = propagate(law, windows, x, covariance, last, np.array(ahead))
    error = np.abs(orbits.values - np.array(measured))
    median = np.nanmedian(error, axis=0).max(axis=1)
    good = np.where(np.isfinite(error), error <= 2 * orbits.std, np.nan)
    return median.tolist(), np.nanmean(good, axis=(0, 2)).tolist()


def rest_of_record(map_: Any, held: list[Any]) -> list[float]:
    """RMS of the worst coordinate over each held-out part, from its first 20 samples."""
    found = []
    for recording in held:
        run = recording.runs[0]
        t = recording.times(run)
        start = recording.slice(stop=t[SAMPLES - 1])
        later = recording.slice(start=t[SAMPLES])
        every = max(1, len(t) // 2_000)
        times = later.times(run)[::every]
        predicted = map_.forecast(start, times, recording if recording.inputs else None)
        rms = []
        for n in recording.positions:
            error = predicted.values[n][0] - later.values(n, run)[::every]
            if n in recording.angles:
                error = (error + np.pi) % (2 * np.pi) - np.pi
            rms.append(float(np.sqrt(np.nanmean(error**2))))
        found.append(max(rms))
    return found


def line(name: str, m: dict[str, Any]) -> str:
    told = [
        f"{t} s {e:.3g}" + (f" (≤ {m['asked'][t]:g})" if t in m["asked"] else "")
        + f" [{m['within_two_deviations'][t]:.0%}]"
        for t, e in m["median"].items()
    ]  # fmt: skip
    rest = ", ".join(f"{r:.3g}" for r in m["rest"])
    limit = f" (≤ {m['asked']['rest']:g})" if "rest" in m["asked"] else ""
    return (
        f"{name}: {'; '.join(told)}; rest {rest}{limit}; {m['seconds']:.1f} s (≤ "
        f"{m['most_seconds']})\n"
        f"    {m['text'][0]}\n    {m['text'][1]}"
    )


if __name__ == "__main__":
    main()
