"""Laws of noisy sequences: their errors, and whether bands hold them."""

from __future__ import annotations

import dataclasses

# Sets float64, so it comes before all of JAX.
from harness import Numbers

# isort: split
import jax
import numpy as np
from posteriors.calibration import (
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

FITS, NOISE, TESTED = 5, 1e-3, 100


def sequences(dt: float, quick: bool) -> Numbers:
    """Forty sequences of fifty states of Hénon–Heiles with noise of 1e-3 on every number: every fit
    by itself, and their bands pooled."""
    scene = dataclasses.replace(henon_heiles(), dt=dt)
    test = np.asarray(gfnn.sample_test_states(scene, TESTED, jax.random.key(100 + SEED)))
    reference = references(scene, test[None])[0]
    runs, found = [], []
    for seed in range(SEED, SEED + (1 if quick else FITS)):
        z0 = np.asarray(gfnn.sample_test_states(scene, 40, jax.random.key(seed)))
        states = np.asarray(gfnn.reference_trajectories(scene, z0, 49))
        states = states + NOISE * np.random.default_rng(seed).normal(size=states.shape)
        pairs = gfnn.Pairs(states[:, :-1].reshape(-1, 4), states[:, 1:].reshape(-1, 4), dt)
        fit = quietly(pairs, learn="hamiltonian", seed=seed)
        error, band = errors_and_bands(fit, test, reference, seed, ())
        found.append((error[:STATES], band[:STATES]))
        runs.append(
            {
                "terms": fit.chosen.num_parameters,
                "formula": fit.formula,
                "noise": None if fit.noise is None else fit.noise.tolist(),
                "rms_of_all": np.sqrt(np.nanmean(error**2, axis=(0, 2))).tolist(),
            }
        )
        print(f"  {dt:g} {seed}: {runs[-1]}", flush=True)
    bands = pooled(found, np.std(test, axis=0))
    return {"dt": dt, "steps": STEPS, "runs": runs, **bands}
