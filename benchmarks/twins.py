"""Simulated twins of measured records: whether the law that was put in comes out, with true errors.

    python benchmarks/twins.py            every twin (some three minutes)
    python benchmarks/twins.py --quick    two of them, one draw of the noise

Each twin is integrated by SciPy from its own equations of motion, with the coefficients, the
sampling and the length of the record that it is named for. To its positions noise is added, from
1e-6 to 1e-2 of their spread. Counted are fits whose formula has exactly the terms and the kinds of
friction that were put in, and coefficients of these that lie within three standard errors.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from harness import TABLES, Numbers, between_markers, main, markdown, number, once, results
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn

NOISES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)  # of the spread
DRAWS = 1
WITHIN = 3.0  # standard errors


class Twin(NamedTuple):
    """accelerate(q, v) -> q̈; the start of each run (q, v), their end and step; the terms of L and R
    as formulas have them, where each angle's zero is its own."""

    accelerate: Callable
    starts: tuple[tuple[float, ...], ...]
    end: float
    dt: float
    names: tuple[str, ...]
    angles: tuple[str, ...]
    lagrangian: dict[str, float]
    friction: dict[str, float]


def _pendulum(q, v):
    return -1.357 * np.sin(q) - 0.012 * v


def _track(q, v):
    return -6.22 * q - 0.014 * v


def _carts(q, v):
    force = [-85.6 * q[0] + 77.8 * q[1], -85.4 * q[1] + 77.8 * q[0]]
    return np.array(force) / [1.0, 2.44]


def _double_pendulum(q, v):
    c, s = 0.407 * np.cos(q[0] - q[1]), 0.407 * np.sin(q[0] - q[1])
    force = [
        -s * v[1] ** 2 - 62.2 * np.sin(q[0]) - 0.02 * v[0] - 0.008 * (v[0] - v[1]),
        s * v[0] ** 2 - 23.0 * np.sin(q[1]) - 0.008 * (v[1] - v[0]),
    ]
    return np.linalg.solve(np.array([[1.0, c], [c, 0.316]]), force)


def _arm(q, v):
    return 64.0 * np.sin(q) - 0.0047 * v * abs(v) - 0.13 * v / np.hypot(v, 1e-3)


TWINS = {
    "pendulum": Twin(
        _pendulum, ((1.45, 0.0),), 57.0, 1 / 6, ("theta",), ("theta",),
        {"omega**2": 0.5, "cos(theta)": 1.357}, {"omega**2": 0.006},
    ),
    "air_track": Twin(
        _track, ((100.0, 0.0),), 17.4, 1 / 30, ("x",), (),
        {"v**2": 0.5, "x**2": -3.11}, {"v**2": 0.007},
    ),
    "two_carts": Twin(
        _carts, ((60.0, -40.0, 0.0, 150.0),), 9.9, 1 / 30, ("x1", "x2"), (),
        {"v1**2": 0.5, "v2**2": 1.22, "x1**2": -42.8, "x1*x2": 77.8, "x2**2": -42.7}, {},
    ),
    "double_pendulum": Twin(
        _double_pendulum, ((1.3, -1.2, 0.0, 8.0), (-1.0, 0.4, 3.0, 0.0)), 2.6, 0.01,
        ("theta1", "theta2"), ("theta1", "theta2"),
        {"omega1**2": 0.5, "omega1*omega2*cos(theta1 - theta2)": 0.407, "omega2**2": 0.158,
         "cos(theta1)": 62.2, "cos(theta2)": 23.0},
        {"omega1**2": 0.01, "(omega2 - omega1)**2": 0.004},
    ),
    "arm1": Twin(
        _arm, ((4.7, 0.0), (4.2, 0.0)), 9.0, 0.004, ("theta",), ("theta",),
        {"omega**2": 0.5, "cos(theta)": -64.0},
        {"abs(omega)**3": 0.0047 / 3, "dry": 0.13},
    ),
}  # fmt: skip


def recording(twin: Twin, noise: float, draw: int) -> gfnn.Recording:
    """Positions of the twin's runs with noise, a share of their spread, and velocities of none."""
    rng, t, tables = np.random.default_rng(draw), np.arange(0, twin.end, twin.dt), []
    d = len(twin.names)
    orbits = []
    for start in twin.starts:
        first = np.array(start) * (1 + 0.02 * draw)
        orbits.append(
            solve_ivp(
                lambda _, x: [*x[d:], *np.ravel(twin.accelerate(x[:d], x[d:]))], (0, t[-1]), first,
                t_eval=t, method="DOP853", rtol=1e-11, atol=1e-11, max_step=0.05,
            ).y[:d]
        )  # fmt: skip
    spread = np.concatenate(orbits, axis=1).std(axis=1)
    for run, q in enumerate(orbits):
        seen = q + noise * spread[:, None] * rng.normal(size=q.shape)
        columns = dict(zip(twin.names, seen, strict=True))
        tables.append({"run": np.full(len(t), str(run)), "t": t, **columns})
    return gfnn.Recording(tables, positions=twin.names, angles=twin.angles)


def plain(term: str) -> str:
    """The term without zeros of angles; dry friction in a word."""
    term = re.sub(r" [-+] \d\.?[\d.e-]*\)", ")", term)
    return "dry" if re.fullmatch(r"abs\([^()]*\)", term) else term


def case(twin: Twin, noise: float, draw: int) -> Numbers:
    """One fit: whether its terms are those put in, and its errors in standard errors."""
    record = recording(twin, noise, draw)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        done = once(lambda: gfnn.fit(record))
    fit: Any = done.out
    found = {plain(t.term): (t.coefficient, t.std) for t in fit.lagrangian.terms}
    lost = {plain(t.term): (t.coefficient, t.std) for t in fit.friction.terms}
    same = {
        "lagrangian": set(found) == set(twin.lagrangian),
        "friction": set(lost) == set(twin.friction),
    }
    off = {}
    for put_in, came_out in ((twin.lagrangian, found), (twin.friction, lost)):
        for term, value in put_in.items():
            c, std = came_out.get(term, (0.0, 0.0))
            if std > 0:
                off[f"R: {term}" if put_in is twin.friction else term] = abs(c - value) / std
    off |= {f"zero of {name}": abs(zero) / std for name, (zero, std) in fit.zeros.items()}
    return {
        "noise": noise, "draw": draw, "same": same, "standard_errors": off,
        "formula": fit.formula, "friction": fit.friction.formula,
        "processor_seconds": done.processor_seconds,
    }  # fmt: skip


def measured(name: str, quick: bool) -> Numbers:
    cases = []
    for noise in NOISES:
        for draw in range(1 if quick else DRAWS):
            cases.append(case(TWINS[name], noise, draw))
            c = cases[-1]
            worst = max(c["standard_errors"].items(), key=lambda item: item[1], default=("", 0))
            print(f"  {noise:g}: {c['same']}, {worst[0]} off by {worst[1]:.1f}; {c['formula']} | "
                  f"{c['friction']}; {c['processor_seconds']:.1f} s", flush=True)  # fmt: skip
    return {"cases": cases}


def _piece(name: str) -> Callable[[bool], Numbers]:
    return lambda quick: measured(name, quick)


PIECES = {name: _piece(name) for name in TWINS}


def tables() -> None:
    """The table of RESULTS.md."""
    rows = []
    for name, result in results(PIECES, "twins").items():
        for noise in NOISES:
            cases = [c for c in result["measured"]["cases"] if c["noise"] == noise]
            off = [z for c in cases for z in c["standard_errors"].values()]
            seconds = np.mean([c["processor_seconds"] for c in cases])
            rows.append([
                name, f"{noise:g}",
                f"{sum(c['same']['lagrangian'] for c in cases)} of {len(cases)}",
                f"{sum(c['same']['friction'] for c in cases)} of {len(cases)}",
                f"{sum(z <= WITHIN for z in off)} of {len(off)}", number(max(off)),
                number(seconds),
            ])  # fmt: skip
    heads = ("twin", "noise ÷ spread", "terms of L exact", "friction exact",
             f"within {WITHIN:g} standard errors", "largest", "CPU s")  # fmt: skip
    between_markers(TABLES, "twins", markdown(heads, rows))


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "twins", tables, None, quick_pieces=("pendulum", "air_track"))
