"""Public tables: their systems, splits and metrics, beside the best figure that each table has.

    python benchmarks/public.py                     the flows of dysts, which are made here
    python benchmarks/public.py --odebench FILE     ODEBench too, FILE its strogatz_extended.json
    python benchmarks/public.py --records DIR       SNLS80mV.csv and dataBenchmark.csv in DIR too
    python benchmarks/public.py --quick             two flows, into runs/

dysts (Gilpin, arXiv:2110.05266): Hamiltonian and nearly Hamiltonian flows at its initial states and
parameters, 1,000 samples at 100 a period without noise, then 200 steps ahead; the metric is its
sMAPE in per cent, the mean over columns. The table's models saw one column, ours all of them: as
states (q, p), angles named. Its double pendulum is as coded there, and as mechanics has it:
the two differ by half of a term in dp/dt, and the first keeps no symplectic form.

ODEBench (d'Ascoli et al., arXiv:2310.05573): one trajectory of 512 samples, noise x (1 + γ ξ), the
metric R² > 0.9 on the trajectory of the second initial state. Systems of our kind, listed before
any was fitted: `MECHANICAL`, as recordings of a position and its velocity, angles named, and
`POISSON`, populations as states without a bracket. The other 53 are of first order, self-excited
or have friction that depends on position.

Silverbox (Wigren & Schoukens, ECC 2013): the law of the multisine, and the free run of the arrow,
which is the first 40,000 samples, from its first 20 on. Cascaded tanks (Schoukens & Noël, 2017):
the estimation record, of which there is no mechanical law. What it shows of this is told by free
runs, of two tanks by Torricelli's law and of a mechanical law, both fitted to it.
"""

from __future__ import annotations

import functools
import json
import sys
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from harness import TABLES, Numbers, between_markers, main, markdown, number, once, provenance
from harness import results as results_of
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import gfnn_jax as gfnn
from gfnn_jax.errors import FitError
from gfnn_jax.models.brackets.fields import FreeField, fit_field
from gfnn_jax.models.brackets.find import polynomials

FILE, FOLDER = "--odebench", "--records"
# Number in ODEBench -> whether its position is an angle
MECHANICAL = {24: False, 25: False, 28: True, 32: False, 34: True, 43: True, 44: True}
POISSON = (27, 31)
GAMMAS = (0.0, 0.05)  # γ, of the multiplicative noise
RATE = 1e7 / 2**14  # Hz, of Silverbox
ARROW, MULTISINE = slice(0, 40_000), slice(40_650, 105_712)  # samples
SEEN = 20  # samples that a free run begins with
FULL = 10.0  # V, beyond which the sensor of the tanks shows no more
# The two states at first, and the numbers of `_two_tanks` and `_cubic_spring`, to begin with
TANKS = np.array([4, 5.2, 0.05, 0.05, 0.05, 0.05])
SPRING = np.array([0, 5.2, 0, -4e-4, 0, 0, 8e-4, 0.04, 0])
RIGHT = 0.9  # R² of a trajectory that counts as right
TRAINED, AHEAD, A_PERIOD = 1000, 200, 100  # samples
_TOLERANCES = {"rtol": 1e-13, "atol": 1e-13, "method": "DOP853"}
_GRAVITY, _ATWOODS = 9.81, 9.82  # m/s², as dysts has them


def henon_heiles(t: float, z: np.ndarray) -> list[float]:
    x, y, px, py = z
    return [px, py, -x - 2 * x * y, -y - x**2 + y**2]


def nuclear_quadrupole(t: float, z: np.ndarray) -> list[float]:
    x, y, px, py = z
    cubic, quartic = 3 / np.sqrt(2) * 0.55, 0.4
    square = x**2 + y**2
    return [
        px,
        py,
        -x + cubic * (x**2 - y**2) - quartic * x * square,
        -y - 2 * cubic * x * y - quartic * y * square,
    ]


def swinging_atwood(t: float, z: np.ndarray) -> list[float]:
    r, angle, pr, pa = z
    swings, counter = 1.0, 4.5  # kg
    return [
        pr / (swings + counter),
        pa / (swings * r**2),
        pa**2 / (swings * r**3) - counter * _ATWOODS + swings * _ATWOODS * np.cos(angle),
        -swings * _ATWOODS * r * np.sin(angle),
    ]


def double_pendulum(t: float, z: np.ndarray, share: float = 1.0) -> list[float]:
    """Unit masses and lengths. share: of the term in p1 p2 cos(a − b) sin 2(a − b): 1 in mechanics,
    a half in dysts."""
    a, b, p1, p2 = z
    cosine, below = np.cos(a - b), 1 + np.sin(a - b) ** 2
    turning = p1 * p2 * np.sin(a - b) / below
    square = p1**2 + 2 * p2**2 - 2 * share * p1 * p2 * cosine
    pull = np.sin(2 * (a - b)) * square / (2 * below**2)
    return [
        (p1 - p2 * cosine) / below,
        (2 * p2 - p1 * cosine) / below,
        -2 * _GRAVITY * np.sin(a) - turning + pull,
        -_GRAVITY * np.sin(b) + turning - pull,
    ]


def nose_hoover(t: float, z: np.ndarray) -> list[float]:
    x, y, w = z
    return [y, -x + y * w, 1.5 - y**2]


# name -> rates, initial state, period, angles, best sMAPE of the public table
Flow = tuple[Callable[..., list[float]], tuple[float, ...], float, tuple[int, ...], float]
_PENDULUMS = (-44.334542, 223.53554, -1.2249799, 2.535486)
FLOWS: Mapping[str, Flow] = {
    "henon-heiles": (
        henon_heiles,
        (-0.29707259, -0.0031367513, 0.42548865, 0.071905482),
        6.37,
        (),
        1.0,
    ),
    "nuclear-quadrupole": (
        nuclear_quadrupole,
        (-0.85591178, 1.48078342, -0.85075322, 1.63576085),
        6.0230769,
        (),
        7.5,
    ),
    "swinging-atwood": (
        swinging_atwood,
        (0.113296, np.pi / 2, 0.10992, 0.17747),
        0.34176471,
        (1,),
        20.9,
    ),
    "double-pendulum": (double_pendulum, _PENDULUMS, 4.0234, (0, 1), 109.4),
    "double-pendulum-as-coded": (
        functools.partial(double_pendulum, share=0.5),
        _PENDULUMS,
        4.0234,
        (0, 1),
        109.4,
    ),
    "nose-hoover": (nose_hoover, (-1.9758582, 0.24647527, 0.79024299), 5.8673, (), 38.9),
}


def smape(forecast: np.ndarray, truth: np.ndarray) -> float:
    """Symmetric mean absolute percentage error of the table: 0 to 200, mean over columns."""
    return float(np.mean(200 * abs(forecast - truth) / (abs(forecast) + abs(truth))))


def fitted(fit: Callable[[], gfnn.Fit]) -> tuple[gfnn.Fit | None, Numbers]:
    """The fit and what it says of itself, or None and why there is none."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        try:
            found = once(fit)
        except FitError as refusal:
            return None, {"refused": str(refusal)}
    return found.out, {
        "verdict": str(found.out.verdict),
        "formula": found.out.formula,
        "friction": None if found.out.friction is None else str(found.out.friction),
        "processor_seconds": found.processor_seconds,
    }


def flow(name: str, quick: bool) -> Numbers:
    """One flow of dysts: states of one orbit, the law, 200 steps ahead."""
    rates, start, period, angles, best = FLOWS[name]
    dt = period / A_PERIOD
    times = dt * np.arange(TRAINED + AHEAD)
    z = solve_ivp(rates, (0, times[-1]), start, t_eval=times, **_TOLERANCES).y.T
    options: dict[str, Any] = {"angles": angles} if angles else {}
    structure = None if len(start) % 2 == 0 else "poisson"
    pairs = gfnn.Pairs(z[: TRAINED - 1], z[1:TRAINED], dt, structure=structure)
    fit, result = fitted(lambda: gfnn.fit(pairs, **options))
    result["best_of_the_table"] = best
    if fit is not None:
        ahead = np.asarray(fit.predict(z[TRAINED - 1], AHEAD))[1:]
        result["smape"] = smape(ahead, z[TRAINED:])
    elif structure:
        result["smape_of_the_field"] = smape(_by_its_field(z[:TRAINED], dt), z[TRAINED:])
    print(f"  {result}", flush=True)
    return result


def _by_its_field(z: np.ndarray, dt: float) -> np.ndarray:
    """States (AHEAD, n) after those of z (N, n), by a field of degree 2 that was fitted to these:
    what is known of a motion that has no bracket."""
    names = tuple(f"z{i + 1}" for i in range(z.shape[1]))
    field = FreeField(polynomials(names, 2, constant=True))
    c = fit_field(field, z[:-1], z[1:], dt).c
    times = dt * np.arange(AHEAD + 1)
    moved = solve_ivp(
        lambda t, x: field.rate(c, x[None])[0],
        (0, times[-1]),
        z[-1],
        t_eval=times[1:],
        **_TOLERANCES,
    )
    return moved.y.T


def odebench(path: Path, gamma: float, quick: bool) -> Numbers:
    """The systems of our kind of ODEBench at one level of noise."""
    every = {entry["id"]: entry for entry in json.loads(path.read_text(encoding="utf-8"))}
    systems = {}
    for name in (*MECHANICAL, *POISSON):
        seen, unseen = every[name]["solutions"][0][:2]
        t, y, truth = np.array(seen["t"]), np.array(seen["y"]).T, np.array(unseen["y"]).T
        y = y * (1 + gamma * np.random.default_rng(name).standard_normal(y.shape))
        fit, result = fitted(functools.partial(_learned, t, y, name))
        result["system"] = every[name]["eq_description"]
        if fit is not None:
            ahead = np.asarray(fit.predict(truth[0], len(t) - 1))
            left = np.sum((ahead - truth) ** 2, axis=0)
            spread = np.sum((truth - truth.mean(axis=0)) ** 2, axis=0)
            result["r2"] = [float(r) for r in 1 - left / spread]
            result["right"] = bool(np.mean(result["r2"]) > RIGHT)
        systems[str(name)] = result
        print(f"  {name}: {result}", flush=True)
    return {"gamma": gamma, "systems": systems}


def _learned(t: np.ndarray, y: np.ndarray, name: int) -> gfnn.Fit:
    """The fit of one system: of a recording of a position and its velocity, or of states."""
    if name in POISSON:
        dt = float(t[1] - t[0])
        return gfnn.fit(gfnn.Pairs(y[:-1], y[1:], dt, structure="poisson"))
    table = {"t": t, "x": y[:, 0], "v": y[:, 1]}
    angles = ["x"] if MECHANICAL[name] else ()
    return gfnn.fit(gfnn.Recording(table, positions=["x"], velocities=["v"], angles=angles))


def silverbox(folder: Path, quick: bool) -> Numbers:
    """The error of a free run of the arrow, by the law of the multisine."""
    table = np.loadtxt(folder / "SNLS80mV.csv", delimiter=",")
    t = np.arange(len(table)) / RATE

    def recording(rows: slice) -> gfnn.Recording:
        columns = {"t": t[rows], "u": table[rows, 0], "y": table[rows, 1]}
        return gfnn.Recording(columns, positions=["y"], inputs=["u"], angles=[])

    arrow = recording(slice(0, 4_000) if quick else ARROW)
    fit, result = fitted(lambda: gfnn.fit(recording(MULTISINE)))
    if fit is not None:
        run = arrow.runs[0]
        t, seen = arrow.times(run), arrow.values("y", run)[SEEN:]
        start, later = arrow.slice(stop=t[SEEN - 1]), t[SEEN:]
        left = fit.map.forecast(start, later, arrow).values["y"][0] - seen
        result["rms_millivolts"] = 1e3 * float(np.sqrt(np.mean(left**2)))
        result["largest_millivolts"] = 1e3 * float(np.max(np.abs(left)))
    print(f"  {result}", flush=True)
    return result


def tanks(folder: Path, quick: bool) -> Numbers:
    """What is said of a record that is not mechanical."""
    table = pd.read_csv(folder / "dataBenchmark.csv")
    t = table["Ts"].iloc[0] * np.arange(len(table))
    columns = {"t": t, "u": table["uEst"].to_numpy(), "y": table["yEst"].to_numpy()}
    recording = gfnn.Recording(columns, positions=["y"], inputs=["u"], angles=[])
    _, result = fitted(lambda: gfnn.fit(recording))
    y, u, dt = columns["y"], columns["u"], float(t[1])
    result["explained_by_tanks"] = _free_run(_two_tanks, TANKS, y, u, dt)
    result["explained_by_a_mechanical_law"] = _free_run(_cubic_spring, SPRING, y, u, dt)
    print(f"  {result}", flush=True)
    return result


def _two_tanks(p: np.ndarray, x: np.ndarray, u: float) -> np.ndarray:
    """Rates of two levels by Torricelli's law; the second one is shown."""
    above, below = np.sqrt(np.maximum(x, 0.0))
    return np.array([p[0] * u - p[1] * above, p[2] * above - p[3] * below])


def _cubic_spring(p: np.ndarray, x: np.ndarray, u: float) -> np.ndarray:
    """Rates of a velocity and a position: a force of the position up to its cube, one of the input,
    and linear and quadratic friction."""
    v, q = x
    return np.array([p[:4] @ q ** np.arange(4) + p[4] * u - p[5] * v - p[6] * abs(v) * v, v])


def _free_run(rates: Callable, start: np.ndarray, y: np.ndarray, u: np.ndarray, dt: float) -> float:
    """The share of the variance of y (n,), below the sensor's limit, that the free run of a law of
    two states explains whose numbers and first states, ``start``, were fitted to it."""
    seen, forces = y < FULL, np.stack([u[:-1], 0.5 * (u[:-1] + u[1:]), u[1:]], axis=1)

    def left(p: np.ndarray) -> np.ndarray:
        x, own = p[:2], p[2:]
        run = np.empty_like(y)
        run[0] = x[1]
        for k, (first, middle, last) in enumerate(forces):  # Runge and Kutta's step
            one = rates(own, x, first)
            two = rates(own, x + 0.5 * dt * one, middle)
            three = rates(own, x + 0.5 * dt * two, middle)
            x = x + dt / 6 * (one + 2 * (two + three) + rates(own, x + dt * three, last))
            x = np.clip(x, -10 * FULL, 10 * FULL)
            run[k + 1] = x[1]
        return np.where(seen, run - y, np.minimum(run - FULL, 0.0))

    size = np.maximum(np.abs(start), 1e-3)
    missed = left(least_squares(left, start, x_scale=size, max_nfev=80).x)[seen]
    return float(1 - np.mean(missed**2) / np.var(y[seen]))


PIECES: dict[str, Callable[[bool], Numbers]] = {
    f"dysts-{name}": functools.partial(flow, name) for name in FLOWS
}


def tables() -> None:
    """The two tables of RESULTS.md."""
    found = results_of({name: p for name, p in PIECES.items() if "dysts" in name}, "public")
    rows = []
    for name, result in found.items():
        m = result["measured"]
        rows.append(
            [
                name.removeprefix("dysts-").replace("-", " "),
                number(m["best_of_the_table"]),
                number(m["smape"]) if "smape" in m else "–",
                number(m["smape_of_the_field"]) if "smape_of_the_field" in m else "",
                m.get("refused", m.get("verdict", "")).split(":")[0],
                f"`{m['formula']}`" if m.get("formula") else "–",
                number(m.get("processor_seconds")),
            ]
        )
    if rows:
        heads = ("flow of dysts", "best of its table, sMAPE", "ours", "by the field alone")
        heads += ("verdict", "law", "CPU s")
        between_markers(TABLES, "dysts", f"{markdown(heads, rows)}\n\n{provenance(found)}")
    _records()
    names = {f"odebench-{gamma:g}": None for gamma in GAMMAS}
    levels = results_of(names, "public")  # type: ignore[arg-type]
    if not levels:
        return
    rows = []
    for number_of in (*MECHANICAL, *POISSON):
        row = [str(number_of), ""]
        for level in levels.values():
            m = level["measured"]["systems"][str(number_of)]
            row[1] = m["system"]
            r2 = number(float(np.mean(m["r2"]))) if "r2" in m else "refused"
            row += [r2, f"`{m['formula']}`" if m.get("formula") else "–"]
        rows.append(row)
    heads = ["number", "system of ODEBench"]
    for level in levels.values():
        heads += [f"R² at γ = {level['measured']['gamma']:g}", "law"]
    between_markers(TABLES, "odebench", f"{markdown(heads, rows)}\n\n{provenance(levels)}")


def _records() -> None:
    """The two records of a folder."""
    names = dict.fromkeys(("silverbox-arrow", "cascaded-tanks"))
    found = results_of(names, "public")  # type: ignore[arg-type]
    if not found:
        return
    rows = []
    for name, result in found.items():
        m = result["measured"]
        error = f"{number(m['rms_millivolts'])} mV" if "rms_millivolts" in m else "–"
        law = f"`{m['formula']}`, R = `{m['friction']}`" if m.get("formula") else "–"
        said = m.get("refused", m.get("verdict", ""))
        law, said = (text.replace("|", "\\|") for text in (law, said))
        if "explained_by_tanks" in m:
            shares = (m["explained_by_tanks"], m["explained_by_a_mechanical_law"])
            error = "explains {:.0%} as two tanks, {:.0%} as a mechanical law".format(*shares)
        best = "0.26 mV" if "rms_millivolts" in m else "not mechanical"
        rows.append([name, best, error, said, law, number(m.get("processor_seconds"))])
    heads = ("record", "to compare with", "free run", "verdict", "law", "CPU s")
    between_markers(TABLES, "public-records", f"{markdown(heads, rows)}\n\n{provenance(found)}")


if __name__ == "__main__":
    arguments = sys.argv[1:]
    if FILE in arguments:
        at = arguments.index(FILE)
        file = Path(arguments[at + 1])
        del arguments[at : at + 2]
        PIECES |= {f"odebench-{g:g}": functools.partial(odebench, file, g) for g in GAMMAS}
    if FOLDER in arguments:
        at = arguments.index(FOLDER)
        folder = Path(arguments[at + 1])
        del arguments[at : at + 2]
        PIECES |= {"silverbox-arrow": functools.partial(silverbox, folder)}
        PIECES |= {"cascaded-tanks": functools.partial(tanks, folder)}
    main(__doc__ or "", PIECES, "public", tables, arguments, tuple(PIECES)[:2])
