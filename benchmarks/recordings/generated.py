"""Recordings as laboratories write them, simulated: clean ones, and ones with a known mistake.

Every recording is a table of text columns with runs, noise and digits, of one of six small systems.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

Columns = dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class Sheet:
    """Runs of one file: names of positions and velocities, and by run name columns (n,) by name,
    ``t`` first, in SI units and lifted radians. text: extra lines below the header."""

    positions: tuple[str, ...]
    velocities: tuple[str, ...]
    angular: bool
    runs: dict[str, Columns]
    text: str = ""

    def changed(self, change: Callable[[Columns], Columns], **more) -> Sheet:
        """With every run's columns changed."""
        runs = {run: change(dict(columns)) for run, columns in self.runs.items()}
        return dataclasses.replace(self, runs=runs, **more)

    def written(self, path: Path, *, with_runs: bool = True) -> Path:
        """The CSV file, run by run."""
        names = list(dict.fromkeys(n for columns in self.runs.values() for n in columns))
        with open(path, "w", encoding="utf-8") as file:
            file.write(",".join([*(["run"] if with_runs else []), *names]) + "\n" + self.text)
            for run, columns in self.runs.items():
                for k in range(len(columns["t"])):
                    cells = [f"{columns[n][k]:.9g}" if n in columns else "" for n in names]
                    cells = ["" if cell == "nan" else cell for cell in cells]
                    file.write(",".join([*([run] if with_runs else []), *cells]) + "\n")
        return path


# The systems: right-hand sides of z = (q, v), with a state to start from, for a random number
# generator; sizes of one, times of seconds.


def _pendulum(rng):
    w, c = rng.uniform(3, 12), rng.choice([0.0, 0.05, 0.2])
    return (
        ("theta",),
        ("omega",),
        True,
        lambda t, z: [z[1], -w * np.sin(z[0]) - c * z[1]],
        (lambda: [rng.uniform(0.4, 2.4), 0.0]),
    )


def _cart(rng):
    w, k, c = rng.uniform(2, 20), rng.choice([0.0, 3.0]), rng.choice([0.0, 0.1])
    return (
        ("x",),
        ("v",),
        False,
        lambda t, z: [z[1], -w * z[0] - k * z[0] ** 3 - c * z[1]],
        (lambda: [rng.uniform(0.3, 1.5), rng.uniform(-1, 1)]),
    )


def _two_carts(rng):
    a, b, c = rng.uniform(4, 20, 3)
    g = rng.choice([0.0, 0.1])

    def rate(t, z):
        x, y, u, v = z
        return [u, v, -a * x + b * (y - x) - g * u, -c * y - b * (y - x) - g * v]

    return ("x1", "x2"), ("v1", "v2"), False, rate, lambda: [*rng.uniform(-1, 1, 2), 0.0, 0.0]


def _double_pendulum(rng):
    m, g, c = rng.uniform(0.5, 2), rng.uniform(5, 15), rng.choice([0.0, 0.03])

    def rate(t, z):
        a, b, u, v = z
        s, k = np.sin(a - b), np.cos(a - b)
        f = -s * v * v - (1 + m) * g * np.sin(a) - c * u
        h = s * u * u - g * np.sin(b) - c * v
        det = 1 + m - k * k
        return [u, v, (f - k * h) / det, ((1 + m) * h - k * f) / det]

    start = lambda: [rng.uniform(0.5, 2.5), rng.uniform(-1, 2), 0.0, 0.0]  # noqa: E731
    return ("theta1", "theta2"), ("omega1", "omega2"), True, rate, start


def _plane(rng):
    w, k = rng.uniform(2, 8), rng.uniform(0.2, 1)

    def rate(t, z):
        x, y, u, v = z
        return [u, v, -w * x - 2 * k * x * y, -1.3 * w * y - k * (x * x - y * y)]

    return ("x", "y"), ("vx", "vy"), False, rate, lambda: [*rng.uniform(-0.8, 0.8, 4)]


def _driven(rng):
    w, c, f = rng.uniform(3, 9), rng.uniform(0.1, 0.5), rng.uniform(0.5, 1.5)

    def rate(t, z):
        return [z[1], -w * np.sin(z[0]) - c * z[1] + _torque(t, f)]

    return ("theta",), ("omega",), True, rate, lambda: [rng.uniform(-0.5, 0.5), 0.0]


def _torque(t, f):
    return f * (np.sin(1.7 * t) + 0.7 * np.sin(0.61 * t + 1))


SYSTEMS = (_pendulum, _cart, _two_carts, _double_pendulum, _plane, _driven)


def sheet(
    seed: int, kind: int | None = None, *, runs: int | None = None, stiffer: float = 1.0
) -> Sheet:
    """A clean recording: 1 to 5 runs, 50 to 200 samples a second, even or jittered times, a gap
    now and then; noise of 3e-5 to 3e-3 of the spread. stiffer: factor of all accelerations in the
    last run."""
    rng = np.random.default_rng(seed)
    make = SYSTEMS[(seed if kind is None else kind) % len(SYSTEMS)]
    positions, velocities, angular, rate, start = make(rng)
    number = int(rng.integers(1, 6)) if runs is None else runs
    step = float(rng.choice([0.005, 0.01, 0.02]))
    noise = 10 ** rng.uniform(-4.5, -2.5)
    jittered, gapped = rng.random() < 0.3, rng.random() < 0.3
    found: dict[str, Columns] = {}
    for run in range(number):
        count = int(rng.integers(500, 1200))
        t = step * np.arange(count)
        if jittered:
            t[1:-1] += rng.uniform(-0.2, 0.2, count - 2) * step
        if gapped:
            t = np.delete(t, slice(count // 2, count // 2 + 12))
        factor = np.repeat([1.0, stiffer if run == number - 1 else 1.0], len(positions))
        forced = lambda t, z, f=factor: f * rate(t, z)  # noqa: E731
        z = solve_ivp(forced, (0, t[-1]), start(), "DOP853", t, rtol=1e-8, atol=1e-9).y
        z = z + noise * z.std(axis=1, keepdims=True) * rng.standard_normal(z.shape)
        columns = {"t": np.round(t, 6), **dict(zip((*positions, *velocities), z, strict=True))}
        if make is _driven:
            f = rate(0.0, [0.0, 0.0])[1] / _torque(0.0, 1.0)
            columns["tau"] = _torque(t, f)
        found[str(run)] = columns
    return Sheet(positions, velocities, angular, found)


# Mistakes: what a user's file holds instead of a clean sheet.


def _swapped(sheet: Sheet) -> Sheet:
    """The columns in another order than their header: x and v stand in each other's place."""
    x, v = sheet.positions[0], sheet.velocities[0]
    return sheet.changed(lambda c: {**c, x: c[v], v: c[x]})


def _interleaved(sheet: Sheet) -> Sheet:
    """θ₁, ω₁, θ₂, ω₂ under the header θ₁, θ₂, ω₁, ω₂."""
    (a, b), (u, w) = sheet.positions, sheet.velocities
    return sheet.changed(lambda c: {**c, a: c[a], b: c[u], u: c[b], w: c[w]})


def _milliseconds(sheet: Sheet) -> Sheet:
    return sheet.changed(lambda c: {**c, "t": 1e3 * c["t"]})


def _degrees(sheet: Sheet) -> Sheet:
    return sheet.changed(lambda c: {**c, **{n: np.degrees(c[n]) for n in sheet.positions}})


def _degrees_alone(sheet: Sheet) -> Sheet:
    """Angles in degrees, without velocities."""

    def change(c):
        return {"t": c["t"], **{n: np.degrees(c[n]) for n in sheet.positions}}

    return sheet.changed(change, velocities=())


def _cut(sheet: Sheet) -> Sheet:
    """A turning angle, wrapped, then interpolated on a finer grid of times."""
    name = sheet.positions[0]

    def change(c):
        t = c["t"]
        fine = np.arange(t[0], t[-1], 0.37 * np.median(np.diff(t)))
        turning = np.angle(np.exp(1j * (c[name] + 1.3 * t)))
        return {"t": np.round(fine, 9), name: np.interp(fine, t, turning)}

    return sheet.changed(change, velocities=())


def _same_time(sheet: Sheet) -> Sheet:
    def change(c):
        t = c["t"].copy()
        t[len(t) // 3] = t[len(t) // 3 - 1]
        return {**c, "t": t}

    return sheet.changed(change)


def _gone(sheet: Sheet) -> Sheet:
    """Single cells of a column are NaN."""
    name = sheet.positions[-1]

    def change(c):
        x = c[name].copy()
        x[17::97] = np.nan
        return {**c, name: x}

    return sheet.changed(change)


def _column_gone(sheet: Sheet) -> Sheet:
    name = sheet.velocities[-1]
    runs = {**sheet.runs}
    last = list(runs)[-1]
    runs[last] = {n: x for n, x in runs[last].items() if n != name}
    return dataclasses.replace(sheet, runs=runs)


def _negative(sheet: Sheet) -> Sheet:
    v = sheet.velocities[0]
    return sheet.changed(lambda c: {**c, v: -c[v]})


def _clipped(sheet: Sheet) -> Sheet:
    x = sheet.positions[0]
    limit = 0.7 * max(np.abs(c[x]).max() for c in sheet.runs.values())
    return sheet.changed(lambda c: {**c, x: np.clip(c[x], -limit, limit)})


def _drifting(sheet: Sheet) -> Sheet:
    def change(c):
        t = c["t"]
        return {**c, "t": np.round(t * (1 + 0.02 * t / t[-1]), 6)}

    return sheet.changed(change)


MISTAKES: dict[str, tuple[tuple[str, ...], Callable[[int], tuple[Sheet, bool]]]] = {
    # name: (kinds of faults that name it, seed -> (sheet, whether runs have a column))
    "wrong order": (("order",), lambda s: (_swapped(sheet(s, s % 5)), True)),
    "interleaved": (("order",), lambda s: (_interleaved(sheet(s, 2 + s % 3)), True)),
    "wrong dt": (("time unit",), lambda s: (_milliseconds(sheet(s)), True)),
    "degrees": (("degrees",), lambda s: (_degrees(sheet(s, (0, 3, 5)[s % 3])), True)),
    "degrees alone": (("degrees",), lambda s: (_degrees_alone(sheet(s, (0, 3)[s % 2])), True)),
    "interpolated jump": (("interpolated jump",), lambda s: (_cut(sheet(s, 0)), True)),
    "repeated times": (("is the same as",), lambda s: (_same_time(sheet(s)), True)),
    "times run back": (("reading",), lambda s: (sheet(s, runs=3), False)),
    "a unit row": (
        ("reading",),
        lambda s: (dataclasses.replace(sheet(s, 0, runs=2), text="-,s,rad,rad/s\n"), True),
    ),
    "NaN": (("missing",), lambda s: (_gone(sheet(s)), True)),
    "a column missing": (("missing column",), lambda s: (_column_gone(sheet(s, runs=3)), True)),
    "wrong sign": (("sign",), lambda s: (_negative(sheet(s)), True)),
    "two systems": (("different systems",), lambda s: (sheet(s, s % 3, runs=3, stiffer=1.5), True)),
    "clipped": (("clipped",), lambda s: (_clipped(sheet(s, s % 5)), True)),
    "drifting clock": (("drifting clock",), lambda s: (_drifting(sheet(s)), True)),
}
