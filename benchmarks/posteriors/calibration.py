"""Coverage and width of bands, pooled over independent data sets.

A few coefficients make all errors of one fit, so that these lie inside or outside together. A row
therefore pools several data sets, each with pairs, noise, fit and test states of its own.
"""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections import Counter
from typing import Any

# Sets float64, so it comes before all of JAX.
from harness import Numbers, angles_of

# isort: split
import jax
import jax.numpy as jnp
import numpy as np

import gfnn_jax as gfnn
from gfnn_jax.coordinates import nearest_image
from gfnn_jax.scenes import DrawnFrom, Scene

SIGMAS, STEPS = {"0": 0.0, "1e-6": 1e-6, "1e-4": 1e-4, "1e-2": 1e-2}, (1, 10, 100, 1_000)
# Pairs, and how many data sets of so many at first; up to MOST times as many until they decide.
DATA_SETS, MOST = {100: 10, 1_000: 10, 10_000: 5}, 4
# Test states of each data set, those of them that go on to the last step, samples.
STATES, FAR, SAMPLES = 40, 10, 50
# The first of the data sets' seeds: the posterior was tuned on 0 to 4. Every σ has its own, so that
# rows do not miss together.
SEED, SEEDS_OF_SIGMA = 11, {sigma: 11 + 100 * k for k, sigma in enumerate(SIGMAS.values())}
# Coverage that a band of two standard deviations is to have, and its width over the RMS error.
COVERED, WIDEST = (0.90, 0.995), 3.0
# Of the spread: an RMS error that is roundoff, and up to which the last step's is small.
ROUNDOFF, SMALL = 1e-12, 0.05


@dataclasses.dataclass(frozen=True)
class Librations:
    """``draw(key, num)``: a pendulum's states of amplitudes up to 2, which orbits do not leave."""

    def __call__(self, key, num):
        u = jax.random.uniform(key, (2, num), jnp.float64)
        # H + 1 = 2 (sin²(q/2) + (p/2)²): a disc in these coordinates.
        r, turn = jnp.sin(1.0) * jnp.sqrt(u[0]), 2 * jnp.pi * u[1]
        return jnp.stack([2 * jnp.arcsin(r * jnp.cos(turn)), 2 * r * jnp.sin(turn)]).T


def swinging(z, t=0.0, args=()):
    """A pendulum."""
    return z[1] ** 2 / 2 - jnp.cos(z[0])


def pendulum() -> Scene:
    """Librations, learned without being told of the angle."""
    return Scene("pendulum", "librations", 1, 0.2, DrawnFrom(Librations()), hamiltonian=swinging)


def quietly(*args, **options):
    """`gfnn.fit` without its warnings, which the fit keeps."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        return gfnn.fit(*args, max_seconds=None, **options)


def noisy(pairs, sigma: float, seed: int):
    """The pairs with noise on both states."""
    rng, spread = np.random.default_rng(seed), np.std(pairs.z0, axis=0)
    z0, z1 = (
        np.asarray(z) + sigma * spread * rng.normal(size=z.shape) for z in (pairs.z0, pairs.z1)
    )
    return gfnn.Pairs(z0, z1, pairs.dt)


def at_steps(rollout, z0) -> np.ndarray:
    """States (..., B, len(STEPS), 2d) from ``rollout(z0, num_steps, save_every=k)`` of z0
    (..., B, 2d) at STEPS; at the last of them NaN but for the first FAR states."""
    near = np.asarray(rollout(z0, STEPS[-2], save_every=1)[0])[..., list(STEPS[:-1]), :]
    far = np.asarray(rollout(z0[..., :FAR, :], STEPS[-1], save_every=STEPS[-1])[0])[..., 1:, :]
    found = np.full((*near.shape[:-2], len(STEPS), near.shape[-1]), np.nan)
    found[..., :-1, :], found[..., :FAR, -1:, :] = near, far
    return found


def references(scene: Scene, z0) -> np.ndarray:
    """The true states (B, len(STEPS), 2d) as `at_steps` has them, of test states (B, 2d)."""

    def true(z, num_steps, save_every):
        return gfnn.reference_trajectories(scene, z, num_steps)[:, ::save_every], None

    return at_steps(true, z0)


def errors_and_bands(fit, z0, reference, seed: int, angles) -> tuple[np.ndarray, np.ndarray]:
    """The error and the band, two standard deviations, (B, len(STEPS), 2d)."""
    mean = at_steps(fit.map.rollout, z0)
    drawn = at_steps(fit.sample(jax.random.key(seed), SAMPLES).rollout, z0)

    def between(a, b):
        difference = a - b
        return nearest_image(difference.reshape(-1, difference.shape[-1]), angles).reshape(
            difference.shape
        )

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of states that do not go so far
        spread = np.sqrt(np.nanmean(between(drawn, mean) ** 2, axis=0))
    return between(mean, reference), 2 * spread


def calibrated(
    make, quick: bool, *, sigma: float, lend: bool, data_sets=DATA_SETS, **options
) -> Numbers:
    """Coverage and width for every number of pairs. lend: whether fits are given the scene.
    data_sets: as many, and as many again, up to MOST times, while a step's coverage is within its
    standard error of the least that it is to be. options: of `gfnn.fit`."""
    scene = make()
    angles = angles_of(scene)
    if quick:
        data_sets = {next(iter(data_sets)): 2}
    first = SEEDS_OF_SIGMA[sigma]

    @functools.cache
    def test(seed: int) -> tuple[np.ndarray, np.ndarray]:
        z0 = np.asarray(gfnn.sample_test_states(scene, STATES, jax.random.key(1_000 + seed)))
        return z0, references(scene, z0)

    spread = np.std(
        np.concatenate([test(first + k)[0] for k in range(max(data_sets.values()))]), axis=0
    )
    rows = []
    for size, count in data_sets.items():
        labels: Counter[str] = Counter()
        found: list[tuple[np.ndarray, np.ndarray]] = []
        row: dict[str, Any] = {"sigma": sigma, "pairs": size}
        for part in range(1 if quick else MOST):
            for seed in range(first + part * count, first + (part + 1) * count):
                pairs = noisy(gfnn.sample_pairs(scene, size, jax.random.key(seed)), sigma, seed)
                fit = quietly(pairs, scene if lend else None, seed=seed, **options)
                labels[f"{fit.chosen.chart} {fit.chosen.label}"] += 1
                if fit.map.posterior is not None:
                    found.append(errors_and_bands(fit, *test(seed), seed, angles))
            row |= {"labels": dict(labels.most_common()), **pooled(found, spread)}
            print(f"  {row}", flush=True)
            if all(isinstance(cell, str) or cell.decided for cell in cells(row)):
                break
        rows.append(row)
    return {"seed": first, "rows": rows}


def pooled(found: list[tuple[np.ndarray, np.ndarray]], spread) -> Numbers:
    """Pool errors and bands (B, len(STEPS), 2d) of all data sets, at each of STEPS.

    coverage: the part of all errors that lie inside; a lost prediction does not. coverage_error:
    its standard error, from the scatter between data sets, because errors of one set are
    correlated; None for a single set. width: the median band of all ÷ the RMS of all errors. (The
    RMS of one data set may be small by chance, so that its own ratio means little.) rms, relative:
    the RMS error, and that of errors ÷ ``spread`` (2d,). lost: predictions that are not finite.
    """
    if not found:
        return {}
    error, band = (np.stack(parts) for parts in zip(*found, strict=True))
    states = [STATES] * (len(STEPS) - 1) + [FAR]
    by_set = [
        np.mean(np.abs(error[:, :n, k]) <= band[:, :n, k], axis=(1, 2))
        for k, n in enumerate(states)
    ]
    rms, relative = (np.sqrt(np.nanmean(e**2, axis=(0, 1, 3))) for e in (error, error / spread))
    sets = len(error)
    return {
        "data_sets": sets,
        "coverage": [float(np.mean(c)) for c in by_set],
        "coverage_error": [
            float(np.std(c, ddof=1) / np.sqrt(sets)) if sets > 1 else None for c in by_set
        ],
        "width": (np.nanmedian(band, axis=(0, 1, 3)) / rms).tolist(),
        "rms": rms.tolist(),
        "relative": relative.tolist(),
        "lost": [
            int(np.sum(~np.isfinite(error[:, :n, k]).all(axis=-1))) for k, n in enumerate(states)
        ],
    }


# What a result says


@dataclasses.dataclass(frozen=True)
class Cell:
    """A row at one step. coverage_error: None of a single data set."""

    step: int
    coverage: float
    coverage_error: float | None
    width: float
    rms: float

    @property
    def covers(self) -> bool:
        """Nine tenths of the errors or more."""
        return self.coverage >= COVERED[0]

    @property
    def decided(self) -> bool:
        """Whether it covers is no matter of chance: more than one standard error decides."""
        return abs(self.coverage - COVERED[0]) >= (self.coverage_error or 0.0)

    @property
    def narrow(self) -> bool:
        """Covers, by bands that are not too wide."""
        return self.covers and self.width <= WIDEST

    @property
    def meets(self) -> bool:
        """True where neither coverage nor width is too large."""
        return self.narrow and self.coverage <= COVERED[1]


def cells(row: dict[str, Any]) -> list[Cell | str]:
    """Cells of a row, or the reason why there is none.

    The reason is "roundoff", which no posterior describes, "large" errors at the last step, where
    all predictions may be lost, or "" without a posterior.
    """
    if "coverage" not in row:
        return [""] * len(STEPS)
    if row["relative"][0] < ROUNDOFF:
        return ["roundoff"] * len(STEPS)
    found: list[Cell | str] = [
        Cell(*values)
        for values in zip(
            STEPS, *(row[k] for k in ("coverage", "coverage_error", "width", "rms")), strict=True
        )
    ]
    last = row["relative"][-1]
    if last is None or not last < SMALL:
        found[-1] = "large"
    return found
