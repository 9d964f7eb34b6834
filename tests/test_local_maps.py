"""What neighbouring pairs say of a map, where they are many and noisy, or on a single orbit."""

import numpy as np

from gfnn_jax.charts import CHARTS
from gfnn_jax.local_maps import data_defect, judge_chart, local_jacobians


def turned(z, angle=0.5):
    q, p = z.T
    return np.stack(
        [q * np.cos(angle) + p * np.sin(angle), p * np.cos(angle) - q * np.sin(angle)]
    ).T


def test_more_noisy_pairs_are_judged_no_worse():
    rng = np.random.default_rng(0)
    z = rng.uniform(-1, 1, (60_000, 2))
    noise = 1e-2 * rng.standard_normal((2, *z.shape))
    y0, y1, scale = z + noise[0], turned(z) + noise[1], z.std(axis=0)
    jacobians = local_jacobians(y0, y1, scale)
    assert data_defect(jacobians, scale) < 0.1
    judged = judge_chart(CHARTS["midpoint"], jacobians, scale)
    assert abs(judged.low - np.cos(0.25) ** 2) < 0.15


def test_a_single_orbit_looks_symplectic():
    """Nothing is known across the orbit, and nothing is held against it."""
    phase = 0.3 + 0.1 * np.arange(1_000)
    z = np.stack([np.cos(phase), -np.sin(phase)], axis=1)
    scale = z.std(axis=0)
    jacobians = local_jacobians(z[:-1], z[1:], scale)
    assert data_defect(jacobians, scale) < 0.1
    assert judge_chart(CHARTS["midpoint"], jacobians, scale).low > 0.9
