"""Laws of states that are no (q, p): the bracket found too, from pairs and from noisy sequences.

    python benchmarks/brackets.py --processor-time     all rows, then the table in RESULTS.md
    python benchmarks/brackets.py --only tops --quick

Pairs are of 20 to 75 runs of 20 steps, right to the last digit, with no more told than
``structure="poisson"``; vortices have the terms log r as well. Errors are on fresh states: of the
field, relative; of a step and of the last one, largest coordinate, in the median over 3 orbits of
1,000 steps, of chaotic systems of 100. Casimirs are followed over 10⁶ steps of one orbit, those of
Toda's chain until its bodies are so far apart that a is 0. Fields without a bracket are ten of
which none may get one; three have uniform friction, which multiplies their bracket.
"""

from __future__ import annotations

import re
import sys
import time
import warnings
from collections.abc import Callable
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
from harness import TABLES, Numbers, between_markers, markdown, number, provenance, results, timed
from harness import main as run_pieces

import gfnn_jax as gfnn

EXTRAPOLATED = 10  # midpoint rules of 2 to 20 parts
INERTIA = np.array([[2.0, 0.1, 0.05], [0.1, 1.5, 0.15], [0.05, 0.15, 1.0]])
INVERSE = np.linalg.inv(INERTIA)
Field = Callable[[np.ndarray], np.ndarray]


def euler(w):
    return INVERSE @ np.cross(INERTIA @ w, w)


def heavy(slope: Callable[[float], float]) -> Field:
    """A top whose potential has this slope along Γ3, and smaller ones along Γ1 and Γ2."""

    def field(z):
        m, g = z[:3], z[3:]
        w = np.array([0.5, 0.6, 1.0]) * m
        return np.concatenate(
            [np.cross(m, w) + np.cross(g, [0.1, 0.2, slope(g[2])]), np.cross(g, w)]
        )

    return field


def spins(z):
    """Four spins on a chain with unequal couplings, in a field."""
    s, bonds = z.reshape(4, 3), np.array([1.0, 0.7, 1.3])
    easy, b = np.array([1.0, 0.8, 1.2]), np.tile(np.array([0.1, 0.2, 0.3], z.dtype), (4, 1))
    b[:-1] += bonds[:, None] * easy * s[1:]
    b[1:] += bonds[:, None] * easy * s[:-1]
    return np.cross(s, b).ravel()


def populations(matrix, rest) -> Field:
    return lambda z: z * (np.array(matrix) @ (z - rest))


def vortices(circulations) -> Field:
    g = np.array(circulations)

    def field(z):
        x, y = np.split(z, 2)
        dx, dy = x[:, None] - x, y[:, None] - y
        square = dx**2 + dy**2 + np.eye(len(g))
        return np.concatenate([-(g * dy / square).sum(axis=1), (g * dx / square).sum(axis=1)])

    return field


def toda(z):
    """Toda's chain of four bodies by Flaschka's a and b."""
    a, b = z[:3], z[3:]
    return np.concatenate([a * np.diff(b), 2 * np.diff([0.0, *a**2, 0.0])])


def charged(z):
    b = 1 + 0.4 * z[0]
    return np.array([z[2], z[3], b * z[3] - z[0], -b * z[2] - 0.7 * z[1]])


def normal(size: int, factor: float = 1.0):
    return lambda rng: factor * rng.normal(size=size)


def positive(size: int):
    return lambda rng: rng.uniform(0.5, 1.5, size)


def apart(bodies: int):
    """Positions of vortices that are no closer than 0.8."""

    def draw(rng):
        while True:
            z = 1.2 * rng.normal(size=2 * bodies)
            x, y = np.split(z, 2)
            if all(
                np.hypot(x[i] - x[j], y[i] - y[j]) > 0.8 for i, j in combinations(range(bodies), 2)
            ):
                return z

    return draw


def unit_gravity(rng):
    g = rng.normal(size=3)
    return np.concatenate([rng.normal(size=3), g / np.linalg.norm(g) * rng.uniform(0.7, 1.2)])


def chain(rng):
    return np.concatenate([rng.uniform(0.3, 1.0, 3), 0.5 * rng.normal(size=4)])


CIRCULAR = [[0, 1, 0, -0.9], [-1, 0, 0.7, 0], [0, -0.7, 0, 1.3], [0.9, 0, -1.3, 0]]
TWICE = [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, -0.8], [0, 0, 0.7, 0]]
# name -> field, states, dt, runs, the bracket's name, the given terms
SYSTEMS: dict[str, tuple[Field, Any, float, int, str]] = {
    "free top, full inertia": (euler, normal(3), 0.2, 20, "so(3)"),
    "heavy top": (heavy(lambda x: 0.9), normal(6), 0.2, 30, "se(3)"),
    "four spins": (spins, normal(12, 0.7), 0.2, 75, "so(3)⁴"),
    "predators and prey": (
        populations([[0, -1], [1, 0]], 1.0),
        positive(2),
        0.3,
        20,
        "log-canonical",
    ),
    "two pairs of them": (populations(TWICE, 1.0), positive(4), 0.3, 40, "log-canonical"),
    "four in a circle": (populations(CIRCULAR, 1.0), positive(4), 0.2, 40, "log-canonical"),
    "rock, paper, scissors, unequal": (
        populations([[0, 1, -1.4], [-1, 0, 0.7], [1.4, -0.7, 0]], 0.0),
        positive(3),
        0.2,
        20,
        "log-canonical",
    ),
    "three vortices": (vortices([1, 0.6, -0.8]), apart(3), 0.2, 20, "constant"),
    "four vortices": (vortices([1, 0.6, 0.8, 1.3]), apart(4), 0.2, 20, "constant"),
    "Toda's chain by Flaschka": (toda, chain, 0.2, 75, "aff(1)³ + R"),
    "charge, field 1 + 0.4 x": (charged, normal(4, 0.7), 0.2, 40, "canonical by p = m v + A(x)"),
    "top, V = 1/(1.5 + Γ3)": (heavy(lambda x: -1 / (1.5 + x) ** 2), unit_gravity, 0.2, 30, "se(3)"),
    "top, V = exp Γ3": (heavy(np.exp), unit_gravity, 0.2, 30, "se(3)"),
    "top, V = cos 2Γ3": (heavy(lambda x: -2 * np.sin(2 * x)), unit_gravity, 0.2, 30, "se(3)"),
    "top, V = √(2 + Γ3²)": (
        heavy(lambda x: x / np.sqrt(2 + x * x)),
        unit_gravity,
        0.2,
        30,
        "se(3)",
    ),
}


CHAOTIC = {
    "four spins",
    "heavy top",
    "four vortices",
    *(name for name in SYSTEMS if name.startswith("top,")),
}


def damped_top(w):
    return euler(w) - np.array([0.05, 0.15, 0.3]) * w


def dry_top(w):
    return euler(w) - 0.1 * np.tanh(20 * w)


def food_chain(z):
    x, y, w = z
    eaten, more = 1.7 * x * y / (1 + 1.5 * x), 0.5 * y * w / (1 + 0.8 * y)
    return np.array([x * (1 - x) - eaten, eaten - more - 0.2 * y, more - 0.1 * w])


WITHOUT: dict[str, tuple[Field, Any, float]] = {
    "Lorenz": (
        lambda z: (
            0.2
            * np.array([10 * (z[1] - z[0]), z[0] * (28 - z[2]) - z[1], z[0] * z[1] - 8 / 3 * z[2]])
        ),
        lambda rng: 8 * rng.normal(size=3) + [0, 0, 20],
        0.1,
    ),
    "Van der Pol": (lambda z: np.array([z[1], (1 - z[0] ** 2) * z[1] - z[0]]), normal(2), 0.2),
    "food chain with saturation": (food_chain, positive(3), 0.2),
    "top, dry friction": (dry_top, normal(3), 0.2),
    "top, unequal friction": (damped_top, normal(3), 0.2),
    "Rössler": (
        lambda z: np.array([-z[1] - z[2], z[0] + 0.2 * z[1], 0.2 + z[2] * (z[0] - 2.0)]),
        normal(3),
        0.1,
    ),
    "Brusselator": (
        lambda z: np.array([1 + z[0] ** 2 * z[1] - 3 * z[0], 2 * z[0] - z[0] ** 2 * z[1]]),
        positive(2),
        0.2,
    ),
    "FitzHugh–Nagumo": (
        lambda z: np.array([z[0] - z[0] ** 3 / 3 - z[1] + 0.5, 0.3 * (z[0] + 0.7 - 0.8 * z[1])]),
        normal(2),
        0.2,
    ),
    "competition": (
        populations([[-1, -0.5, -0.3], [-0.2, -1, -0.6], [-0.7, -0.4, -1]], 0.6),
        positive(3),
        0.2,
    ),
    "Halvorsen": (
        lambda z: 0.2 * (-1.4 * z - 4 * np.roll(z, -1) - 4 * np.roll(z, -2) - np.roll(z, -1) ** 2),
        normal(3),
        0.1,
    ),
}


def orbit(field: Field, start: np.ndarray, dt: float, steps: int) -> np.ndarray:
    """States (steps + 1, n) of one run, by Gragg's extrapolation to order 20 in the platform's
    longest floats: what is left after rounding to float64 is less than its last digit."""
    z = np.asarray(start, np.longdouble)
    states, squares = [z], np.arange(2, 2 * EXTRAPOLATED + 2, 2, dtype=np.longdouble) ** 2
    for _ in range(steps):
        table = []
        for j in range(1, EXTRAPOLATED + 1):
            h = np.longdouble(dt) / (2 * j)
            before, now = z, z + h * field(z)
            for _ in range(2 * j - 1):
                before, now = now, before + 2 * h * field(now)
            row = [0.5 * (before + now + h * field(now))]
            for k, last in enumerate(table):
                row.append(row[k] + (row[k] - last) / (squares[j - 1] / squares[j - 2 - k] - 1))
            table = row
        z = table[-1]
        states.append(z)
    return np.array(states, float)


def pairs_of(runs: list[np.ndarray], dt: float, names: tuple[str, ...] = ()) -> gfnn.Pairs:
    z0, z1 = np.concatenate([r[:-1] for r in runs]), np.concatenate([r[1:] for r in runs])
    run = np.repeat(np.arange(len(runs)), [len(r) - 1 for r in runs])
    return gfnn.Pairs(z0, z1, dt, run=run, structure="poisson", names=names)


def learned(pairs: gfnn.Pairs, **options: Any) -> tuple[gfnn.Fit, float]:
    """A fit, and the processor's seconds."""
    started = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fit = gfnn.fit(pairs, max_seconds=None, **options)
    return fit, time.process_time() - started


def of_system(name: str, quick: bool) -> Numbers:
    """Everything about one system with a bracket."""
    field, draw, dt, count, expected = SYSTEMS[name]
    rng = np.random.default_rng(0)
    runs = [orbit(field, draw(rng), dt, 20) for _ in range(count)]
    names, options = (), {}
    if "vortices" in name:
        bodies = range(1, runs[0].shape[1] // 2 + 1)
        names = tuple(f"{axis}{i}" for axis in "xy" for i in bodies)
        squares = (f"log((x{i} - x{j})**2 + (y{i} - y{j})**2)" for i, j in combinations(bodies, 2))
        options = {"terms": list(squares)}
    fit, seconds = learned(pairs_of(runs, dt, names), **options)
    assert fit.bracket is not None
    fresh, steps = [draw(rng) for _ in range(3)], 100 if quick or name in CHAOTIC else 1000
    states = np.array(fresh)
    rates = np.array([field(z) for z in fresh])
    reference = np.array([orbit(field, z, dt, steps) for z in fresh])
    rollout = np.asarray(fit.map.rollout(states, steps)[0])
    flow = fit.map.pieces[0]
    off = np.abs(rollout - reference).max(axis=2)
    own = fit.bracket.matrix(states) @ gradient_of(fit, states)[..., None]
    one = timed(lambda: fit.map.rollout(states[0], 10_000, save_every=10_000)[0])
    count_of = 10_000 if quick else 100_000 if one.seconds > 0.08 else 1_000_000
    long = np.asarray(fit.map.rollout(states[0], count_of, save_every=1_000)[0])
    drift = [np.nanmax(np.abs(c(long) / c(long)[0] - 1)) for c in fit.casimirs]
    return {
        "system": name,
        "pairs": 20 * count,
        "expected": expected,
        "found": fit.bracket.name,
        "law": str(fit.law),
        "field": float(np.abs(own[..., 0] - rates).max() / np.abs(rates).max()),
        "one_step": float(np.median(off[:, 1])),
        "last": float(np.median(off[:, -1])),
        "casimirs": float(max(drift)) if drift else None,
        "defect": fit.symplecticity_defect,
        "microseconds": 1e6 * one.seconds / 10_000,
        "substeps": getattr(flow, "substeps", None),
        "cpu_seconds": seconds,
    }


def gradient_of(fit: gfnn.Fit, z: np.ndarray) -> np.ndarray:
    """∇H (N, n) of a law."""
    law = fit.map.pieces[0]
    family = getattr(law.family, "family", law.family)
    return family.gradient(np.asarray(law.params), z)


def without(quick: bool) -> Numbers:
    """What is said of fields without a bracket."""
    found = {}
    for name, (field, draw, dt) in list(WITHOUT.items())[: 3 if quick else None]:
        rng = np.random.default_rng(0)
        runs = [orbit(field, draw(rng), dt, 20) for _ in range(40)]
        try:
            fit, _ = learned(pairs_of(runs, dt))
            found[name] = f"claimed: {fit.bracket}; {fit.verdict}"
        except gfnn.FitError as error:
            found[name] = error.verdict
    return found


def noisy(quick: bool) -> Numbers:
    """Sequences with noise of 1e-3 on every number."""
    found = {}
    cases = {
        "gyroscope": (euler, normal(3), 6, 400),
        "heavy top": (SYSTEMS["heavy top"][0], normal(6), 20, 200),
    }
    for name, (field, draw, count, steps) in cases.items():
        for seed in range(1 if quick else 3):
            rng = np.random.default_rng(seed)
            runs = [orbit(field, draw(rng), 0.05, steps) for _ in range(count)]
            runs = [r + 1e-3 * rng.normal(size=r.shape) for r in runs]
            fit, seconds = learned(pairs_of(runs, 0.05))
            assert fit.bracket is not None
            fresh = np.array([draw(rng) for _ in range(20)])
            last = np.array([orbit(field, z, 0.05, 100)[-1] for z in fresh])
            off = np.linalg.norm(np.asarray(fit.map.rollout(fresh, 100)[0])[:, -1] - last, axis=1)
            long = np.asarray(fit.map.rollout(fresh[:5], 20_000, save_every=200)[0])
            casimir = (
                np.sum((long @ INERTIA) ** 2, -1)
                if name == "gyroscope"
                else np.sum(long[..., 3:] ** 2, -1)
            )
            found[f"{name}, seed {seed}"] = {
                "found": fit.bracket.name,
                "verdict": fit.verdict,
                "step_100": float(np.sqrt(np.mean(off**2))),
                "step_100_median": float(np.median(off)),
                "casimir": float(np.median(np.abs(casimir / casimir[:, :1] - 1).max(axis=1))),
                "cpu_seconds": seconds,
            }
    return found


def resisted(field: Field, rates: list[float]) -> Field:
    """A field with friction beside it."""
    return lambda z: field(z) - np.array(rates) * z


DAMPED = {  # λ is 0.05
    "free top": (resisted(euler, [0.05] * 3), *SYSTEMS["free top, full inertia"][1:4]),
    "heavy top, Π damped": (
        resisted(SYSTEMS["heavy top"][0], [0.05] * 3 + [0] * 3),
        *SYSTEMS["heavy top"][1:4],
    ),
    "Toda's chain": (resisted(toda, [0] * 3 + [0.05] * 4), chain, 0.2, 75),
}


def damped(quick: bool) -> Numbers:
    """Uniform friction: its rate, and errors on fresh states."""
    found = {}
    for name, (field, draw, dt, count) in list(DAMPED.items())[: 1 if quick else None]:
        rng = np.random.default_rng(0)
        fit, seconds = learned(
            pairs_of([orbit(field, draw(rng), dt, 20) for _ in range(count)], dt)
        )
        assert fit.bracket is not None
        fresh = np.array([draw(rng) for _ in range(3)])
        reference = np.array([orbit(field, z, dt, 100) for z in fresh])
        off = np.abs(np.asarray(fit.map.rollout(fresh, 100)[0]) - reference).max(axis=2)
        found[name] = {
            "found": fit.bracket.name,
            "rate": -float(np.log(float(fit.map.multiplier() or 1.0))) / dt,
            "one_step": float(np.median(off[:, 1])),
            "last": float(np.median(off[:, -1])),
            "defect": fit.symplecticity_defect,
            "cpu_seconds": seconds,
        }
    return found


def damped_noisy(quick: bool) -> Numbers:
    """Uniform friction of sequences with noise of 1e-3: tops of random inertia and rate."""
    found = {}
    for seed in range(1 if quick else 5):
        rng = np.random.default_rng(seed)
        turn, rate = np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.uniform(0.02, 0.15)
        inertia = turn @ np.diag(rng.uniform(1, 2.5, 3)) @ turn.T

        def field(w, inertia=inertia, rate=rate):
            return np.linalg.inv(inertia) @ np.cross(inertia @ w, w) - rate * w

        runs = [orbit(field, rng.normal(size=3), 0.05, 400) for _ in range(6)]
        runs = [r + 1e-3 * rng.normal(size=r.shape) for r in runs]
        fit, seconds = learned(pairs_of(runs, 0.05))
        assert fit.bracket is not None
        fresh = rng.normal(size=(20, 3))
        last = np.array([orbit(field, z, 0.05, 100)[-1] for z in fresh])
        off = np.linalg.norm(np.asarray(fit.map.rollout(fresh, 100)[0])[:, -1] - last, axis=1)
        own = -float(np.log(float(fit.map.multiplier() or 1.0))) / 0.05
        found[f"free top, seed {seed}"] = {
            "found": fit.bracket.name,
            "verdict": fit.verdict,
            "rate_off": abs(own / rate - 1),
            "step_100": float(np.sqrt(np.mean(off**2))),
            "cpu_seconds": seconds,
        }
    return found


def varied_top(of_moment: bool) -> Field:
    """A heavy top whose third moment, or whose gravity, is the last state, and stays."""

    def field(z):
        m, g, one = z[:3], z[3:6], np.ones_like(z[6])
        moment, pull = (z[6], one) if of_moment else (one, z[6])
        w = m * np.array([0.5 * one, 0.6 * one, 1 / moment])
        turned = np.cross(m, w) + pull * np.cross(g, [0.1, 0.2, 0.9])
        return np.concatenate([turned, np.cross(g, w), [0 * one]])

    return field


def driven_spin(z):
    """A spin in a field that turns with the period 7.5; the time is the last state."""
    field = np.array([0.3, 0.4 * np.cos(2 * np.pi * z[3] / 7.5), 0.2])
    return np.append(np.cross(z[:3], field + np.array([1.0, 0.5, 0.2]) * z[:3]), 1.0)


VARIED = {  # the last state is a parameter, or the time of a drive
    "heavy top, its moment a parameter": (varied_top(True), 6, {"m": (0.5, 1.5)}),
    "heavy top, gravity a parameter": (varied_top(False), 6, {"m": (0.5, 1.5)}),
    "driven spin": (driven_spin, 3, {"t": (0.0, 30.0)}),
}


def varied(quick: bool) -> Numbers:
    """Laws that depend on a parameter of each run, or on the time: errors on fresh systems."""
    found = {}
    for name, (field, n, beside) in list(VARIED.items())[: 1 if quick else None]:
        rng, ((key, limits),) = np.random.default_rng(0), beside.items()

        def draw(rng, n=n, limits=limits):
            return np.append(rng.normal(size=n), rng.uniform(*limits))

        runs = [orbit(field, draw(rng), 0.2, 20) for _ in range(40)]
        z0, z1 = (np.concatenate([r[k : k + 20] for r in runs]) for k in (0, 1))
        known: dict[str, Any] = {"args": {key: z0[:, n]}}
        known = {"t0": z0[:, n], "period": 7.5} if key == "t" else known
        known |= {"run": np.repeat(np.arange(40), 20), "structure": "poisson"}
        fit, seconds = learned(gfnn.Pairs(z0[:, :n], z1[:, :n], 0.2, **known))
        assert fit.bracket is not None
        fresh = np.array([draw(rng) for _ in range(3)])
        reference = np.array([orbit(field, z, 0.2, 100) for z in fresh])[..., :n]
        own: dict[str, Any] = {"params": {key: fresh[:, n]}}
        own = {"t0": fresh[:, n]} if key == "t" else own
        off = np.abs(np.asarray(fit.map.rollout(fresh[:, :n], 100, **own)[0]) - reference)
        found[name] = {
            "found": fit.bracket.name,
            "law": str(fit.law),
            "one_step": float(np.median(off.max(axis=2)[:, 1])),
            "last": float(np.median(off.max(axis=2)[:, -1])),
            "defect": fit.symplecticity_defect,
            "cpu_seconds": seconds,
        }
    return found


def piece_of(name: str) -> str:
    """Name of a system's piece: letters, digits and hyphens."""
    return re.sub("[^a-z0-9]+", "-", name.lower()).strip("-")


PIECES = {piece_of(name): partial(of_system, name) for name in SYSTEMS}
PIECES |= {"without": without, "damped": damped, "varied": varied, "noisy": noisy}
PIECES |= {"damped-noisy": damped_noisy}


def tables() -> None:
    found = results(PIECES, "brackets")
    rows = [
        [
            m["system"],
            number(m["pairs"]),
            m["found"],
            *(
                number(m[key])
                for key in (
                    "field",
                    "one_step",
                    "last",
                    "casimirs",
                    "defect",
                    "microseconds",
                    "cpu_seconds",
                )
            ),
        ]
        for result in found.values()
        if "system" in (m := result["measured"])
    ]
    heads = (
        "system",
        "pairs",
        "bracket found",
        "field",
        "one step",
        "last step",
        "Casimirs, 10⁶ steps",
        "defect",
        "µs/step",
        "fit, CPU s",
    )
    text = markdown(heads, rows)
    if "without" in found:
        said = [[name, verdict] for name, verdict in found["without"]["measured"].items()]
        text += "\n\n" + markdown(("field without a bracket", "what is said"), said)
    if "damped" in found:
        keys = ("one_step", "last", "defect", "cpu_seconds")
        said = [
            [name, m["found"], f"{m['rate'] - 0.05:.0e}", *(number(m[key]) for key in keys)]
            for name, m in found["damped"]["measured"].items()
        ]
        heads = (
            "uniform friction, λ = 0.05",
            "bracket",
            "λ off by",
            "one step",
            "step 100",
            "defect",
            "fit, CPU s",
        )
        text += "\n\n" + markdown(heads, said)
    if "varied" in found:
        keys = ("one_step", "last", "defect", "cpu_seconds")
        said = [
            [name, m["found"], m["law"], *(number(m[key]) for key in keys)]
            for name, m in found["varied"]["measured"].items()
        ]
        heads = ("parameters and a drive", "bracket", "H", "one step", "step 100", "defect")
        text += "\n\n" + markdown((*heads, "fit, CPU s"), said)
    if "noisy" in found:
        said = [
            [
                name,
                m["found"],
                m["verdict"].partition(":")[0],
                *(
                    number(m[key])
                    for key in ("step_100", "step_100_median", "casimir", "cpu_seconds")
                ),
            ]
            for name, m in found["noisy"]["measured"].items()
        ]
        heads = (
            "sequences, σ 10⁻³",
            "bracket",
            "verdict",
            "step 100, RMS",
            "median",
            "true Casimir off, 20,000 steps",
            "CPU s",
        )
        text += "\n\n" + markdown(heads, said)
    if "damped-noisy" in found:
        keys = ("rate_off", "step_100", "cpu_seconds")
        said = [
            [name, m["found"], m["verdict"].partition(":")[0], *(number(m[key]) for key in keys)]
            for name, m in found["damped-noisy"]["measured"].items()
        ]
        heads = ("friction, σ 10⁻³", "bracket", "verdict", "λ off by, relative", "step 100, RMS")
        text += "\n\n" + markdown((*heads, "CPU s"), said)
    between_markers(TABLES, "brackets", f"{text}\n\n{provenance(found)}")


if __name__ == "__main__":
    run_pieces(__doc__ or "", PIECES, "brackets", tables, sys.argv[1:], ("heavy-top", "without"))
