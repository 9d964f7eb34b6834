"""Systems of the cases: dz/dt for z of shape (2d, N), by hand or from an energy by sympy."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import sympy
from users.case import Field


@cache
def of_energy(text: str, dim: int) -> Field:
    """The field J∇H of an H that is written as Python writes it, differentiated by sympy."""
    names = [sympy.Symbol(f"{letter}{i + 1}") for letter in "qp" for i in range(dim)]
    energy = sympy.sympify(text)
    slopes = [sympy.lambdify(names, sympy.diff(energy, name), "numpy") for name in names]

    def field(z):
        dq, dp = np.split(np.stack([slope(*z) + 0 * z[0] for slope in slopes]), 2)
        return np.concatenate([dp, -dq])

    return field


KEPLER = "(p1**2 + p2**2)/2 - 1/sqrt(q1**2 + q2**2)"
CART = "p1**2/2 + (p2 - p1*cos(q2))**2/(2*(2 - cos(q2)**2)) - cos(q2)"
CHAIN_OF_DUFFINGS = (
    "(p1**2 + p2**2 + p3**2 + q1**2 + q2**2 + q3**2)/2 + (q1**4 + q2**4 + q3**4)/4"
    " + 3*((q1 - q2)**2 + (q2 - q3)**2)/20"
)
WELLS = (
    "(p1**2 + p2**2 + p3**2)/2 + (q1**2 - 1)**2/4 + (q2**2 - 1)**2/4 + (q3**2 - 1)**2/4"
    " + (q1 - q2)**2/10 + (q2 - q3)**2/10"
)
HENON_HEILES_3 = "(p1**2 + p2**2 + p3**2 + q1**2 + q2**2 + q3**2)/2 + q1**2*q2 - q2**3/3 + q1*q3**2"
TOP = (  # of Euler angles (φ, θ, ψ): I = 1, I₃ = 1/2, m g l = 1
    "p2**2/2 + (p1 - p3*cos(q2))**2/(2*sin(q2)**2) + p3**2 + cos(q2)"
)
# In the frame that turns with three bodies of masses 0.9, 0.05, 0.05 at the corners of a triangle.
FOUR_BODIES = (
    "(p1**2 + p2**2)/2 + q2*p1 - q1*p2 - 0.9/sqrt((q1 + 0.075)**2 + q2**2)"
    " - 0.05/sqrt((q1 - 0.791)**2 + (q2 - 0.5)**2) - 0.05/sqrt((q1 - 0.791)**2 + (q2 + 0.5)**2)"
)


def toda(z):
    """A chain with fixed ends, springs with V = exp(−r) + r."""
    q, p = np.split(z, 2)
    pull = 1 - np.exp(-np.diff(np.pad(q, ((1, 1), (0, 0))), axis=0))
    return np.concatenate([p, np.diff(pull, axis=0)])


def dry_pendulum(z, friction: float):
    """A pendulum whose bearing rubs; the sign of p is smoothed over 1e-3."""
    q, p = z
    return np.stack([p, -np.sin(q) - friction * np.tanh(p / 1e-3)])


def resisting_air(z, friction: float = 0.05):
    """A pendulum whose friction is quadratic in p."""
    q, p = z
    return np.stack([p, -np.sin(q) - friction * np.abs(p) * p])


def pendulum(z, stiffness: Any = 1.0, friction: float = 0.0):
    """stiffness: g / length, a number or one per state. friction: of the momentum, per time."""
    q, p = z
    return np.stack([p, -stiffness * np.sin(q) - friction * p])


def henon_heiles(z):
    x, y, px, py = z
    return np.stack([px, py, -x - 2 * x * y, -y - x**2 + y**2])


EARTH, RADIUS, J2 = 3.986004418e14, 6.378137e6, 1.08262668e-3  # m³/s², m, 1


def satellite(z):
    """Metres and metres per second, the momentum of unit mass: Kepler's force and J2's."""
    q, p = z[:3], z[3:]
    r2 = np.sum(q**2, axis=0)
    kepler, flattening = EARTH / r2**1.5, 1.5 * J2 * RADIUS**2 / r2
    pole = np.array([[1.0], [1.0], [3.0]])
    return np.concatenate([p, -kepler * q * (1 + flattening * (pole - 5 * q[2] ** 2 / r2))])


def penning_trap(z, quartic: float):
    """A charge in a field B = 1 along the axis and a quadrupole, canonical momenta p = v + A."""
    (x, y, s), p = z[:3], z[3:]
    squeeze, rho2 = 0.1, x**2 + y**2
    v = p - 0.5 * np.stack([-y, x, 0 * s])
    radial = -squeeze / 2 + quartic * (1.5 * rho2 - 6 * s**2)
    axial = squeeze + quartic * (4 * s**2 - 6 * rho2)
    return np.stack([*v, 0.5 * v[1] - radial * x, -0.5 * v[0] - radial * y, -axial * s])


def double_pendulum(z):
    """Masses, lengths and g are 1; the momenta are those that belong to the angles."""
    a, b, pa, pb = z
    c, s = np.cos(a - b), np.sin(a - b)
    den = 1 + s**2
    kinetic = (pa**2 + 2 * pb**2 - 2 * pa * pb * c) / (2 * den)
    turn = pa * pb * s / den - 2 * s * c * kinetic / den
    return np.stack(
        [(pa - pb * c) / den, (2 * pb - pa * c) / den, -turn - 2 * np.sin(a), turn - np.sin(b)]
    )


def fput(z, beta: float = 0.3):
    """A chain with fixed ends, springs with a cubic force."""
    q, p = np.split(z, 2)
    stretch = np.diff(np.pad(q, ((1, 1), (0, 0))), axis=0)
    force = stretch + beta * stretch**3
    return np.concatenate([p, np.diff(force, axis=0)])
