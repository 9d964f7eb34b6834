"""Coordinates in which a map is learned: what is an angle, what is cyclic, canonical changes.

A scene declares its coordinates and a fit uses them; the user sees his own. A change of
coordinates must be canonical (its Jacobian D satisfies Dᵀ J D = J), so that a map which is
symplectic in the inner coordinates is symplectic in the user's.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp

from gfnn_jax.phase_space import split


def _identity(z):
    return z


@dataclasses.dataclass(frozen=True)
class Coordinates:
    """Inner coordinates y = forward(z) of a scene, and their structure.

    angles:    indices of y with period 2π: the map commutes with the shift by 2π. An index of a q
               is an angle, and enters S through its Fourier harmonics; an index of a p is periodic
               for the map only (the standard map's p), and S need not be periodic in it.
    cyclic:    indices of y that do not enter S at all; the conjugate variable is conserved.
    forward, inverse: the canonical change z -> y and back, for one state of shape (2d,).
    """

    name: str
    angles: tuple[int, ...] = ()
    cyclic: tuple[int, ...] = ()
    forward: Callable = _identity
    inverse: Callable = _identity


CARTESIAN = Coordinates("cartesian")


def _to_polar(z):
    (x, y), (px, py) = split(z)
    r = jnp.hypot(x, y)
    return jnp.stack([r, jnp.arctan2(y, x), (x * px + y * py) / r, x * py - y * px])


def _from_polar(y):
    (r, phi), (p_r, p_phi) = split(y)
    c, s = jnp.cos(phi), jnp.sin(phi)
    p_t = p_phi / r
    return jnp.stack([r * c, r * s, p_r * c - p_t * s, p_r * s + p_t * c])


def polar(*, cyclic: bool) -> Coordinates:
    """Plane polar coordinates (r, φ, p_r, p_φ) of (x, y, p_x, p_y); p_φ is the angular momentum.

    ``cyclic`` says that the dynamics is invariant under rotation, so that φ does not enter S and
    p_φ is conserved to roundoff. Not defined at r = 0.
    """
    return Coordinates(
        "polar", angles=(1,), cyclic=(1,) if cyclic else (), forward=_to_polar, inverse=_from_polar
    )
