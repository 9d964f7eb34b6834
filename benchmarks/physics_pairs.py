"""Laws of physics behind pairs that come with nothing but the states: is the exact one found?

    python benchmarks/physics_pairs.py                       every kind, three draws of each
    python benchmarks/physics_pairs.py --only schwarzschild  one kind
    python benchmarks/physics_pairs.py --quick               one draw of each, into runs/

A kind is H as text, with numbers that are drawn, 400 states in a box or on orbits, and their images
by SciPy at tolerances of 1e-13. Given are the pairs, which coordinates are angles, and the input of
each pair; not that there is friction. A law is *exact* that has as many terms as the truth, the
rate of its friction to 1e-8, and whose steps from 100 states that no fit has seen err by less than
1e-9 of their spread, at a tolerance of 1e-10.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import sympy as sp
from harness import TABLES, Numbers, between_markers, main, markdown, number, once, provenance
from harness import results as results_of
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn
from gfnn_jax.errors import FitWarning

DRAWS, PAIRS, FRESH = 3, 400, 100
SEED = 20_261_127  # nothing was tuned on these draws
NAME, TOLERANCE, EXACT, ALIKE = "physics-pairs", 1e-10, 1e-9, 1e-8
Draw = Callable[[np.random.Generator], np.ndarray]


class System(NamedTuple):
    """H as text in q1, …, p1, … and an input u; where states are drawn; the terms that it is
    printed with (of the cart those of L); the rate of uniform friction; which coordinates are
    angles."""

    h: str
    state: Draw
    dt: float
    terms: int
    rate: float = 0.0
    angles: tuple[int, ...] = ()


def _box(*ranges: tuple[float, float]) -> Draw:
    low, high = np.array(ranges).T
    return lambda rng: rng.uniform(low, high)


def _orbit(rng: np.random.Generator) -> np.ndarray:
    """A state of an ellipse around the origin, of GM = 1."""
    r, along, off = rng.uniform(0.6, 1.6), rng.uniform(0, 2 * np.pi), rng.uniform(-0.4, 0.4)
    speed, way = rng.uniform(0.7, 1.2) / np.sqrt(r), along + np.pi / 2 + off
    return np.array([np.cos(along), np.sin(along), 0, 0]) * r + np.array(
        [0, 0, speed * np.cos(way), speed * np.sin(way)]
    )


def toda(rng: np.random.Generator) -> System:
    a, k = rng.uniform(0.7, 1.5, 2)
    h = f"p1**2/2 + p2**2/2 + {a}*exp({k}*(q1 - q2)) + {a}*exp({k}*(q2 - q1))"
    return System(h, _box(*[(-1, 1)] * 4), 0.1, 3)


def schwarzschild(rng: np.random.Generator) -> System:
    mass, momentum, near = rng.uniform(0.7, 1.3), rng.uniform(3.5, 5.0), rng.uniform(4.0, 8.0)
    f = f"(1 - {2 * mass}/q1)"
    h = f"({f}*p1**2 + {momentum**2}/q1**2 - 1/{f})/2"
    return System(h, _box((near * mass, 3 * near * mass), (-0.3, 0.3)), 0.5, 4)


def cart(rng: np.random.Generator) -> System:
    """A pendulum on a cart that nothing holds."""
    cart, bob, length = rng.uniform(0.6, 1.5), rng.uniform(0.2, 0.6), rng.uniform(0.5, 1.0)
    both, turning, coupled = cart + bob, bob * length**2, f"{bob * length}*cos(q2)"
    apart = f"({both * turning} - ({coupled})**2)"
    h = f"({turning}*p1**2 - 2*{coupled}*p1*p2 + {both}*p2**2)/(2*{apart})"
    h += f" - {9.81 * bob * length}*cos(q2)"
    return System(h, _box((-1, 1), (-3, 3), (-0.5, 0.5), (-0.5, 0.5)), 0.05, 4, angles=(1,))


def orbit_with_drag(rng: np.random.Generator) -> System:
    return System(
        "p1**2/2 + p2**2/2 - 1/sqrt(q1**2 + q2**2)", _orbit, 0.1, 3, rng.uniform(0.02, 0.1)
    )


def morse_with_drag(rng: np.random.Generator) -> System:
    depth, a = rng.uniform(0.6, 1.6), rng.uniform(0.8, 1.6)
    h = f"p1**2/2 + {depth}*exp({-2 * a}*q1) - {2 * depth}*exp({-a}*q1)"
    return System(h, _box((-0.4, 1.5), (-0.8, 0.8)), 0.1, 3, rng.uniform(0.02, 0.15))


def torque_on_an_angle(rng: np.random.Generator) -> System:
    swing, gain = rng.uniform(1.0, 4.0), rng.uniform(0.3, 1.0)
    h = f"p1**2/2 - {swing}*cos(q1) - {gain}*u*q1"
    return System(h, _box((-3.1, 3.1), (-2, 2)), 0.1, 3, angles=(0,))


KINDS = {
    "toda": toda,
    "schwarzschild": schwarzschild,
    "cart": cart,
    "orbit-with-drag": orbit_with_drag,
    "morse-with-drag": morse_with_drag,
    "torque-on-an-angle": torque_on_an_angle,
}


def _pairs(system: System, count: int, rng: np.random.Generator):
    """States and images (N, 2d), and the input of each (N,), None of a law without one."""
    states = np.array([system.state(rng) for _ in range(count)])
    dim = states.shape[1] // 2
    names = [f"{x}{i + 1}" for x in "qp" for i in range(dim)]
    h, inputs = sp.sympify(system.h), rng.uniform(-1, 1, count)
    given = (*names, "u")
    gradient = sp.lambdify(given, [sp.diff(h, name) for name in names])

    def rates(_, z, u):
        slope = np.array(gradient(*z, u), float)
        return np.concatenate([slope[dim:], -slope[:dim] - system.rate * z[dim:]])

    def image(z, u):
        span, options = (0, system.dt), {"rtol": 1e-13, "atol": 1e-14, "method": "DOP853"}
        return solve_ivp(rates, span, z, args=(u,), **options).y[:, -1]

    images = np.array([image(z, u) for z, u in zip(states, inputs, strict=True)])
    return states, images, inputs if sp.Symbol("u") in h.free_symbols else None


def measured(draw: Callable[[np.random.Generator], System], quick: bool) -> Numbers:
    """What the fits of one kind found."""
    draws = []
    for seed in range(1 if quick else DRAWS):
        rng = np.random.default_rng([SEED, seed])
        system = draw(rng)
        z0, z1, u = _pairs(system, PAIRS, rng)
        pairs = gfnn.Pairs(z0, z1, system.dt, args=None if u is None else {"u": u})
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore", FitWarning)
            fit = partial(gfnn.fit, pairs, tolerance=TOLERANCE, angles=system.angles)
            fit, _, seconds = once(fit)
        draws.append({**_judged(fit, system, rng), "processor_seconds": seconds})
        print(f"  {seed}: {draws[-1]}", flush=True)
    return {"draws": draws}


def _judged(fit: gfnn.Fit, system: System, rng: np.random.Generator) -> Numbers:
    """The law of a fit, and its errors beside the truth's."""
    z0, z1, u = _pairs(system, FRESH, rng)
    off = np.asarray(fit.map.step(z0, args=None if u is None else u[:, None])[0]) - z1
    error, rate = float(np.sqrt(np.mean((off / z1.std(axis=0)) ** 2))), 0.0
    if fit.friction is not None:
        rate = float(fit.friction.terms[0].coefficient)
    terms = 0 if fit.hamiltonian is None else len(fit.hamiltonian.terms)
    exact = terms == system.terms and error < EXACT and abs(rate - system.rate) < ALIKE
    law = {"formula": fit.formula, "terms": terms, "rate": rate, "verdict": str(fit.verdict)}
    return law | {"error": error, "true_rate": system.rate, "exact": bool(exact)}


PIECES = {name: partial(measured, draw) for name, draw in KINDS.items()}


def tables() -> None:
    """The table of RESULTS.md."""
    found = results_of(PIECES, NAME)
    if not found:
        return
    rows = []
    for name, result in found.items():
        draws = result["measured"]["draws"]
        rows.append(
            [
                name.replace("-", " "),
                f"{sum(d['exact'] for d in draws)} of {len(draws)}",
                number(max(d["error"] for d in draws)),
                number(np.mean([d["processor_seconds"] for d in draws])),
            ]
        )
    heads = ("pairs of", "exact", "largest error of a step ÷ spread", "CPU s")
    between_markers(TABLES, NAME, f"{markdown(heads, rows)}\n\n{provenance(found)}")


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "physics-pairs", tables, None)
