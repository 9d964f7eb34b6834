"""Motion of laws: steps, rollouts, forecasts and fits beside those of the commit before the kernel.

    python benchmarks/speeds/motion.py           rows of the package that is imported, as JSON

Each checkout is measured by a process of its own, with the package of that checkout, on one thread;
this file imports nothing else of the studies. Steps are of a double pendulum with seven
coefficients and derivatives in the state and in all coefficients: smooth, and with dry friction of
both joints, which sticks. Rollouts are of the map of its law: without friction, symplectic to
roundoff, and with dry friction as of a recording's law, smoothed over 1e-4 where no events are
followed. Fits are of the first seconds of measured records: until the law is printed, and until its
bands are known; of the commit before, which printed the law with them, both are one. Forecasts are
of fifty times by these. Fits of whole records of the folder that MEASURED names in the environment
(arm1.csv, arm3.csv, …) stand beside them, each in a process of its own. Drawn recordings (24 s,
600 samples, σ 1e-3, damped) are of 4, 8 and 16 pendulums and of eight masses, with springs between
neighbours, and of a double pendulum, 100,000 samples; each is fitted by a process of its own, whose
peak of memory is told. Times are processor seconds, the least of several calls of what is short;
the first step of a law compiles, with an empty cache."""

from __future__ import annotations

import dataclasses
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is loaded
import jax
import numpy as np
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn
from gfnn_jax.families.lagrangian import Terms
from gfnn_jax.flows.motion import Form
from gfnn_jax.maps.laws import map_of_law, smoothed
from gfnn_jax.maps.sensors import Sensors

try:
    from gfnn_jax.families.friction import DRY, LINEAR, Friction
except ModuleNotFoundError:  # as in OLD
    from gfnn_jax.families.lagrangian import DRY, LINEAR, Friction  # pyright: ignore

OLD = "f45649e9^"  # before laws were followed by compiled code
LANES = (1, 768)
RECORDS = {"pendulum": 60.0, "two_carts": 6.0, "double_pendulum": 3.53}  # seconds of each
# record of a user's folder -> what its columns are, where these do not say so
OF_FOLDER: dict[str, dict[str, Any]] = {
    "arm1": {},
    "arm3": {},
    "silverbox": {"inputs": ["u"], "positions": ["y"]},
    "robot_arm": {
        "positions": ["theta1", "theta2"],
        "inputs": ["tau1", "tau2"],
        "angles": ["theta1", "theta2"],
    },
}
# recording -> (how many coordinates, whether they are angles, the most seconds asked)
DRAWN: dict[str, tuple[int, bool, float]] = {
    "4 pendulums": (4, True, 8.0),
    "8 pendulums": (8, True, 30.0),
    "16 pendulums": (16, True, 120.0),
    "8 masses": (8, False, 60.0),
    "double pendulum": (2, True, 25.0),
}
SECONDS, MILLI, MICRO = ("s", 1.0), ("ms", 1e3), ("µs", 1e6)
MEGABYTES = "MB", 1.0
# row -> (title, its unit, the most it may be)
ROWS: dict[str, tuple[str, tuple[str, float], float | None]] = {
    "first step": ("first step of a law on a machine, compiled", SECONDS, 5.0),
    **{
        f"step, {kind}, {lanes}": (f"step with derivatives, {kind}, lanes: {lanes}", MICRO, None)
        for kind in ("smooth", "dry")
        for lanes in LANES
    },
    "rollout, alone": ("step of a rollout, double pendulum, alone", MICRO, 3.0),
    "rollout, lanes": ("the same, one of 100 lanes", MICRO, 1.0),
    "rollout, dry, alone": ("step of a rollout with dry friction, alone", MICRO, 10.0),
    "rollout, dry, lanes": ("the same, one of 100 lanes", MICRO, 10.0),
    "forecast, pendulum": ("forecast of a recording, pendulum", MILLI, 5.0),
    "forecast, double_pendulum": ("the same, double pendulum", MILLI, 5.0),
    **{
        f"{row}, {name}": (title.format(name), SECONDS, None)
        for name in (*RECORDS, *OF_FOLDER)
        for row, title in (
            ("law", "law of `{}` printed after"),
            ("fit", "fit of `{}`, law and bands"),
        )
    },
    **{
        f"drawn, {name}{what}": (f"{title}: {name}", unit, most)
        for name, (_, _, seconds) in DRAWN.items()
        for what, title, unit, most in (
            ("", "fit of a drawn recording", SECONDS, seconds),
            (", memory", "its peak of memory", MEGABYTES, 1000.0),
        )
    },
}


def double_pendulum(kind: int | None) -> tuple[Form, np.ndarray]:
    """A double pendulum with friction of this kind of both joints, or without."""
    rows = [
        ((2, 0), (0, 0), (0, 0), 0.0),
        ((1, 1), (0, 0), (1, -1), 0.0),
        ((0, 2), (0, 0), (0, 0), 0.0),
        ((0, 0), (0, 0), (1, 0), 0.0),
        ((0, 0), (0, 0), (0, 1), 0.0),
    ]
    joints = [] if kind is None else [((1, 0), kind, 0.0), ((-1, 1), kind, 0.0)]
    form = Form(Terms.of(rows, 2), np.zeros(5), np.eye(5), Friction.of(joints, 2), 0)
    return form, np.array([0.5, 0.4, 0.25, 20.0, 8.0, *[0.3] * len(joints)])


def map_of(kind: int | None) -> Any:
    """The map of its law; with dry friction that of a recording, with sensors."""
    form, p = double_pendulum(kind)
    law = form.lagrangian(p) if kind is None else smoothed(form.lagrangian(p), 1e-4)
    q, v = np.split(np.random.default_rng(0).normal(size=(200, 4)), 2, axis=1)
    found = map_of_law(law, np.concatenate([q, law.momentum(q, v)], axis=1), 0.01, tolerance=1e-6)
    if kind is None:
        return found
    none, lead, sigma = np.zeros((1, 2)), np.array([1.0]), np.full(2, 1e-5)
    sensors = Sensors(("a", "b"), (), (), sigma, 8.0, 1.0, "hold", 0.0, lead, none, creep=1e-4)
    return dataclasses.replace(found, sensors=sensors)


def step_of(form: Form) -> Callable[..., Any]:
    """The step of a form; of commits before the kernel that with events was a function."""
    if hasattr(form, "follow"):
        return form.step
    from gfnn_jax.flows import coulomb  # pyright: ignore[reportAttributeAccessIssue]

    return lambda *arguments: coulomb.step(form, *arguments)


def least(call: Callable[[], object], calls: int) -> float:
    """Processor seconds of the fastest call."""
    times = []
    for _ in range(calls):
        begin = time.process_time()
        call()
        times.append(time.process_time() - begin)
    return min(times)


def measured(quick: bool) -> dict[str, float]:
    """The rows of the package that is imported; quick: no fits."""
    found = {}
    for name, kind in (("smooth", LINEAR), ("dry", DRY)):
        form, p = double_pendulum(kind)
        for lanes in LANES:
            x, h = np.random.default_rng(0).normal(size=(lanes, 4)), np.full(lanes, 0.02)
            x[::3, 2:] *= 0.02
            step = partial(step_of(form), p, x, h, np.zeros((lanes, 1, 6, 0)))
            found.setdefault("first step", least(step, 1))
            found[f"step, {name}, {lanes}"] = least(step, 30) / lanes
    for name, kind, steps in (("", None, 10_000), (", dry", DRY, 1_000)):
        map_, z = map_of(kind), np.array([[0.5, -0.3, 0.0, 0.0]])
        for row, lanes, count in (("alone", 1, steps), ("lanes", 100, steps // 50)):
            many = np.repeat(z, lanes, axis=0) + 1e-3 * np.arange(lanes)[:, None]
            ahead = partial(lambda *a: np.asarray(a[0].rollout(*a[1:])[0]), map_, many, count)
            ahead()
            found[f"rollout{name}, {row}"] = least(ahead, 3) / (lanes * count)
    for name, stop in () if quick else RECORDS.items():
        of = gfnn.records.RECORDS[name]
        recording = gfnn.read(
            gfnn.records.path(name), positions=list(of.positions), angles=list(of.angles)
        ).slice(stop=stop)
        fits = [timed(recording) for _ in range(2)]  # the first one loads what it needs
        found |= {f"{row}, {name}": min(f[row] for _, f in fits) for row in ("law", "fit")}
        fit = fits[-1][0]
        times = stop + 0.02 * np.arange(1, 51)
        found[f"forecast, {name}"] = least(partial(fit.map.forecast, recording, times), 20)
    return found


def timed(recording: gfnn.Recording) -> tuple[Any, dict[str, float]]:
    """A fit, and the seconds until its law was printed and until it ended."""
    begin = time.process_time()
    printed = []

    def note(line: str) -> None:
        if line.startswith("law (its bands follow)"):
            printed.append(time.process_time() - begin)

    fit = gfnn.fit(recording, max_seconds=None, on_progress=note)
    end = time.process_time() - begin
    return fit, {"law": min(printed, default=end), "fit": end}


def of_folder(path: Path) -> dict[str, float]:
    """Seconds of the fit of a whole record, after one that loads what fits need."""
    timed(gfnn.read(gfnn.records.path("pendulum"), positions=["theta"]).slice(stop=20.0))
    fit, seconds = timed(gfnn.read(path, **OF_FOLDER[path.stem]))
    print(getattr(fit, "verdict", ""), fit.law, file=sys.stderr)
    return {f"{row}, {path.stem}": one for row, one in seconds.items()}


def drawn(name: str) -> gfnn.Recording:
    """The drawn recording of this name."""
    d, turns, _ = DRAWN[name]
    rng = np.random.default_rng(0)

    def side_by_side(t: float, x: np.ndarray) -> np.ndarray:
        q, v = x[:d], x[d:]
        between = 0.8 * (np.sin(np.diff(q)) if turns else np.diff(q))
        own = -4 * np.sin(q) if turns else -q
        return np.concatenate([v, own - 0.05 * v + np.diff(between, prepend=0, append=0)])

    def double(t: float, x: np.ndarray) -> np.ndarray:
        (a, b), v = x[:2], x[2:]
        c, s = 0.4 * np.cos(a - b), 0.4 * np.sin(a - b)
        force = [-s * v[1] ** 2 - 20 * np.sin(a), s * v[0] ** 2 - 8 * np.sin(b)]
        return np.concatenate([v, np.linalg.solve([[1.0, c], [c, 0.5]], force - 1e-4 * v)])

    field, end, samples = (double, 1e3, 100_000) if d == 2 else (side_by_side, 24.0, 600)
    t = np.arange(samples) * (end / samples)
    start = np.concatenate([0.8 * rng.normal(size=d), np.zeros(d)])
    q = solve_ivp(field, (0, end), start, t_eval=t, rtol=1e-9, atol=1e-10).y[:d]
    names = [f"q{i + 1}" for i in range(d)]
    columns = dict(zip(names, q + 1e-3 * rng.normal(size=q.shape), strict=True))
    return gfnn.Recording({"t": t, **columns}, positions=names, angles=names if turns else ())


def fitted(name: str) -> dict[str, float]:
    """Seconds of the fit of a drawn recording, and megabytes of this process at its peak."""
    recording = drawn(name)
    begin = time.process_time()
    fit = gfnn.fit(recording, max_seconds=None)
    seconds = time.process_time() - begin
    print(fit.verdict, fit.law, file=sys.stderr)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {f"drawn, {name}": seconds, f"drawn, {name}, memory": peak}


def of_checkout(checkout: Path, quick: bool) -> dict[str, float]:
    """The rows of a checkout's package, in a process of its own that compiles anew."""
    runs = [["--quick"] * quick]
    if not quick and (folder := os.environ.get("MEASURED")):
        paths = [Path(folder).resolve() / f"{name}.csv" for name in OF_FOLDER]
        runs += [[str(path)] for path in paths if path.is_file()]
    if checkout == Path(__file__).resolve().parents[2] and not quick:
        runs += [[name] for name in DRAWN]
    found = {}
    with tempfile.TemporaryDirectory() as cache:
        caches = {"NUMBA_CACHE_DIR": cache, "XDG_CACHE_HOME": cache}  # of either compiler
        environment = {**os.environ, **caches, "PYTHONPATH": str(checkout)}
        for run in runs:
            command = [sys.executable, str(Path(__file__).resolve()), *run]
            done = subprocess.run(
                command, env=environment, stdout=subprocess.PIPE, text=True, check=True
            )
            found |= json.loads(done.stdout.splitlines()[-1])
    return found


def motion(quick: bool) -> dict[str, Any]:
    """The rows now, and, where not quick, of the commit `OLD`: one process after the other."""
    here = Path(__file__).resolve().parents[2]
    found = {"now": of_checkout(here, quick)}
    if quick:
        return found
    with tempfile.TemporaryDirectory() as folder:
        git = partial(subprocess.run, cwd=here, check=True, capture_output=True)
        git(["git", "worktree", "add", "--detach", f"{folder}/old", OLD])
        try:
            return {"before": of_checkout(Path(folder) / "old", quick), **found}
        finally:
            git(["git", "worktree", "remove", "--force", f"{folder}/old"])


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    asked = sys.argv[1:]
    if asked and asked[0].endswith(".csv"):
        rows = of_folder(Path(asked[0]))
    elif asked and asked[0] in DRAWN:
        rows = fitted(asked[0])
    else:
        rows = measured("--quick" in asked)
    print(json.dumps(rows))
