"""A measured double pendulum: the law of two thirds of its record, and forecasts of the rest.

    python benchmarks/double_pendulum.py            into results/, figures/ and the README
    python benchmarks/double_pendulum.py --quick    the same into runs/, nothing else is touched

The record is Schmidt & Lipson's (`gfnn_jax/records`): two angles, told to be angles; its
velocities are not used. States are estimated from the twenty samples before a time of the last
third, which no fit has seen, and forecast for a second.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

# Sets float64, so it comes before all of JAX.
from harness import FIGURES, README, RESULTS, between_markers, read, write

# isort: split
import matplotlib.pyplot as plt
import numpy as np

import gfnn_jax as gfnn
from gfnn_jax.evaluate.figures_style import COLOURS, style

ANGLES = ("theta1", "theta2")
SAMPLES, AHEAD, STARTS = 20, 1.0, 3  # of a start; seconds; starts in the figure
PART = 2 / 3  # of the record, in time, that is learned from


def measured() -> dict:
    """The law, its time, and forecasts from several starts beside what was measured."""
    record = gfnn.read(gfnn.records.path("double_pendulum"), angles=ANGLES, positions=ANGLES)
    run = record.runs[0]
    t = record.times(run)
    end = t[0] + PART * (t[-1] - t[0])
    started = time.process_time()
    fit = gfnn.fit(record.slice(stop=end))
    seconds = time.process_time() - started
    unseen = record.slice(start=end)
    t, angles = unseen.times(run), np.array([unseen.unwrapped(name, run) for name in ANGLES])
    last = np.searchsorted(t, t[-1] - AHEAD)
    forecasts, errors, inside = [], [], []
    for k in np.linspace(SAMPLES - 1, last, 24).astype(int):
        rows = np.flatnonzero((t > t[k]) & (t <= t[k] + AHEAD))
        start = record.slice(float(t[k - SAMPLES + 1]), float(t[k]))
        found = fit.map.forecast(start, t[rows])
        values, std = (np.array([of[n][0] for n in ANGLES]) for of in (found.values, found.std))
        off = values - angles[:, rows]
        off -= 2 * np.pi * np.round(off / (2 * np.pi))
        at = [np.argmin(np.abs(t[rows] - t[k] - ahead)) for ahead in (0.1, 0.5, 1.0)]
        errors.append(np.abs(off[:, at]).max(axis=0))
        inside.append(np.abs(off) <= 2 * std)
        line = np.linspace(0, AHEAD, 101)
        smooth = fit.map.forecast(start, t[k] + line[1:]).values
        forecasts.append(
            {
                "start": t[k],
                "t": t[rows].tolist(),
                "std": std.tolist(),
                "error": off.tolist(),
                "measured": (values - off).tolist(),
                "line_t": line[1:].tolist(),
                "line": [smooth[n][0].tolist() for n in ANGLES],
            }
        )
    shown = np.linspace(0, len(forecasts) - 1, STARTS).astype(int)
    return {
        "lagrangian": str(fit.lagrangian),
        "friction": str(fit.friction),
        "formula": fit.formula,
        "cpu_seconds": seconds,
        "samples": len(record.slice(stop=end)),
        "median_error": dict(zip(("0.1", "0.5", "1"), np.median(errors, axis=0), strict=True)),
        "within_two_deviations": float(np.mean(np.concatenate(inside, axis=1))),
        "forecasts": [forecasts[i] for i in shown],
    }


def typeset(law: str) -> str:
    """L or R as matplotlib sets it: 0.16(1) ω₂² becomes 0.16(1)\\,\\omega_2^2."""
    signs = dict(
        zip("₁₂²³ωθ−|", ("_1", "_2", "^2", "^3", r"\omega", r"\theta", "-", r"\vert "), strict=True)
    )
    return (
        "".join(signs.get(letter, letter) for letter in law)
        .replace("cos", r"\cos")
        .replace(" ", r"\,")
    )


@style()
def draw(found: dict, path: Path) -> None:
    """The law on top; measured angles and forecasts, and under them the errors of forecasts with
    their bands, a column a start."""
    figure, axes = plt.subplots(
        2, STARTS, figsize=(10, 5.0), sharex=True, sharey="row", layout="constrained"
    )
    law = (
        f"${name} = {typeset(found[of])}$" for name, of in (("L", "lagrangian"), ("R", "friction"))
    )
    figure.suptitle("\n".join(law), fontsize=10, linespacing=1.6)
    for (above, below), forecast in zip(axes.T, found["forecasts"], strict=True):
        t = np.array(forecast["t"]) - forecast["start"]
        for i, (name, colour) in enumerate(zip(("θ₁", "θ₂"), COLOURS[:2], strict=True)):
            above.plot(
                forecast["line_t"],
                forecast["line"][i],
                color=colour,
                lw=1.2,
                label=f"{name} forecast",
            )
            above.plot(
                t,
                forecast["measured"][i],
                ".",
                ms=3,
                color="black",
                label="measured" if i else None,
            )
            error, std = (1e3 * np.array(forecast[of][i]) for of in ("error", "std"))
            below.fill_between(
                t,
                -2 * std,
                2 * std,
                color=colour,
                alpha=0.2,
                lw=0,
                label=f"{name} ± 2 standard deviations",
            )
            below.plot(t, error, ".", ms=3, color=colour)
        below.set_xlabel("seconds ahead")
    axes[0, 0].set_ylabel("angle [rad]")
    axes[1, 0].set_ylabel("forecast − measured [mrad]")
    axes[0, 0].legend(fontsize=8)
    axes[1, 0].legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def text(found: dict) -> str:
    """The README's words."""
    error = {ahead: f"{1e3 * value:.1f}" for ahead, value in found["median_error"].items()}
    inside = 100 * found["within_two_deviations"]
    return (
        f"```text\nL = {found['lagrangian']}\nR = {found['friction']}\n```\n\n"
        "![Forecasts of a measured double pendulum](benchmarks/figures/double_pendulum.png)\n\n"
        "*A measured double pendulum (Schmidt & Lipson, Science 2009): its law from "
        f"{found['samples']} samples of two\nangles, in {found['cpu_seconds']:.0f} s of a "
        "processor, and forecasts of the last third of the record, which\nno fit has seen, from "
        f"the {SAMPLES} samples before. Median error {error['0.1']}, {error['0.5']} and "
        f"{error['1']} mrad after 0.1,\n0.5 and 1 s; {inside:.0f} % of what was measured lies "
        "within two standard deviations. Drawn by\n`benchmarks/double_pendulum.py`.*"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="into runs/, nothing else is touched")
    parser.add_argument("--tables", action="store_true", help="only draw and write again")
    arguments = parser.parse_args()
    folder = Path("runs") / "double-pendulum" if arguments.quick else RESULTS
    path = folder / "double-pendulum.json"
    if not arguments.tables:
        write(path, measured())
    found = read({"record": path})["record"]
    draw(found, (folder if arguments.quick else FIGURES) / "double_pendulum.png")
    print(text(found))
    if not arguments.quick:
        between_markers(README, "record", text(found))


if __name__ == "__main__":
    main()
