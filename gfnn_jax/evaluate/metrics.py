"""Measures of a prediction: errors, their growth, invariants, statistics of chaotic orbits.

Arrays in, arrays out. B trajectories of L saved states are an array (B, L, 2d), q first; ``steps``
(L,) are the step numbers of the saved states. The measures do not depend on how a prediction was
made, so that all methods are measured alike. Measures of saved arrays are NumPy in float64. Orbital
elements and Lyapunov exponents also work inside a jitted computation.
"""

from gfnn_jax.evaluate.chaos import (
    STENCIL,
    curve_distance,
    kl_divergence,
    lyapunov_exponent,
    section_crossings,
)
from gfnn_jax.evaluate.elements import ELEMENTS, eccentricity, semi_major_axis
from gfnn_jax.evaluate.errors import (
    ErrorStatistics,
    absolute_error,
    error_statistics,
    momentum_error,
    one_step_rms,
    position_error,
)
from gfnn_jax.evaluate.growth import (
    POINTS_PER_DECADE,
    Estimate,
    diffusion_coefficient,
    drift_exponent,
    energy_drift,
    energy_error,
    growth_exponent,
)

__all__ = [
    "ELEMENTS",
    "POINTS_PER_DECADE",
    "STENCIL",
    "ErrorStatistics",
    "Estimate",
    "absolute_error",
    "curve_distance",
    "diffusion_coefficient",
    "drift_exponent",
    "eccentricity",
    "energy_drift",
    "energy_error",
    "error_statistics",
    "growth_exponent",
    "kl_divergence",
    "lyapunov_exponent",
    "momentum_error",
    "one_step_rms",
    "position_error",
    "section_crossings",
    "semi_major_axis",
]
