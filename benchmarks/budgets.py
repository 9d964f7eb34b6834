"""How well a fit keeps the time that it is given: seconds after the imports ÷ the budget.

    python benchmarks/budgets.py                        what has no result yet, then the table
    python benchmarks/budgets.py --only kepler-30       this one again, with --overwrite
    python benchmarks/budgets.py --quick                one budget of two systems, into runs/budgets

A system that is told nothing (no structure, angles or terms) and a budget of 10, 30 or 120 seconds
make a piece. What is measured is all that ``gfnn fit`` does after its imports: the fit, the report
and the saved model, in a process of its own without any compiled programs. The clock that the fit
looks at, and the seconds, are the processor's: other work on the machine changes these less. In the
pieces "-wall" both are those of the clock on the wall, which other work does change: the load is
kept with them.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

# Sets float64, so it comes before all of JAX.
from harness import HERE, SEED, TABLES, Numbers, between_markers, main, markdown, number, provenance
from harness import results as results_of

# isort: split
import numpy as np
from users.case import box
from users.known import drawn
from users.systems import fput, henon_heiles

import gfnn_jax as gfnn
from gfnn_jax.evaluate import report
from gfnn_jax.learn.fit import fit
from gfnn_jax.maps import saved
from gfnn_jax.phase_space import sizes

BUDGETS = (10, 30, 120)


def toda(z):
    """A ring of exponential springs."""
    q, p = np.split(z, 2)
    bond = np.exp(q - np.roll(q, -1, axis=0))
    return np.concatenate([p, np.roll(bond, 1, axis=0) - bond])


def elastic_pendulum(z):
    """A mass on a spring of length 1 and stiffness 10, hanging from 0, g = 1."""
    q, p = z[:2], z[2:]
    r = np.sqrt(np.sum(q**2, axis=0))
    return np.concatenate([p, -10 * (1 - 1 / r) * q - np.array([[0.0], [1.0]])])


def heavy_top(z):
    """Euler angles φ, θ, ψ; moments of inertia 1, 1 and 2, m g l = 1."""
    _, theta, _, p_phi, p_theta, p_psi = z
    c, s = np.cos(theta), np.sin(theta)
    across = p_phi - p_psi * c
    turn = across / s**2
    force = np.sin(theta) - across * (p_psi * s**2 - across * c) / s**3
    return np.stack([turn, p_theta, p_psi / 2 - turn * c, 0 * c, force, 0 * c])


def kepler(z):
    """A body of unit mass around another, in Cartesian coordinates of the plane."""
    q, p = z[:2], z[2:]
    return np.concatenate([p, -q / np.sum(q**2, axis=0) ** 1.5])


def near(centre: Sequence[float], half: Sequence[float]) -> Callable[[int, int], np.ndarray]:
    """(number, seed) -> states (number, 2d), uniform in a box around the centre."""
    draw = box(half)
    return lambda num, seed: np.asarray(centre) + draw(num, seed)


def orbits(num: int, seed: int) -> np.ndarray:
    """States of ellipses of semi-axes 0.8 to 1.2 and eccentricities up to 0.3."""
    rng = np.random.default_rng([SEED, seed])
    axis, e = rng.uniform(0.8, 1.2, num), rng.uniform(0, 0.3, num)
    f, turn = rng.uniform(0, 2 * np.pi, (2, num))
    r, speed = axis * (1 - e**2) / (1 + e * np.cos(f)), 1 / np.sqrt(axis * (1 - e**2))
    q = np.stack([r * np.cos(f + turn), r * np.sin(f + turn)], axis=1)
    p = [
        -speed * (np.sin(f + turn) + e * np.sin(turn)),
        speed * (np.cos(f + turn) + e * np.cos(turn)),
    ]
    return np.concatenate([q, np.stack(p, axis=1)], axis=1)


SYSTEMS: dict[str, Callable[[], tuple[gfnn.Pairs, gfnn.Pairs]]] = {
    "toda-32": lambda: drawn(toda, box([0.5] * 64), 0.05, 2_000),
    "fput-8": lambda: drawn(fput, box([0.5] * 16), 0.1, 2_000),
    "elastic-pendulum": lambda: drawn(
        elastic_pendulum, near([0.0, -1.1, 0.0, 0.0], [0.3, 0.2, 0.3, 0.3]), 0.2, 2_000
    ),
    "heavy-top": lambda: drawn(
        heavy_top, near([0.0, 1.2, 0.0, 0.5, 0.0, 1.0], [1.0, 0.3, 1.0, 0.2, 0.3, 0.2]), 0.1, 2_000
    ),
    "kepler": lambda: drawn(kepler, orbits, 0.1, 1_800),
    "million-pairs": lambda: drawn(henon_heiles, box([0.3] * 4), 0.3, 1_000_000),
}


CLOCKS = {"processor": time.process_time, "wall": time.perf_counter}


def measured_here(system: str, budget: float, clock_name: str) -> Numbers:
    """The fit, the report and the saved model of a system, with a budget of so many seconds."""
    pairs, fresh = SYSTEMS[system]()
    clock, load = CLOCKS[clock_name], os.getloadavg()[0]
    started, busy = clock(), time.process_time()
    with warnings.catch_warnings(), tempfile.TemporaryDirectory() as folder:
        warnings.simplefilter("ignore", gfnn.FitWarning)  # kept in fit.messages
        found = fit(pairs, seed=SEED, max_seconds=budget, clock=clock)
        fitted = clock() - started
        found = found.settled()
        report.assemble(found)
        reported = clock() - started
        saved.save(found.map, Path(folder) / "model")
    seconds, chosen = clock() - started, found.chosen
    busy = time.process_time() - busy
    error = np.asarray(found.map.step(fresh.z0)[0]) - fresh.z1
    return {
        "budget": budget,
        "clock": clock_name,
        "processor_seconds": busy,
        "load": [load, os.getloadavg()[0]],
        "seconds": seconds,
        "ratio": seconds / budget,
        "fit_seconds": fitted,
        "report_seconds": reported - fitted,
        "chosen": f"{chosen.chart} {chosen.label}",
        "operations": found.operations,
        "max_operations": found.max_operations,
        "claimed": chosen.validation_relative,
        "met": found.met,
        "ended": found.ended,
        "true_error": float(np.sqrt(np.mean((error / sizes(pairs.z0)) ** 2))),
        "messages": list(found.messages),
    }


def measure(system: str, budget: float, clock_name: str, quick: bool) -> Numbers:
    """The same in a process of its own."""
    command = [sys.executable, __file__, "--here", system, str(budget), clock_name]
    environment = os.environ | {"PYTHONPATH": str(HERE.parent)}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    return json.loads(done.stdout.splitlines()[-1])


PIECES = {
    f"{system}-{budget}": partial(measure, system, float(budget), "processor")
    for system in SYSTEMS
    for budget in BUDGETS
} | {
    f"{system}-30-wall": partial(measure, system, 30.0, "wall")
    for system in ("elastic-pendulum", "kepler")
}
QUICK = ("elastic-pendulum-10", "kepler-10")


def _load(measured: Numbers) -> str:
    """Other work during a piece of the wall's clock, by the load average before and after."""
    if measured.get("clock") != "wall":
        return ""
    return " to ".join(f"{load:.1f}" for load in measured["load"])


def tables() -> None:
    """The section of RESULTS.md."""
    found = results_of(PIECES, "budgets")
    if not found:
        return
    heads = [
        "system, budget in s",
        "seconds ÷ budget",
        "load",
        "chosen",
        "claimed",
        "true error",
        "ended",
    ]
    rows = [
        [
            name,
            number(m["ratio"]),
            _load(m),
            m["chosen"],
            number(m["claimed"]),
            number(m["true_error"]),
            m["ended"],
        ]
        for name, m in ((name, result["measured"]) for name, result in found.items())
    ]
    between_markers(TABLES, "budgets", f"{markdown(heads, rows)}\n\n{provenance(found)}")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--here"]:
        print(json.dumps(measured_here(sys.argv[2], float(sys.argv[3]), sys.argv[4])))
    else:
        main(__doc__ or "", PIECES, "budgets", tables, None, QUICK)
