"""Residual torques of the measured robot arm: what the textbook's two links leave of them, and why.

    python benchmarks/robot_arm.py DIR        of robot_arm.csv in the folder DIR

The equations of two links, d/dt ∂L/∂v − ∂L/∂q + friction = τ, hold in weak form: integrated against
bumps (s(1 − s))³ over windows of a length T, without accelerations. They are linear in masses,
weights and friction (dry and linear in each joint), found by least squares from all runs, and leave
a residual torque. Each row adds something that would explain it. Nothing of the package is used:
NumPy and SciPy.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import harness
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from harness import FIGURES, RESULTS, TABLES, Numbers, between_markers, markdown, provenance, write
from scipy.optimize import least_squares
from scipy.signal import savgol_filter

from gfnn_jax.evaluate import figures

STEP = 0.004  # s, of the samples that integrals are summed over
LENGTHS = (0.1, 0.25, 0.5)  # s, of windows
SMOOTHED = 21  # samples of the local cubics (42 ms)
WIDTH = 0.2  # rad/s, of dry friction: tanh(v / WIDTH)
DELAYS = (-0.006, -0.003, 0.003, 0.006, 0.01)  # s


class Run(NamedTuple):
    """Angles, speeds and torques (n, 2) of a run at even times t (n,)."""

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    tau: np.ndarray


Extra = Callable[[Run, np.ndarray], np.ndarray]  # run, angles less zeros -> forces (n, 2, columns)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, metavar="DIR")
    runs = read(parser.parse_args().folder / "robot_arm.csv")
    still = np.zeros((len(runs), 2))
    rows: dict[str, list[float]] = {}

    def add(name: str, zeros: list[np.ndarray], *extra: Extra, delay: float = 0.0) -> None:
        rows[name] = [
            float(np.sqrt(np.mean(residuals(runs, T, z, extra, delay)[0] ** 2)))
            for T, z in zip(LENGTHS, zeros, strict=True)
        ]
        print(f"{name:60s}", *(f"{1e3 * r:6.1f}" for r in rows[name]), flush=True)

    none = [still] * len(LENGTHS)
    zeros = [zeros_of_runs(runs, T) for T in LENGTHS]
    add("two links, dry and linear friction", none)
    add("… torques with a constant", none, constants(runs, each=False))
    add("… torques with constants of each run", none, constants(runs, each=True))
    add("zeros of the angles, of each run", zeros)
    for delay in DELAYS:
        add(f"… torques {1e3 * delay:+g} ms later", zeros, delay=delay)
    for name, extra in EXTRAS.items():
        add(f"… {name}", zeros, extra)
    add("… all of these at once", zeros, *EXTRAS.values())
    result: Numbers = {
        "piece": "robot_arm",
        "windows": LENGTHS,
        "rms": rows,
        "zeros": zeros[-1].tolist(),
        "torque": float(np.sqrt(np.mean(np.concatenate([r.tau for r in runs]) ** 2))),
    }
    write(RESULTS / "robot-arm-residuals.json", result)
    draw(runs, zeros[-1])
    table(result)


def read(path: Path) -> list[Run]:
    """The runs of the record, by local cubics."""
    runs = []
    for _, one in pd.read_csv(path).groupby("run"):
        times, step = one["t"].to_numpy(), float(np.median(np.diff(one["t"])))
        t = np.arange(times[0], times[-1], STEP)

        def even(names: str, order: int = 0, of=one, at=t, now=times, dt=step) -> np.ndarray:
            columns = [of[f"{names}{k}"].to_numpy() for k in (1, 2)]
            if names == "theta":
                smooth = partial(
                    savgol_filter, polyorder=3, window_length=SMOOTHED, deriv=order, delta=dt
                )
                columns = [np.asarray(smooth(c)) for c in columns]
            return np.stack([np.interp(at, now, c) for c in columns], axis=1)

        runs.append(Run(t, even("theta"), even("theta", 1), even("tau")))
    return runs


def weights(length: float) -> tuple[np.ndarray, np.ndarray]:
    """A bump of integral 1 over a window, and its slope, times the step."""
    n = round(length / STEP)
    s = (np.arange(n) + 0.5) / n
    bump = s * (1 - s)
    norm = np.sum(bump**3)
    return bump**3 / norm, 3 * bump**2 * (1 - 2 * s) / length / norm


def windows(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Integrals of values (n, ...) against a weight over windows a quarter of its length apart."""
    n = len(weight)
    starts = range(0, len(values) - n, n // 4)
    return np.stack([np.tensordot(weight, values[i : i + n], 1) for i in starts])


def links(run: Run, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Momenta and forces (n, 2, 10) of each coefficient: three constant masses, the one of cos θ₂,
    two weights, dry and linear friction of each joint."""
    (q1, q2), (v1, v2) = q.T, run.v.T
    o, cos, both = 0 * v1, np.cos(q2), np.sin(q1 + q2)
    momenta = [(v1, o), (v2, v1), (o, v2), (cos * (2 * v1 + v2), cos * v1)] + [(o, o)] * 6
    forces = [(o, o)] * 3 + [(o, -np.sin(q2) * v1 * (v1 + v2)), (-np.sin(q1), o), (-both, -both)]
    forces += [(-dry(v1), o), (-v1, o), (o, -dry(v2)), (o, -v2)]
    return np.array(momenta).transpose(2, 1, 0), np.array(forces).transpose(2, 1, 0)


def dry(v: np.ndarray) -> np.ndarray:
    return np.tanh(v / WIDTH)


def residuals(
    runs: list[Run], length: float, zeros: np.ndarray, extra: tuple[Extra, ...], delay: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Residual torques (windows, 2) of all runs, and the coefficients."""
    bump, slope = weights(length)
    columns, torques = [], []
    for run, zero in zip(runs, zeros, strict=True):
        q = run.q - zero
        momenta, forces = links(run, q)
        own = [-windows(momenta, slope) - windows(forces, bump)]
        own += [windows(one(run, q), bump) for one in extra]
        columns.append(np.concatenate(own, axis=2))
        later = [np.interp(run.t - delay, run.t, tau) for tau in run.tau.T]
        torques.append(windows(np.stack(later, axis=1), bump))
    X, y = np.concatenate(columns), np.concatenate(torques)
    flat = X.reshape(-1, X.shape[2])
    found = np.linalg.lstsq(flat, y.ravel(), rcond=1e-10)[0]
    return y - X @ found, found


def zeros_of_runs(runs: list[Run], length: float) -> np.ndarray:
    """Zeros (runs, 2) of the angles that leave least."""

    def left(zeros: np.ndarray) -> np.ndarray:
        return residuals(runs, length, zeros.reshape(-1, 2), ())[0].ravel()

    return least_squares(left, np.zeros(2 * len(runs)), xtol=1e-4).x.reshape(-1, 2)


def constants(runs: list[Run], each: bool) -> Extra:
    def columns(run: Run, q: np.ndarray) -> np.ndarray:
        own = next(k for k, one in enumerate(runs) if one is run) if each else 0
        found = np.zeros((*q.shape, 2 * len(runs) if each else 2))
        found[:, [0, 1], [2 * own, 2 * own + 1]] = 1.0
        return found

    return columns


def force(joint: int, of: Callable[[Run, np.ndarray], np.ndarray]) -> Extra:
    """A force of(run, q) (n,) on one joint."""
    return lambda run, q: (of(run, q)[:, None] * np.eye(2)[joint])[..., None]


def both(of: Callable[[Run, np.ndarray, int], np.ndarray]) -> Extra:
    """A force of(run, q, joint) on each joint, with a coefficient for each."""
    return lambda run, q: np.stack(
        [of(run, q, k)[:, None] * np.eye(2)[k] for k in range(2)], axis=2
    )


EXTRAS: dict[str, Extra] = {
    "a gain of the first torque beside the second's": force(0, lambda r, q: -r.tau[:, 0]),
    "torques that act on the other joint": both(lambda r, q, k: -r.tau[:, 1 - k]),
    "gains that change with the torque, τ³": both(lambda r, q, k: r.tau[:, k] ** 3),
    "quadratic friction": both(lambda r, q, k: r.v[:, k] * np.abs(r.v[:, k])),
    "Stribeck's friction, below 1 rad/s": both(
        lambda r, q, k: dry(r.v[:, k]) * np.exp(-(r.v[:, k] ** 2))
    ),
    "friction by the torque of the motor": both(
        lambda r, q, k: dry(r.v[:, k]) * np.abs(r.tau[:, k])
    ),
    "friction by the other joint's speed": both(
        lambda r, q, k: dry(r.v[:, k]) * np.abs(r.v[:, 1 - k])
    ),
    "springs at the joints": both(lambda r, q, k: q[:, k]),
    "potentials sin 2θ, sin 3θ of the second": lambda r, q: np.stack(
        [np.sin(n * q[:, 1])[:, None] * [0, 1] for n in (2, 3)], axis=2
    ),
}


def draw(runs: list[Run], zeros: np.ndarray) -> None:
    """Residual torque of the first run over windows of 0.1 s, with its angles."""
    _, found = residuals(runs, LENGTHS[-1], zeros, ())
    run, (bump, slope) = runs[0], weights(LENGTHS[0])
    momenta, forces = links(run, run.q - zeros[0])
    left = windows(run.tau, bump) - (-windows(momenta, slope) - windows(forces, bump)) @ found
    t = windows(run.t, bump)
    with figures.style():
        grid, axes = plt.subplots(2, 1, figsize=(6.4, 3.6), sharex=True, layout="constrained")
        for k, ax in enumerate(axes):
            ax.plot(t, left[:, k], color="C0", lw=0.9)
            ax.set_ylabel(f"residual τ{k + 1} [N m]", color="C0")
            ax.set_ylim(-0.8, 0.8)
            angle = ax.twinx()
            angle.plot(run.t, run.q[:, k], color="C1", lw=0.9)
            angle.set_ylabel(f"θ{k + 1} [rad]", color="C1")
            angle.grid(False)
        axes[-1].set_xlabel("t [s]")
        axes[-1].set_xlim(0, 5)
        FIGURES.mkdir(exist_ok=True)
        figures.save(grid, FIGURES / "robot_arm.png")


def table(result: Numbers) -> None:
    heads = ("added to the textbook", *(f"rms over windows of {T:g} s, mN m" for T in LENGTHS))
    rows = [[name, *(f"{1e3 * r:.1f}" for r in rms)] for name, rms in result["rms"].items()]
    found = harness.read({"robot_arm": RESULTS / "robot-arm-residuals.json"})
    between_markers(TABLES, "robot-arm", f"{markdown(heads, rows)}\n\n{provenance(found)}")


if __name__ == "__main__":
    main()
