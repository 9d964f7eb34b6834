"""Any sensor, any sampling: recordings that are uneven, incomplete or of short runs, and sensors
that show no position; systems are drawn at random, and the laws that come out are judged.

    python benchmarks/any_record.py            ten draws of each (an hour of a processor)
    python benchmarks/any_record.py --quick    two draws of one piece, into runs/

Times are those of a Poisson process, 30 % of the cells are missing, or 200 runs have six to ten
samples each; beside them the same number of even, complete readings. Positions have noise of 1e-3
of their spread, and friction is linear or none. A law is *right* whose friction is of the kinds of
the truth and whose forecasts of a period, from true states, err by less than 1 % of the spread in
the median.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from harness import TABLES, Numbers, between_markers, main, markdown, number, once, provenance
from harness import results as results_of
from random_recordings import SYSTEMS, friction, integrated, law_of
from scipy.integrate import solve_ivp
from scipy.signal import lfilter, sawtooth, square

import gfnn_jax as gfnn
from gfnn_jax.errors import FitError

DRAWS, QUICK = 10, 2
FIRST = 100  # draw; nothing was tuned to these
NOISE, RIGHT = 1e-3, 0.01  # of the spread
CLEAN, CLEAN_DRAWS = 1e-6, 4
COUNT, RUNS = 1_500, 200
MISSING = 0.3
OFF = 0.05  # of a force, up to which a law of one orbit is right
DUFFING = "spring"
MECHANICAL = ("pendulum", "double pendulum", DUFFING, "carts")
_STARTS, _AHEAD = 11, 10


def _poisson(seconds: float) -> Callable[[np.random.Generator], np.ndarray]:
    return lambda rng: np.sort(rng.uniform(0, seconds, COUNT))


def _even(seconds: float) -> Callable[[np.random.Generator], np.ndarray]:
    return lambda rng: (1 + np.arange(COUNT)) * seconds / COUNT


SAMPLINGS = {
    "even, 30 s": _even(30.0),
    "even, 60 s": _even(60.0),
    "Poisson, 30 s": _poisson(30.0),
    "Poisson, 60 s": _poisson(60.0),
    "30 % of cells missing": _even(60.0),
}
SHORT = "200 runs of 6 to 10 samples"


def case(name: str, sampling: str, draw: int, noise: float = NOISE) -> Numbers:
    """One recording with this noise, its fit and how right it is."""
    rng = np.random.default_rng([MECHANICAL.index(name), draw])
    system, d = SYSTEMS[name](rng), 0
    d = len(system.start)
    omega, size = rng.uniform(2.0, 8.0), rng.uniform(0.01, 0.05)
    kind = str(rng.choice(["none", "linear"]))

    def truth(q: np.ndarray, v: np.ndarray) -> np.ndarray:
        rubbed = np.linalg.solve(system.masses(q), friction(kind, size, v / omega))
        return omega**2 * (system.force(q, v / omega) + rubbed)

    if sampling == SHORT:
        step = 2 * np.pi / omega / rng.uniform(8, 20)
        runs = []
        for _ in range(RUNS):
            start = system.start * rng.uniform(0.3, 1.0) * rng.choice([-1, 1], d)
            phase = rng.uniform(0, 2 * np.pi / omega)
            t = np.concatenate([[0.0], phase + step * np.arange(rng.integers(6, 11))])
            runs.append((t[1:] - phase, integrated(truth, start, 0 * start, t)[1:]))
    else:
        t = SAMPLINGS[sampling](rng)
        states = integrated(truth, system.start, 0 * system.start, np.append(0.0, t))[1:]
        runs = [(t, states)]
    every = np.concatenate([states for _, states in runs])
    spread = every[:, :d].std(axis=0)
    names = [f"x{i}" for i in range(1, d + 1)]
    tables = []
    for t, states in runs:
        seen = states[:, :d] + noise * spread * rng.normal(size=(len(t), d))
        if "missing" in sampling:
            seen = np.where(rng.uniform(size=seen.shape) < MISSING, np.nan, seen)
        tables.append({"t": t, **dict(zip(names, seen.T, strict=True))})
    angles = [names[i] for i in system.angles]
    recording = gfnn.Recording(tables, positions=names, angles=angles)
    found: Numbers = {"draw": draw, "friction": kind}
    fit, said = _fitted(recording)
    if fit is None:
        return found | said
    ahead = 2 * np.pi / omega * np.arange(_AHEAD + 1) / _AHEAD
    law, errors = law_of(fit, 1e-3 * omega), []
    for k in np.linspace(0, len(every) - 1, _STARTS).astype(int):
        start = every[k, :d], every[k, d:]
        try:
            miss = integrated(law, *start, ahead) - integrated(truth, *start, ahead)
            errors.append(np.sqrt(np.mean((miss[1:, :d] / spread) ** 2)))
        except (ArithmeticError, np.linalg.LinAlgError):
            errors.append(np.inf)
    error, kinds = float(np.median(errors)), {*fit.which_friction.kinds}
    rubs = bool(kinds) == (kind != "none") and not kinds & {"dry", "quadratic"}
    return (
        found
        | said
        | {
            "error": error if np.isfinite(error) else None,
            "right": bool(error < RIGHT and rubs),
            "rubs": fit.friction.formula,
        }
    )


def _fitted(recording: gfnn.Recording, **options: Any) -> tuple[Any, Numbers]:
    """A fit, None where it is refused, and what it says of itself."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", gfnn.FitWarning)  # kept in fit.messages
            done = once(lambda: gfnn.fit(recording, **options))
    except FitError as error:
        return None, {"verdict": error.verdict, "refused": str(error), "right": False}
    fit: Any = done.out
    return fit, {
        "verdict": fit.verdict,
        "formula": fit.formula,
        "processor_seconds": done.processor_seconds,
    }


def sampled(sampling: str, name: str, quick: bool) -> Numbers:
    """Draws of one system with one sampling."""
    cases = []
    for draw in FIRST + np.arange(QUICK if quick else DRAWS):
        c = case(name, sampling, int(draw)) | {"system": name}
        cases.append(c)
        what = c.get("refused") or f"{c['error']:.2g} {c['formula']}; {c['rubs']}"
        right = "right" if c["right"] else "WRONG"
        print(f"  {name} {draw} ({c['friction']}): {right} {what[:150]}", flush=True)
    return {"cases": cases}


def clean_case(name: str, draw: int) -> Numbers:
    """Even readings without noise beside the same with 1e-6 of the spread: the law is no worse
    where it errs by no more than that of noise, or is right to 1e-6."""
    if draw == FIRST:
        case(name, "even, 30 s", 0, CLEAN)  # what a process loads by its first fit
    clean, noisy = (case(name, "even, 30 s", draw, noise) for noise in (0.0, CLEAN))
    errors = [np.inf if c.get("error") is None else c["error"] for c in (clean, noisy)]
    found: Numbers = {k: clean[k] for k in ("draw", "verdict", "formula", "error") if k in clean}
    found["named"] = bool(errors[0] <= max(errors[1], CLEAN) and clean["right"] >= noisy["right"])
    if "formula" in clean and "formula" in noisy:
        found["times"] = clean["processor_seconds"] / noisy["processor_seconds"]
    return found | {"of_noise": noisy.get("error"), "rubs": [clean.get("rubs"), noisy.get("rubs")]}


# Sensors that show no position

PHONE = {
    "gyro": "omega + b",
    "radial": "A*omega**2 + G*cos(theta)",
    "tangential": "A*theta_ddot + G*sin(theta)",
}
WORN = {  # what a pendulum carries
    "gyroscope": ("gyro",),
    "accelerometer": ("radial", "tangential"),
    "accelerometer, axis along the rod": ("radial",),
    "both": tuple(PHONE),
}


def worn_case(name: str, draw: int) -> Numbers:
    """A pendulum that carries a gyroscope with a bias (noise 5e-3 rad/s), an accelerometer of
    unknown scale κ on its bob (0.03 m/s²), or both, at 50 Hz over 24 s. A law is right whose ω₀²
    is within 0.1 % and whose friction is linear and within 5 %; its sensors' parameters, the bias,
    κl and κg, within four standard errors."""
    rng = np.random.default_rng([88, draw])
    squared, rubs, size, scale = rng.uniform((5, 0.05, 0.25, 0.8), (40, 0.15, 1.2, 1.25))
    t, length, b = 0.02 * np.arange(1_200), 9.81 / squared, rng.uniform(-0.1, 0.1)

    def pull(theta, omega):
        return -squared * np.sin(theta) - rubs * omega

    options = {"t_eval": t, "rtol": 1e-10, "atol": 1e-12}
    theta, omega = solve_ivp(lambda _, s: [s[1], pull(*s)], (0, t[-1]), [size, 0.0], **options).y
    read = {
        "gyro": omega + b,
        "radial": scale * (length * omega**2 + 9.81 * np.cos(theta)),
        "tangential": scale * (length * pull(theta, omega) + 9.81 * np.sin(theta)),
    }
    noise = {"gyro": 5e-3, "radial": 0.03, "tangential": 0.03}
    table = {"t": t} | {n: read[n] + noise[n] * rng.normal(size=len(t)) for n in WORN[name]}
    shown = {n: PHONE[n] for n in WORN[name]}
    fit, said = _fitted(gfnn.Recording(table, coordinates="theta", observe=shown))
    found: Numbers = {"draw": draw, "swing": size, "named": False} | said
    if fit is None:
        return found
    terms = {term.term: term for term in fit.lagrangian.terms}
    lost = {term.term: term for term in fit.friction.terms}
    truth = {"b": b, "A": scale * length, "G": scale * 9.81}
    off = {n: (v - truth[n]) / std for n, (v, std) in fit.sensors.items()}
    found["sensors_off"] = max(map(abs, off.values()))
    if set(lost) == {"omega**2"} and set(terms) == {"omega**2", "cos(theta)"}:
        found["squared_off"] = abs(terms["cos(theta)"].coefficient / squared - 1)
        found["friction_off"] = abs(2 * lost["omega**2"].coefficient / rubs - 1)
        right = found["squared_off"] < 1e-3 and found["friction_off"] < 0.05
        found["right"] = found["named"] = bool(right and found["sensors_off"] < 4)
    return found


# Coordinates that no column shows


def two_carts(rng: np.random.Generator) -> tuple[Callable, Any]:
    """Rates of two carts between walls, joined by a cubic spring, and where they start."""
    m, k1, k2, k, cubic = rng.uniform((0.7, 2, 2, 2, 1), (2.5, 10, 10, 10, 6))
    start, rubs = [1.0, rng.uniform(-0.8, 0.8), 0.0, 0.0], rng.uniform(0.005, 0.05, 2)

    def rates(_, s):
        pull = k * (s[1] - s[0]) + cubic * (s[1] - s[0]) ** 3
        return [
            *s[2:],
            -k1 * s[0] + pull - rubs[0] * s[2],
            (-k2 * s[1] - pull - rubs[1] * s[3]) / m,
        ]

    return rates, start


def three_carts(rng: np.random.Generator) -> tuple[Callable, Any]:
    """Three carts, each on a spring of its own, in a row of cubic springs."""
    m, rubs = np.append(1.0, rng.uniform(0.7, 2.0, 2)), rng.uniform(0.005, 0.05, 3)
    k, cubic, own = rng.uniform(2, 10, 2), rng.uniform(1, 6, 2), rng.uniform(2.5, 10, 3)

    def rates(_, s):
        apart = np.diff(s[:3])
        pull = np.pad(k * apart + cubic * apart**3, 1)
        return [*s[3:], *((np.diff(pull) - own * s[:3] - rubs * s[3:]) / m)]

    return rates, [1.0, *rng.uniform(-0.8, 0.8, 2), 0.0, 0.0, 0.0]


def two_pendulums(rng: np.random.Generator) -> tuple[Callable, Any]:
    """A pendulum on a pendulum."""
    g, m, length = rng.uniform((4, 0.2, 0.5), (20, 0.7, 1.5))
    start, rubs = (
        [rng.uniform(0.4, 1.0), rng.uniform(-1, 1), 0.0, 0.0],
        rng.uniform(0.005, 0.03, 2),
    )

    def rates(_, s):
        c, sine = m * length * np.cos(s[0] - s[1]), m * length * np.sin(s[0] - s[1])
        forces = [
            -sine * s[3] ** 2 - g * np.sin(s[0]),
            sine * s[2] ** 2 - g * m * length * np.sin(s[1]),
        ]
        return [*s[2:], *np.linalg.solve([[1, c], [c, m * length**2]], forces - rubs * s[2:])]

    return rates, start


def hidden_case(name: str, draw: int) -> Numbers:
    """The first of two positions, a law with one hidden coordinate, and its forecasts of five
    periods beside those of the law of both."""
    rng = np.random.default_rng([MECHANICAL.index(name), draw, 1])
    rates, start = (two_carts if name == "carts" else two_pendulums)(rng)
    t = 0.02 * np.arange(3_000)
    options = {"t_eval": t, "rtol": 1e-10, "atol": 1e-12}
    q = solve_ivp(rates, (0, t[-1]), start, **options).y.T[:, :2]
    seen, spread = t < 36, q[:1_800].std(axis=0)
    x = q + NOISE * spread * rng.normal(size=q.shape)
    turns = np.diff(np.sign(q[seen, 0] - q[seen, 0].mean())) != 0
    ahead = t[~seen][: int(5 * 2 * 36 / np.sum(turns) / 0.02)]
    found: Numbers = {"draw": draw, "system": name}
    for columns, model in ((["x1"], gfnn.Lagrangian(hidden=1)), (["x1", "x2"], None)):
        table = {"t": t[seen], "x1": x[seen, 0], "x2": x[seen, 1]}
        angles = columns if name != "carts" else []
        recording = gfnn.Recording(table, positions=columns, angles=angles)
        fit, said = _fitted(recording, model=model)
        if fit is not None:
            off = fit.map.forecast(recording, ahead).values["x1"][0] - q[~seen, 0][: len(ahead)]
            said["error"] = float(np.sqrt(np.mean(off**2)) / spread[0])
        found |= said if len(columns) == 1 else {"of_both": said.get("error")}
    right = found.get("error", np.inf) < 3 * (found["of_both"] or 0.0)
    return found | {"right": bool(right), "named": bool(right), "verdict": found.get("verdict", "")}


def one_that_swings(rng: np.random.Generator) -> tuple[Callable, Any]:
    """A pendulum, or a spring of Duffing's."""
    angle, squared, rubs = bool(rng.integers(2)), rng.uniform(4, 20), rng.uniform(0.0, 0.1)
    cubic = rng.uniform(0.1, 1.0)

    def rates(_, s):
        pull = np.sin(s[0]) if angle else s[0] + cubic * s[0] ** 3
        return [s[1], -squared * pull - rubs * s[1]]

    return rates, [rng.uniform(0.5, 1.5), 0.0]


def one_that_is_driven(rng: np.random.Generator) -> tuple[Callable, Any]:
    """A spring of Duffing's under a harmonic force that nobody recorded."""
    rates, start = one_that_swings(rng)
    size, omega = rng.uniform(0.5, 3.0), rng.uniform(1.0, 6.0)
    return lambda t, s: [s[1], rates(t, s)[1] + size * np.cos(omega * t)], start


NUMBERS = {  # row -> what makes a motion, columns that show it, coordinates that none shows
    "none: a pendulum or a spring": (one_that_swings, 1, 0),
    "none: under a force": (one_that_is_driven, 1, 0),
    "none: two carts": (two_carts, 2, 0),
    "one: two carts": (two_carts, 1, 1),
    "one: two pendulums": (two_pendulums, 1, 1),
    "two: three carts": (three_carts, 1, 2),
}


def number_case(name: str, draw: int) -> Numbers:
    """The first positions of a motion, and the number of hidden coordinates that a fit finds in
    them, told nothing."""
    rng = np.random.default_rng([*name.encode(), draw])
    make, seen, number = NUMBERS[name]
    rates, start = make(rng)
    t = 0.02 * np.arange(1_800)
    q = solve_ivp(rates, (0, t[-1]), start, t_eval=t, rtol=1e-10, atol=1e-12).y[:seen]
    q = q + NOISE * q.std(axis=1)[:, None] * rng.normal(size=q.shape)
    columns = {f"x{k + 1}": x for k, x in enumerate(q)}
    angles = [*columns] if make is two_pendulums else []
    recording = gfnn.Recording({"t": t, **columns}, positions=[*columns], angles=angles)
    fit, said = _fitted(recording)
    found = None if fit is None else fit.map.dim - seen
    return {"draw": draw, "number": found, "named": found == number} | said


# Times at which gates see a motion

SIGMA_OF_TIMES = 1e-4


def gates_case(name: str, draw: int) -> Numbers:
    """A damped pendulum that two photogates at unknown angles see 200 times each, as long as it
    reaches them. A law is right whose ω₀² is within 0.1 %, whose friction is of the right kind, and
    whose gates are within four standard errors."""
    rng = np.random.default_rng([*name.encode(), draw])
    squared, size = rng.uniform((8, 0.6), (40, 1.4))
    linear = bool(rng.integers(2))
    rubs = rng.uniform(0.002, 0.006) * np.sqrt(squared) if linear else rng.uniform(0.005, 0.02)
    places = rng.choice([-1, 1]) * rng.uniform((0.05, -0.2), (0.25, 0.05))

    def rates(_, s):
        return [s[1], -squared * np.sin(s[0]) - rubs * s[1] * (1.0 if linear else abs(s[1]))]

    crossed = [lambda _, s, a=a: s[0] - a for a in places]
    span, start = (0, 800 / np.sqrt(squared)), [size, 0.0]
    options: dict[str, Any] = {"rtol": 1e-10, "atol": 1e-12, "events": crossed}
    times = solve_ivp(rates, span, start, "DOP853", **options).t_events
    gates = [x[:200] + SIGMA_OF_TIMES * rng.normal(size=len(x[:200])) for x in times]
    recording = gfnn.Recording(
        {"t": np.concatenate(gates), "gate": np.repeat(["left", "right"], [*map(len, gates)])},
        events={"left": "theta - a", "right": "theta - b"},
        angles=["theta"],
        std={"left": SIGMA_OF_TIMES, "right": SIGMA_OF_TIMES},
    )
    found: Numbers = {"draw": draw, "friction": "linear" if linear else "quadratic"}
    fit, said = _fitted(recording)
    found |= {"named": False} | said
    if fit is None:
        return found
    terms = {term.term: term.coefficient for term in fit.lagrangian.terms}
    rubbed = [term.term for term in fit.friction.terms]
    found["squared_off"] = float(abs(terms.get("cos(theta)", 0.0) / squared - 1))
    gates_off = [
        (abs(fit.sensors[n][0]) - abs(a)) / fit.sensors[n][1]
        for n, a in zip("ab", places, strict=True)
    ]
    found["gates_off"] = float(max(map(abs, gates_off)))
    right = found["squared_off"] < 1e-3 and found["gates_off"] < 4
    found["named"] = bool(right and rubbed == ["omega**2" if linear else "abs(omega)**3"])
    return found


# Records that no law of the vocabulary makes


def hysteresis(rng: np.random.Generator) -> np.ndarray:
    """A spring of Bouc and Wen beside a linear one, let go."""
    share, stiffness, c = rng.uniform(0.3, 0.7), rng.uniform(5, 20), rng.uniform(0.02, 0.1)

    def rates(_, s):
        x, v, z = s
        dz = v - 1.5 * abs(v) * z - 0.8 * v * abs(z)
        return [v, -stiffness * ((1 - share) * x + share * z) - c * v, dz]

    return _orbit(rates, [rng.uniform(1, 3), 0, 0])[:, :1]


def impacts(rng: np.random.Generator) -> np.ndarray:
    """A mass on a spring between stiff walls."""
    stiffness, wall, hard = rng.uniform(2, 8), rng.uniform(0.3, 0.7), rng.uniform(3e3, 1e4)

    def rates(_, s):
        over = max(s[0] - wall, 0.0) - max(-s[0] - wall, 0.0)
        return [s[1], -stiffness * s[0] - hard * over - (5.0 if over else 0.02) * s[1]]

    return _orbit(rates, [0.0, rng.uniform(3, 6)], max_step=1e-3)[:, :1]


def random_walk(rng: np.random.Generator) -> np.ndarray:
    """Sums of independent steps, of one column or two, some drawn back to zero."""
    back = float(rng.choice([0.0, 0.01, 0.05]))
    steps = rng.normal(size=(len(TIMES), rng.integers(1, 3)))
    for k in range(1, len(steps)):
        steps[k] += (1 - back) * steps[k - 1]
    return steps


def food_chain(rng: np.random.Generator) -> np.ndarray:
    """Hastings and Powell's chain of three species with saturation."""
    b1 = rng.uniform(2.2, 3.2)

    def rates(_, s):
        x, y, z = s
        eaten, prey = 5 * x * y / (1 + b1 * x), 0.1 * y * z / (1 + 2 * y)
        return 4 * np.array([x * (1 - x) - eaten, eaten - prey - 0.4 * y, prey - 0.01 * z])

    return _orbit(rates, [rng.uniform(0.6, 0.9), rng.uniform(0.1, 0.3), rng.uniform(8, 11)])


def unrecorded_force(rng: np.random.Generator) -> np.ndarray:
    """A pendulum or a spring under a force of broad spectrum."""
    angle, omega2, c = bool(rng.integers(2)), rng.uniform(4, 20), rng.uniform(0.1, 0.5)
    force = _band(rng, 3.0 * np.sqrt(omega2) / (2 * np.pi)) * omega2 * rng.uniform(0.3, 0.8)

    def rates(t, s):
        pull = np.sin(s[0]) if angle else s[0]
        return [s[1], -omega2 * pull - c * s[1] + np.interp(t, TIMES, force)]

    return _orbit(rates, [0.3, 0.0])[:, :1]


def maglev(rng: np.random.Generator) -> np.ndarray:
    """A ball under a magnet whose current a controller sets, unrecorded."""
    target = 1 + 0.15 * np.sign(np.sin(TIMES * rng.uniform(0.6, 1.2))) + 0.1 * _band(rng, 1.0)
    kp, kd, lag = rng.uniform(25, 40), rng.uniform(6, 9), rng.uniform(0.03, 0.08)

    def rates(t, s):
        x, v, i = s
        asked = 3.1 + kp * (x - np.interp(t, TIMES, target)) / 3 + kd * v / 3
        return [v, 9.81 - max(i, 0.0) ** 2 / max(x, 0.2) ** 2, (asked - i) / lag]

    return _orbit(rates, [1.0, 0.0, 3.1])[:, :1]


def turbulence(rng: np.random.Generator) -> np.ndarray:
    """Gaussian noise whose power falls with the frequency to the power of 5/3."""
    count, columns = len(TIMES), int(rng.integers(1, 3))
    f = np.fft.rfftfreq(count)
    size = np.where(f > rng.uniform(1e-3, 5e-3), np.maximum(f, 1e-9) ** (-5 / 6), 0.0)
    return np.fft.irfft(
        size[:, None] * np.fft.rfft(rng.normal(size=(count, columns)), axis=0), axis=0
    )


def one_of_three(rng: np.random.Generator) -> np.ndarray:
    """A coordinate of a chaotic flow of first order: Rössler's, Lorenz' or Thomas'."""
    fast, which = rng.uniform(0.7, 1.3), int(rng.integers(3))
    flows = (
        lambda x, y, z: (-y - z, x + 0.2 * y, 0.2 + z * (x - 5.7)),
        lambda x, y, z: (10 * (y - x), x * (28 - z) - y, x * y - 8 / 3 * z),
        lambda x, y, z: (np.sin(y) - 0.19 * x, np.sin(z) - 0.19 * y, np.sin(x) - 0.19 * z),
    )
    fast *= (2.0, 0.4, 3.0)[which]
    start = np.array([1.0, 0.5, (0.1, 20.0, 0.5)[which]]) * rng.uniform(0.9, 1.1, 3)
    found = _orbit(lambda _, s: fast * np.array(flows[which](*s)), start)
    return found[:, [int(rng.integers(3))]]


def unrecorded_waves(rng: np.random.Generator) -> np.ndarray:
    """A pendulum or a spring under a square wave or a saw tooth that nobody recorded."""
    angle, wave = bool(rng.integers(2)), (square, sawtooth)[rng.integers(2)]
    omega2, c = rng.uniform(4, 20), rng.uniform(0.05, 0.5)
    drive, size = np.sqrt(omega2) * rng.uniform(0.25, 1.7), omega2 * rng.uniform(0.1, 0.5)

    def rates(t, s):
        pull = np.sin(s[0]) if angle else s[0]
        return [s[1], -omega2 * pull - c * s[1] + size * wave(drive * t)]

    return _orbit(rates, [rng.uniform(-0.5, 0.5), 0.0], max_step=0.02)[:, :1]


def relay(rng: np.random.Generator) -> np.ndarray:
    """A mass that a relay holds, with a dead zone in which it keeps its last sign, or without."""
    omega2, c, size = rng.uniform(0, 6), rng.uniform(0.05, 0.5), rng.uniform(1, 4)
    lead, dead = rng.uniform(-0.1, 0.3), rng.choice([0.0, rng.uniform(0.05, 0.3)])
    x, v, u, fine, found = 1.0, 0.0, -1.0, 20, []
    for k in range(fine * len(TIMES)):
        asked = x + lead * v
        u = -float(np.sign(asked)) if abs(asked) > dead else u
        v += TIMES[1] / fine * (-omega2 * x - c * v + size * u)
        x += TIMES[1] / fine * v
        found += [x] * (k % fine == 0)
    return np.array(found)[:, None]


def backlash(rng: np.random.Generator) -> np.ndarray:
    """A mass that an unrecorded support moves, through a spring with play."""
    gap, k, w, c = rng.uniform([0.1, 20, 1, 0.1], [0.4, 60, 4, 0.6])

    def rates(t, s):
        pull = np.sin(w * t) + 0.5 * np.sin(1.618 * w * t) - s[0]
        return [s[1], k * np.sign(pull) * max(abs(pull) - gap, 0.0) - c * s[1]]

    return _orbit(rates, [0.0, 0.0], max_step=0.01)[:, :1]


def steps(rng: np.random.Generator) -> np.ndarray:
    """Noise of a band that is held for some samples, or rounded; or a telegraph's signal."""
    x, kind = _band(rng, rng.uniform(0.5, 2.0))[:, None], int(rng.integers(3))
    if kind == 0:
        return x[np.arange(len(x)) // (n := int(rng.integers(3, 12))) * n]
    if kind == 1:
        return np.round(x / (coarse := rng.uniform(0.2, 1.0))) * coarse
    return np.cumprod(np.where(rng.uniform(size=x.shape) < 0.04, -1.0, 1.0), axis=0)


def resonant_noise(rng: np.random.Generator) -> np.ndarray:
    """An autoregression of order 2."""
    w, damping = rng.uniform(2, 8) * TIMES[1], rng.uniform(0.02, 0.3)
    part = [1.0, -2 * np.exp(-damping * w) * np.cos(w), np.exp(-2 * damping * w)]
    return np.asarray(lfilter([1.0], part, rng.normal(size=(len(TIMES), 1)), axis=0))


def _band(rng: np.random.Generator, highest: float) -> np.ndarray:
    """Noise (n,) of unit size up to a frequency (Hz)."""
    f = np.fft.rfftfreq(len(TIMES), TIMES[1])
    found = np.fft.irfft(np.where(f < highest, np.fft.rfft(rng.normal(size=len(TIMES))), 0))
    return found / found.std()


def _orbit(rates: Callable, start: Any, **options: Any) -> np.ndarray:
    span = (0, TIMES[-1])
    return solve_ivp(rates, span, start, t_eval=TIMES, rtol=1e-8, atol=1e-10, **options).y.T


TIMES = 0.02 * np.arange(2_000)
UNCERTAIN = "no certain cause"
OUTSIDE = {  # generator -> words of a verdict that names what the record is
    "hysteresis": (hysteresis, ("memory", "hysteresis")),
    "impacts": (impacts, ("impact", "jump")),
    "random walks": (random_walk, ("chance",)),
    "food chain": (food_chain, ("first order",)),
    "unrecorded broadband force": (unrecorded_force, ("unrecorded",)),
    "maglev, current unrecorded": (maglev, ("unrecorded",)),
    "turbulence-like noise": (turbulence, ("chance",)),
    "one coordinate of a chaotic flow": (one_of_three, ("unrecorded", UNCERTAIN)),
    "unrecorded square wave or saw tooth": (unrecorded_waves, ("unrecorded", UNCERTAIN, "drive")),
    "relay": (relay, ("memory", "force", UNCERTAIN)),
    "backlash of an unrecorded support": (backlash, ("unrecorded", UNCERTAIN)),
    "steps": (steps, ("steps",)),
    "autoregression": (resonant_noise, ("unrecorded", "chance")),
}
EACH = (6, 6, 6, 5, 6, 5, 6, *6 * (4,))


def outside_case(name: str, draw: int) -> Numbers:
    """A record outside the vocabulary, and what is said of it."""
    rng = np.random.default_rng([*name.encode(), draw])
    make, words = OUTSIDE[name]
    x = make(rng)
    x = x + (name != "steps") * NOISE * x.std(axis=0) * rng.normal(size=x.shape)
    names = [f"x{i}" for i in range(1, x.shape[1] + 1)]
    table = {"t": TIMES, **dict(zip(names, x.T, strict=True))}
    _, said = _fitted(gfnn.Recording(table, positions=names, angles=[]))
    verdict = said["verdict"] or f"refused: {said.get('refused')}"
    return said | {
        "draw": draw,
        "class": name,
        "verdict": verdict,
        "identified": verdict.startswith("identified"),
        "named": any(word in verdict for word in words),
    }


# Positions that tell the velocities


class Motion(NamedTuple):
    """Rates of a motion of two positions, with their speeds behind them where it is a law of
    forces; where it starts, and about how long it takes to come back."""

    rates: Callable
    start: Any
    period: float


def membrane(rng: np.random.Generator) -> Motion:
    """FitzHugh and Nagumo's."""
    a, b, slow, current = rng.uniform((0.5, 0.6, 0.06, 0.4), (0.8, 0.9, 0.15, 0.7))

    def rates(_, z):
        return [z[0] - z[0] ** 3 / 3 - z[1] + current, slow * (z[0] + a - b * z[1])]

    return Motion(rates, [rng.uniform(-1, 1), rng.uniform(-0.5, 1)], 40.0)


def prey(rng: np.random.Generator) -> Motion:
    """Lotka and Volterra's."""
    a, b, c, d = rng.uniform(0.5, 1.5, 4)
    start = rng.uniform((0.7, 0.5), (2.0, 1.5)) * [d / c, a / b]
    return Motion(
        lambda _, z: [z[0] * (a - b * z[1]), z[1] * (c * z[0] - d)], start, 7 / np.sqrt(a * d)
    )


def brusselator(rng: np.random.Generator) -> Motion:
    """An oscillating reaction."""
    a = rng.uniform(0.8, 1.2)
    b = 1 + a * a + rng.uniform(0.1, 0.6)

    def rates(_, z):
        made = z[0] ** 2 * z[1]
        return [a + made - (b + 1) * z[0], b * z[0] - made]

    return Motion(rates, [1.0, 1.0], 7.0)


def two_columns_of_van_der_pol(rng: np.random.Generator) -> Motion:
    """In Liénard's plane."""
    m = rng.uniform(0.3, 1.5)
    return Motion(lambda _, z: [m * (z[0] - z[0] ** 3 / 3 - z[1]), z[0] / m], [0.5, 0.0], 7.0)


def decay(rng: np.random.Generator) -> Motion:
    """Two linear equations, whose spiral two equal springs with friction have too."""
    g, w, k = rng.uniform((0.01, 0.8, 0.5), (0.04, 1.5, 2.0))
    return Motion(
        lambda _, z: [-g * z[0] - w * k * z[1], w / k * z[0] - g * z[1]], [1.0, 0.3], 6.28 / w
    )


def planet(rng: np.random.Generator) -> Motion:
    """An ellipse about a sun."""
    e, m = rng.uniform((0.05, 0.5), (0.6, 2.0))
    fast = np.sqrt(m * (1 + e) / (1 - e))

    def rates(_, z):
        pull = -m / np.hypot(z[0], z[1]) ** 3
        return [z[2], z[3], pull * z[0], pull * z[1]]

    return Motion(rates, [1 - e, 0.0, 0.0, fast], 6.28 / np.sqrt(m))


def equal_springs(rng: np.random.Generator) -> Motion:
    """An ellipse about its middle, with or without friction."""
    w, g = rng.uniform(0.8, 2.0), float(rng.choice([0.0, 0.02]))
    start = [1.0, 0.0, rng.uniform(-0.5, 0.5) * w, rng.uniform(0.3, 1.2) * w]
    return Motion(
        lambda _, z: [z[2], z[3], -w * w * z[0] - g * z[2], -w * w * z[1] - g * z[3]],
        start,
        6.28 / w,
    )


def rosette(rng: np.random.Generator) -> Motion:
    """A hardening spring in the plane, whose orbit crosses itself."""
    b = rng.uniform(0.2, 1.0)

    def rates(_, z):
        pull = -(1 + b * (z[0] ** 2 + z[1] ** 2))
        return [z[2], z[3], pull * z[0], pull * z[1]]

    return Motion(rates, [1.0, 0.0, 0.0, rng.uniform(0.4, 1.2)], 5.5)


POWERS = "one of several: the power of the distance"
ORBITS = {
    "membrane": (membrane, ("first order",)),
    "prey and predators": (prey, ("first order",)),
    "reaction": (brusselator, ("first order",)),
    "Van der Pol in Liénard's plane": (two_columns_of_van_der_pol, ("first order",)),
    "two linear equations": (decay, ("first order",)),
    "ellipse about a sun": (planet, ("identified", POWERS)),
    "ellipse about its middle": (equal_springs, ("identified", "first order or mechanical")),
    "rosette": (rosette, ("identified", POWERS)),
}
EACH_ORBIT = 5


def orbit_case(name: str, draw: int) -> Numbers:
    """One orbit, 3 to 15 periods of it, and what is said of it."""
    rng = np.random.default_rng([*name.encode(), draw])
    make, words = ORBITS[name]
    motion = make(rng)
    t = np.arange(0, rng.uniform(3, 15) * motion.period, motion.period / rng.uniform(40, 80))
    options = {"t_eval": t, "rtol": 1e-9, "atol": 1e-11}
    x = solve_ivp(motion.rates, (0, t[-1]), motion.start, **options).y.T[:, :2]
    x = x + NOISE * x.std(axis=0) * rng.normal(size=x.shape)
    table = {"t": t, "x1": x[:, 0], "x2": x[:, 1]}
    fit, said = _fitted(gfnn.Recording(table, positions=["x1", "x2"], angles=[]))
    verdict = said["verdict"] or f"refused: {said.get('refused')}"
    wrong = verdict.startswith("identified") and not _is_right(fit, motion, x)
    return said | {
        "draw": draw,
        "class": name,
        "verdict": verdict,
        "identified": verdict.startswith("identified"),
        "wrong": wrong,
        "named": any(word in verdict for word in words) and not wrong,
    }


def _is_right(fit: Any, motion: Motion, x: np.ndarray) -> bool:
    """Return whether a law has the forces of the truth, also a third off the orbit x (n, 2)."""
    if len(motion.start) == 2:
        return False  # of first order
    r, law = np.linalg.norm(x, axis=1), law_of(fit, 1e-3)
    turns = np.exp(1j * np.arange(12))
    at = np.linspace(0.7 * r.min(), 1.3 * r.max(), 12) * turns
    q = np.stack([at.real, at.imag], axis=1)
    true = np.array([motion.rates(0.0, [*one, 0.0, 0.0])[2:] for one in q])
    miss = np.array([law(one, np.zeros(2)) for one in q]) - true
    return bool(np.all(np.linalg.norm(miss, axis=1) < OFF * np.linalg.norm(true, axis=1)))


def drawn(one: Callable[[str, int], Numbers], name: str, count: int, quick: bool) -> Numbers:
    """Draws of records of one kind, and what is said of each."""
    cases = []
    for draw in FIRST + np.arange(1 if quick else count):
        c = one(name, int(draw))
        cases.append(c)
        named = "named" if c["named"] else "NOT"
        what = c.get("formula", "") + " " + c["verdict"]
        print(f"  {name} {draw}: {named}: {what[:150]}", flush=True)
    return {"cases": cases}


def _slug(name: str) -> str:
    plain = name.lower().replace(" %", "-percent").replace("é", "e")
    return re.sub("[^a-z0-9-]", "", plain.replace(" ", "-"))


ROWS = [
    (sampling, name)
    for sampling in (*SAMPLINGS, SHORT)
    for name in MECHANICAL
    if (sampling, name) != (SHORT, "double pendulum")
]
PIECES = {_slug(f"{s} {name}"): partial(sampled, s, name) for s, name in ROWS}
PIECES |= {
    _slug(f"outside {n}"): partial(drawn, outside_case, n, k)
    for n, k in zip(OUTSIDE, EACH, strict=True)
}
PIECES |= {_slug(f"clean {n}"): partial(drawn, clean_case, n, CLEAN_DRAWS) for n in MECHANICAL}
PIECES |= {_slug(f"worn {n}"): partial(drawn, worn_case, n, DRAWS) for n in WORN}
HIDDEN = ("carts", "double pendulum")
PIECES |= {_slug(f"hidden {n}"): partial(drawn, hidden_case, n, DRAWS) for n in HIDDEN}
PIECES |= {_slug(f"hidden number {n}"): partial(drawn, number_case, n, DRAWS) for n in NUMBERS}
GATES = ("two gates",)
PIECES |= {_slug(n): partial(drawn, gates_case, n, DRAWS) for n in GATES}
PIECES |= {_slug(f"orbit {n}"): partial(drawn, orbit_case, n, EACH_ORBIT) for n in ORBITS}


def tables() -> None:
    """The tables of RESULTS.md."""
    found = results_of(PIECES, "any_record")
    cases = {piece: one["measured"]["cases"] for piece, one in found.items()}
    rows = []
    for sampling, name in ROWS:
        own = cases.get(_slug(f"{sampling} {name}"))
        if own is None:
            continue
        laws = [c for c in own if "formula" in c]
        right = [c["error"] for c in laws if c["right"]]
        wrong = [c for c in laws if not c["right"] and c["verdict"].startswith("identified")]
        rows.append(
            [
                sampling,
                name,
                f"{len(right)} of {len(own)}",
                str(len(own) - len(laws)),
                str(len(wrong)),
                number(np.median(right)) if right else "–",
                number(np.mean([c["processor_seconds"] for c in laws])) if laws else "–",
            ]
        )
    heads = (
        "sampling",
        "system",
        "right",
        "refused",
        "wrong and *identified*",
        "median error of the right, a period ahead",
        "CPU s",
    )
    text = markdown(heads, rows)
    rows = []
    for name in MECHANICAL:
        own = cases.get(_slug(f"clean {name}"), [])
        times = [number(np.median([c["times"] for c in own if "times" in c]))] if own else []
        if own:
            rows.append([name, f"{sum(c['named'] for c in own)} of {len(own)}", *times])
    heads = (
        "without noise, beside σ 1e-6",
        "law no worse",
        "median ratio of seconds",
    )
    text += "\n\n" + markdown(heads, rows)
    rows = []
    for name in WORN:
        own = cases.get(_slug(f"worn {name}"), [])
        heads = ("squared_off", "friction_off", "sensors_off")
        errors = [[c[k] for c in own if k in c] for k in heads]
        largest = [number(max(e)) if e else "–" for e in errors]
        if own:
            rows.append([name, f"{sum(c['named'] for c in own)} of {len(own)}", *largest])
    heads = (
        "carried by a pendulum",
        "right",
        "largest relative error of ω₀²",
        "of friction",
        "of bias, κl, κg, in standard errors",
    )
    text += "\n\n" + markdown(heads, rows)
    rows = []
    for name in HIDDEN:
        own = cases.get(_slug(f"hidden {name}"), [])
        errors = [[c[k] for c in own if c.get(k)] for k in ("error", "of_both")]
        right = f"{sum(c['right'] for c in own)} of {len(own)}"
        if own:
            rows.append([name, right, *(number(np.median(e)) if e else "–" for e in errors)])
    heads = (
        "one column, one hidden coordinate",
        "forecast within 3 × that of both",
        "median error, five periods ahead",
        "of both",
    )
    text += "\n\n" + markdown(heads, rows)
    rows = []
    for name in NUMBERS:
        own = cases.get(_slug(f"hidden number {name}"), [])
        times = [c["processor_seconds"] for c in own if "processor_seconds" in c]
        right = f"{sum(c['named'] for c in own)} of {len(own)}"
        if own:
            rows.append([name, right, *(number(f(times)) for f in (np.median, max) if times)])
    heads = ("hidden coordinates, told only the columns", "number right", "median CPU s", "most")
    text += "\n\n" + markdown(heads, rows)
    rows = []
    for name in GATES:
        own = cases.get(_slug(name), [])
        errors = [[c[k] for c in own if k in c] for k in ("squared_off", "gates_off")]
        right = f"{sum(c['named'] for c in own)} of {len(own)}"
        if own:
            rows.append([name, right, *(number(max(e)) if e else "–" for e in errors)])
    heads = (
        "a pendulum's times at",
        "right",
        "largest relative error of ω₀²",
        "of the gates' angles, in standard errors",
    )
    text += "\n\n" + markdown(heads, rows)
    for kind, names, head in (
        ("outside", OUTSIDE, "outside the vocabulary"),
        ("orbit", ORBITS, "one orbit, of first order or of a law"),
    ):
        rows = []
        for name in names:
            own = cases.get(_slug(f"{kind} {name}"), [])
            named, identified, wrong = (
                sum(c.get(k, False) for c in own) for k in ("named", "identified", "wrong")
            )
            wrong = identified if kind == "outside" else wrong
            if own:
                rows.append([name, f"{named} of {len(own)}", str(identified), str(wrong)])
        heads = (head, "named for what it is", "*identified*", "wrong and *identified*")
        text += "\n\n" + markdown(heads, rows)
    between_markers(TABLES, "any-record", f"{text}\n\n{provenance(found)}")


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "any_record", tables, None, ["poisson-30-s-pendulum"])
