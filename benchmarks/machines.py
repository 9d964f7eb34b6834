"""Laws for other programs: how their steps agree with the flow of the law, and what a step takes.

    python benchmarks/machines.py                 pieces without a result, then the table
    python benchmarks/machines.py --only pendulum --overwrite
    python benchmarks/machines.py --robot FILE    robot_arm.csv to MuJoCo too
    python benchmarks/machines.py --quick         few states, into runs/machines, no table

Every law is drawn with coefficients at random within a few percent. Its flow is made by collocation
of 8 stages in 8 substeps, to roundoff: 10⁴ independent single steps, and 100 steps in a row of 20
states. MuJoCo follows chains of links for 1 s by steps of 1 ms. FILE is the record of an arm of two
links moved by motors (Wiebe et al., IEEE RA-L 2024), in absolute angles: its law, of four runs, is
written as MJCF, and MuJoCo moved by the torques of the last run for 0.5 s from its states; the same
of the double pendulum that comes with the package, which moves freely. swing-up is of one run of
that arm (`notebooks`). A piece's result is one JSON file, machines-*.json in benchmarks/results;
formats whose tool is not installed are left out.
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
from harness import (
    HERE,
    SEED,
    TABLES,
    Numbers,
    between_markers,
    markdown,
    number,
    provenance,
    results,
)
from harness import main as run_pieces

# isort: split
import jax
import numpy as np
import pandas as pd

import gfnn_jax as gfnn
from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.exports import SUFFIXES
from gfnn_jax.families.friction import LINEAR, Friction
from gfnn_jax.families.lagrangian import Lagrangian, Terms
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
    return map_of_law(own, z, 0.05), z, None


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
    return map_of_law(own, z, 0.01), z, None


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
    return map_of_law(own, z, 0.05, signals=Signals(("F",)), inputs=u), z, u


def parametrised(rng: np.random.Generator, count: int) -> Law:
    rows = [((2,), (0,), (0,), 0.0), ((0,), (0,), (1,), 0.0)]
    coefficients = np.array([0.5, 9.0]) * _near(rng, 2)
    powers = ((2,), (1,), (0,))
    own = _lagrangian(rows, coefficients, [((1,), LINEAR, 0.0)], [0.05], 1, powers=powers)
    z, long = rng.uniform(-1, 1, (count, 2)) * [2, 3], rng.uniform(0.5, 2, (count, 1))
    return map_of_law(own, z, 0.05, parameters=("l",), args=long), z, long


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
ROLES: dict[str, Any] = {"positions": JOINTS, "angles": JOINTS, "inputs": TORQUES}
VISCOUS = ["R: omega1**2", "R: (omega1 - omega2)**2"]
TERMS = [
    "omega1**2",
    "omega2**2",
    "omega1*omega2",
    "omega1*omega2*cos(theta1 - theta2)",
    "V: cos(theta1)",
    "V: cos(theta2)",
    "R: abs(omega1)",
    "R: abs(omega1 - omega2)",
    *VISCOUS,
]
LIMIT, PERIOD, LONG = 6.0, 0.01, 10.0  # N m; s, of a torque and of what is followed
SWINGS = {"pendubot": (0, 2.0), "acrobot": (1, 3.0)}  # the joint that has a motor, s of its plan
TRAINED, WINDOW, AHEAD = 4, 0.3, 0.5  # runs; s of samples before a start, s followed
CHAINS = ("pendulum", "double-pendulum")
NEEDED = {"c": "cc", "js": "node", "casadi": "casadi", "fmu": "fmpy"}


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
    # The steps of a law are within its tolerance for most states: these are for all.
    map_ = dataclasses.replace(map_, pieces=(dataclasses.replace(exact, substeps=2),))
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
        if "c" in found["formats"]:
            found["microseconds"] = _alone(Path(folder) / "c" / "own.so", z, args)
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
    """A law of the robot arm's first runs, in absolute angles, as MJCF: how far MuJoCo's motion is
    from the law's own, under the torques of its last run."""
    table: Any = pd.read_csv(path)
    table["theta2"] += table["theta1"]
    table = table[["run", "t", *JOINTS, *TORQUES]]
    training = table[table["run"] < (1 if quick else TRAINED)]
    fit = gfnn.fit(gfnn.Recording(training, **ROLES), terms=TERMS)
    last = table[table["run"] == table["run"].max()].drop(columns="run")
    return _beside_mujoco(fit, gfnn.Recording(last, **ROLES), np.arange(2.0, 9.0, 0.35))


def swings(quick: bool) -> Numbers:
    """The same of the double pendulum that comes with the package, the last third of its record."""
    path = gfnn.records.path("double_pendulum")
    record = gfnn.read(path, angles=JOINTS, positions=JOINTS)
    t = record.times(record.runs[0])
    fit = gfnn.fit(record.slice(stop=t[2 * len(t) // 3]))
    return _beside_mujoco(fit, record, np.linspace(t[2 * len(t) // 3], t[-1] - AHEAD, 22)[1:-1])


def _beside_mujoco(fit: gfnn.Fit, record: gfnn.Recording, starts: np.ndarray) -> Numbers:
    """Forecasts over half a second from states estimated at these times of a record, by the law and
    by MuJoCo from its MJCF, under the inputs of the record."""
    map_, run = fit.map, record.runs[0]
    dt, t = float(map_.dt), record.times(run)
    count, dim, names = round(AHEAD / dt), map_.dim, record.inputs
    states = [map_.estimate(record.slice(start - WINDOW, start))[0] for start in starts]
    z = np.array([np.asarray(state)[0] for state in states])
    ahead = starts[:, None] + dt * np.arange(count + 1)
    u = [np.interp(ahead, t, record.values(name, run)) for name in names]
    given = np.stack(u, axis=-1) if names else None
    own = np.asarray(map_.rollout(z, count, inputs=given)[0])[:, -1, :dim]
    mujoco: Any = importlib.import_module("mujoco")
    with tempfile.TemporaryDirectory() as folder:
        gfnn.export(map_, "urdf", Path(folder) / "own.urdf")
        path = gfnn.export(map_, "mjcf", Path(folder) / "own.xml")
        model = mujoco.MjModel.from_xml_path(str(path))
    steps = int(np.ceil(count * dt / model.opt.timestep))
    model.opt.timestep = count * dt / steps
    rule = map_.signals
    is_linear, delay = (rule.degree > 0, rule.delay) if rule is not None else (True, 0.0)
    joints, ends = np.tril(np.ones((dim, dim))), []  # absolute angles of those of the joints
    for n, (begun, v) in enumerate(zip(z, velocities_of(map_, z), strict=True)):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = (np.linalg.solve(joints, x) for x in (begun[:dim], v))
        for k in range(steps):
            now = (k + 0.5) * model.opt.timestep - delay
            at = now if is_linear else dt * (now // dt)
            data.ctrl[:] = [np.interp(at, ahead[n] - starts[n], row[n]) for row in u]
            mujoco.mj_step(model, data)
        ends.append(joints @ data.qpos)
    read = [np.interp(ahead[:, -1], t, record.unwrapped(name, run)) for name in record.positions]

    def off(found: np.ndarray, others: Any) -> Numbers:
        turned = np.abs(np.angle(np.exp(1j * (found - others))))
        return {"median": 1e3 * float(np.median(turned)), "largest": 1e3 * float(turned.max())}

    return {
        "formula": fit.formula,
        "friction": str(fit.friction),
        "ahead": count * dt,
        "step": model.opt.timestep,
        "starts": len(starts),
        **off(np.array(ends), own),
        "measured": {
            "law": off(own, np.transpose(read)),
            "mujoco": off(np.array(ends), np.transpose(read)),
        },
    }


def swing_up(quick: bool) -> Numbers:
    """Controllers of the law of one run of the robot arm, of one joint each: how many draws of its
    posterior come up and stay, and the designers' plant (`notebooks/swing_up.py`)."""
    sys.path.insert(0, str(HERE.parent / "notebooks"))
    own: Any = importlib.import_module("swing_up")
    table = pd.read_csv(own.RECORD)
    table["theta2"] += table["theta1"]
    record = gfnn.Recording(table, **ROLES)
    fit = gfnn.fit(record, terms=[t for t in TERMS if t not in VISCOUS], input_hold="linear")
    draws, found = 10 if quick else 100, {}
    for name, (joint, seconds) in SWINGS.items():
        begun = time.process_time()
        _, by, margin = own.controller(fit, joint, PERIOD, seconds, LIMIT)
        found[name] = {"seconds": time.process_time() - begun, "margin": margin}
        plants = {
            "draws": (own.draws_of(fit, joint, PERIOD, draws, seed=2), draws),
            "published": (own.designers(joint, PERIOD, True), 1),
            "leaderboard": (own.designers(joint, PERIOD, False), 1),
        }
        for key, (plant, count) in plants.items():
            x, u = own.followed(by, plant, count, LONG, LIMIT)
            since = own.up_from(x, PERIOD)
            is_up = np.isfinite(since)
            found[name][key] = {
                "plants": count,
                "up": int(is_up.sum()),
                "from": float(np.median(since[is_up])) if is_up.any() else None,
                "score": _scored(x[:, is_up], u[:, is_up], since[is_up], joint)
                if is_up.any()
                else None,
            }
    return found


def _scored(x: np.ndarray, u: np.ndarray, since: np.ndarray, joint: int) -> float:
    """The median score of motions that come up, of 1 at most, as `analysis/leaderboard.py` of the
    designers has it for simulations (version 2; torques every 2 ms)."""
    q, v = (np.stack([a[..., 0], a[..., 1] - a[..., 0]], axis=-1) for a in (x[..., :2], x[..., 2:]))
    turned = np.abs(np.diff(q, axis=0)).max(
        axis=-1
    )  # of the joint that moves more: at least its own
    changes = np.diff(np.repeat(u, round(PERIOD / 2e-3), axis=0), axis=0).std(axis=0)
    criteria = [
        (since, 20.0),
        ((turned * np.abs(u)).sum(axis=0), 60.0),
        (PERIOD * (u**2).sum(axis=0), 20.0),
        (changes, 0.1),
        (PERIOD * (v[:-1] ** 2).sum(axis=(0, 2)), 400.0),
    ]
    return float(np.median(1 - np.mean([np.tanh(np.pi * c / n) for c, n in criteria], axis=0)))


PIECES = {name: functools.partial(measured, name=name) for name in LAWS}
RECORDED = {"robot-arm": "a robot arm, torques", "swings": "a double pendulum, free"}


def tables() -> None:
    arm = results(dict.fromkeys(RECORDED, swings), "machines")
    rows = [
        [
            RECORDED[name],
            str(m["starts"]),
            f"{number(m['median'])} / {number(m['largest'])}",
            *(number(m["measured"][own]["median"]) for own in ("law", "mujoco")),
        ]
        for name, m in ((name, result["measured"]) for name, result in arm.items())
    ]
    heads = ["record", "starts", "MuJoCo from the law, median / largest", "law", "MuJoCo"]
    heads[3:] = [f"{own} from what was measured, median" for own in heads[3:]]
    between_markers(TABLES, "machines-robot", f"{markdown(heads, rows)}\n\n{provenance(arm)}")
    for result in (swung := results({"swing-up": swings}, "machines")).values():
        rows = [
            [
                name,
                f"{m['draws']['up']} of {m['draws']['plants']}",
                number(m["draws"]["from"]),
                number(m["draws"]["score"]),
                *("yes" if m[key]["up"] else "no" for key in ("published", "leaderboard")),
                number(m["seconds"]),
            ]
            for name, m in result["measured"].items()
        ]
        heads = ["machine", "draws that come up and stay", "up after, s", "score"]
        heads += ["published plant", "the same without friction", "plan and regulator, CPU s"]
        between_markers(
            TABLES, "machines-swing-up", f"{markdown(heads, rows)}\n\n{provenance(swung)}"
        )
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
    heads = ["law", *(f"`{to}`" for to in formats), "`c`, µs a step"]
    between_markers(TABLES, "machines", f"{markdown(heads, rows)}\n\n{provenance(found)}")


def main(argv: Sequence[str] | None = None) -> None:
    arguments = list(sys.argv[1:] if argv is None else argv)
    pieces: dict[str, Any] = {**PIECES, "swings": swings, "swing-up": swing_up}
    if ROBOT in arguments:
        at = arguments.index(ROBOT)
        pieces["robot-arm"] = functools.partial(robot, path=Path(arguments[at + 1]))
        del arguments[at : at + 2]
    run_pieces(__doc__ or "", pieces, "machines", tables, arguments)


if __name__ == "__main__":
    main()
