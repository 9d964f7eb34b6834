"""Laws for other programs: how their steps agree with the flow of the law, and what a step takes.

    python benchmarks/machines.py                 pieces without a result, then the table
    python benchmarks/machines.py --only pendulum --overwrite
    python benchmarks/machines.py --robot FILE    robot_arm.csv to MuJoCo too
    python benchmarks/machines.py --quick         few states, into runs/machines, no table

Every law is drawn with coefficients at random within a few percent. Its flow is made by collocation
of 8 stages in 8 substeps, to roundoff: 10⁴ independent single steps, and 100 steps in a row of 20
states. MuJoCo follows chains of links for 1 s by steps of 1 ms. FILE is the record of an arm of two
links moved by motors (Wiebe et al., IEEE RA-L 2024), in absolute angles: its law, of four runs, is
written as MJCF, and MuJoCo moved by the torques of the last run for 0.5 s from its states. A
piece's result is one JSON file, machines-*.json in benchmarks/results; formats whose tool is not
installed are left out.
"""

from __future__ import annotations

import ctypes
import dataclasses
import functools
import importlib
import importlib.util
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

# Sets float64, so it comes before all of JAX.
from harness import SEED, TABLES, Numbers, between_markers, markdown, number, provenance, results
from harness import main as run_pieces

# isort: split
import jax
import numpy as np
import pandas as pd

import gfnn_jax as gfnn
from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.exports.export import SUFFIXES
from gfnn_jax.families.lagrangian import LINEAR, Friction, Lagrangian, Terms
from gfnn_jax.families.terms import given_terms
from gfnn_jax.flows.flow import Flow
from gfnn_jax.maps.domain import covering
from gfnn_jax.maps.inputs import Signals
from gfnn_jax.maps.laws import map_of_law, velocities_of
from gfnn_jax.maps.symplectic_map import SymplecticMap

Law = tuple[SymplecticMap, np.ndarray, np.ndarray | None]  # map, states, args
Steps = Callable[[np.ndarray, np.ndarray | None], np.ndarray]
_NONE = (0, 0)


def _lagrangian(rows, coefficients, friction, losses, dim, **others: Any) -> Lagrangian:
    gains = others.pop("gains", np.zeros((dim, 0)))
    terms, of = Terms.of(rows, dim), Friction.of(friction, dim)
    return Lagrangian(terms, coefficients, of, np.array(losses), 0.0, gains, **others)


def pendulum(rng: np.random.Generator, count: int) -> Law:
    rows = [((2,), (0,), (0,), 0.0), ((0,), (0,), (1,), 0.0)]
    own = _lagrangian(rows, np.array([0.5, 9.0]) * _near(rng, 2), [((1,), LINEAR, 0.0)], [0.05], 1)
    z = rng.uniform(-1, 1, (count, 2)) * [2, 4]
    return map_of_law(own, z, 0.05, tolerance=1e-15), z, None


def double_pendulum(rng: np.random.Generator, count: int) -> Law:
    rows = [
        ((2, 0), _NONE, _NONE, 0.0),
        ((0, 2), _NONE, _NONE, 0.0),
        ((1, 1), _NONE, (1, -1), 0.0),
        (_NONE, _NONE, (1, 0), 0.0),
        (_NONE, _NONE, (0, 1), 0.0),
    ]
    friction = [((1, 0), LINEAR, 0.0), ((-1, 1), LINEAR, 0.0)]
    coefficients = np.array([0.13, 0.04, 0.1, 5.8, 2.1]) * _near(rng, 5)
    own = _lagrangian(rows, coefficients, friction, [0.02, 0.01], 2)
    z = rng.uniform(-1, 1, (count, 4)) * [1, 1, 0.5, 0.2]
    return map_of_law(own, z, 0.01, tolerance=1e-15), z, None


def henon_heiles(rng: np.random.Generator, count: int) -> Law:
    family = given_terms(2, ["p1**2", "p2**2", "q1**2", "q2**2", "q1**2*q2", "q2**3"])
    params = np.array([0.5, 0.5, 0.5, 0.5, 1.0, -1 / 3]) * _near(rng, 6)
    z, size = rng.uniform(-0.3, 0.3, (count, 4)), np.full(4, 0.3)
    flow = Flow(family, params, 0.5, size, 8, 2)
    return SymplecticMap((flow,), CARTESIAN, covering(z), size, np.zeros(0), 0.5), z, None


def driven(rng: np.random.Generator, count: int) -> Law:
    rows = [((2,), (0,), (0,), 0.0), ((0,), (0,), (1,), 0.0), ((0,), (4,), (0,), 0.0)]
    coefficients = np.array([0.5, 4.0, -0.1]) * _near(rng, 3)
    own = _lagrangian(rows, coefficients, [((1,), LINEAR, 0.0)], [0.1], 1, gains=np.ones((1, 1)))
    z, u = rng.uniform(-1, 1, (count, 2)) * [2, 3], rng.normal(size=(count, 1))
    return map_of_law(own, z, 0.05, tolerance=1e-15, signals=Signals(("F",)), inputs=u), z, u


def parametrised(rng: np.random.Generator, count: int) -> Law:
    rows = [((2,), (0,), (0,), 0.0), ((0,), (0,), (1,), 0.0)]
    coefficients = np.array([0.5, 9.0]) * _near(rng, 2)
    powers = ((2,), (1,), (0,))
    own = _lagrangian(rows, coefficients, [((1,), LINEAR, 0.0)], [0.05], 1, powers=powers)
    z, long = rng.uniform(-1, 1, (count, 2)) * [2, 3], rng.uniform(0.5, 2, (count, 1))
    return map_of_law(own, z, 0.05, tolerance=1e-15, parameters=("l",), args=long), z, long


def _near(rng: np.random.Generator, count: int) -> np.ndarray:
    return 1 + 0.05 * rng.uniform(-1, 1, count)


LAWS = {
    "pendulum": pendulum,
    "double-pendulum": double_pendulum,
    "henon-heiles": henon_heiles,
    "driven": driven,
    "parametrised": parametrised,
}
ROBOT = "--robot"
JOINTS, TORQUES = ["theta1", "theta2"], ["tau1", "tau2"]
TERMS = [
    "omega1**2",
    "omega2**2",
    "omega1*omega2*cos(theta1 - theta2)",
    "V: cos(theta1)",
    "V: cos(theta2)",
    "R: abs(omega1)",
    "R: abs(omega1 - omega2)",
    "R: omega1**2",
    "R: (omega1 - omega2)**2",
]
TRAINED, WINDOW, AHEAD = 4, 0.3, 0.5  # runs; s of samples before a start, s followed
CHAINS = ("pendulum", "double-pendulum")
NEEDED = {"c": "cc", "c-taylor": "cc", "js": "node", "casadi": "casadi", "fmu": "fmpy"}


def by_c(path: Path) -> Steps:
    library = path.with_suffix(".so")
    command = ["cc", "-O3", "-std=c99", "-shared", "-fPIC", str(path), "-o", str(library), "-lm"]
    subprocess.run(command, check=True)
    step, pointer = ctypes.CDLL(str(library)).own_step, ctypes.POINTER(ctypes.c_double)

    def steps(z, u):
        found = np.array(z)
        for n, row in enumerate(found):
            given = [] if u is None else [u[n].ctypes.data_as(pointer)]
            step(row.ctypes.data_as(pointer), *given, row.ctypes.data_as(pointer))
        return found

    return steps


def by_javascript(path: Path) -> Steps:
    def steps(z, u):
        given = [[]] * len(z) if u is None else u.tolist()
        file = path.with_suffix(".json")
        file.write_text(json.dumps([z.tolist(), given]))
        script = (
            f"const own = require({str(path)!r});"
            f"const [z, u] = JSON.parse(require('fs').readFileSync({str(file)!r}));"
            "console.log(JSON.stringify(z.map((row, n) => own.step(row, own.dt, u[n]))));"
        )
        done = subprocess.run(["node", "-e", script], capture_output=True, text=True, check=True)
        return np.array(json.loads(done.stdout))

    return steps


def by_jax(path: Path) -> Steps:
    own: dict[str, Any] = {}
    exec(compile(path.read_text(encoding="utf-8"), str(path), "exec"), own)
    step = jax.jit(jax.vmap(own["step"]))
    return lambda z, u: np.asarray(step(z, np.zeros((len(z), 0)) if u is None else u))


def by_casadi(path: Path) -> Steps:
    import casadi

    own = casadi.Function.load(str(path))

    def steps(z, u):
        given = {} if u is None else {"u": u.T}
        return own(z=z.T, **given)["Z"].full().T

    return steps


def by_fmu(path: Path) -> Steps:
    import fmpy
    from fmpy.fmi3 import FMU3Slave

    about, folder = fmpy.read_model_description(str(path)), fmpy.extract(str(path))
    names = {"guid": about.guid, "unzipDirectory": folder, "instanceName": "one"}
    own = FMU3Slave(modelIdentifier="own", **names)
    own.instantiate()
    own.enterInitializationMode(startTime=0.0)
    own.exitInitializationMode()
    numbers = {v.name: v.valueReference for v in about.modelVariables}
    dt = about.defaultExperiment.stepSize

    def steps(z, u):
        states = [numbers[f"{q}{i + 1}"] for q in "qp" for i in range(z.shape[1] // 2)]
        inputs, found = [numbers[name] for name in ("F", "l") if name in numbers], []
        for n, row in enumerate(z):
            own.setFloat64(states, row.tolist())
            if inputs:
                own.setFloat64(inputs, u[n].tolist())
            own.doStep(0.0, float(dt or 0.0))
            found.append(own.getFloat64(states))
        return np.array(found)

    return steps


RUNS = {
    "c": by_c,
    "c-taylor": by_c,
    "js": by_javascript,
    "jax": by_jax,
    "casadi": by_casadi,
    "fmu": by_fmu,
}


def _is_here(to: str) -> bool:
    tool = NEEDED.get(to)
    return tool is None or bool(shutil.which(tool) or importlib.util.find_spec(tool))


def measured(quick: bool, name: str) -> Numbers:
    """Measure every format of one law."""
    singles, starts, row = (200, 4, 20) if quick else (10_000, 20, 100)
    map_, z, args = LAWS[name](np.random.default_rng(SEED), singles)
    exact = dataclasses.replace(map_.pieces[0], stages=8, substeps=8)
    flow = jax.jit(lambda z, u: exact.step(z, u)[0])
    wanted, ahead, u = (
        np.asarray(flow(z, args)),
        z[:starts],
        None if args is None else args[:starts],
    )
    for _ in range(row):
        ahead = np.asarray(flow(ahead, u))
    found: Numbers = {"formats": {}, "dt": float(map_.dt), "states": singles, "in_a_row": row}
    with tempfile.TemporaryDirectory() as folder:
        for to, make in RUNS.items():
            if not _is_here(to):
                continue
            home = Path(folder) / to
            home.mkdir()
            steps = make(gfnn.export(map_, to, home / f"own{SUFFIXES[to]}"))
            steps(z[:starts], u)
            begun = time.process_time()
            once = steps(z, args)
            taken, state = time.process_time() - begun, z[:starts]
            for _ in range(row):
                state = steps(state, u)
            found["formats"][to] = {
                "single": float(np.abs(once - wanted).max()),
                "row": float(np.abs(state - ahead).max()),
                "seconds": taken,
            }
        if "c-taylor" in found["formats"]:
            found["microseconds"] = _alone(Path(folder) / "c-taylor" / "own.so", z, args)
        if name in CHAINS and importlib.util.find_spec("mujoco"):
            for to in ("mjcf", "urdf"):
                path = gfnn.export(map_, to, Path(folder) / f"own{SUFFIXES[to]}")
                found["formats"][to] = {"one_second": _by_mujoco(path, map_, z[:5])}
    return found


def _alone(library: Path, z: np.ndarray, args: np.ndarray | None) -> float:
    """The microseconds of a step of one state, in C alone: the fastest of fifty batches."""
    source = library.with_name("loop.c")
    given = "" if args is None else "u, "
    source.write_text(
        "int own_step();\nvoid loop(const double *z, double *u, double *Z, long n)\n"
        f"{{ for (long i = 0; i < n; i++) own_step(z, {given}Z); }}\n"
    )
    loop = library.with_name("loop.so")
    objects = [str(source), str(library.with_suffix(".c"))]
    command = ["cc", "-O3", "-std=c99", "-shared", "-fPIC", *objects, "-o", str(loop), "-lm"]
    subprocess.run(command, check=True)
    run, pointer = ctypes.CDLL(str(loop)).loop, ctypes.POINTER(ctypes.c_double)
    own = np.zeros(1) if args is None else args[0].copy()
    states = [a.ctypes.data_as(pointer) for a in (z[0].copy(), own, np.empty_like(z[0]))]
    best = np.inf
    for _ in range(50):
        begun = time.perf_counter()
        run(*states, ctypes.c_long(2_000))
        best = min(best, (time.perf_counter() - begun) / 2_000)
    return 1e6 * best


def _by_mujoco(path: Path, map_: SymplecticMap, z: np.ndarray) -> float:
    """The largest difference of positions after a second."""
    mujoco: Any = importlib.import_module("mujoco")
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.timestep, model.opt.integrator = 1e-3, mujoco.mjtIntegrator.mjINT_RK4
    steps, off = round(1 / float(map_.dt)), 0.0
    ends = np.asarray(map_.rollout(z, steps)[0])[:, -1]
    joints = np.tril(np.ones((map_.dim, map_.dim)))  # absolute angles of those of the joints
    for begun, end, v in zip(z, ends, velocities_of(map_, z), strict=True):
        data = mujoco.MjData(model)
        data.qpos[:] = np.linalg.solve(joints, begun[: map_.dim])
        data.qvel[:] = np.linalg.solve(joints, v)
        for _ in range(1_000):
            mujoco.mj_step(model, data)
        off = max(off, float(np.abs(joints @ data.qpos - end[: map_.dim]).max()))
    return off


def robot(quick: bool, path: Path) -> Numbers:
    """A law of the robot arm as MJCF: how far MuJoCo's motion is from the law's own."""
    mujoco: Any = importlib.import_module("mujoco")
    table = pd.read_csv(path)
    table["theta2"] += table["theta1"]
    table = table[["run", "t", "theta1", "theta2", "tau1", "tau2"]]
    roles: dict[str, Any] = {"positions": JOINTS, "angles": JOINTS, "inputs": TORQUES}
    training = table[table["run"] < (1 if quick else TRAINED)]
    fit = gfnn.fit(gfnn.Recording(training, **roles), terms=TERMS)
    map_ = fit.map
    last: Any = table[table["run"] == table["run"].max()]
    dt, t, torques = float(map_.dt), last["t"].to_numpy(), last[TORQUES].to_numpy()
    count, starts, states, inputs = round(AHEAD / dt), np.arange(2.0, 9.0, 0.35), [], []
    for start in starts:
        before = last[(t >= start - WINDOW) & (t <= start)].drop(columns="run")
        states.append(np.asarray(map_.estimate(gfnn.Recording(before, **roles))[0])[0])
        ahead = start + dt * np.arange(count + 1)
        inputs.append(np.stack([np.interp(ahead, t, u) for u in torques.T], axis=1))
    z = np.array(states)
    ends = np.asarray(map_.rollout(z, count, inputs=np.array(inputs))[0])[:, -1]
    with tempfile.TemporaryDirectory() as folder:
        for to in ("mjcf", "urdf"):
            gfnn.export(map_, to, Path(folder) / f"arm{SUFFIXES[to]}")
        model = mujoco.MjModel.from_xml_path(str(Path(folder) / f"arm{SUFFIXES['mjcf']}"))
    step, joints, off = model.opt.timestep, np.tril(np.ones((2, 2))), []
    for start, begun, v, end in zip(starts, z, velocities_of(map_, z), ends, strict=True):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = (np.linalg.solve(joints, x) for x in (begun[:2], v))
        for k in range(round(count * dt / step)):
            data.ctrl[:] = [np.interp(start + (k + 0.5) * step, t, u) for u in torques.T]
            mujoco.mj_step(model, data)
        off.append(np.abs(joints @ data.qpos - end[:2]))
    return {
        "formula": fit.formula,
        "friction": str(fit.friction),
        "ahead": AHEAD,
        "step": step,
        "starts": len(starts),
        "median": 1e3 * float(np.median(off)),
        "largest": 1e3 * float(np.max(off)),
    }


PIECES = {name: functools.partial(measured, name=name) for name in LAWS}


def tables() -> None:
    arm = results({"robot-arm": PIECES["pendulum"]}, "machines")
    for result in arm.values():
        m = result["measured"]
        text = (
            f"The robot arm's law as MJCF, {m['starts']} starts in a run that no fit saw: MuJoCo's "
            f"angles after {m['ahead']} s, at its step of {1e3 * m['step']:g} ms, are "
            f"{number(m['median'])} mrad from the law's own motion in the median and "
            f"{number(m['largest'])} at most (5 asked)."
        )
        between_markers(TABLES, "machines-robot", f"{text}\n\n{provenance(arm)}")
    found = results(PIECES, "machines")
    if not found:
        return
    formats = [*RUNS, "mjcf", "urdf"]
    rows = []
    for name, result in found.items():
        own = result["measured"]["formats"]
        cells = []
        for to in formats:
            one = own.get(to, {})
            shown = [number(one[key]) for key in ("single", "row", "one_second") if key in one]
            cells.append(" / ".join(shown) or "–")
        rows.append([name, *cells, number(result["measured"].get("microseconds"))])
    heads = ["law", *(f"`{to}`" for to in formats), "`c-taylor`, µs a step"]
    between_markers(TABLES, "machines", f"{markdown(heads, rows)}\n\n{provenance(found)}")


def main(argv: Sequence[str] | None = None) -> None:
    arguments = list(sys.argv[1:] if argv is None else argv)
    pieces = dict(PIECES)
    if ROBOT in arguments:
        at = arguments.index(ROBOT)
        pieces["robot-arm"] = functools.partial(robot, path=Path(arguments[at + 1]))
        del arguments[at : at + 2]
    run_pieces(__doc__ or "", pieces, "machines", tables, arguments)


if __name__ == "__main__":
    main()
