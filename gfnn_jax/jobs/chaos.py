"""Statistics of a comparison's chaotic orbits: samples of marginals, KL divergences, sections."""

from __future__ import annotations

import numpy as np

from gfnn_jax.coordinates import TWO_PI
from gfnn_jax.evaluate import metrics
from gfnn_jax.scenes import Scene

BINS = 50  # bins of the histograms that KL divergences compare


def marginal_samples(scene: Scene, states) -> dict[str, tuple[np.ndarray, tuple[float, float]]]:
    """Samples of the marginals: label -> samples, and their natural range or NaN.

    For the standard map they are θ and p modulo 2π. For other scenes they are q₂ and p₂ on the
    section q₁ = 0, q̇₁ > 0, interpolated from the saved states in the same way for all methods.
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
    """Range of a histogram: the natural one, else that of the samples, 5 % wider on each side."""
    if np.isfinite(natural[0]):
        return natural
    low, high = float(samples.min()), float(samples.max())
    return low - 0.05 * (high - low), high + 0.05 * (high - low)


def divergences(scene: Scene, predicted, reference) -> dict[str, float] | None:
    """KL divergences of the marginals from those of the reference; None for regular orbits."""
    if scene.regular:
        return None
    ours, theirs = (marginal_samples(scene, states) for states in (predicted, reference))
    return {
        label.strip("$"): metrics.kl_divergence(
            samples, theirs[label][0], BINS, histogram_range(*theirs[label])
        )
        for label, (samples, _) in ours.items()
    }
