"""Measured records: the law of each from positions alone, and its forecasts of a part held out.

    python benchmarks/measured.py DIR                       all records of the folder DIR
    python benchmarks/measured.py DIR --only arm2,video_double_pendulum --thirds 1
    python benchmarks/measured.py DIR --quick               the four short records, into runs/

DIR holds the records by name (pendulum.csv, arm1.csv, …); those that are not there are left out. Of
each a third is held out in turn: every third run, or the first, middle and last third of each run.
From 20 samples before a time in it the state is estimated, and the forecast compared with what was
measured: medians over windows of the worst coordinate's error, by the time ahead; the rest of each
held-out part from one state; the share of errors within two standard deviations; seconds of the
processor. A third that has a result is not measured again (`--overwrite`).

A held-out third has few windows that do not overlap, so that of exact bands too more or less than
95 % of the errors lie within two standard deviations by chance. How often they hold 90 to 99 % is
simulated: of Gaussian errors, which correlate by the share of time that windows have in common.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

# Sets float64, so it comes before all of JAX.
from harness import (
    FIGURES,
    RESULTS,
    TABLES,
    Numbers,
    between_markers,
    markdown,
    provenance,
    read,
    write,
)

import gfnn_jax as gfnn
from gfnn_jax.dataset.stretches import stretches
from gfnn_jax.evaluate import figures, report
from gfnn_jax.maps.estimates import Window, estimates_of, law_of, propagate

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
THIRDS = ("first", "middle", "last")
SAMPLES, WINDOWS, PERIODS = 20, 120, 60
HELD, DRAWS = (0.9, 0.99), 400  # shares within two standard deviations, and simulations of them


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", metavar="DIR")
    parser.add_argument("--only", metavar="A,B", help=", ".join(RECORDS))
    parser.add_argument("--thirds", default="2,0,1", metavar="0,1,2", help="that are held out")
    parser.add_argument("--quick", action="store_true", help="short records, the last third only")
    parser.add_argument("--overwrite", action="store_true", help="measure finished thirds again")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the results")
    parser.add_argument("--verbose", action="store_true")
    arguments = parser.parse_args()
    folder = arguments.out or (Path("runs") / "measured" if arguments.quick else RESULTS)
    names = tuple(arguments.only.split(",")) if arguments.only else tuple(RECORDS)
    unknown = [name for name in names if name not in RECORDS]
    if unknown:
        parser.error(f"unknown record '{unknown[0]}'; records: {', '.join(RECORDS)}")
    names = tuple(n for n in names if n in SHORT) if arguments.quick else names
    thirds = ("2",) if arguments.quick else tuple(arguments.thirds.split(","))
    records = arguments.folder or Path()
    for third in thirds:
        for name in names if arguments.folder else ():
            path, out = records / f"{name}.csv", folder / f"measured-{name}.json"
            done = read({name: out}).get(name, {}).get("measured", {})
            if not path.is_file() or (third in done and not arguments.overwrite):
                continue
            told = print if arguments.verbose else None
            done[third] = measure(name, path, int(third), told)
            write(out, {"piece": name, "measured": dict(sorted(done.items()))})
            print(line(name, done[third]), flush=True)
    chances(records, folder, names)
    if folder == RESULTS:
        tables()


def chances(records: Path, folder: Path, names: tuple[str, ...]) -> None:
    """Add what exact bands would hold to the results of records; it asks for no fit."""
    for name in names:
        path, out = records / f"{name}.csv", folder / f"measured-{name}.json"
        result = read({name: out}).get(name)
        if result and path.is_file():
            recording = recording_of(name, path)
            rng, shares = np.random.default_rng(0), dict[str, list[np.ndarray]]()
            for third, m in result["measured"].items():
                own = exact(split(recording, int(third))[1], RECORDS[name][0], rng)
                m["exact_bands_hold"] = {t: float(np.mean(calibrated(s))) for t, s in own.items()}
                for t, share in own.items():
                    shares.setdefault(t, []).append(share)
            result["exact_bands_hold"] = {
                t: float(np.mean(calibrated(np.mean(s, axis=0)))) for t, s in shares.items()
            }
            out.write_text(report.to_json(result), encoding="utf-8")


def tables() -> None:
    """The table of RESULTS.md, and the figure, of the results there are."""
    found = read({name: RESULTS / f"measured-{name}.json" for name in RECORDS})
    if not found:
        return
    rows = []
    for name, result in found.items():
        for third, m in result["measured"].items():
            ahead = [
                f"{t} s {e:.3g}"
                + (f" (≤ {m['asked'][t]:g})" if t in m["asked"] else "")
                + f" [{m['within_two_deviations'][t]:.0%}]"
                for t, e in m["median"].items()
                if e is not None
            ]
            rest = ", ".join(f"{r:.3g}" for r in m["rest"][:3])
            rest += " …" if len(m["rest"]) > 3 else ""
            rest += f" (≤ {m['asked']['rest']:g})" if "rest" in m["asked"] else ""
            rows.append(
                [
                    name,
                    THIRDS[int(third)],
                    "; ".join(ahead),
                    rest,
                    m["which_friction"],
                    f"{m['seconds']:.0f} (≤ {m['most_seconds']})",
                ]
            )
    heads = (
        "record",
        "third held out",
        "median error ahead (asked) [within 2 σ]",
        "rest of a part, RMS",
        "friction",
        "CPU s",
    )
    held, chance = np.array(
        [
            (share, m["exact_bands_hold"][t])
            for result in found.values()
            for m in result["measured"].values()
            for t, share in m["within_two_deviations"].items()
            if share is not None
        ]
    ).T
    whole, of_whole = np.array(
        [
            (over_thirds(result, t), chance)
            for result in found.values()
            for t, chance in result["exact_bands_hold"].items()
        ]
    ).T
    good, sure = calibrated(held), chance >= HELD[0]
    text = (
        f"Two standard deviations hold 90 to 99 % of the errors in {calibrated(whole).sum()} of "
        f"{len(whole)} rows of a record and a time ahead, more in {np.sum(whole > HELD[1])}, less "
        f"in {np.sum(whole < HELD[0])}; of each third by itself in {good.sum()} of {len(held)}. "
        f"Bands that are exact would in {of_whole.sum():.0f} and {chance.sum():.0f} in the mean, "
        f"since few windows are independent. Of the {sure.sum()} thirds in which they would nine "
        f"times in ten, these do in {np.sum(good & sure)}."
    )
    table = f"{markdown(heads, rows)}\n\n{text}\n\n{provenance(found)}"
    between_markers(TABLES, "measured", table)
    draw(found)


def draw(found: dict[str, Numbers]) -> None:
    """Median errors by the time ahead: a panel for each record, a line for each third, and a mark
    for what was asked."""
    with figures.style():
        grid, axes = plt.subplots(
            2,
            -(-len(found) // 2),
            figsize=(2.4 * -(-len(found) // 2), 4.6),
            squeeze=False,
            layout="constrained",
        )
    for ax in axes.ravel()[len(found) :]:
        ax.axis("off")
    for ax, (name, result) in zip(axes.ravel(), found.items(), strict=False):
        for third, m in sorted(result["measured"].items()):
            seen = [(float(t), e) for t, e in m["median"].items() if e is not None]
            look = {"label": THIRDS[int(third)], "color": f"C{third}"}
            ax.plot(*zip(*seen, strict=True), ".-", **look)
        asked = [(t, e) for t, e in RECORDS[name][2].items() if t != "rest"]
        if asked:
            ax.plot(*zip(*asked, strict=True), "k_", ms=10)
        ax.set_title(name)
        ax.set_ylim(bottom=0)
    axes[0, 0].legend(title="third held out", fontsize=7, title_fontsize=7)
    grid.supxlabel("time ahead [s]")
    grid.supylabel("median error [mrad, units, mV]")
    FIGURES.mkdir(exist_ok=True)
    figures.save(grid, FIGURES / "measured.png")


def measure(name: str, path: Path, fold: int, told: Any = None) -> dict[str, Any]:
    """Fit two thirds of a record, and judge forecasts of the rest."""
    training, held = split(recording_of(name, path), fold)
    started = time.process_time()
    fit: Any = gfnn.fit(training, on_progress=told or (lambda line: None))
    seconds = time.process_time() - started
    times, unit, asked, most = RECORDS[name]
    errors, within = forecasts(fit.map, held, times)
    rest = rest_of_record(fit.map, held)
    return {
        "formula": fit.formula,
        "friction": fit.friction.formula,
        "text": fit.table.split("\n")[:2],
        "which_friction": "+".join(fit.which_friction.kinds) or "none",
        "odds": fit.which_friction.odds,
        "seconds": seconds,
        "most_seconds": most,
        "unit": unit,
        "asked": {str(k): v for k, v in asked.items()},
        "median": {
            str(t): None if e is None else e * unit for t, e in zip(times, errors, strict=True)
        },
        "within_two_deviations": {str(t): w for t, w in zip(times, within, strict=True)},
        "rest": [r * unit for r in rest],
        "residual": {k: v * unit for k, v in fit.residual.items()},
        "horizon": [h._asdict() for h in fit.horizon],
        "num_training": len(training),
    }


def recording_of(name: str, path: Path) -> Any:
    columns: dict[str, Any] = {"inputs": ["u"], "positions": ["y"]} if name == "silverbox" else {}
    if name == "robot_arm":
        columns = {
            "positions": ["theta1", "theta2"],
            "inputs": ["tau1", "tau2"],
            "angles": ["theta1", "theta2"],
        }
    return gfnn.read(path, **columns)


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


def held_windows(
    held: list[Any], times: tuple[float, ...]
) -> tuple[list[tuple[Any, int]], np.ndarray, np.ndarray]:
    """Windows of held-out parts: the stretch and the sample (n,) where each ends, times (n, m) of
    the samples at ``times`` (m,) s later, and what was measured there (n, m, channels), NaN where
    the part ends before."""
    parts = [s for recording in held for s in stretches(recording)]
    ends = [
        (s, k)
        for s in parts
        for k in range(SAMPLES - 1, len(s.t) - 1)
        if s.t[k] + times[0] <= s.t[-1]
    ]
    ends = ends[:: max(1, len(ends) // WINDOWS)]
    ahead, measured = [], []
    for s, k in ends:
        at = np.searchsorted(s.t, s.t[k] + np.array(times) - 1e-9)
        inside = at < len(s.t)
        at = np.minimum(at, len(s.t) - 1)
        ahead.append(np.where(inside, s.t[at], s.t[at[inside][-1]] if inside.any() else s.t[k]))
        measured.append(np.where(inside[:, None], s.y[at], np.nan))
    return ends, np.array(ahead), np.array(measured)


def forecasts(
    map_: Any, held: list[Any], times: tuple[float, ...]
) -> tuple[list[float | None], list[float | None]]:
    """Median over windows of the worst coordinate's error at each time ahead, and the share within
    two standard deviations; None where no part is that long."""
    law = law_of(map_)
    ends, ahead, measured = held_windows(held, times)
    windows = []
    for s, k in ends:
        rows = slice(k - SAMPLES + 1, k + 1)
        windows.append(Window(s.t[rows], s.y[rows], s.t, s.u))
    given = [law], np.zeros(len(windows), int), windows
    x, covariance = estimates_of(*given)
    last = np.array([w.t[-1] for w in windows])
    orbits = propagate(*given, x, covariance, last, ahead)
    error = np.abs(orbits.values - measured)
    seen = np.isfinite(error)
    median, share = [], []
    for n in range(len(times)):
        some = seen[:, n].all(axis=1)
        median.append(float(np.median(error[some, n], axis=0).max()) if some.any() else None)
        good = error[some, n] <= 2 * orbits.std[some, n]
        share.append(float(np.mean(good)) if some.any() else None)
    return median, share


def over_thirds(result: dict[str, Any], t: str) -> float:
    """The share of a record's errors at this time ahead that two standard deviations hold, in the
    mean over its thirds."""
    shares = [m["within_two_deviations"][t] for m in result["measured"].values()]
    return float(np.mean([share for share in shares if share is not None]))


def calibrated(share: np.ndarray) -> np.ndarray:
    """Whether two standard deviations hold 90 to 99 % of errors."""
    return (share >= HELD[0]) & (share <= HELD[1])


def exact(
    held: list[Any], times: tuple[float, ...], rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Shares (DRAWS,) of the errors of held-out windows that exact bands of two standard deviations
    hold, by the time ahead. Errors of two windows correlate by the share of the time, from the
    first sample to the one forecast, that they have in common; those of channels do not."""
    ends, ahead, measured = held_windows(held, times)
    begun = np.array([s.t[k - SAMPLES + 1] for s, k in ends])
    part = np.array([id(s) for s, _ in ends])
    found = {}
    for n, t in enumerate(times):
        inside, count = np.zeros(DRAWS), 0
        some = np.isfinite(measured[:, n]).all(axis=1)
        for own in (some & (part == one) for one in np.unique(part[some])):
            a, b = begun[own], ahead[own, n]
            common = np.maximum(np.minimum(b[:, None], b) - np.maximum(a[:, None], a), 0.0)
            sizes, axes = np.linalg.eigh(common / np.sqrt((b - a)[:, None] * (b - a)))
            draws = rng.normal(size=(len(a), measured.shape[2] * DRAWS))
            errors = axes * np.sqrt(np.maximum(sizes, 0.0)) @ draws
            inside += np.sum(np.abs(errors) <= 2, axis=0).reshape(-1, DRAWS).sum(axis=0)
            count += len(a) * measured.shape[2]
        if count:
            found[str(t)] = inside / count
    return found


def rest_of_record(map_: Any, held: list[Any]) -> list[float]:
    """RMS of the worst coordinate over each held-out part, from its first 20 samples, for at most
    60 periods of the fastest motion."""
    found, longest = [], 2 * np.pi * PERIODS / law_of(map_).sensors.omega
    for recording in held:
        run = recording.runs[0]
        t = recording.times(run)
        start = recording.slice(stop=t[SAMPLES - 1])
        later = recording.slice(t[SAMPLES], t[SAMPLES] + longest)
        every = max(1, len(later.times(run)) // 1_000)
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
        f"{t} s {e:.3g}"
        + (f" (≤ {m['asked'][t]:g})" if t in m["asked"] else "")
        + f" [{m['within_two_deviations'][t]:.0%}]"
        for t, e in m["median"].items()
        if e is not None
    ]
    rest = ", ".join(f"{r:.3g}" for r in m["rest"])
    limit = f" (≤ {m['asked']['rest']:g})" if "rest" in m["asked"] else ""
    return (
        f"{name}: {'; '.join(told)}; rest {rest}{limit}; {m['seconds']:.1f} s (≤ "
        f"{m['most_seconds']})\n"
        f"    {m['text'][0]}\n    {m['text'][1]}"
    )


if __name__ == "__main__":
    main()
