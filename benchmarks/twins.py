"""Simulated twins of measured records: whether the law that was put in comes out, with true errors.

    python benchmarks/twins.py            every twin (some twenty minutes of a processor)
    python benchmarks/twins.py --quick    two of them, one draw of the noise

Each twin is integrated by SciPy from its own equations of motion, its dry friction from event to
event (`coulomb_motion`), with coefficients, sampling and
length close to those of the record that it is named for (of the filmed pendulum, the robot arm and
the circuit a part of its length); inputs are held from sample to sample. To its positions noise is
added, from 1e-6 to 1e-2 of their spread. Counted are fits whose formula has exactly the terms and
the kinds of friction that were put in, and coefficients of these that lie within three standard
errors.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Mapping
from functools import cache
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from coulomb_motion import Body
from harness import TABLES, Numbers, between_markers, main, markdown, number, once, results

import gfnn_jax as gfnn

NOISES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)  # of the spread
DRAWS = 1
WITHIN = 3.0  # standard errors


class Twin(NamedTuple):
    """Its equations of motion; the start of each run (q, v), their end and step; the terms of L
    and R as formulas have them, where each angle's zero is its own. inputs: by name their force on
    each coordinate, held from sample to sample; push(rng, t) -> (n, inputs) a run's. inertia: the
    two terms of M₁₁, whose mean over the data is 1 in a fit. wrapped: angles in (−π, π]."""

    body: Body
    starts: tuple[tuple[float, ...], ...]
    end: float
    dt: float
    names: tuple[str, ...]
    angles: tuple[str, ...]
    lagrangian: dict[str, float]
    friction: dict[str, float]
    inputs: Mapping[str, tuple[float, ...]] = MappingProxyType({})
    push: Callable | None = None
    inertia: tuple[str, str] | None = None
    wrapped: bool = False


def along(force: Callable, masses: tuple[float, ...] = (1.0,), dry: tuple[float, ...] = ()) -> Body:
    """Coordinates with masses of their own; dry friction acts on the first of them."""
    rubbed = np.eye(len(masses))[: len(dry)]
    return Body(lambda q: np.diag(masses), force, rubbed, np.array(dry))


def _carts(q, v, u):
    return np.array([-85.6 * q[0] + 77.8 * q[1], -85.4 * q[1] + 77.8 * q[0]])


def links(masses, weights, friction, dry: tuple[float, ...] = ()) -> Body:
    """Of links with angles of their own: L = Σ ½ M_ij v_i v_j cos(q_i − q_j) + Σ c_i cos q_i, the
    M_ij ``masses`` and c_i ``weights``, the forces friction(v), and dry friction in joints."""

    def force(q, v, u):
        return friction(v) - weights * np.sin(q) - (masses * np.sin(q[:, None] - q)) @ v**2

    sizes = np.array(dry)
    directions = (np.eye(len(weights)) - np.eye(len(weights), k=-1))[: len(dry)][sizes > 0]
    return Body(lambda q: masses * np.cos(q[:, None] - q), force, directions, sizes[sizes > 0])


def joints(v, forces):
    """Forces on links of joints, of which each is a function of their relative speeds."""
    push = -np.array([force(s) for force, s in zip(forces, np.diff(v, prepend=0.0), strict=True)])
    return push - np.append(push[1:], 0.0)


_ROD, _REACH, _FAR = 0.33, 0.22, 0.165


def _robot_masses(q):
    """Of two links, the second's angle measured from the first."""
    turning = _REACH * np.cos(q[1])
    across = 2 * _FAR + turning
    return np.array([[2 * _ROD + 2 * turning, across], [across, 2 * _FAR]])


def _robot_force(q, v, u):
    turning, both = _REACH * np.sin(q[1]), 10.5 * np.sin(q[0] + q[1])
    first = turning * v[1] * (2 * v[0] + v[1]) - 14 * np.sin(q[0]) - both + 10 * u[0]
    return np.array([first, -turning * v[0] ** 2 - both + 10 * u[1]])


def multisine(lowest, highest, count, sizes):
    """(n, inputs) at times t of sines of as many frequencies (Hz) as ``count``, their sizes the rms
    of each input."""

    def push(rng, t):
        frequencies = np.linspace(lowest, highest, count)
        phases = rng.uniform(0, 2 * np.pi, (count, len(sizes)))
        waves = np.sin(2 * np.pi * frequencies[:, None] * t[:, None, None] + phases)
        return waves.sum(axis=1) * np.array(sizes) * np.sqrt(2 / count)

    return push


def swings(count, dim, angle, speed, about=0.0):
    """Starts of so many runs, angles and speeds up to these."""
    rng = np.random.default_rng(count)
    q = about + rng.uniform(-angle, angle, (count, dim))
    return tuple(map(tuple, np.concatenate([q, rng.uniform(-speed, speed, (count, dim))], axis=1)))


TWO, THREE = ("theta1", "theta2"), ("theta1", "theta2", "theta3")
TWINS = {
    "pendulum": Twin(
        along(lambda q, v, u: -1.357 * np.sin(q) - 0.012 * v),
        ((1.45, 0.0),),
        57.0,
        1 / 6,
        ("theta",),
        ("theta",),
        {"omega**2": 0.5, "cos(theta)": 1.357},
        {"omega**2": 0.006},
    ),
    "air_track": Twin(
        along(lambda q, v, u: -6.22 * q - 0.014 * v),
        ((100.0, 0.0),),
        17.4,
        1 / 30,
        ("x",),
        (),
        {"v**2": 0.5, "x**2": -3.11},
        {"v**2": 0.007},
    ),
    "two_carts": Twin(
        along(_carts, (1.0, 2.44)),
        ((60.0, -40.0, 0.0, 150.0),),
        9.9,
        1 / 30,
        ("x1", "x2"),
        (),
        {"v1**2": 0.5, "v2**2": 1.22, "x1**2": -42.8, "x1*x2": 77.8, "x2**2": -42.7},
        {},
    ),
    "double_pendulum": Twin(
        links(
            np.array([[1.0, 0.407], [0.407, 0.316]]),
            np.array([62.2, 23.0]),
            lambda v: joints(v, [lambda s: 0.02 * s, lambda s: 0.008 * s]),
        ),
        ((1.3, -1.2, 0.0, 8.0), (-1.0, 0.4, 3.0, 0.0)),
        2.6,
        0.01,
        TWO,
        TWO,
        {
            "omega1**2": 0.5,
            "omega1*omega2*cos(theta1 - theta2)": 0.407,
            "omega2**2": 0.158,
            "cos(theta1)": 62.2,
            "cos(theta2)": 23.0,
        },
        {"omega1**2": 0.01, "(omega2 - omega1)**2": 0.004},
    ),
    "arm1": Twin(
        along(lambda q, v, u: 64.0 * np.sin(q) - 0.0047 * v * abs(v), dry=(0.13,)),
        ((4.7, 0.0), (4.2, 0.0)),
        9.0,
        0.004,
        ("theta",),
        ("theta",),
        {"omega**2": 0.5, "cos(theta)": -64.0},
        {"abs(omega)**3": 0.0047 / 3, "abs(omega)": 0.13},
    ),
    "arm2": Twin(
        links(
            np.array([[1.0, 0.4914], [0.4914, 0.5563]]),
            np.array([-58.9, -27.83]),
            lambda v: -np.array([0.003, 0.002]) * v * abs(v),
            (0.0, 0.056),
        ),
        swings(16, 2, 1.0, 4.0, about=np.pi),
        2.667,
        0.001,
        TWO,
        TWO,
        {
            "omega1**2": 0.5,
            "omega1*omega2*cos(theta1 - theta2)": 0.4914,
            "omega2**2": 0.27815,
            "cos(theta1)": -58.9,
            "cos(theta2)": -27.83,
        },
        {"abs(omega1)**3": 0.001, "abs(omega2)**3": 0.002 / 3, "abs(omega2 - omega1)": 0.056},
    ),
    "arm3": Twin(
        links(
            np.array([[1.0, 0.778, 0.2], [0.778, 0.966, 0.265], [0.2, 0.265, 0.22]]),
            np.array([-58.0, -44.0, -11.3]),
            lambda v: joints(v, [lambda s: 0.0, lambda s: 0.0, lambda s: 0.0006 * s * abs(s)]),
            (0.033, 0.027),
        ),
        swings(12, 3, 0.5, 2.0, about=np.pi),
        1.539,
        0.001,
        THREE,
        THREE,
        {
            "omega1**2": 0.5,
            "omega1*omega2*cos(theta1 - theta2)": 0.778,
            "omega1*omega3*cos(theta1 - theta3)": 0.2,
            "omega2**2": 0.483,
            "omega2*omega3*cos(theta2 - theta3)": 0.265,
            "omega3**2": 0.11,
            "cos(theta1)": -58.0,
            "cos(theta2)": -44.0,
            "cos(theta3)": -11.3,
        },
        {"abs(omega3 - omega2)**3": 0.0002, "abs(omega1)": 0.033, "abs(omega2 - omega1)": 0.027},
    ),
    "video_double_pendulum": Twin(
        links(
            np.array([[1.0, 0.35], [0.35, 0.27]]),
            np.array([105.0, 38.0]),
            lambda v: joints(v, [lambda s: 0.03 * s, lambda s: 0.004 * s]),
        ),
        ((1.95, -0.08, 0.0, 0.0), (2.3, 0.1, 0.0, 0.0)),
        20.0,
        0.0025,
        TWO,
        TWO,
        {
            "omega1**2": 0.5,
            "omega1*omega2*cos(theta1 - theta2)": 0.35,
            "omega2**2": 0.135,
            "cos(theta1)": 105.0,
            "cos(theta2)": 38.0,
        },
        {"omega1**2": 0.015, "(omega2 - omega1)**2": 0.002},
        wrapped=True,
    ),
    "robot_arm": Twin(
        Body(_robot_masses, _robot_force, np.eye(2), np.array([1.4, 0.8])),
        ((0.0,) * 4,) * 3,
        10.0,
        0.002,
        TWO,
        TWO,
        {
            "omega1**2": _ROD,
            "omega1**2*cos(theta2)": _REACH,
            "omega1*omega2*cos(theta2)": _REACH,
            "omega1*omega2": 2 * _FAR,
            "omega2**2": _FAR,
            "cos(theta1)": 14.0,
            "cos(theta1 + theta2)": 10.5,
        },
        {"abs(omega1)": 1.4, "abs(omega2)": 0.8},
        {"tau1": (10.0, 0.0), "tau2": (0.0, 10.0)},
        multisine(0.2, 2.5, 12, (0.4, 0.3)),
        ("omega1**2", "omega1**2*cos(theta2)"),
    ),
    "silverbox": Twin(
        along(lambda q, v, u: -184_200 * q - 734_000 * q**3 - 41 * v + 180_000 * u),
        ((0.0, 0.0),),
        20.0,
        1 / 610.35,
        ("y",),
        (),
        {"y_dot**2": 0.5, "y**2": -92_100.0, "y**4": -183_500.0},
        {"y_dot**2": 20.5},
        {"u": (180_000.0,)},
        multisine(1.0, 200.0, 400, (0.022,)),
    ),
}


@cache
def orbits(name: str, draw: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (n,), positions (runs, d, n) and inputs (runs, n, k) of a twin's runs."""
    twin, rng = TWINS[name], np.random.default_rng(draw)
    t, d = np.arange(0, twin.end, twin.dt), len(twin.names)
    x = np.array(twin.starts) * (1 + 0.02 * draw)
    options = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-11, "max_step": 0.05}
    if twin.push is None:
        q = [twin.body.follow(one, t, **options)[:, :d].T for one in x]
        return t, np.array(q), np.zeros((len(x), len(t), 0))
    u, q = np.array([twin.push(rng, t) for _ in x]), []
    for state, inputs in zip(x, u, strict=True):
        states = [state]
        for k in range(len(t) - 1):
            states.append(twin.body.follow(states[-1], t[k : k + 2], inputs[k], **options)[-1])
        q.append(np.array(states)[:, :d].T)
    return t, np.array(q), u


def recording(name: str, noise: float, draw: int) -> gfnn.Recording:
    """Positions of the twin's runs with noise, a share of their spread, and velocities of none."""
    twin, rng = TWINS[name], np.random.default_rng([draw, round(-np.log10(noise))])
    t, every, inputs = orbits(name, draw)
    spread, tables = every.swapaxes(0, 1).reshape(len(twin.names), -1).std(axis=1), []
    for run, (q, u) in enumerate(zip(every, inputs, strict=True)):
        seen = q + noise * spread[:, None] * rng.normal(size=q.shape)
        if twin.wrapped:
            seen = np.pi - (np.pi - seen) % (2 * np.pi)
        columns = {
            **dict(zip(twin.names, seen, strict=True)),
            **dict(zip(twin.inputs, u.T, strict=True)),
        }
        tables.append({"run": np.full(len(t), str(run)), "t": t, **columns})
    return gfnn.Recording(
        tables, positions=twin.names, angles=twin.angles, inputs=tuple(twin.inputs)
    )


def plain(term: str) -> str:
    """The term without zeros of angles."""
    return re.sub(r" [-+] \d\.?[\d.e-]*\)", ")", term)


def scale_of(twin: Twin, found: dict[str, tuple[float, float]]) -> float:
    """The factor of L as a fit has it: its own terms tell the mean over the data of ∂²L/∂v₁²."""
    if twin.inertia is None or not set(twin.inertia) <= set(found):
        return 1.0
    own, turning = twin.inertia
    mean = (0.5 - found[own][0]) / found[turning][0]
    return 0.5 / (twin.lagrangian[own] + mean * twin.lagrangian[turning])


def case(name: str, noise: float, draw: int) -> Numbers:
    """One fit: whether its terms are those put in, and its errors in standard errors."""
    twin, record = TWINS[name], recording(name, noise, draw)
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
    off, scale = {}, scale_of(twin, found)
    for of, put_in, came_out in (("", twin.lagrangian, found), ("R: ", twin.friction, lost)):
        for term, value in put_in.items():
            c, std = came_out.get(term, (0.0, 0.0))
            if std > 0:
                off[of + term] = abs(c - scale * value) / std
    for u, forces in twin.inputs.items():
        for q, force in zip(twin.names, forces, strict=True):
            gain, std = fit.gains[u][q]
            off[f"gain of {u} on {q}"] = abs(gain - scale * force) / std
    off |= {f"zero of {name}": abs(zero) / std for name, (zero, std) in fit.zeros.items()}
    return {
        "noise": noise,
        "draw": draw,
        "same": same,
        "standard_errors": off,
        "formula": fit.formula,
        "friction": fit.friction.formula,
        "processor_seconds": done.processor_seconds,
    }


def measured(name: str, quick: bool) -> Numbers:
    cases = []
    for noise in NOISES:
        for draw in range(1 if quick else DRAWS):
            cases.append(case(name, noise, draw))
            c = cases[-1]
            worst = max(c["standard_errors"].items(), key=lambda item: item[1], default=("", 0))
            print(
                f"  {noise:g}: {c['same']}, {worst[0]} off by {worst[1]:.1f}; {c['formula']} | "
                f"{c['friction']}; {c['processor_seconds']:.1f} s",
                flush=True,
            )
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
            rows.append(
                [
                    name,
                    f"{noise:g}",
                    f"{sum(c['same']['lagrangian'] for c in cases)} of {len(cases)}",
                    f"{sum(c['same']['friction'] for c in cases)} of {len(cases)}",
                    f"{sum(z <= WITHIN for z in off)} of {len(off)}",
                    number(max(off)),
                    number(seconds),
                ]
            )
    heads = (
        "twin",
        "noise ÷ spread",
        "terms of L exact",
        "friction exact",
        f"within {WITHIN:g} standard errors",
        "largest",
        "CPU s",
    )
    between_markers(TABLES, "twins", markdown(heads, rows))


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "twins", tables, None, quick_pieces=("pendulum", "air_track"))
