"""Statistics of a comparison's chaotic orbits: samples of marginals, KL divergences, sections."""

from __future__ import annotations

import numpy as np

from gfnn_jax.coordinates import TWO_PI
from gfnn_jax.evaluate import metrics
from gfnn_jax.scenes import Scene

BINS = 50  # of the histograms that KL divergences compare


def marginal_samples(scene: Scene, states) -> dict[str, tuple[np.ndarray, tuple[float, float]]]:
    """What the marginals are of: label -> samples, and the range where there is a natural one.

    Of the standard map θ and p modulo 2π; else the section q₁ = 0, q̇₁ > 0, interpolated from the
    saved states alike for every method, in (q₂, p₂).
    """
    if scene.dim == 1:
        both = states.reshape(-1, 2) % TWO_PI
        return {"θ": (both[:, 0], (0.0, TWO_PI)), "p": (both[:, 1], (0.0, TWO_PI))}
    section = section_points(states)
    nowhere = (np.nan, np.nan)
    return {"$q_2$": (section[:, 1], nowhere), "$p_2$": (section[:, 3], nowhere)}


def section_points(states) -> np.ndarray:
    """States (K, 2d) where trajectories (B, L, 2d) cross q₁ = 0 upwards."""
    return np.concatenate([metrics.section_crossings(z, index=0) for z in states])


def histogram_range(samples, natural) -> tuple[float, float]:
    """The natural one, else that of the reference's samples, a twentieth wider on either side."""
    if np.isfinite(natural[0]):
        return natural
    low, high = float(samples.min()), float(samples.max())
    return low - 0.05 * (high - low), high + 0.05 * (high - low)


def divergences(scene: Scene, predicted, reference) -> dict[str, float] | None:
    """KL divergences of the marginals from the reference's; None where the orbits are regular."""
    if scene.regular:
        return None
    ours, theirs = (marginal_samples(scene, states) for states in (predicted, reference))
    return {
        label.strip("$"): metrics.kl_divergence(
            samples, theirs[label][0], BINS, histogram_range(*theirs[label])
        )
        for label, (samples, _) in ours.items()
    }
