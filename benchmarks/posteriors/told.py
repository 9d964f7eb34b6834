"""The noise that a fit reports, beside the noise that was put in."""

from __future__ import annotations

# Sets float64, so it comes before all of JAX.
from harness import Numbers

# isort: split
import jax
import numpy as np
from posteriors.calibration import SEED, noisy, quietly

import gfnn_jax as gfnn
from gfnn_jax.scenes import froeschle, henon_heiles

LEVELS, FITS = (1e-6, 1e-4, 1e-2), 3
PAIRS, SEQUENCES, STATES = 2_000, 40, 50


def told(quick: bool) -> Numbers:
    """Noise reported ÷ noise put in, of every coordinate and data set: as S and as H, from single
    pairs and from sequences, and of a ring of sites."""
    scene, ring = henon_heiles(energy=1 / 12), froeschle(32)
    cases = {
        "Hénon–Heiles, S, pairs": (_pairs, scene, {"learn": "map"}),
        "Hénon–Heiles, S, sequences": (_sequences, scene, {"learn": "map"}),
        "Hénon–Heiles, H, pairs": (_pairs, scene, {"learn": "hamiltonian"}),
        "Hénon–Heiles, H, sequences": (_sequences, scene, {"learn": "hamiltonian"}),
        "ring of 32 sites, S, pairs": (_pairs, ring, {"learn": "map"}),
    }
    rows = []
    for sigma in LEVELS[1:2] if quick else LEVELS:
        for case, (draw, of, options) in cases.items():
            ratios = []
            for seed in range(SEED, SEED + (1 if quick else FITS)):
                pairs, true = draw(of, sigma, seed)
                lent = of if of is ring else None
                fit = quietly(pairs, lent, seed=seed, tolerance=1e-9, **options)
                ratios.append(None if fit.noise is None else (fit.noise / true).tolist())
            rows.append({"sigma": sigma, "case": case, "ratios": ratios})
            print(f"  {sigma:g} {case}: {ratios}", flush=True)
    return {"rows": rows}


def _pairs(scene, sigma: float, seed: int):
    """Single pairs, as those of the calibration, and the deviation of their noise (2d,)."""
    count = PAIRS if scene.dim == 2 else 200
    clean = gfnn.sample_pairs(scene, count, jax.random.key(seed))
    return noisy(clean, sigma, seed), sigma * np.std(clean.z0, axis=0)


def _sequences(scene, sigma: float, seed: int):
    """Sequences of states, and the deviation of their noise (2d,)."""
    z0 = np.asarray(gfnn.sample_test_states(scene, SEQUENCES, jax.random.key(seed)))
    states = np.asarray(gfnn.reference_trajectories(scene, z0, STATES - 1))
    true = sigma * states.reshape(-1, states.shape[-1]).std(axis=0)
    states = states + true * np.random.default_rng(seed).normal(size=states.shape)
    z0, z1 = (part.reshape(-1, states.shape[-1]) for part in (states[:, :-1], states[:, 1:]))
    return gfnn.Pairs(z0, z1, scene.dt), true
