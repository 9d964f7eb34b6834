"""One law of recordings whose runs differ in a parameter: whether it is the one that was put in.

    python benchmarks/parameters.py            every system (some ten minutes)
    python benchmarks/parameters.py --quick    two of them, one size of the noise

Each system is integrated by SciPy from its own equations of motion, a run for each value of a
length or of an added mass, and noise is added to its positions, of 1e-4 to 1e-2 of their spread.
Counted are fits whose terms, with their functions of the parameter, and whose kinds of friction are
those put in, and coefficients within three standard errors. Then runs of two values that no fit
has seen, one between the others and one a tenth beyond, are forecast from their first third: the
error beside the noise, and the share within two standard deviations. They are several, from starts
and with noise of their own, for all of a forecast is as far off as its first state.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from harness import TABLES, Numbers, between_markers, main, markdown, number, once, results
from scipy.integrate import solve_ivp
from twins import WITHIN, plain

import gfnn_jax as gfnn

NOISES = (1e-4, 1e-3, 1e-2)  # of the spread
DRAWS = 5  # of the noise
AHEAD = 4  # runs that are forecast, of each value
G = 9.81


class Family(NamedTuple):
    """Systems that differ in a parameter. accelerate(q, v, u, value) -> q̈; values of the runs;
    positions (d,) at the start of run k, from rest; terms of L, R and the gain as formulas have
    them, where the mean of M₁₁ over the runs is 1. force(t): the input."""

    accelerate: Callable
    parameter: str
    values: tuple[float, ...]
    start: Callable[[int], Sequence[float]]
    end: float
    dt: float
    names: tuple[str, ...]
    angles: tuple[str, ...]
    lagrangian: dict[str, float]
    friction: dict[str, float]
    gain: float = 0.0


def force(t):
    """An input of four frequencies."""
    rates, phases = np.array([0.7, 1.3, 2.1, 3.3]), np.array([0.1, 2.0, 4.0, 5.0])
    return np.sum(np.sin(np.multiply.outer(t, rates) + phases), axis=-1)


def _pendulum(q, v, u, length):
    return -G / length * np.sin(q) - 0.1 * v


def _cart(q, v, u, mass):
    return (-3 * q - 0.05 * v + 0.7 * u) / (0.5 + mass)


def _two_carts(on, q, v, u, mass):
    inertia = np.array([0.5, 0.8])
    inertia[on] += mass
    return np.array([-20 * q[0] - 15 * (q[0] - q[1]), -15 * (q[1] - q[0]) - 10 * q[1]]) / inertia


def _double_pendulum(q, v, u, length):
    """Masses of 0.3 and 0.2 kg, an upper link of 0.25 m, a lower one of this length."""
    c, s = 0.05 * length * np.cos(q[0] - q[1]), 0.05 * length * np.sin(q[0] - q[1])
    push = [
        -s * v[1] ** 2 - 0.125 * G * np.sin(q[0]) - 1e-3 * v[0],
        s * v[0] ** 2 - 0.2 * G * length * np.sin(q[1]) - 5e-4 * v[1],
    ]
    return np.linalg.solve(np.array([[0.03125, c], [c, 0.2 * length**2]]), push)


LENGTHS, MASSES = (0.5, 0.8, 1.0, 1.4, 2.0), (0.0, 0.1, 0.3, 0.6)
SPRINGS = {"x1**2": -17.5, "x1*x2": 15.0, "x2**2": -12.5}


def _over(scale: float, terms: dict[str, float]) -> dict[str, float]:
    return {name: value / scale for name, value in terms.items()}


_CART = Family(
    _cart,
    "m",
    MASSES,
    lambda k: (0.8,),
    20.0,
    0.05,
    ("x",),
    (),
    _over(0.75, {"v**2": 0.25, "v**2*m": 0.5, "x**2": -1.5}),
    _over(0.75, {"v**2": 0.025}),
)
FAMILIES = {
    "pendulum, its length": Family(
        _pendulum,
        "l",
        LENGTHS,
        lambda k: (1.2 - 0.1 * k,),
        12.0,
        0.03,
        ("theta",),
        ("theta",),
        {"omega**2": 0.5, "cos(theta)/l": G},
        {"omega**2": 0.05},
    ),
    "cart on a spring, an added mass": _CART,
    "the same, driven": _CART._replace(end=30.0, gain=0.7 / 0.75),
    "two carts, mass on the first": Family(
        partial(_two_carts, 0),
        "m",
        MASSES,
        lambda k: (0.3, 0.1 * k - 0.1),
        8.0,
        0.02,
        ("x1", "x2"),
        (),
        _over(0.75, {"v1**2": 0.25, "v1**2*m": 0.5, "v2**2": 0.4} | SPRINGS),
        {},
    ),
    "two carts, mass on the second": Family(
        partial(_two_carts, 1),
        "m",
        MASSES,
        lambda k: (0.3, 0.1 * k - 0.1),
        8.0,
        0.02,
        ("x1", "x2"),
        (),
        _over(0.5, {"v1**2": 0.25, "v2**2": 0.4, "v2**2*m": 0.5} | SPRINGS),
        {},
    ),
    "double pendulum, its lower length": Family(
        _double_pendulum,
        "l",
        (0.15, 0.2, 0.3, 0.4),
        lambda k: (1.0, 0.2 * k - 0.6),
        4.0,
        0.01,
        ("theta1", "theta2"),
        ("theta1", "theta2"),
        _over(
            0.03125,
            {
                "omega1**2": 0.015625,
                "omega1*omega2*cos(theta1 - theta2)*l": 0.05,
                "omega2**2*l**2": 0.1,
                "cos(theta1)": 0.125 * G,
                "cos(theta2)*l": 0.2 * G,
            },
        ),
        _over(0.03125, {"omega1**2": 5e-4, "omega2**2": 2.5e-4}),
    ),
    "pendulums of one length": Family(
        lambda q, v, u, unused: _pendulum(q, v, u, 1.0),
        "l",
        LENGTHS,
        lambda k: (1.2 - 0.1 * k,),
        12.0,
        0.03,
        ("theta",),
        ("theta",),
        {"omega**2": 0.5, "cos(theta)": G},
        {"omega**2": 0.05},
    ),
}


@cache
def orbits(name: str, values: tuple[float, ...]) -> tuple[np.ndarray, ...]:
    """Positions (d, n) of a run of each value."""
    family, d = FAMILIES[name], len(FAMILIES[name].names)
    t = np.arange(0, family.end, family.dt)

    def rate(s, x, value):
        u = force(s) if family.gain else 0.0
        return [*x[d:], *np.ravel(family.accelerate(x[:d], x[d:], u, value))]

    return tuple(
        solve_ivp(
            rate,
            (0, t[-1]),
            [*family.start(k), *np.zeros(d)],
            t_eval=t,
            args=(value,),
            method="DOP853",
            rtol=1e-11,
            atol=1e-11,
            max_step=0.05,
        ).y[:d]
        for k, value in enumerate(values)
    )


def recording(name: str, values: tuple[float, ...], noise: float, seed: int) -> gfnn.Recording:
    """Positions of a run of each value, with noise that is a share of the spread of the runs that
    are learned from."""
    family, tables = FAMILIES[name], []
    rng = np.random.default_rng([seed, NOISES.index(noise)])
    t, found = np.arange(0, family.end, family.dt), orbits(name, values)
    spread = np.concatenate(orbits(name, family.values), axis=1).std(axis=1)
    for k, (q, value) in enumerate(zip(found, values, strict=True)):
        seen = q + noise * spread[:, None] * rng.normal(size=q.shape)
        columns = dict(zip(family.names, seen, strict=True))
        columns |= {family.parameter: np.full(len(t), value)}
        columns |= {"u": force(t)} if family.gain else {}
        tables.append({"run": np.full(len(t), str(k)), "t": t, **columns})
    return gfnn.Recording(
        tables,
        positions=family.names,
        angles=family.angles,
        parameters=[family.parameter],
        inputs=["u"] if family.gain else None,
    )


def case(name: str, noise: float, draw: int) -> Numbers:
    """One fit: whether its terms are those put in, its errors in standard errors, and forecasts of
    values that it has not seen."""
    family = FAMILIES[name]
    record = recording(name, family.values, noise, draw)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        done = once(lambda: gfnn.fit(record))
    fit: Any = done.out
    off, same = {}, {}
    for kind, put_in in (("lagrangian", family.lagrangian), ("friction", family.friction)):
        found = {plain(t.term): (t.coefficient, t.std) for t in getattr(fit, kind).terms}
        same[kind] = set(found) == set(put_in)
        for term, value in put_in.items():
            c, std = found.get(term, (0.0, 0.0))
            if std > 0:
                off[f"{kind}: {term}"] = abs(c - value) / std
    if family.gain:
        gain, std = fit.gains["u"][family.names[0]]
        off["gain"] = abs(gain - family.gain) / std
    low, *_, last, high = family.values
    ahead = {
        place: forecast(name, fit, value, noise, DRAWS + draw)
        for place, value in (
            ("between", 0.5 * (last + high)),
            ("beyond", high + 0.1 * (high - low)),
        )
    }
    return {
        "noise": noise,
        "draw": draw,
        "same": same,
        "standard_errors": off,
        "formula": fit.formula,
        "friction": fit.friction.formula,
        "forecasts": ahead,
        "processor_seconds": done.processor_seconds,
    }


def forecast(name: str, fit: Any, value: float, noise: float, seed: int) -> Numbers:
    """The last two thirds of runs of this value from their first third: RMS error in units of the
    noise, and the share of samples within two standard deviations."""
    family, new = FAMILIES[name], recording(name, (value,) * AHEAD, noise, seed)
    t = new.times("0")
    cut = family.end / 3
    found = fit.map.forecast(new.slice(stop=cut), t[t > cut], new if family.gain else None)
    error, inside = [], []
    for column, sigma in zip(family.names, fit.map.sensors.sigma, strict=True):
        seen = np.array([new.values(column, run)[t > cut] for run in new.runs])
        off = found.values[column] - seen
        error.append(off / sigma)
        inside.append(np.abs(off) <= 2 * found.std[column])
    return {"error": float(np.sqrt(np.mean(np.square(error)))), "within": float(np.mean(inside))}


def measured(name: str, quick: bool) -> Numbers:
    cases = []
    for noise in NOISES[1:2] if quick else NOISES:
        for draw in range(1 if quick else DRAWS):
            cases.append(case(name, noise, draw))
            c = cases[-1]
            worst = max(c["standard_errors"].items(), key=lambda item: item[1], default=("", 0))
            print(
                f"  {noise:g}: {c['same']}, {worst[0]} off by {worst[1]:.1f}; {c['formula']} | "
                f"{c['friction']}; {c['forecasts']}; {c['processor_seconds']:.1f} s",
                flush=True,
            )
    return {"cases": cases}


NAMES = {name.replace(",", "").replace(" ", "-"): name for name in FAMILIES}
PIECES = {key: partial(measured, name) for key, name in NAMES.items()}


def tables() -> None:
    """The table of RESULTS.md."""
    rows = []
    for name, result in results(PIECES, "parameters").items():
        for noise in NOISES:
            cases = [c for c in result["measured"]["cases"] if c["noise"] == noise]
            if not cases:
                continue
            off = [z for c in cases for z in c["standard_errors"].values()]
            ahead = {
                place: (
                    np.sqrt(np.mean([c["forecasts"][place]["error"] ** 2 for c in cases])),
                    np.mean([c["forecasts"][place]["within"] for c in cases]),
                )
                for place in ("between", "beyond")
            }
            rows.append(
                [
                    NAMES[name],
                    f"{noise:g}",
                    *(
                        f"{sum(c['same'][k] for c in cases)} of {len(cases)}"
                        for k in ("lagrangian", "friction")
                    ),
                    f"{sum(z <= WITHIN for z in off)} of {len(off)}",
                    number(max(off)),
                    *(f"{error:.2f}, {within:.0%}" for error, within in ahead.values()),
                    number(np.mean([c["processor_seconds"] for c in cases])),
                ]
            )
    heads = (
        "systems",
        "noise ÷ spread",
        "terms of L exact",
        "friction exact",
        f"within {WITHIN:g} standard errors",
        "largest",
        "forecast between",
        "and beyond",
        "CPU s",
    )
    between_markers(TABLES, "parameters", markdown(heads, rows))


if __name__ == "__main__":
    quick = ("pendulum-its-length", "two-carts-mass-on-the-second")
    main(__doc__ or "", PIECES, "parameters", tables, None, quick_pieces=quick)
