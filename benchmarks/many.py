"""Many degrees of freedom: laws of rings of sites and of bodies, from few pairs.

    python benchmarks/many.py            every row (about ten minutes on two cores)
    python benchmarks/many.py --quick    one of them, small

Each row is told the structure and nothing else, and judged by states that no fit has seen, against
the flow of the true H by 12-stage Gauss collocation; three bodies by scipy's DOP853.
"""

from __future__ import annotations

import resource
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
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
    timed,
)
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn
from gfnn_jax.evaluate import metrics
from gfnn_jax.families.sums import Part, Sums, Windows, body_terms
from gfnn_jax.families.terms import Terms
from gfnn_jax.flows.collocation import Steps, images

FRESH = 4  # states that a row is judged by; of bodies more
SIZES = (10, 100, 1_000, 3_000, 10_000)
CLOSE = 512  # parts of a step of three bodies, whose close passages one step does not resolve


def ring(dim: int, bonds: Terms) -> Sums:
    """½ Σ p² and a ring's bonds."""
    kinetic = Part(Terms(1, ("p1",), ((2,),)), Windows("ring", 0))
    return Sums(dim, (kinetic, Part(bonds, Windows("ring", 1))))


def fput_ring(dim: int) -> tuple[Sums, np.ndarray]:
    """The β ring of the scene fput and its coefficients."""
    return ring(dim, Terms(2, ("q2 - q1",), ((2,), (4,)))), np.array([0.5, 0.5, 0.25])


def moved(law, z, dt: float, steps: int = 1) -> np.ndarray:
    """States z (B, 2d) after so many steps of the true law."""
    family, params = law
    for _ in range(steps):
        z = images(family, params, z, dt, Steps(12, 1)).states
    return z


def judged(
    law,
    pairs: gfnn.Pairs,
    structure: str,
    fresh,
    exact,
    num_steps: int,
    *,
    parts: int = 1,
    tolerance: float = 1e-12,
    apart: Mapping[str, float] | None = None,
) -> Numbers:
    """A fit of these pairs, and its errors from fresh states (B, 2d). exact: their images, and
    where they are after all steps. parts: of a step of the rollout. apart: the law's coefficients
    where what is alike has terms of its own."""
    (family, params), (one, last), dt = law, exact, float(pairs.dt)
    fit, seconds, _ = once(lambda: fitted_to(pairs, structure, tolerance))
    every = num_steps * parts
    rollout: Callable[[], Any] = partial(
        fit.map.rollout, fresh, every, dt=dt / parts if parts > 1 else None, save_every=every
    )
    states = np.asarray(rollout()[0])
    alone = timed(lambda: fit.map.rollout(fresh[0], 100, save_every=100))
    error = states[:, -1] - last
    off = np.linalg.norm(error, axis=1)
    off = np.where(np.isfinite(off), off, np.inf)
    coefficients = {t: c for t, c, _ in fit.hamiltonian.terms} if fit.hamiltonian else {}
    exact_ones = dict(zip(family.term_names, params.tolist(), strict=True))
    if apart is not None and apart.keys() == coefficients.keys():
        exact_ones = apart
    wrong = max(abs(coefficients.get(t, 0.0) - c) / abs(c) for t, c in exact_ones.items())
    energy = np.asarray(fit.map.hamiltonian(states[:, -1])) / fit.map.hamiltonian(fresh) - 1
    return {
        "structure": structure,
        "dim": family.dim,
        "dt": dt,
        "pairs": len(pairs),
        "formula": fit.formula,
        "terms": fit.chosen.num_parameters,
        "fit_seconds": seconds,
        "one_step_rms": float(np.sqrt(np.mean((np.asarray(fit.map.step(fresh)[0]) - one) ** 2))),
        "coefficients_off": wrong,
        "steps": num_steps,
        "error_median": float(np.median(off)),
        "error_90": float(np.sort(off)[int(0.9 * len(off))]),
        "error_mean_absolute": float(np.abs(error).mean()),
        "error_mean_square": float(np.mean(error**2)),
        "energy_off": float(np.nanmedian(np.abs(energy))),
        "symplecticity_defect": fit.symplecticity_defect,
        "microseconds_per_step_alone": 1e6 * alone.seconds / 100,
        "gigabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }


def fitted_to(pairs: gfnn.Pairs, structure: str, tolerance: float = 1e-12) -> gfnn.Fit:
    """The fit of every row: told the structure and nothing else."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        return gfnn.fit(pairs, structure=structure, tolerance=tolerance, max_seconds=None)


def by_law(law, z0, dt: float, structure: str, fresh, num_steps: int) -> Numbers:
    """Measure as `judged` does, with pairs drawn at z0 (N, 2d) and all images by the law."""
    exact = moved(law, fresh, dt), moved(law, fresh, dt, num_steps)
    return judged(law, gfnn.Pairs(z0, moved(law, z0, dt), dt), structure, fresh, exact, num_steps)


def normal(dim: int, num: int, sigma_q: float, sigma_p: float) -> np.ndarray:
    """States (num, 2·dim)."""
    unit = np.random.default_rng(SEED).normal(size=(num, 2, dim))
    return (unit * np.array([[sigma_q], [sigma_p]])).reshape(num, -1)


def fput(dim: int, quick: bool) -> Numbers:
    """The β ring, 40 pairs."""
    z = normal(dim, 40 + FRESH, 0.2, 0.28)
    return by_law(fput_ring(dim), z[:40], 0.1, "ring", z[40:], 10 if dim > 1_000 else 1_000)


def leapfrog(quick: bool) -> Numbers:
    """1,000 sites, one trajectory: microseconds per dt of leapfrogs of the same H, written by hand,
    of 10 steps per dt."""
    z, h = normal(1_000, 1, 0.2, 0.28)[0], 0.01

    def stepped(xp, q, p, loop):
        def force(q):
            r = xp.roll(q, -1) - q
            bond = r + r**3
            return bond - xp.roll(bond, 1)

        def one(_, state):
            q, p = state
            p = p + 0.5 * h * force(q)
            q = q + h * p
            return q, p + 0.5 * h * force(q)

        return loop(1_000, one, (q, p))

    def plain(n, one, state):
        for i in range(n):
            state = one(i, state)
        return state

    by_jax = jax.jit(
        lambda q, p: stepped(jax.numpy, q, p, lambda n, f, s: jax.lax.fori_loop(0, n, f, s))
    )
    half = z[:1_000], z[1_000:]
    by_numpy = timed(lambda: stepped(np, *half, plain))
    after = np.concatenate(by_numpy.out) - moved(fput_ring(1_000), z[None], 10 * h, 100)[0]
    return {
        "numpy_microseconds": 1e4 * by_numpy.seconds,
        "jax_microseconds": 1e4 * timed(lambda: by_jax(*half)).seconds,
        "error_at_step_100": float(np.linalg.norm(after)),
    }


def toda(quick: bool) -> Numbers:
    """Toda's ring of 32 sites, 200 pairs."""
    law = ring(32, Terms(2, ("exp(q1 - q2)",), ((1,),))), np.array([0.5, 1.0])
    z = normal(32, 210, 0.3, 0.3)
    return by_law(law, z[:200], 0.05, "ring", z[200:], 2_000)


def froeschle(quick: bool) -> Numbers:
    """A ring of 64 coupled standard maps, 100 pairs: a map without a flow, judged modulo 2π."""
    scene = gfnn.scenes.froeschle()
    pairs = gfnn.sample_pairs(scene, 110, jax.random.key(SEED))
    fit, seconds, _ = once(
        lambda: gfnn.fit(
            gfnn.Pairs(pairs.z0[:100], pairs.z1[:100], 1.0),
            structure="ring",
            learn="map",
            angles=scene.coordinates.angles,
            tolerance=1e-12,
            max_seconds=None,
        )
    )
    fresh, steps = pairs.z0[100:], 10
    exact = np.asarray(gfnn.reference_trajectories(scene, fresh, steps))
    states = np.asarray(fit.map.rollout(fresh, steps)[0])
    error = np.remainder(states - exact + np.pi, 2 * np.pi) - np.pi
    off = np.linalg.norm(error[:, -1], axis=1)
    alone = timed(lambda: fit.map.rollout(fresh[0], 100, save_every=100))
    (piece,) = fit.map.pieces
    kicks = {"p_i²": 0.5, "cos(q_i)": 0.5, "cos(q_{i+1} - q_i)": -0.1}
    found = dict(zip(piece.family.term_names, np.asarray(piece.params).tolist(), strict=True))
    return {
        "structure": "ring",
        "dim": 64,
        "dt": 1.0,
        "pairs": 100,
        "formula": None,
        "terms": fit.chosen.num_parameters,
        "fit_seconds": seconds,
        "one_step_rms": float(np.sqrt(np.mean(error[:, 1] ** 2))),
        "coefficients_off": max(abs(found.get(t, 0.0) - c) / abs(c) for t, c in kicks.items()),
        "steps": steps,
        "error_median": float(np.median(off)),
        "error_90": float(np.sort(off)[int(0.9 * len(off))]),
        "symplecticity_defect": fit.symplecticity_defect,
        "microseconds_per_step_alone": 1e6 * alone.seconds / 100,
        "gigabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }


def three_bodies(quick: bool) -> Numbers:
    """Equal bodies in the plane, nearly on a circle and falling out of it: 2,000 pairs along
    trajectories to t = 5, close passages and all, judged on others by scipy's DOP853."""
    rng, num, dt, steps = np.random.default_rng(SEED), 400, 0.5, 10
    r = rng.uniform(0.9, 1.2, (num, 1))
    turn = rng.uniform(0, 2 * np.pi, (num, 1)) + 2 * np.pi / 3 * np.arange(3)
    speed = (1 + 0.2 * rng.normal(size=(num, 3))) / np.sqrt(np.sqrt(3) * r)
    q = r[..., None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    p = speed[..., None] * np.stack([-np.sin(turn), np.cos(turn)], axis=-1)
    z = np.concatenate([q.reshape(num, -1), p.reshape(num, -1)], axis=1)
    law = body_terms(3, 2, (-1,), alike=True), np.array([0.5, -1.0])

    def field(_, z):
        q = z[:6].reshape(3, 2)
        away = q[:, None] - q
        cubes = np.sum(away**2, axis=-1) ** 1.5 + np.eye(3)
        return np.concatenate([z[6:], -np.sum(away / cubes[..., None], axis=1).ravel()])

    times, span = dt * np.arange(steps + 1), (0.0, dt * steps)
    z = np.stack(
        [solve_ivp(field, span, state, "DOP853", times, rtol=3e-14, atol=1e-14).y.T for state in z]
    )
    known, fresh = z[:200], z[200:]
    pairs = gfnn.Pairs(known[:, :-1].reshape(-1, 12), known[:, 1:].reshape(-1, 12), dt)
    exact = fresh[:, 1], fresh[:, -1]
    # DOP853 itself is off by 1e-12 after a close passage.
    names = body_terms(3, 2, (-1,), alike=False).term_names
    return judged(
        law,
        pairs,
        "bodies:3",
        fresh[:, 0],
        exact,
        steps,
        parts=CLOSE,
        tolerance=1e-11,
        apart=dict(zip(names, [0.5] * 3 + [-1.0] * 3, strict=True)),
    )


def four_bodies(quick: bool) -> Numbers:
    """A star and three companions in space."""
    scene = gfnn.scenes.n_body()
    masses = scene.hamiltonian.masses  # pyright: ignore[reportOptionalMemberAccess]
    pulls = [-masses[i] * masses[j] for i in range(4) for j in range(i + 1, 4)]
    law = body_terms(4, 3, (-1,), alike=False), np.array([*(0.5 / m for m in masses), *pulls])
    key, test = jax.random.split(jax.random.key(SEED))
    z, fresh = gfnn.sample_states(scene, 1_000, key), gfnn.sample_test_states(scene, 30, test)
    return by_law(law, z, scene.dt, "bodies:4", fresh, 1_000)


def energy(quick: bool) -> Numbers:
    """The FPUT-β ring of 1,000 sites: how its energy error grows with the number of steps.

    Of two lanes alone, whose increments over a lag are averaged over where it begins: rms ∝ lagᵅ.
    """
    z, steps, every = normal(1_000, 42, 0.2, 0.28), 2_000 if quick else 100_000, 100
    pairs = gfnn.Pairs(z[:40], moved(fput_ring(1_000), z[:40], 0.1), 0.1)
    map_ = fitted_to(pairs, "ring").map
    (states, _), seconds, _ = once(lambda: map_.rollout(z[40:], steps, save_every=every))
    states = np.asarray(states)
    values = np.asarray(map_.hamiltonian(states.reshape(-1, 2_000))).reshape(states.shape[:2])
    off = metrics.energy_error(values)
    lags = np.unique(np.geomspace(1, off.shape[1] // 4, 20).astype(int))
    rms = [float(np.sqrt(np.mean((off[:, n:] - off[:, :-n]) ** 2))) for n in lags]
    return {
        "dim": 1_000,
        "steps": steps,
        "lanes": len(off),
        "seconds": seconds,
        "lags": (every * lags).tolist(),
        "rms": rms,
        "exponent": float(np.polyfit(np.log(lags), np.log(rms), 1)[0]),
        "drift_per_step": metrics.energy_drift(every * np.arange(off.shape[1]), off).value,
        "largest": float(np.abs(off).max()),
    }


PIECES = {
    **{f"fput-{dim}": partial(fput, dim) for dim in SIZES},
    "toda": toda,
    "froeschle": froeschle,
    "three-bodies": three_bodies,
    "four-bodies": four_bodies,
    "leapfrog": leapfrog,
    "energy": energy,
}
_TITLES = {
    **{f"fput-{dim}": f"FPUT-β ring, d = {dim:,}" for dim in SIZES},
    "toda": "Toda's ring, d = 32",
    "froeschle": "64 coupled standard maps",
    "three-bodies": "three equal bodies in the plane",
    "four-bodies": "four bodies in space",
}
# (piece, what is measured, its key, the best published figure that this project knows of for such a
# task), from Hamiltonian networks on data of their own. Nothing of them was run here.
_PUBLISHED = (
    ("toda", "mean square error of the rollout, at its last step", "error_mean_square", 2.9e-4),
    ("three-bodies", "mean absolute error at t = 5", "error_mean_absolute", 1.4e-3),
)
_BESIDE = (
    "Published: the best figures known to this project for such tasks, from Hamiltonian networks "
    "and other data; neither run nor checked here. They are for scale, not a race: the fits above "
    "are told that sites or bodies interact in pairs, and networks are not."
)


def tables() -> None:
    """The table of RESULTS.md."""
    found = results(PIECES, "many")
    heads = (
        "task",
        "dt",
        "pairs",
        "fit s",
        "terms",
        "coefficients off by",
        "one-step RMS",
        "at step",
        "error, median",
        "error, 90 %",
        "µs per step alone",
        "GB",
    )
    rows = []
    for name, title in _TITLES.items():
        if name not in found:
            continue
        m = found[name]["measured"]
        keys = (
            "fit_seconds",
            "terms",
            "coefficients_off",
            "one_step_rms",
            "steps",
            "error_median",
            "error_90",
            "microseconds_per_step_alone",
            "gigabytes",
        )
        rows.append((title, f"{m['dt']:g}", str(m["pairs"]), *(number(m[key]) for key in keys)))
    text = markdown(heads, rows)
    if "leapfrog" in found:
        m = found["leapfrog"]["measured"]
        text += (
            "\n\nA leapfrog of the same ring of 1,000 sites, written by hand, ten steps per dt, "
            f"takes {number(m['numpy_microseconds'])} µs in NumPy and "
            f"{number(m['jax_microseconds'])} µs in JAX, and is off by "
            f"{number(m['error_at_step_100'])} at step 100."
        )
    if "energy" in found:
        m = found["energy"]["measured"]
        text += (
            f"\n\nEnergy of the ring of {m['dim']:,} sites over {m['steps']:,} steps, "
            f"{m['lanes']} lanes: the rms of its relative change over n steps, n from "
            f"{m['lags'][0]:,} to {m['lags'][-1]:,}, grows as n^{m['exponent']:.2f}, to "
            f"{number(m['rms'][-1])}; the largest error of all is {number(m['largest'])}."
        )
    beside = [
        (_TITLES[name], measure, number(found[name]["measured"][key]), number(published))
        for name, measure, key, published in _PUBLISHED
        if key in found.get(name, {}).get("measured", {})
    ]
    if beside:
        heads = ("task", "measure", "here", "published")
        text += f"\n\n{markdown(heads, beside)}\n\n{_BESIDE}"
    text += f"\n\n{provenance(found)}" if found else ""
    between_markers(TABLES, "many", text)


if __name__ == "__main__":
    main(str(__doc__), PIECES, "many", tables, None, quick_pieces=("fput-10",))
