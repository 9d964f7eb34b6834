"""Small fits of every kind, and their numbers: does a change of the code change a result?

    python benchmarks/freeze.py --out before.json            at the old commit
    python benchmarks/freeze.py --against before.json        at the new one, on the same machine

The data are drawn here by NumPy and SciPy, so that both commits see the same bits. For each fit the
terms of its law with standard errors, the numbers of its rollout or forecast, its choice and its
types of warnings are kept. The comparison says of each fit

    same bits        all numbers are equal to the last bit;
    same             the same terms and choice; each coefficient has changed by at most
                     max(1e-10 of itself, 1e-6 of its standard error), each other number by 1e-8;
    DIFFERENT        anything else, with what differs.

It exits with 1 where a fit is different. Times are processor seconds of this process and say
nothing of one run alone.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is loaded
import jax
import numpy as np
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn

jax.config.update("jax_enable_x64", True)

STEPS, AHEAD = 20, 8  # of a rollout; times of a forecast
OF_ITSELF, OF_ERROR, OF_OTHERS = 1e-10, 1e-6, 1e-8  # changes that roundoff explains

Fits = dict[str, Callable[[], Any]]


def fit_(pairs: Any, **options: Any) -> Any:
    """A fit that does not look at the clock."""
    return gfnn.fit(pairs, max_seconds=None, **options)


def flow(field, z0, dt, steps=1):
    """(N, steps + 1, n) of ż = field(z), by SciPy; z0 (N, n)."""
    shape = z0.shape
    times = dt * np.arange(steps + 1)
    found = solve_ivp(
        lambda _, y: field(y.reshape(shape)).ravel(),
        (0, times[-1]),
        z0.ravel(),
        "DOP853",
        t_eval=times,
        rtol=1e-13,
        atol=1e-13,
    )
    return np.moveaxis(found.y.reshape(*shape, steps + 1), -1, 1)


def henon_heiles(z):
    """Rates of ½|p|² + ½|q|² + q₁²q₂ − q₂³/3."""
    q1, q2, p1, p2 = z.T
    return np.stack([p1, p2, -q1 - 2 * q1 * q2, -q2 - q1**2 + q2**2], axis=1)


def kepler(z):
    """Rates of ½|p|² − 1/|q|."""
    q, p = z[:, :2], z[:, 2:]
    return np.concatenate([p, -q / np.linalg.norm(q, axis=1, keepdims=True) ** 3], axis=1)


def pendulum(friction):
    """Rates of ½p² − cos q with ṗ = … − friction · p."""
    return lambda z: np.stack([z[:, 1], -np.sin(z[:, 0]) - friction * z[:, 1]], axis=1)


def pairs_of(orbits, dt, **more):
    """Pairs of sequences (M, L, 2d)."""
    count, states, width = orbits.shape
    return gfnn.Pairs(
        orbits[:, :-1].reshape(-1, width),
        orbits[:, 1:].reshape(-1, width),
        dt,
        run=np.repeat(np.arange(count), states - 1),
        place=np.tile(np.arange(states - 1), count),
        **more,
    )


def drawn(field, width, number, dt, size=0.17, seed=0, steps=1):
    """Sequences from normal states of this size."""
    return flow(field, size * np.random.default_rng(seed).normal(size=(number, width)), dt, steps)


def fits_of_pairs() -> Fits:
    """Name -> a fit of pairs."""

    def two(field, width, number, dt, **more):
        z = drawn(field, width, number, dt, **more)
        return gfnn.Pairs(z[:, 0], z[:, 1], dt)

    def orbits_of_two_bodies(number, dt):
        rng = np.random.default_rng(3)
        angle, speed = rng.uniform(0, 2 * np.pi, number), rng.uniform(0.9, 1.15, number)
        c, s = np.cos(angle), np.sin(angle)
        z0 = np.stack([c, s, -speed * s, speed * c], axis=1)
        z = flow(kepler, z0, dt)
        return gfnn.Pairs(z[:, 0], z[:, 1], dt)

    def kicked(number, turns=1):
        rng = np.random.default_rng(1)
        q, p = rng.uniform(0, 2 * np.pi, (2, number))
        rows = [np.stack([q, p], axis=1)]
        for _ in range(turns):
            p = p + 0.6 * np.sin(q)
            q = q + p
            rows.append(np.stack([q, p], axis=1))
        return rows

    def noisy(field, width, number, dt, steps, sigma):
        z = drawn(field, width, number, dt, steps=steps)
        return pairs_of(z + sigma * np.random.default_rng(5).normal(size=z.shape), dt)

    def uneven():
        rng = np.random.default_rng(2)
        z0, dt = 0.17 * rng.normal(size=(150, 4)), rng.uniform(0.1, 0.6, 150)
        z1 = np.concatenate(
            [flow(henon_heiles, z[None], h)[:, 1] for z, h in zip(z0, dt, strict=True)]
        )
        return gfnn.Pairs(z0, z1, dt)

    def of_lengths():
        rng = np.random.default_rng(4)
        length = rng.uniform(0.5, 2, 120)
        z0 = np.stack([rng.uniform(-2, 2, 120), length**2 * rng.uniform(-2, 2, 120)], axis=1)
        z1 = []
        for z, a in zip(z0, length, strict=True):

            def field(x, a=a):
                return np.stack([x[:, 1] / a**2, -9.81 * a * np.sin(x[:, 0])], axis=1)

            z1.append(flow(field, z[None], 0.05)[0, 1])
        return gfnn.Pairs(z0, np.stack(z1), 0.05, {"l": length})

    def springs(z):
        q, p = np.split(z, 2, axis=1)
        force = 0
        for shift in (1, -1):
            r = np.roll(q, shift, axis=1) - q
            force = force + r + r**3
        return np.concatenate([p, force], axis=1)

    def driven():
        rng = np.random.default_rng(6)
        z0 = rng.uniform(-0.8, 0.8, (300, 2))

        def field(t, y):
            q, p = y.reshape(2, -1)
            return np.concatenate([p, -np.sin(q) + 0.1 * np.cos(t)])

        found = solve_ivp(field, (0, 2 * np.pi), z0.T.ravel(), "DOP853", rtol=1e-12, atol=1e-12)
        return gfnn.Pairs(z0, found.y[:, -1].reshape(2, -1).T, 2 * np.pi)

    def morse(z):
        e = np.exp(-1.3 * z[:, :1])
        return np.concatenate([z[:, 1:], -2.08 * (e - e * e)], axis=1)

    hh = two(henon_heiles, 4, 300, 0.5)
    states = kicked(40, 12)
    monitor = np.stack([z[:, :1] for z in states], axis=1)

    return {
        "hénon–heiles": lambda: fit_(hh, tolerance=1e-8),
        "hénon–heiles, map": lambda: fit_(hh, tolerance=1e-6, learn="map"),
        "hénon–heiles, type 3": lambda: fit_(hh, tolerance=1e-4, learn="map", chart="type3"),
        "hénon–heiles, terms": lambda: fit_(
            hh, tolerance=1e-8, terms=["q1**2*q2", "q2**3"], learn="hamiltonian"
        ),
        "hénon–heiles, network": lambda: fit_(
            hh, tolerance=1e-2, learn="map", family="mlp", max_operations=2 * 10**10
        ),
        "hénon–heiles, sines": lambda: fit_(hh, tolerance=1e-3, learn="map", family="sines"),
        "hénon–heiles, noise": lambda: fit_(
            noisy(henon_heiles, 4, 20, 0.5, 25, 1e-3), tolerance=1e-3
        ),
        "hénon–heiles, noise, map": lambda: fit_(
            noisy(henon_heiles, 4, 20, 0.5, 25, 1e-3), tolerance=1e-3, learn="map"
        ),
        "uneven times": lambda: fit_(uneven(), tolerance=1e-8),
        "pendulum, angle": lambda: fit_(
            two(pendulum(0), 2, 200, 0.4, size=0.9), tolerance=1e-8, angles=(0,)
        ),
        "pendulum, friction": lambda: fit_(
            two(pendulum(0.1), 2, 200, 0.4, size=0.9), tolerance=1e-8, angles=(0,)
        ),
        "pendulums of lengths": lambda: fit_(of_lengths(), tolerance=1e-8, angles=(0,)),
        "two bodies": lambda: fit_(orbits_of_two_bodies(300, 0.2), tolerance=1e-6),
        "morse, textbook": lambda: fit_(two(morse, 2, 120, 0.3, size=0.2), tolerance=1e-10),
        "morse, noise": lambda: fit_(noisy(morse, 2, 12, 0.3, 30, 1e-3), tolerance=1e-3),
        "standard map": lambda: fit_(
            gfnn.Pairs(kicked(200)[0], kicked(200)[1], 1.0), tolerance=1e-10, angles=(0, 1)
        ),
        "driven pendulum": lambda: fit_(driven(), tolerance=1e-4),
        "ring of springs": lambda: fit_(
            two(springs, 24, 12, 0.1, size=0.5), structure="ring", tolerance=1e-12
        ),
        "ring of springs, map": lambda: fit_(
            two(springs, 24, 20, 0.1, size=0.5), structure="ring", tolerance=1e-6, learn="map"
        ),
        "one monitor": lambda: fit_(
            gfnn.Recording(
                [
                    {"run": np.full(13, str(k)), "t": np.arange(13.0), "theta": q[:, 0]}
                    for k, q in enumerate(monitor)
                ],
                positions=["theta"],
                angles=["theta"],
            ),
            learn="map",
            tolerance=1e-8,
        ),
    }


def recorded(rate, starts, names, *, end=15.0, dt=0.04, sigma=1e-3, columns=None, **options):
    """A recording of positions, a run for each start, by SciPy; rate(t, x, run)."""
    rng, t, tables = np.random.default_rng(7), np.arange(0, end, dt), []
    for run, start in enumerate(starts):
        found = solve_ivp(
            rate, (0, end), start, args=(run,), t_eval=t, rtol=1e-10, atol=1e-12, max_step=0.1
        )
        q = found.y[: len(names)]
        q = q + sigma * rng.normal(size=q.shape)
        more = {name: column(t, run) for name, column in (columns or {}).items()}
        tables.append(
            {"run": np.full(len(t), str(run)), "t": t, **dict(zip(names, q, strict=True))} | more
        )
    return gfnn.Recording(tables, positions=names, **options)


def fits_of_recordings() -> Fits:
    """Name -> a fit of a recording."""

    def swing(friction, dry=0.0, lengths=(1.0,)):
        def rate(_, x, run):
            loss = friction * x[1] + dry * np.tanh(x[1] / 1e-3)
            return [x[1], -9.81 / lengths[run % len(lengths)] * np.sin(x[0]) - loss]

        return rate

    def duffing(t, x, _):
        return [x[1], -4 * x[0] - 2 * x[0] ** 3 - 0.1 * x[1] + np.sin(1.3 * t)]

    def carts(_, x, __):
        q1, q2, v1, v2 = x
        return [v1, v2, -12 * q1 + 6 * q2 - 0.1 * v1, 6 * q1 - 9 * q2 - 0.05 * v2]

    def record(name, stop):
        of = gfnn.records.RECORDS[name]
        found = gfnn.read(
            gfnn.records.path(name), positions=list(of.positions), angles=list(of.angles)
        )
        return found.slice(stop=stop)

    theta: dict[str, Any] = {"angles": ["theta"]}
    one = [(1.2, 0.0)]
    lengths = (0.5, 1.0, 2.0)

    def of_lengths():
        return recorded(
            swing(0.1, lengths=lengths),
            [(1.0 + 0.1 * k, 0.0) for k in range(3)],
            ["theta"],
            columns={"l": lambda t, run: np.full(len(t), lengths[run])},
            parameters=["l"],
            **theta,
        )

    return {
        "swing": lambda: gfnn.fit(recorded(swing(0.05), one, ["theta"], **theta)),
        "swing, dry friction": lambda: gfnn.fit(
            recorded(swing(0.02, 0.05), one, ["theta"], end=10.0, dt=0.02, **theta)
        ),
        "swing, terms": lambda: gfnn.fit(
            recorded(swing(0.05), one, ["theta"], **theta),
            terms=["cos(theta)", "cos(2*theta)"],
            friction="linear",
        ),
        "swing, offset": lambda: gfnn.fit(
            recorded(
                swing(0.05),
                one,
                ["theta"],
                observe={"theta": "theta + b"},
                guess={"b": 0.02},
                **theta,
            )
        ),
        "swings of lengths": lambda: gfnn.fit(of_lengths()),
        "duffing, driven": lambda: gfnn.fit(
            recorded(
                duffing,
                [(0.5, 0.0), (-0.8, 0.3)],
                ["x"],
                columns={"u": lambda t, _: np.sin(1.3 * t)},
                inputs=["u"],
            )
        ),
        "carts": lambda: gfnn.fit(
            recorded(carts, [(0.5, 0.1, 0.0, 0.0), (0.0, -0.4, 0.3, 0.0)], ["x1", "x2"])
        ),
        "measured pendulum": lambda: gfnn.fit(record("pendulum", 60.0)),
        "measured carts": lambda: gfnn.fit(record("two_carts", 6.0)),
        "measured double pendulum": lambda: gfnn.fit(record("double_pendulum", 3.53)),
    }


def listed(law: Any) -> list:
    """[term, coefficient, std] of a law's expression."""
    return [[str(t.term), float(t.coefficient), float(t.std)] for t in law.terms]


def numbers_of(fit: Any) -> dict[str, Any]:
    """The numbers of a fit, by the names that both kinds of data have."""
    found: dict[str, Any] = {"terms": {}, "numbers": {}, "choice": []}
    lagrangian = getattr(fit, "lagrangian", None)
    if lagrangian is not None:
        found["terms"] = {"L": listed(lagrangian), "R": listed(fit.friction)}
        for name, forces in fit.gains.items():
            found["terms"][f"gain of {name}"] = [[q, *map(float, g)] for q, g in forces.items()]
        for name, value in {**fit.zeros, **fit.sensors}.items():
            found["terms"][name] = [["value", *map(float, value)]]
        found["numbers"]["noise"] = [float(s) for s in fit.noise.values()]
        found["numbers"]["residual"] = [float(s) for s in fit.residual.values()]
        found["choice"] = [str(k) for k in fit.which_friction.kinds]
        return found
    best = fit.chosen
    found["choice"] = [best.learns, best.chart, best.label, int(best.num_parameters)]
    if fit.hamiltonian is not None:
        found["terms"]["H"] = listed(fit.hamiltonian)
    z0 = np.asarray(fit.test_states)[:4]
    args = None if fit.test_args is None else {k: v[:4] for k, v in fit.test_args.items()}
    given = {} if args is None else {"args": args}
    try:
        states, info = fit.map.rollout(z0, STEPS, **given)
        found["numbers"]["rollout"] = np.asarray(states).ravel().tolist()
        found["choice"].append(np.asarray(info.status).tolist())
    except (TypeError, gfnn.InputError) as error:
        found["choice"].append(type(error).__name__)
    found["numbers"]["error"] = [float(best.validation_rms), float(best.validation_bound)]
    return found


def run(name: str, make: Callable[[], Any]) -> dict[str, Any]:
    """A fit's numbers, its processor seconds, its types of warnings."""
    started = time.process_time()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            fit = make()
            found = numbers_of(fit)
            if getattr(fit, "lagrangian", None) is not None:
                found["numbers"] |= forecast_of(fit)
        except (gfnn.FitError, gfnn.InputError, gfnn.WorkError) as error:
            found = {"terms": {}, "numbers": {}, "choice": [type(error).__name__]}
    found["warnings"] = sum(issubclass(w.category, gfnn.FitWarning) for w in caught)
    found["seconds"] = round(time.process_time() - started, 2)
    return found


def forecast_of(fit: Any) -> dict[str, list[float]]:
    """Steps of a law's map from one state, with inputs at rest."""
    dim = fit.map.dim
    z0 = np.full((1, 2 * dim), 0.1)
    linear = fit.map.linearise(z0[0], np.zeros(len(fit.gains))) if fit.gains else None
    if linear is not None:
        return {"linearised": np.concatenate([np.ravel(m) for m in linear]).tolist()}
    try:
        states, _ = fit.map.rollout(z0, AHEAD)
    except (TypeError, ValueError, gfnn.InputError):
        return {}
    return {"rollout": np.asarray(states).ravel().tolist()}


def differences(old: dict[str, Any], new: dict[str, Any]) -> tuple[str, list[str]]:
    """The verdict on a fit, and what differs."""
    strip = ("seconds",)
    if {k: v for k, v in old.items() if k not in strip} == {
        k: v for k, v in new.items() if k not in strip
    }:
        return "same bits", []
    lines = []
    for name in {**old["terms"], **new["terms"]}:
        a, b = old["terms"].get(name, []), new["terms"].get(name, [])
        if [t for t, *_ in a] != [t for t, *_ in b]:
            lines.append(f"terms of {name}: {[t for t, *_ in a]} -> {[t for t, *_ in b]}")
            continue
        for (term, c, std), (_, other, _) in zip(a, b, strict=True):
            allowed = max(OF_ITSELF * abs(c), OF_ERROR * std if np.isfinite(std) else 0.0)
            if not abs(other - c) <= allowed:
                part = abs(other - c) / std if std > 0 else float("nan")
                lines.append(f"{name}, {term}: {c!r} -> {other!r} ({part:.1g} standard errors)")
    for name in {**old["numbers"], **new["numbers"]}:
        a, b = (np.array(x["numbers"].get(name, []), float) for x in (old, new))
        if a.shape != b.shape:
            lines.append(f"{name}: {len(a)} numbers -> {len(b)}")
        elif not np.allclose(a, b, rtol=OF_OTHERS, atol=1e-12, equal_nan=True):
            lines.append(f"{name}: changes by up to {np.nanmax(np.abs(a - b)):.1e}")
    lines += [
        f"{name}: {old[name]} -> {new[name]}"
        for name in ("choice", "warnings")
        if old[name] != new[name]
    ]
    return ("DIFFERENT" if lines else "same"), lines


def main() -> int:
    """Run the fits; write or compare their numbers."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, help="file that the numbers are written to")
    parser.add_argument("--against", type=Path, help="file of the old commit")
    parser.add_argument("--only", help="fits whose name has this in it; several with commas")
    asked = parser.parse_args()
    before = json.loads(asked.against.read_text()) if asked.against else {}
    found, wrong = {}, 0
    for name, make in {**fits_of_pairs(), **fits_of_recordings()}.items():
        if asked.only and not any(part in name for part in asked.only.split(",")):
            continue
        found[name] = run(name, make)
        line = f"{name:28s}{found[name]['seconds']:7.1f} s"
        if name in before:
            verdict, lines = differences(before[name], found[name])
            wrong += verdict == "DIFFERENT"
            line = "\n    ".join([f"{line}  {before[name]['seconds']:7.1f} s  {verdict}", *lines])
        else:
            line += f"  {found[name]['choice']} {found[name]['terms']}"[:200]
        print(line, flush=True)
    if asked.out:
        asked.out.write_text(json.dumps(found, indent=0))
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
