"""Orbital elements of the plane two-body problem, H = |p|²/2 − 1/|q|. NumPy or JAX arrays."""

from __future__ import annotations

from collections.abc import Callable

from gfnn_jax.arrays import namespace
from gfnn_jax.phase_space import split


def semi_major_axis(z):
    """Semi-major axis a of states (..., 4), from the energy −1/(2a). Negative on a hyperbola."""
    xp, (q, p) = namespace(z), split(z)
    return 1 / (2 / xp.linalg.norm(q, axis=-1) - xp.sum(p * p, axis=-1))


def eccentricity(z):
    """Eccentricity e of states (..., 4): the length of the Laplace–Runge–Lenz vector.

    The formula √(1 + 2 E L²) would lose half the digits on a nearly circular orbit.
    """
    xp, (q, p) = namespace(z), split(z)
    speed = xp.sum(p * p, axis=-1, keepdims=True)
    radial = xp.sum(q * p, axis=-1, keepdims=True)
    return xp.linalg.norm(
        (speed - 1 / xp.linalg.norm(q, axis=-1, keepdims=True)) * q - radial * p, axis=-1
    )


ELEMENTS: dict[str, Callable] = {"axis": semi_major_axis, "eccentricity": eccentricity}
