"""Random recordings: systems, sampling, noise and friction are drawn, and what comes out is judged.

    python benchmarks/random_recordings.py            every system (a quarter of an hour)
    python benchmarks/random_recordings.py --quick    two recordings of each, into runs/

Each recording begins at rest, as a body that is let go, and has 3 to 150 samples a period, 5 to 40
periods, noise up to 3 % of the spread, steps of the sensor up to 1 % or none, and linear,
quadratic, dry or no friction; dry friction holds what it can. Only angles are told. The law is the
text of the formula, read by SymPy and integrated by SciPy: forecasts of a period from true states
along the recording are compared with the truth. A law is *right* whose median forecast errs by less
than 2 % of the spread, or by less than the noise; *said* of others is where a message warns, or the
horizon of 20 % is shorter than a period. Bands are judged on ten motions that the fit has not seen,
let go elsewhere within the recording's amplitudes and read by the same sensors: the share of
readings 0.1, 1 and 5 periods after a window that two standard deviations hold.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import sympy as sp
from coulomb_motion import Body
from harness import TABLES, Numbers, between_markers, main, markdown, number, once, provenance
from harness import results as results_of
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn
from gfnn_jax.errors import FitError

DRAWS, QUICK = 24, 2
SAMPLES, PERIODS = (3.0, 150.0), (5.0, 40.0)  # samples a period, and periods
NOISES = (0.0, 1e-5, 1e-4, 1e-3, 1e-2, 3e-2)  # of the spread
STEPS = (0.0, 0.0, 0.0, 1e-3, 1e-2)  # of the sensor, of the largest spread
KINDS, SHARES = ("none", "linear", "quadratic", "dry"), (0.2, 0.5, 0.15, 0.15)
RIGHT = 0.02  # of the spread
FEW = 8.0  # samples a period
MOST, LEAST = 4_000, 30  # samples
_SMOOTH = 1e-3  # of the speeds, over which dry friction turns
_STARTS, _AHEAD = 11, 10
AHEAD = (0.1, 1.0, 5.0)  # periods, of forecasts whose bands are judged
HELD = (0.9, 0.99)  # share that a calibrated band of two standard deviations holds
_MOTIONS, _WINDOW = 10, 20  # unseen motions; samples, at least, that a forecast starts from

Force = Callable[[np.ndarray, np.ndarray], np.ndarray]


class System(NamedTuple):
    """force(q, v) -> accelerations without friction, in units of 1/ω; masses(q) that friction is
    divided by; where it is let go; which coordinates are angles."""

    force: Force
    masses: Callable[[np.ndarray], np.ndarray]
    start: np.ndarray
    angles: tuple[int, ...] = ()


def pendulum(rng: np.random.Generator) -> System:
    return System(lambda q, v: -np.sin(q), _unit(1), rng.uniform(0.3, 2.8, 1), (0,))


def spring(rng: np.random.Generator) -> System:
    hardening = rng.uniform(-0.5, 2)
    return System(lambda q, v: -q - hardening * q**3, _unit(1), rng.uniform(0.5, 1, 1))


def trap(rng: np.random.Generator) -> System:
    stiffness = np.array([1.0, rng.uniform(0.3, 3)])
    return System(lambda q, v: -stiffness * q, _unit(2), rng.uniform(0.3, 1, 2))


def two_pendulums(rng: np.random.Generator) -> System:
    weights = np.array([1.0, rng.uniform(0.3, 3)])
    return System(lambda q, v: -weights * np.sin(q), _unit(2), rng.uniform(0.4, 2.2, 2), (0, 1))


def carts(rng: np.random.Generator) -> System:
    masses = np.diag([1.0, rng.uniform(0.5, 2)])
    between = rng.uniform(0.3, 2)
    stiffness = np.array([[1 + between, -between], [-between, 1 + between]])
    return _solved(lambda q, v: -stiffness @ q, lambda q: masses, rng.normal(size=2))


def henon_heiles(rng: np.random.Generator) -> System:
    def force(q, v):
        return np.array([-q[0] - 2 * q[0] * q[1], -q[1] - q[0] ** 2 + q[1] ** 2])

    return System(force, _unit(2), rng.uniform(-0.35, 0.35, 2))


def double_pendulum(rng: np.random.Generator) -> System:
    a, weight = rng.uniform(0.2, 0.6), rng.uniform(0.3, 0.8)

    def masses(q):
        c = np.cos(q[0] - q[1])
        return np.array([[1, a * c], [a * c, a]])

    def force(q, v):
        s = a * np.sin(q[0] - q[1])
        return np.array([-s * v[1] ** 2 - np.sin(q[0]), s * v[0] ** 2 - weight * a * np.sin(q[1])])

    start = rng.uniform(0.4, 2.2, 2) * rng.choice([-1, 1], 2)
    return _solved(force, masses, start, (0, 1))


def pendulum_on_a_cart(rng: np.random.Generator) -> System:
    m = rng.uniform(0.2, 0.8)

    def masses(q):
        return np.array([[1, m * np.cos(q[1])], [m * np.cos(q[1]), m]])

    def force(q, v):
        return np.array([m * v[1] ** 2 * np.sin(q[1]) - 0.5 * q[0], -m * np.sin(q[1])])

    start = np.array([rng.uniform(-0.5, 0.5), rng.uniform(0.5, 2.2)])
    return _solved(force, masses, start, (1,))


def _unit(dim: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda q: np.eye(dim)


def _solved(force: Force, masses, start: np.ndarray, angles: tuple[int, ...] = ()) -> System:
    return System(lambda q, v: np.linalg.solve(masses(q), force(q, v)), masses, start, angles)


SYSTEMS = {
    "pendulum": pendulum,
    "spring": spring,
    "trap": trap,
    "two pendulums": two_pendulums,
    "carts": carts,
    "Hénon–Heiles": henon_heiles,
    "double pendulum": double_pendulum,
    "pendulum on a cart": pendulum_on_a_cart,
}


def friction(kind: str, size: float, v: np.ndarray) -> np.ndarray:
    """Force of friction on each coordinate."""
    of_speed = {
        "none": 0 * v,
        "linear": v,
        "quadratic": v * np.abs(v),
        "dry": 0.3 * np.tanh(v / _SMOOTH),
    }
    return -size * of_speed[kind]


def integrated(acceleration: Force, q, v, t: np.ndarray) -> np.ndarray:
    """States (n, 2d) at times t from positions and velocities."""
    d = len(q)

    def rates(_, z):
        return np.concatenate([z[d:], acceleration(z[:d], z[d:])])

    done = solve_ivp(rates, (0, t[-1]), [*q, *v], t_eval=t, rtol=1e-9, atol=1e-11)
    if not done.success:
        raise ArithmeticError(done.message)
    return done.y.T


def held_by_friction(system: System, omega: float, sizes: np.ndarray, q, v, t) -> np.ndarray:
    """States (n, 2d) at times t, with dry friction of these sizes (d,): bodies at rest stay where
    `friction`, which turns over speeds, would let them creep."""

    def force(q, v, u):
        return omega**2 * system.masses(q) @ system.force(q, v / omega)

    body, times = Body(system.masses, force, np.eye(len(q)), sizes), np.append(0.0, t[t > 0])
    options = {"method": "DOP853", "rtol": 1e-9, "atol": 1e-11}
    return body.follow(np.concatenate([q, v]), times, **options)[-len(t) :]


def law_of(fit: Any, width: float) -> Force:
    """q̈ of the formulas of L and R, read by SymPy; dry friction turns over speeds of ``width``."""
    names = tuple(fit.map.sensors.positions)
    q = [sp.Symbol(name, real=True) for name in names]
    v = [sp.Symbol(name.replace("x", "v"), real=True) for name in names]
    known = {str(s): s for s in (*q, *v)} | {"abs": sp.Abs, "cos": sp.cos, "sin": sp.sin}
    L, R = (
        sp.parse_expr(text, local_dict=known)
        for text in (fit.lagrangian.formula, fit.friction.formula or "0")
    )
    mass = sp.hessian(L, v)
    left = [
        sp.diff(L, x) - sum(sp.diff(L, s, y) * w for y, w in zip(q, v, strict=True)) - sp.diff(R, s)
        for x, s in zip(q, v, strict=True)
    ]
    of_mass = sp.lambdify((*q, *v), mass)
    of_force = sp.lambdify((*q, *v), left, [{"sign": lambda s: np.tanh(s / width)}, "numpy"])

    def acceleration(q, v):
        force = np.array(of_force(*q, *v), float)
        return np.linalg.solve(np.array(of_mass(*q, *v), float), force)

    return acceleration


def sensed(q: np.ndarray, noise: np.ndarray, step: float, rng: np.random.Generator) -> np.ndarray:
    """Readings of positions q (…, d) with noise (d,) by sensors of this step, 0 of none."""
    seen = q + noise * rng.normal(size=q.shape)
    return step * np.round(seen / step) if step else seen


class Record(NamedTuple):
    """A recording that was drawn: its times (n,), the true states (n, 2d) at its ``count`` samples
    and beyond them, what the sensors show (n, d), the true q̈(q, v), in which dry friction turns
    over speeds, and the true states at times t that follow q and v, in which it holds."""

    system: System
    t: np.ndarray
    states: np.ndarray
    seen: np.ndarray
    count: int
    truth: Force
    follow: Callable[..., np.ndarray]
    omega: float
    kind: str
    samples: float
    noise: float
    step: float

    @property
    def period(self) -> float:
        return 2 * np.pi / self.omega

    @property
    def spread(self) -> np.ndarray:
        return self.states[: self.count, : self.seen.shape[1]].std(axis=0)

    @property
    def recording(self) -> gfnn.Recording:
        """What a user has."""
        names = [f"x{i + 1}" for i in range(self.seen.shape[1])]
        columns = dict(zip(names, self.seen[: self.count].T, strict=True))
        angles = [names[i] for i in self.system.angles]
        table = {"t": self.t[: self.count], **columns}
        return gfnn.Recording(table, positions=names, angles=angles)

    def error(self, fit: Any) -> float:
        """Median error of the law's forecasts of a period from true states, ÷ the spread."""
        d = self.seen.shape[1]
        ahead = self.period * np.arange(_AHEAD + 1) / _AHEAD
        law, errors = law_of(fit, _SMOOTH * self.omega), []
        for k in np.linspace(0, self.count - 1, _STARTS).astype(int):
            start = self.states[k, :d], self.states[k, d:]
            try:
                miss = integrated(law, *start, ahead) - integrated(self.truth, *start, ahead)
                errors.append(np.sqrt(np.mean((miss[1:, :d] / self.spread) ** 2)))
            except (ArithmeticError, np.linalg.LinAlgError):
                errors.append(np.inf)
        return float(np.median(errors))

    def right(self, error: float) -> bool:
        return error < max(RIGHT, self.noise)

    def held(self, fit: Any, rng: np.random.Generator) -> list[float]:
        """Shares of readings of unseen motions, at each time ahead, within two deviations."""
        d, dt = self.seen.shape[1], self.t[1]
        window = dt * np.arange(max(_WINDOW, round(self.samples)))
        times = np.concatenate([window, window[-1] + self.period * np.array(AHEAD)])
        motions = []
        for _ in range(_MOTIONS):
            start = self.system.start * rng.uniform(0.4, 1, d)
            later = rng.uniform(0, self.period) + times
            motions.append(self.follow(start, 0 * start, later)[:, :d])
        seen = sensed(np.array(motions), self.noise * self.spread, self.step, rng)
        runs = np.repeat(np.arange(_MOTIONS), len(window))
        names = tuple(fit.map.sensors.positions)
        columns = dict(zip(names, seen[:, : len(window)].reshape(-1, d).T, strict=True))
        table = {"run": runs, "t": np.tile(window, _MOTIONS), **columns}
        angles = [names[i] for i in self.system.angles]
        before = gfnn.Recording(table, positions=names, angles=angles)
        ahead = fit.forecast(times[len(window) :], after=before)
        inside = [
            np.abs(ahead.values[n] - seen[:, len(window) :, i]) <= 2 * ahead.std[n]
            for i, n in enumerate(names)
        ]
        return np.mean(inside, axis=(0, 1)).tolist()


def record(
    draw_system: Callable[[np.random.Generator], System],
    rng: np.random.Generator,
    samples: tuple[float, float] = SAMPLES,
    periods: tuple[float, float] = PERIODS,
    noises: tuple[float, ...] = NOISES,
    beyond: float = 0.0,
) -> Record:
    """Draw a system and its recording, which goes on for so many periods ``beyond`` its end."""
    system = draw_system(rng)
    omega, size = 10 ** rng.uniform(-0.5, 1.5), 10 ** rng.uniform(-2.5, -1)
    kind = str(rng.choice(KINDS, p=SHARES))
    often, long = np.exp([rng.uniform(*np.log(ends)) for ends in (samples, periods)])
    noise, step = rng.choice(noises), rng.choice(STEPS)
    count = int(np.clip(often * long, LEAST, MOST))
    t = 2 * np.pi / omega / often * np.arange(count + int(beyond * often))
    d = len(system.start)

    def truth(q, v):
        rubbed = np.linalg.solve(system.masses(q), friction(kind, size, v / omega))
        return omega**2 * (system.force(q, v / omega) + rubbed)

    follow = partial(integrated, truth)
    if kind == "dry":
        sizes = -(omega**2) * friction(kind, size, np.ones(d))
        follow = partial(held_by_friction, system, omega, sizes)
    states = follow(system.start, 0 * system.start, t)
    q = states[:, :d]
    spread = q[:count].std(axis=0)
    step *= spread.max()
    seen = sensed(q, noise * spread, step, rng)
    facts = kind, float(often), float(noise), float(step)
    return Record(system, t, states, seen, count, truth, follow, omega, *facts)


def case(name: str, draw: int) -> Numbers:
    which = list(SYSTEMS).index(name)
    drawn = record(SYSTEMS[name], np.random.default_rng([which, draw]))
    recording = drawn.recording
    found: Numbers = {
        "draw": draw,
        "friction": drawn.kind,
        "samples": drawn.samples,
        "count": drawn.count,
        "noise": drawn.noise,
        "step": drawn.step,
    }
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", gfnn.FitWarning)  # kept in fit.messages
            done = once(lambda: gfnn.fit(recording))
    except FitError as error:
        return found | {"refused": str(error)}
    fit: Any = done.out
    error = drawn.error(fit)
    return found | {
        "formula": fit.formula,
        "rubs": fit.friction.formula,
        "error": error if np.isfinite(error) else None,
        "right": drawn.right(error),
        "said": bool(fit.messages) or fit.horizon[-1].measured < drawn.period,
        "messages": list(fit.messages),
        "held": drawn.held(fit, np.random.default_rng([which, draw, 1])),
        "processor_seconds": done.processor_seconds,
    }


def measured(name: str, quick: bool) -> Numbers:
    cases = []
    for draw in range(QUICK if quick else DRAWS):
        c = case(name, draw)
        cases.append(c)
        what = (
            c.get("refused")
            or f"{c['error']}, {'right' if c['right'] else 'wrong'}; {c['formula']}"
        )
        print(
            f"  {draw}: {c['samples']:.1f} samples a period, {c['friction']}: {what[:110]}",
            flush=True,
        )
    return {"cases": cases}


def _piece(name: str) -> Callable[[bool], Numbers]:
    return lambda quick: measured(name, quick)


PIECES = {
    name.lower().replace("é", "e").replace("–", "-").replace(" ", "-"): _piece(name)
    for name in SYSTEMS
}


def tables() -> None:
    """The table of RESULTS.md."""
    found = results_of(PIECES, "random")
    if not found:
        return
    rows, shares = [], []
    for result, name in ((found[p], n) for p, n in zip(PIECES, SYSTEMS, strict=True) if p in found):
        for label, often in ((f"{FEW:g} or more", True), (f"under {FEW:g}", False)):
            cases = [c for c in result["measured"]["cases"] if (c["samples"] >= FEW) == often]
            laws = [c for c in cases if "formula" in c]
            errors = [np.inf if c["error"] is None else c["error"] for c in laws if c["right"]]
            wrong = [c for c in laws if not c["right"]]
            held = np.mean([c["held"] for c in laws], axis=0) if laws else []
            shares.extend(held if often else [])
            rows.append(
                [
                    name,
                    label,
                    str(len(cases)),
                    str(len(errors)),
                    str(len(cases) - len(laws)),
                    str(sum(c["said"] for c in wrong)),
                    str(sum(not c["said"] for c in wrong)),
                    number(np.median(errors)) if errors else "–",
                    ", ".join(f"{share:.0%}" for share in held) or "–",
                    number(np.mean([c["processor_seconds"] for c in laws])) if laws else "–",
                ]
            )
    heads = (
        "system",
        "samples a period",
        "recordings",
        "right",
        "refused",
        "wrong, and said",
        "wrong, not said",
        "median error of the right, a period ahead",
        "within 2 σ after 0.1, 1, 5 periods",
        "CPU s",
    )
    calibrated = np.sum((np.array(shares) >= HELD[0]) & (np.array(shares) <= HELD[1]))
    text = (
        f"With {FEW:g} samples a period or more two standard deviations hold 90 to 99 % of unseen "
        f"readings in {calibrated} of {len(shares)} rows of a system and a time ahead."
    )
    table = f"{markdown(heads, rows)}\n\n{text}\n\n{provenance(found)}"
    between_markers(TABLES, "random-recordings", table)


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "random", tables, None)
