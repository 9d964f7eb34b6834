"""Maps that lose area: the factor b, one step, the rotation number of an attractor.

    python benchmarks/damped_maps.py            pieces without a result, then the table
    python benchmarks/damped_maps.py --quick    small sizes, into runs/damped-maps, no table

A piece's result is one JSON file, damped-maps-*.json in benchmarks/results; the section of
benchmarks/RESULTS.md is made from these files alone. Every fit is `auto`, told the angles
(and a parameter) alone.
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
from gfnn_jax.evaluate.orbits import rotation_number

B, KICK, DRIFT = 0.9, 0.6, 0.2
RATE, DRIVE, RADIUS, PERIOD = 0.02, 0.15, 0.8, 2 * np.pi
TRANSIENT, STEPS = 2_000, 20_000  # of an orbit on the attractor


def damped_standard_map(z: np.ndarray) -> np.ndarray:
    """P = b p + c + K sin q, Q = q + P."""
    q, p = z.T
    p = B * p + DRIFT + KICK * np.sin(q)
    return np.stack([q + p, p], axis=1)


def kicked(number: int, seed: int) -> gfnn.Pairs:
    """Pairs of the damped standard map with drift."""
    z = np.random.default_rng(seed).uniform([0, -2], [2 * np.pi, 4], (number, 2))
    return gfnn.Pairs(z, damped_standard_map(z), 1.0)


def by_decay(number: int, seed: int) -> gfnn.Pairs:
    """The same, b = e^(−γ), γ a parameter of each pair from 0.05 to 0.3."""
    z = np.random.default_rng(seed).uniform([0, -2], [2 * np.pi, 4], (number, 2))
    decay = np.random.default_rng([seed, 1]).uniform(0.05, 0.3, number)
    p = np.exp(-decay) * z[:, 1] + DRIFT + KICK * np.sin(z[:, 0])
    return gfnn.Pairs(z, np.stack([z[:, 0] + p, p], 1), 1.0, args={"decay": decay})


def driven(number: int, seed: int) -> gfnn.Pairs:
    """A period of q̈ = −sin q − γ q̇ + 0.15 cos t, from a disc of radius 0.8."""
    rng = np.random.default_rng(seed)
    radius = RADIUS * np.sqrt(rng.uniform(size=number))
    angle = rng.uniform(0, 2 * np.pi, number)
    z = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)

    def field(t, y):
        q, p = np.split(y, 2)
        return np.concatenate([p, -np.sin(q) - RATE * p + DRIVE * np.cos(t)])

    solution = solve_ivp(field, (0, PERIOD), z.T.ravel(), method="DOP853", rtol=1e-13, atol=1e-14)
    return gfnn.Pairs(z, solution.y[:, -1].reshape(2, -1).T, PERIOD)


def measured(
    quick: bool,
    *,
    sample: Callable,
    pairs: int,
    b: float | None,
    tolerance: float,
    angles: tuple[int, ...] = (),
    noise: float = 0.0,
) -> Numbers:
    """A fit, its b beside the true one, and its step on pairs that it has not seen."""
    pairs = pairs // 2 if quick else pairs
    given, test = sample(pairs, SEED), sample(400, SEED + 1)
    off = noise * np.random.default_rng(SEED + 2).normal(size=(2, *given.z0.shape))
    given = gfnn.Pairs(given.z0 + off[0], given.z1 + off[1], given.dt, given.args)
    started = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        fit = gfnn.fit(given, angles=angles, tolerance=tolerance, max_seconds=None)
    seconds = time.process_time() - started
    error = nearest_image(np.asarray(fit.map.step(test.z0, test.args)[0]) - test.z1, angles)
    damping = fit.damping
    found: Numbers = {
        "pairs": pairs,
        "b": None,
        "b_error": None,
        "b_std": None,
        "one_step": float(np.sqrt(np.mean(error**2))),
        "defect": fit.symplecticity_defect,
        "terms": fit.chosen.num_parameters,
        "cpu_seconds": seconds,
        "rotation_error": None,
    }
    if damping is not None and test.args is not None:
        own = np.asarray(fit.map.multiplier(test.args))
        found |= {"b_error": float(np.abs(own / np.exp(-test.args["decay"]) - 1).max())}
    elif damping is not None and b is not None:
        found |= {
            "b": float(damping.factor),
            "b_std": float(damping.std),
            "b_error": float(abs(damping.factor / b - 1)),
        }
    if sample is kicked:
        start, steps = np.array([1.0, 0.5]), STEPS // 4 if quick else STEPS
        states = np.asarray(fit.map.rollout(start, TRANSIENT + steps)[0])
        orbit = [start]
        for _ in range(TRANSIENT + steps):
            orbit.append(damped_standard_map(orbit[-1][None])[0])
        own, true = (rotation_number(z[TRANSIENT:, 0]) for z in (states, np.array(orbit)))
        found |= {"rotation": own.value, "rotation_error": abs(own.value - true.value)}
    return found


PENDULUM = float(np.exp(-RATE * PERIOD))
PIECES = {
    "standard-map": partial(
        measured, sample=kicked, pairs=1_000, b=B, tolerance=1e-12, angles=(0,)
    ),
    "standard-map-noise-1e-3": partial(
        measured, sample=kicked, pairs=2_000, b=B, tolerance=1e-6, angles=(0,), noise=1e-3
    ),
    "standard-map-by-decay": partial(
        measured, sample=by_decay, pairs=1_500, b=None, tolerance=1e-10, angles=(0,)
    ),
    "driven-pendulum": partial(measured, sample=driven, pairs=3_000, b=PENDULUM, tolerance=1e-10),
}


def tables() -> None:
    found = results(PIECES, "damped-maps")
    rows = [
        [
            name,
            number(m["pairs"]),
            number(m["b_error"]),
            number(m["b_std"]),
            number(m["one_step"]),
            number(m["defect"]),
            number(m["rotation_error"]),
            number(m["terms"]),
            number(m["cpu_seconds"]),
        ]
        for name, m in ((name, result["measured"]) for name, result in found.items())
    ]
    heads = (
        "map",
        "pairs",
        "error of b ÷ b",
        "its standard error",
        "one step, RMS",
        "‖AᵀJA − bJ‖",
        "error of the rotation number",
        "terms of S",
        "CPU s",
    )
    between_markers(TABLES, "damped-maps", f"{markdown(heads, rows)}\n\n{provenance(found)}")


if __name__ == "__main__":
    run_pieces(__doc__ or "", PIECES, "damped-maps", tables, None)
