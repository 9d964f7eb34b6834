"""Laws of noisy sequences: their errors, and whether bands hold them."""

from __future__ import annotations

import dataclasses
from typing import Any

# Sets float64, so it comes before all of JAX.
from harness import Numbers

# isort: split
import jax
import numpy as np
from posteriors.calibration import (
    SAMPLES,
    SEED,
    STATES,
    STEPS,
    errors_and_bands,
    pooled,
    quietly,
    references,
)

import gfnn_jax as gfnn
from gfnn_jax.scenes import henon_heiles

FITS, NOISE, TESTED, WHOLE = 6, 1e-3, 100, 100


def sequences(dt: float, quick: bool) -> Numbers:
    """Forty sequences of fifty states of Hénon–Heiles with noise of 1e-3 on every number: every fit
    by itself, and their bands pooled; whole: the share of trajectories of ``WHOLE`` steps that the
    tube of 95 % holds at each step."""
    scene = dataclasses.replace(henon_heiles(), dt=dt)
    test = np.asarray(gfnn.sample_test_states(scene, TESTED, jax.random.key(100 + SEED)))
    reference = references(scene, test)
    every = np.asarray(gfnn.reference_trajectories(scene, test[:STATES], WHOLE))
    runs, found, held = [], [], []
    for seed in range(SEED, SEED + (1 if quick else FITS)):
        z0 = np.asarray(gfnn.sample_test_states(scene, 40, jax.random.key(seed)))
        states = np.asarray(gfnn.reference_trajectories(scene, z0, 49))
        states = states + NOISE * np.random.default_rng(seed).normal(size=states.shape)
        pairs = gfnn.Pairs(states[:, :-1].reshape(-1, 4), states[:, 1:].reshape(-1, 4), dt)
        fit = quietly(pairs, learn="hamiltonian", seed=seed)
        error, band = errors_and_bands(fit, test, reference, seed, ())
        found.append((error[:STATES], band[:STATES]))
        key = jax.random.key(seed)
        states, info = fit.map.rollout(test[:STATES], WHOLE, samples=SAMPLES, key=key)
        bands: Any = info.bands
        tube = bands.tube[:, None, None] * bands.std
        inside = np.all(np.abs(np.asarray(states) - every) <= tube, axis=(1, 2))
        held.append(float(inside.mean()))
        runs.append(
            {
                "whole": held[-1],
                "terms": fit.chosen.num_parameters,
                "formula": fit.formula,
                "noise": None if fit.noise is None else fit.noise.tolist(),
                "rms_of_all": np.sqrt(np.nanmean(error**2, axis=(0, 2))).tolist(),
            }
        )
        print(f"  {dt:g} {seed}: {runs[-1]}", flush=True)
    of_each = pooled(found, np.std(test, axis=0))
    return {"dt": dt, "steps": STEPS, "runs": runs, "whole": float(np.mean(held)), **of_each}
