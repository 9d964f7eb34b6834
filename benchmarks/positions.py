"""Maps learned from positions alone: one step, long rollouts, what noise does.

    python benchmarks/positions.py                 pieces without a result, then the table
    python benchmarks/positions.py --only ring-64 --overwrite
    python benchmarks/positions.py --quick         small sizes, into runs/positions, no table

A piece's result is one JSON file, positions-*.json in benchmarks/results; the section of
benchmarks/RESULTS.md is made from these files alone. Test positions are of runs that no fit saw.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from functools import partial

# Sets float64, so it comes before all of JAX.
from harness import SEED, TABLES, Numbers, between_markers, markdown, number, provenance, results
from harness import main as run_pieces

# isort: split
import numpy as np
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn
from gfnn_jax.coordinates import nearest_image
from gfnn_jax.evaluate.gauge import beside_flow

KICK, COUPLING_KICK, COUPLING, SITES = 0.6, 0.5, 0.1, 64
NOISE = 1e-4


def standard_map(number: int, steps: int, seed: int) -> np.ndarray:
    """θ (number, steps + 1, 1), lifted: all of the torus, K = 0.6."""
    theta, p = np.random.default_rng(seed).uniform(0, 2 * np.pi, (2, number))
    read = [theta]
    for _ in range(steps):
        p = p + KICK * np.sin(theta)
        theta = theta + p
        read.append(theta)
    return np.stack(read, axis=1)[..., None]


def ring(number: int, steps: int, seed: int) -> np.ndarray:
    """θ of Froeschlé's ring of 64 (number, steps + 1, 64)."""
    q, p = np.random.default_rng(seed).uniform(-np.pi, np.pi, (2, number, SITES))
    read = [q]
    for _ in range(steps):
        bond = COUPLING * np.sin(np.roll(q, -1, axis=1) - q)
        p = p + COUPLING_KICK * np.sin(q) + bond - np.roll(bond, 1, axis=1)
        q = q + p
        read.append(q)
    return np.stack(read, axis=1)


def henon_heiles(number: int, steps: int, seed: int) -> np.ndarray:
    """x, y (number, steps + 1, 2) below E = 1/12, dt 0.5."""
    return flow_of_henon_heiles(number, steps, seed)[..., :2]


def flow_of_henon_heiles(number: int, steps: int, seed: int) -> np.ndarray:
    """z = (q, p) (number, steps + 1, 4) of the same."""
    rng, starts = np.random.default_rng(seed), []
    while len(starts) < number:
        q, energy, angle = rng.uniform(-0.5, 0.5, 2), rng.uniform(0, 1 / 12), rng.uniform(0, 7)
        left = energy - (0.5 * q @ q + q[0] ** 2 * q[1] - q[1] ** 3 / 3)
        if left > 0:
            speed = np.sqrt(2 * left)
            starts.append([*q, speed * np.cos(angle), speed * np.sin(angle)])

    def field(_, z):
        x, y, px, py = z.reshape(4, -1)
        return np.concatenate([px, py, -x - 2 * x * y, -y - x**2 + y**2])

    solution = solve_ivp(
        field,
        (0, 0.5 * steps),
        np.array(starts).T.ravel(),
        method="DOP853",
        rtol=1e-13,
        atol=1e-15,
        t_eval=0.5 * np.arange(steps + 1),
    )
    return solution.y.reshape(4, number, -1).transpose(1, 2, 0)


def recorded(q: np.ndarray, dt: float, angles: bool) -> gfnn.Recording:
    """Positions (runs, steps, d) as a recording."""
    runs, steps, dim = q.shape
    names = [f"q{i + 1}" for i in range(dim)]
    table = {"run": np.repeat(np.arange(runs), steps), "t": np.tile(dt * np.arange(steps), runs)}
    table |= {name: q[..., i].ravel() for i, name in enumerate(names)}
    return gfnn.Recording(table, positions=names, angles=names if angles else ())


def measured(
    quick: bool,
    *,
    sample: Callable,
    triples: int,
    last: int,
    dt: float = 1.0,
    angles: bool = False,
    wrapped: bool = False,
    structure: str | None = None,
    tolerance: float = 1e-12,
) -> Numbers:
    """A fit to so many triples, and its rollouts to step ``last`` from two positions."""
    triples = triples // 4 if quick else triples
    given, test = sample(triples, 2, SEED), sample(40, last, SEED + 1)
    if wrapped:
        given, test = np.mod(given, 2 * np.pi), np.mod(test, 2 * np.pi)
    started = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        fit = gfnn.fit(
            recorded(given, dt, angles),
            learn="map",
            structure=structure,
            tolerance=tolerance,
            max_seconds=None,
        )
    seconds = time.process_time() - started
    states, _ = fit.map.rollout(positions=(test[:, 0], test[:, 1]), num_steps=last)
    error = np.asarray(states)[..., : test.shape[2]] - test
    error = nearest_image(error, tuple(range(test.shape[2])) if angles else ())
    size = np.linalg.norm(error, axis=-1)
    found = {
        "triples": triples,
        "terms": fit.chosen.num_parameters,
        "rank": fit.chosen.rank,
        "symmetric": fit.positions is not None and fit.positions.symmetric,
        "one_step": float(np.sqrt(np.mean(error[:, 2] ** 2))),
        "last": last,
        "median_at_last": float(np.median(size[:, last])),
        "defect": fit.symplecticity_defect,
        "cpu_seconds": seconds,
    }
    if test.shape[2] == 2:
        z = flow_of_henon_heiles(400, 1, SEED + 2)
        beside = beside_flow(fit.map, gfnn.Pairs(z[:, 0], z[:, 1], dt))
        found |= {"mass_ratio": mass_ratio(fit), "beside_flow": beside._asdict()}
    return found


def noisy(quick: bool, *, sets: int = 5, triples: int = 3_000, noise: float = NOISE) -> Numbers:
    """Fits to noisy triples of Hénon–Heiles, of several data sets: masses, and what the bands of
    forecasts from 21 noisy readings hold, of what is read ahead and of what is true."""
    sets, triples = (1, triples // 2) if quick else (sets, triples)
    leads, begun = np.array([1, 2, 5, 10, 20, 50, 100]), 20
    masses, inside, held, errors, seconds = [], [], [], [], []
    for k in range(sets):
        rng = np.random.default_rng([SEED, k])
        given = henon_heiles(triples, 2, SEED + 10 + k)
        given = given + noise * rng.normal(size=given.shape)
        started = time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", gfnn.FitWarning)
            fit = gfnn.fit(
                recorded(given, 0.5, False), learn="map", tolerance=3e-3, max_seconds=None
            )
        seconds.append(time.process_time() - started)
        masses.append(mass_ratio(fit))
        true = henon_heiles(40 if quick else 200, begun + 100, SEED + 30 + k)
        read = true + noise * rng.normal(size=true.shape)
        found = fit.map.forecast(recorded(read[:, : begun + 1], 0.5, False), 0.5 * (begun + leads))
        values, std = (
            np.stack([a[n] for n in ("q1", "q2")], -1) for a in (found.values, found.std)
        )
        own = np.sqrt(std**2 - np.array(fit.positions.noise) ** 2)
        errors.append(np.abs(values - true[:, begun + leads]))
        held.append(np.abs(values - read[:, begun + leads]) < 2 * std)
        inside.append(errors[-1] < 2 * own)
    return {
        "triples": triples,
        "terms": fit.chosen.num_parameters,
        "noise": fit.positions.noise,
        "one_step": float(np.sqrt(np.mean(np.square(errors), axis=(0, 1, 3))[0])),
        "last": int(leads[-1]),
        "median_at_last": float(np.median(np.array(errors)[:, :, -1])),
        "defect": fit.symplecticity_defect,
        "cpu_seconds": float(np.mean(seconds)),
        "mass_ratio": masses[0],
        "mass_ratios": masses,
        "leads": leads.tolist(),
        "held_of_read": np.mean(held, axis=(0, 1, 3)).tolist(),
        "held_of_true": np.mean(inside, axis=(0, 1, 3)).tolist(),
    }


def cell(quick: bool, *, noise: float, tolerance: float) -> Numbers:
    """One cell of a storage ring (`rings.lattice`) from x and y at one place, turn by turn, of 20
    particles within 2 mm: the next reading, tunes and amplitude detuning, which no gauge touches.
    Needs PyAT."""
    from rings.lattice import AMPLITUDE, ellipsoid, ring
    from rings.tunes import tune

    machine, turns, ahead = ring("hmba.mat"), 500 if quick else 5_000, 1_024

    def tracked(start: np.ndarray, count: int) -> np.ndarray:
        """x, y (N, count + 1, 2)."""
        later = machine.track(start, turns=count)[:, 0]
        return np.concatenate([start[None], later])[..., :2].transpose(1, 0, 2)

    start = ellipsoid(machine.half_axes(AMPLITUDE, AMPLITUDE), 20, 0)
    read = tracked(start, turns - 1)
    spread = read.std(axis=(0, 1))
    given = read + noise * np.random.default_rng(SEED + 2).normal(size=read.shape)
    started = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        fit = gfnn.fit(
            recorded(given, 1.0, False), learn="map", tolerance=tolerance, max_seconds=None
        )
    seconds = time.process_time() - started
    fresh = tracked(ellipsoid(machine.half_axes(AMPLITUDE, AMPLITUDE), 1_000, 1), 2)
    following = np.asarray(fit.map.rollout(positions=(fresh[:, 0], fresh[:, 1]), num_steps=2)[0])
    amplitudes, orbits = np.linspace(0.1, 0.9, 5) * AMPLITUDE, np.zeros((10, 4))
    orbits[:5, 0], orbits[:5, 1] = amplitudes, 0.05 * AMPLITUDE
    orbits[5:, 1], orbits[5:, 0] = amplitudes, 0.05 * AMPLITUDE
    true = tracked(orbits, ahead)
    ours = np.asarray(fit.map.rollout(positions=(true[:, 0], true[:, 1]), num_steps=ahead)[0])
    linear = [tune(true[0, :, k] - true[0, :, k].mean()) for k in (0, 1)]

    def tunes(q: np.ndarray) -> np.ndarray:
        """(10, 2), each followed in its own plane."""
        found = [[tune(orbit[:, k] - orbit[:, k].mean(), linear[k]) for k in (0, 1)] for orbit in q]
        return np.array(found)

    theirs, found = tunes(true), tunes(ours[..., :2])
    detuning = [
        [np.polyfit(amplitudes**2, part[:, k], 1)[0] for part in (t[:5], t[5:]) for k in (0, 1)]
        for t in (theirs, found)
    ]
    off = (following[:, 2, :2] - fresh[:, 2]) / spread
    return {
        "particles": 20,
        "turns": turns,
        "noise": noise,
        "triples": fit.num_pairs,
        "terms": fit.chosen.num_parameters,
        "next_reading": float(np.sqrt(np.mean(off**2))),
        "tunes": float(np.abs(theirs - found).max()),
        "detuning": detuning,
        "detuning_error": float(np.max(np.abs(np.array(detuning[1]) / np.array(detuning[0]) - 1))),
        "sigma": fit.positions.noise,
        "cpu_seconds": seconds,
        "defect": fit.symplecticity_defect,
    }


def mass_ratio(fit: gfnn.Fit) -> float:
    """Of both masses at rest: 1 of Hénon–Heiles."""
    piece = fit.map.pieces[0]
    hessian = np.asarray(piece.family.gradient_and_hessian(piece.params, np.zeros((1, 4)))[1])
    return float(hessian[0, 0, 2] / hessian[0, 1, 3])


PIECES = {
    "cell": partial(cell, noise=0.0, tolerance=1e-4),
    "cell-noise": partial(cell, noise=1e-5, tolerance=1e-1),
    "standard-map-lifted": partial(
        measured, sample=standard_map, triples=2_000, last=100, angles=True
    ),
    "standard-map-wrapped": partial(
        measured, sample=standard_map, triples=2_000, last=100, angles=True, wrapped=True
    ),
    "henon-heiles": partial(measured, sample=henon_heiles, triples=3_000, last=300, dt=0.5),
    "henon-heiles-noise": noisy,
    "ring-64": partial(
        measured,
        sample=ring,
        triples=200,
        last=10,
        angles=True,
        wrapped=True,
        structure="ring",
        tolerance=1e-10,
    ),
}


def tables() -> None:
    found = results(PIECES, "positions")
    rows = [
        [
            name,
            number(m["triples"]),
            number(m["terms"]),
            number(m["one_step"]),
            f"{number(m['median_at_last'])} (step {m['last']})",
            number(m["defect"]),
            f"{m['mass_ratio']:.4f}" if "mass_ratio" in m else "–",
            number(m["cpu_seconds"]),
        ]
        for name, m in ((name, result["measured"]) for name, result in found.items())
        if "one_step" in m
    ]
    heads = (
        "from positions alone",
        "triples",
        "terms of S",
        "one step, RMS",
        "median error",
        "‖MᵀJM − J‖",
        "mass ratio",
        "CPU s",
    )
    text = markdown(heads, rows)
    beside = found.get("henon-heiles", {}).get("measured", {}).get("beside_flow")
    if beside is not None:
        text += (
            f"\n\nHénon–Heiles beside its flow, whose momenta no fit saw: p' = c p with c = "
            f"{beside['factor']:.12f}, what is left of p' {number(beside['momenta'])}, ∇f "
            f"{number(beside['gauge'])} of it (S is symmetric); a step's positions differ by "
            f"{number(beside['positions'])} of their spread, its momenta by "
            f"{number(beside['images'])}."
        )
    if "henon-heiles-noise" in found:
        m = found["henon-heiles-noise"]["measured"]
        rows = [
            [str(lead), f"{100 * read:.1f} %", f"{100 * true:.1f} %"]
            for lead, read, true in zip(
                m["leads"], m["held_of_read"], m["held_of_true"], strict=True
            )
        ]
        ratios = ", ".join(f"{ratio:.4f}" for ratio in m["mass_ratios"])
        heads = ("steps ahead", "readings within 2 std", "true positions within 2 std")
        text += (
            f"\n\nNoise {NOISE:g} in every position, {len(m['mass_ratios'])} data sets, mass "
            f"ratios {ratios}; forecasts from 21 noisy readings:\n\n{markdown(heads, rows)}"
        )
    rows = [
        [
            f"{1e6 * m['noise']:g} µm",
            number(m["terms"]),
            number(m["next_reading"]),
            number(m["tunes"]),
            f"{100 * m['detuning_error']:.1f} %",
            number(m["cpu_seconds"]),
        ]
        for m in (found[name]["measured"] for name in ("cell", "cell-noise") if name in found)
    ]
    if rows:
        heads = (
            "a cell of a storage ring from x, y at one place, noise",
            "terms of S",
            "next reading ÷ spread",
            "tunes, largest difference",
            "amplitude detuning",
            "CPU s",
        )
        text += f"\n\n{markdown(heads, rows)}"
    text += f"\n\n{provenance(found)}"
    between_markers(TABLES, "positions", text)


if __name__ == "__main__":
    run_pieces(__doc__ or "", PIECES, "positions", tables, None)
