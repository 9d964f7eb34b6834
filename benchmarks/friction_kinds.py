"""Which friction a simulated recording shows: positions with noise, of systems whose friction is
known, by an integrator of SciPy. Numbers of the systems in a plane are drawn at random."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np
from harness import Numbers, once
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn

NOISE = 1e-3  # radians
WIDTH = 1e-3  # rad/s, within which dry friction turns over
MIXED = (("linear", "dry"), ("quadratic", "dry"))  # of the first seed, and of the second


class Swings(NamedTuple):
    """A system of angles: masses and force at q, v; its joints (rows of relative speeds) and the
    coefficients of friction there, by kind; the runs' starts, their end and step."""

    masses: Any
    force: Any
    joints: np.ndarray
    losses: dict[str, tuple[float, ...]]
    starts: tuple[tuple[float, ...], ...]
    end: float
    dt: float


def _chain_masses(q):
    c = 0.4 * np.cos(q[0] - q[1])
    return np.array([[1.0, c], [c, 0.5]])


def _chain_force(q, v):
    s = 0.4 * np.sin(q[0] - q[1])
    return np.array([-s * v[1] ** 2 - 20 * np.sin(q[0]), s * v[0] ** 2 - 8 * np.sin(q[1])])


SYSTEMS = {
    "pendulum": Swings(
        lambda q: np.eye(1),
        lambda q, v: -2 * np.sin(q),
        np.eye(1),
        {"linear": (0.03,), "quadratic": (0.03,), "dry": (0.015,)},
        ((1.4, 0.0), (0.6, 0.3)),
        40.0,
        0.05,
    ),
    "double-pendulum": Swings(
        _chain_masses,
        _chain_force,
        np.array([[1.0, 0.0], [-1.0, 1.0]]),
        {"linear": (0.06, 0.03), "quadratic": (0.02, 0.01), "dry": (0.1, 0.05)},
        ((1.5, -0.6, 0.0, 0.0), (-0.8, 1.2, 0.0, 1.0), (0.5, 0.5, 0.0, 0.0)),
        10.0,
        0.02,
    ),
}


def recording(system: Swings, kinds: tuple[str, ...], seed: int, share: float) -> gfnn.Recording:
    """Positions with noise, of runs with these kinds of friction, each at a share of the system's
    coefficients; starts differ by seed."""
    d, rng = len(system.joints[0]), np.random.default_rng(seed)
    t = np.arange(0, system.end, system.dt)

    def rate(_, x):
        q, v = x[:d], x[d:]
        s = system.joints @ v
        pull = np.zeros(len(s))
        for kind in kinds:
            of_speed = {"linear": s, "quadratic": s * abs(s), "dry": s / np.hypot(s, WIDTH)}[kind]
            pull += share * np.array(system.losses[kind]) * of_speed
        return [*v, *np.linalg.solve(system.masses(q), system.force(q, v) - system.joints.T @ pull)]

    tables, names = [], [f"theta{i + 1}" for i in range(d)]
    for run, start in enumerate(system.starts):
        first = np.array(start) * rng.uniform(0.85, 1.15, 2 * d)
        found = solve_ivp(rate, (0, t[-1]), first, t_eval=t, rtol=1e-9, atol=1e-10)
        q = found.y[:d] + NOISE * rng.normal(size=(d, len(t)))
        columns = dict(zip(names, q, strict=True))
        tables.append({"run": np.full(len(t), str(run)), "t": t, **columns})
    return gfnn.Recording(tables, positions=names, angles=names)


def case(system: str, kinds: tuple[str, ...], seed: int) -> Numbers:
    """The friction that is found in one recording, against that which was put in."""
    share = 0.6 if len(kinds) > 1 else 1.0
    record = recording(SYSTEMS[system], kinds, seed, share)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        done = once(lambda: gfnn.fit(record))
    fit = done.out
    expected = {}
    for kind in kinds:
        factor = {"linear": 1 / 2, "quadratic": 1 / 3, "dry": 1.0}[kind]
        for joint, loss in zip(("1", "2 - omega1"), SYSTEMS[system].losses[kind], strict=False):
            expected[kind, joint] = factor * share * loss
    errors = []
    for term, coefficient, std in fit.friction.terms:
        kind = "quadratic" if "**3" in term else "dry" if "abs" in term else "linear"
        joint = "2 - omega1" if "omega2 - omega1" in term else "1" if "omega2" not in term else ""
        errors.append(abs(coefficient - expected.get((kind, joint), 0.0)) / std)
    return {
        "system": system,
        "true": list(kinds),
        "seed": seed,
        "found": list(fit.which_friction.kinds),
        "odds": fit.which_friction.odds,
        "limits": fit.which_friction.limits,
        "text": str(fit.which_friction),
        "standard_errors": max(errors, default=None),
        "friction": {t.term: [t.coefficient, t.std] for t in fit.friction.terms},
        "processor_seconds": done.processor_seconds,
    }


def which(quick: bool) -> Numbers:
    """Two systems, each with linear, quadratic, dry and mixed friction, two recordings each: how
    often the kinds that are found are those that were put in."""
    cases = []
    for name in SYSTEMS:
        for seed in range(1 if quick else 2):
            for kinds in (("linear",), ("quadratic",), ("dry",), MIXED[seed]):
                cases.append(case(name, kinds, seed))
                print(f"  {name} {'+'.join(kinds)}: {cases[-1]['text']}", flush=True)
    return {"cases": cases, "right": sum(c["found"] == c["true"] for c in cases)}


def none(quick: bool) -> Numbers:
    """The same systems without friction: whether any is found, and whether limits hold."""
    cases = []
    for name in SYSTEMS:
        for seed in range(1 if quick else 4):
            cases.append(case(name, (), seed))
            print(f"  {name} without friction: {cases[-1]['text']}", flush=True)
    return {"cases": cases, "reported": sum(bool(c["found"]) for c in cases)}


def _thrown(rng: np.random.Generator) -> tuple[Any, list[np.ndarray], float, float, float]:
    """Acceleration without friction, the runs' states at first, their end and step, and c of the
    drag c |v| v: of balls that are thrown."""
    speed, turn = rng.uniform(5, 12, 3), rng.uniform(0.5, 1.2, 3)
    starts = [
        np.array([0, 0, v * np.cos(a), v * np.sin(a)]) for v, a in zip(speed, turn, strict=True)
    ]
    end = float(1.6 * np.min(speed * np.sin(turn)) / 9.81)
    return lambda q: np.array([0.0, -9.81]), starts, end, end / 60, rng.uniform(0.02, 0.1)


def _around(rng: np.random.Generator, of: Any, size: float) -> Any:
    """The same of one body about the origin."""
    angle = rng.uniform(0, 2 * np.pi)
    out, across = (
        np.array([np.cos(angle), np.sin(angle)]),
        np.array([-np.sin(angle), np.cos(angle)]),
    )
    start = np.concatenate([rng.uniform(0.9, 1.2) * out, rng.uniform(0.8, 1.05) * across])
    period = 2 * np.pi
    return of, [start], 8 * period, period / 40, size * rng.uniform(0.01, 0.05)


def _springs(rng: np.random.Generator) -> Any:
    stiff = np.array([1.0, rng.uniform(1.2, 1.9)])
    return _around(rng, lambda q: -stiff * q, 1.0)


def _orbit(rng: np.random.Generator) -> Any:
    return _around(rng, lambda q: -q / np.linalg.norm(q) ** 3, 0.1)


PLANE = {"thrown balls": _thrown, "springs": _springs, "orbit": _orbit}


def drag_case(name: str, seed: int, drag: bool) -> Numbers:
    """The friction that is found in x, y of a motion with isotropic drag, or without ``drag``."""
    rng = np.random.default_rng([list(PLANE).index(name), seed])
    force, starts, end, dt, c = PLANE[name](rng)
    t, c = np.arange(0, end, dt), c if drag else 0.0

    def rate(_, x):
        return [*x[2:], *(force(x[:2]) - c * np.hypot(x[2], x[3]) * x[2:])]

    runs = [solve_ivp(rate, (0, t[-1]), x, t_eval=t, rtol=1e-10, atol=1e-12).y[:2] for x in starts]
    spread = np.std(np.concatenate(runs, axis=1), axis=1)[:, None]
    tables = []
    for i, q in enumerate(runs):
        x, y = q + NOISE * spread * rng.normal(size=q.shape)
        tables.append({"run": np.full(len(t), str(i)), "t": t, "x": x, "y": y})
    record = gfnn.Recording(tables, positions=["x", "y"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        done = once(lambda: gfnn.fit(record))
    fit = done.out
    terms = fit.friction.terms
    errors = [abs(t.coefficient - c / 3) / t.std for t in terms if t.term.startswith("sqrt(")]
    return {
        "system": name,
        "true": ["isotropic"] * drag,
        "seed": seed,
        "found": list(fit.which_friction.kinds),
        "odds": fit.which_friction.odds,
        "text": str(fit.which_friction),
        "formula": fit.formula,
        "verdict": fit.verdict,
        "standard_errors": max(errors, default=None),
        "friction": {t.term: [t.coefficient, t.std] for t in terms},
        "processor_seconds": done.processor_seconds,
    }


def plane(quick: bool) -> Numbers:
    """Isotropic drag of three systems in a plane, five draws each, and one of each without."""
    cases, none = [], []
    for name in PLANE:
        for seed in range(1 if quick else 5):
            cases.append(drag_case(name, seed, True))
            print(f"  {name}: {cases[-1]['text']}", flush=True)
        none.append(drag_case(name, 100, False))
        print(f"  {name} without friction: {none[-1]['text']}", flush=True)
    right = sum(c["found"] == c["true"] for c in cases)
    return {"cases": cases, "right": right, "none": none}
