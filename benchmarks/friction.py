"""Friction: H with uniform or linear friction from clean pairs, and systems without any.

    python benchmarks/friction.py            every row (about eight minutes on two cores)
    python benchmarks/friction.py --quick    two of them

Each row learns from 200 pairs of a system whose law is known, and judges by states that no fit has
seen: the one-step error, the coefficients of H and of friction, the defect ‖AᵀJA − μJ‖ of the
executed step where a multiplier μ is claimed, and the energy along 1,000 steps beside that of
another integrator, in units of its start. Of systems that keep their energy: whether friction is
reported. Of simulated recordings of positions with noise 1e-3 (`friction_kinds`): which kinds of
friction are found.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import friction_kinds
import numpy as np
from harness import (
    SEED,
    TABLES,
    Numbers,
    between_markers,
    main,
    markdown,
    number,
    once,
    provenance,
    results,
)
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn
from gfnn_jax.families.friction import Friction
from gfnn_jax.families.lagrangian import Lagrangian, Terms
from gfnn_jax.flows.legendre import Legendre
from gfnn_jax.phase_space import apply_j

PAIRS, FRESH, STEPS = 200, 100, 1_000
TOLERANCE = 1e-10
NOISES = (0.0, 1e-5)  # of the systems that keep their energy


class System(NamedTuple):
    """field(z) -> ż without friction; states(rng, count) (count, 2d); H's terms; options of a fit.

    loss: "uniform", "velocities" (½c|v|², v from ``velocity``) or "" for none, at this rate.
    """

    field: Callable
    states: Callable
    dt: float
    terms: dict[str, float]
    options: Any = None
    loss: str = ""
    rate: float = 0.0
    velocity: Callable | None = None


def box(size: float, dim: int) -> Callable:
    return lambda rng, count: rng.uniform(-size, size, (count, 2 * dim))


def henon_heiles(z):
    q1, q2, p1, p2 = z
    return np.array([p1, p2, -q1 - 2 * q1 * q2, -q2 - q1**2 + q2**2])


HENON_HEILES = {"q1²": 0.5, "q2²": 0.5, "p1²": 0.5, "p2²": 0.5, "q1² q2": 1.0, "q2³": -1 / 3}


def with_masses(z, magnetic: float = 0.0):
    """½(1 + 0.4 q₂)(p₁ + B q₂)² + ½p₂² + ½|q|² + q₁²q₂ − ⅓q₂³."""
    q1, q2, p1, p2 = z
    kinetic, mass = p1 + magnetic * q2, 1 + 0.4 * q2
    v1 = mass * kinetic
    push2 = -q2 - q1**2 + q2**2 - 0.2 * kinetic**2 - magnetic * v1
    return np.array([v1, p2, -q1 - 2 * q1 * q2, push2])


def masses_of(magnetic: float) -> dict[str, float]:
    b = magnetic
    found = {
        "q1²": 0.5,
        "q2²": 0.5 + 0.5 * b**2,
        "p1²": 0.5,
        "p2²": 0.5,
        "q1² q2": 1.0,
        "q2³": -1 / 3 + 0.2 * b**2,
        "q2 p1²": 0.2,
    }
    return found | ({"q2 p1": b, "q2² p1": 0.4 * b} if b else {})


def kepler(z):
    r = np.hypot(z[0], z[1])
    return np.array([z[2], z[3], *(-z[:2] / r**3)])


def near_circles(rng, count: int):
    angle, r = rng.uniform(0, 2 * np.pi, count), rng.uniform(0.8, 1.3, count)
    speed = rng.uniform(0.8, 1.1, count) / np.sqrt(r)
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([r * c, r * s, -speed * s, speed * c], axis=1)


def swings(rng, count: int):
    return np.stack([rng.uniform(-2.5, 2.5, count), rng.uniform(-1, 1, count)], axis=1)


NONE = (0, 0)
RODS = Lagrangian(
    Terms.of(
        [
            ((2, 0), NONE, NONE, 0.0),
            ((0, 2), NONE, NONE, 0.0),
            ((1, 1), NONE, (1, -1), 0.0),
            (NONE, NONE, (1, 0), 0.0),
            (NONE, NONE, (0, 1), 0.0),
        ],
        2,
    ),
    np.array([1.0, 0.5, 1.0, 2.0, 1.0]),
    Friction.of([], 2),
    np.zeros(0),
    0.0,
    np.zeros((2, 0)),
)


def rods(z):
    """Two equal rods in (θ, p)."""
    return apply_j(Legendre(RODS.terms).gradient(RODS.coefficients, z[None])[0])


def rods_swinging(rng, count: int):
    q, v = rng.uniform(-0.6, 0.6, (count, 2)), rng.uniform(-0.5, 0.5, (count, 2))
    return np.concatenate([q, RODS.momentum(q, v)], axis=1)


ANGLE, ANGLES = {"angles": (0,)}, {"angles": (0, 1)}
UNIFORM = partial(System, loss="uniform")
FORCED = partial(System, loss="velocities")
SYSTEMS = {
    "pendulum": UNIFORM(
        lambda z: np.array([z[1], -np.sin(z[0])]),
        swings,
        0.3,
        {"cos(q1)": -1.0, "p1²": 0.5},
        ANGLE,
        rate=0.07,
    ),
    "henon-heiles": UNIFORM(henon_heiles, box(0.3, 2), 0.5, HENON_HEILES, rate=0.01),
    "double-pendulum": UNIFORM(
        rods,
        rods_swinging,
        0.2,
        {"v1²": 1, "v2²": 0.5, "v1 v2 cos(q1 - q2)": 1, "cos(q1)": 2, "cos(q2)": 1},
        ANGLES,
        rate=0.01,
    ),
    "kepler": UNIFORM(
        kepler,
        near_circles,
        0.1,
        {"1/sqrt(q1**2 + q2**2)": -1.0, "p1²": 0.5, "p2²": 0.5},
        {"terms": ["1/sqrt(q1**2 + q2**2)"]},
        rate=0.001,
    ),
    "masses": FORCED(with_masses, box(0.3, 2), 0.3, masses_of(0.0), rate=0.05),
    "magnetic": FORCED(
        partial(with_masses, magnetic=0.3), box(0.3, 2), 0.3, masses_of(0.3), rate=0.05
    ),
}
# Systems that keep their energy, some at a dt or a size that leaves a library more over.
TWINS = {
    "pendulum": SYSTEMS["pendulum"],
    "henon-heiles": SYSTEMS["henon-heiles"],
    "henon-heiles-long": SYSTEMS["henon-heiles"]._replace(dt=1.5),
    "kepler": SYSTEMS["kepler"],
    "kepler-no-term": SYSTEMS["kepler"]._replace(options=None),
    "masses": SYSTEMS["masses"],
    "magnetic": SYSTEMS["magnetic"],
    "quartic": System(
        lambda z: np.array([z[2], z[3], -z[0] - z[0] * z[1] ** 2, -z[1] - z[1] * z[0] ** 2]),
        box(0.6, 2),
        0.5,
        {},
    ),
}


def rate_of(system: System, z):
    """ż with friction."""
    field = system.field(z)
    v, push = np.split(field, 2)
    p = np.split(z, 2)[1]
    lost = {"uniform": p, "velocities": v}.get(system.loss, 0 * p)
    return np.concatenate([v, push - system.rate * lost])


def images(system: System, z, time: float):
    """Where the states z (N, 2d) are after a time, by another integrator."""
    options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-15}
    field = lambda _, y: rate_of(system, y)  # noqa: E731
    return np.stack([solve_ivp(field, (0, time), y, **options).y[:, -1] for y in z])


def fitted(system: System, noise: float = 0.0):
    """(fit, fresh states, the processor's seconds)."""
    rng = np.random.default_rng(SEED)
    z, fresh = system.states(rng, PAIRS), system.states(rng, FRESH)
    image = images(system, z, system.dt)
    image = image + noise * rng.normal(size=image.shape)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        done = once(
            lambda: gfnn.fit(
                gfnn.Pairs(z, image, system.dt),
                tolerance=TOLERANCE,
                learn="hamiltonian",
                max_seconds=None,
                seed=SEED,
                **(system.options or {}),
            )
        )
    return done.out, fresh, done.processor_seconds


def with_friction(name: str, quick: bool) -> Numbers:
    """The law, its friction and its map of one system."""
    system = SYSTEMS[name]
    fit, fresh, seconds = fitted(system)
    found = {t.term: t.coefficient for t in fit.hamiltonian.terms}
    friction = {t.term: t.coefficient for t in fit.hamiltonian.friction}
    exact = set(found) == set(system.terms)
    error = np.asarray(fit.map.step(fresh)[0]) - images(system, fresh, system.dt)
    # The energy along an orbit, at 20 of the steps.
    z = fresh[:5]
    steps = STEPS // 10 if quick else STEPS
    every = steps // 20
    states, _ = fit.map.rollout(z, steps, save_every=every)
    here, worst, start = z, 0.0, np.abs(np.asarray(fit.map.hamiltonian(z)))
    for n in range(20):
        here = images(system, here, every * system.dt)
        both = (np.asarray(fit.map.hamiltonian(np.asarray(s))) for s in (states[:, n + 1], here))
        worst = max(worst, float(np.max(np.abs(np.subtract(*both)) / start)))
    return {
        "label": fit.chosen.label,
        "formula": fit.formula,
        "friction": friction,
        "coefficient_error": max(abs(found[t] - c) for t, c in system.terms.items())
        if exact
        else None,
        "friction_error": max(abs(c - system.rate) for c in friction.values()),
        "one_step_rms": float(np.sqrt(np.mean(error**2))),
        "multiplier": fit.map.multiplier() and float(fit.map.multiplier()),
        "symplecticity_defect": fit.symplecticity_defect,
        "energy_error": worst,
        "processor_seconds": seconds,
    }


def twins(quick: bool) -> Numbers:
    """Systems that keep their energy: what friction is reported."""
    cases = []
    for name, system in list(TWINS.items())[: 2 if quick else None]:
        for noise in NOISES:
            fit, *_ = fitted(system._replace(loss="", rate=0.0), noise)
            cases.append(
                {
                    "case": name,
                    "noise": noise,
                    "label": fit.chosen.label,
                    "friction": {t.term: t.coefficient for t in fit.hamiltonian.friction},
                    "multiplier": fit.map.multiplier() and float(fit.map.multiplier()),
                }
            )
    return {"cases": cases, "reported": sum(bool(c["friction"]) for c in cases)}


PIECES = {
    **{name: partial(with_friction, name) for name in SYSTEMS},
    "twins": twins,
    "which": friction_kinds.which,
    "none": friction_kinds.none,
    "plane": friction_kinds.plane,
}


def tables() -> None:
    """The table of RESULTS.md."""
    found = results(PIECES, "friction")
    others = ("twins", "which", "none", "plane")
    apart, which, none, plane = (found.pop(name, None) for name in others)
    heads = (
        "system",
        "law",
        "coefficients",
        "friction",
        "one-step RMS",
        "μ",
        "defect",
        "energy, 1,000 steps",
        "fit, CPU s",
    )
    before, after = (
        ("coefficient_error", "friction_error", "one_step_rms"),
        ("symplecticity_defect", "energy_error", "processor_seconds"),
    )
    rows = []
    for name, result in found.items():
        m = result["measured"]
        multiplier = "–" if m["multiplier"] is None else f"{m['multiplier']:.6f}"
        figures = [[number(m.get(key)) for key in keys] for keys in (before, after)]
        rows.append([name, m["label"], *figures[0], multiplier, *figures[1]])
    text = f"{markdown(heads, rows)}\n\n{provenance(found)}"
    if apart is not None:
        m = apart["measured"]
        text += (
            f"\n\nOf {len(m['cases'])} fits of systems that keep their energy, with noise and "
            f"without, {m['reported']} report friction."
        )
    if which is not None and none is not None:
        text += f"\n\n{kinds_found(which['measured'], none['measured'])}"
    if plane is not None:
        m = plane["measured"]
        farthest = max(c["standard_errors"] for c in m["cases"] if c["found"] == c["true"])
        text += (
            f"\n\nOf {len(m['cases'])} recordings of x, y with isotropic drag {m['right']} have it "
            f"alone, its coefficient within {farthest:.2g} standard errors; of {len(m['none'])} "
            f"without drag {sum('isotropic' in c['found'] for c in m['none'])}."
        )
    between_markers(TABLES, "friction", text)


def kinds_found(which: Numbers, none: Numbers) -> str:
    """A table of the recordings with each kind of friction, and a sentence."""
    rows = [
        [
            c["system"],
            "+".join(c["true"]),
            "+".join(c["found"]) or "none",
            number(c["standard_errors"]),
            number(c["processor_seconds"]),
        ]
        for c in which["cases"]
    ]
    heads = ("recording", "friction put in", "found", "coefficients, standard errors", "fit, CPU s")
    return (
        f"{markdown(heads, rows)}\n\nOf {len(which['cases'])} recordings the kinds of "
        f"{which['right']} are found; of {len(none['cases'])} without friction {none['reported']} "
        "report some."
    )


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "friction", tables, None, ("pendulum", "henon-heiles"))
