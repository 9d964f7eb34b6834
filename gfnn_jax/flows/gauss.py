"""Coefficients of Gauss collocation: Runge–Kutta methods of order 2s that are symplectic for every
Hamiltonian and symmetric in time (Hairer, Lubich & Wanner, "Geometric Numerical Integration",
sections II.1 and VI.4)."""

from functools import cache
from typing import NamedTuple

import numpy as np

_POLISHED = 3


class Gauss(NamedTuple):
    """matrix (s, s), weights (s,) and nodes (s,) of the unit interval, float64.

    coupling: (s, s), μ_ij = a_ij / b_j with μ_ij + μ_ji = 1 to the last bit. In it, and in
    L_i = h b_i K_i, the method is symplectic whatever rounding makes of the b_i; with a_ij rounded
    it is so to 1e-17 only, and the energy drifts (Antoñana, Makazaga & Murua, Numer. Algorithms 76,
    2017).
    """

    matrix: np.ndarray
    weights: np.ndarray
    nodes: np.ndarray
    coupling: np.ndarray


@cache
def gauss(stages: int) -> Gauss:
    """The coefficients a_ij = ∫₀^c_i ℓ_j, b_j = ∫₀¹ ℓ_j of s stages, to the last digit.

    In the platform's longest floats: the nodes by Newton's method on the Legendre polynomial, the
    integrals by the rule itself, which is exact for them.
    """
    wide = np.longdouble
    x = np.polynomial.legendre.leggauss(stages)[0].astype(wide)
    for _ in range(_POLISHED):
        value, slope = _legendre(x, stages)
        x = x - value / slope
    slope = _legendre(x, stages)[1]
    weights = 1 / ((1 - x**2) * slope**2)  # half of those of [−1, 1]
    nodes = (1 + x) / 2
    # ∫₀^c_i ℓ_j = c_i Σ_k b_k ℓ_j(c_i c_k).
    at = nodes[:, None] * nodes[None, :]
    lagrange = np.ones((stages, stages, stages), wide)
    for j in range(stages):
        for m in range(stages):
            if m != j:
                lagrange[..., j] *= (at - nodes[m]) / (nodes[j] - nodes[m])
    matrix = nodes[:, None] * np.einsum("k,ikj->ij", weights, lagrange)
    coupling = _coupling(matrix / weights)
    return Gauss(*(a.astype(np.float64) for a in (matrix, weights, nodes, coupling)))


def _coupling(ratios) -> np.ndarray:
    """Rounded so that μ_ij + μ_ji = 1 and, by the symmetry in time, μ_ij = μ_s+1−j,s+1−i: one of a
    pair lies between ½ and 2, so that 1 less it is exact."""
    ratios = (0.5 * (ratios + ratios[::-1, ::-1].T)).astype(np.float64)
    larger = np.where(ratios >= 0.5, ratios, 0.0)
    coupling = np.where(ratios >= 0.5, ratios, 1.0 - larger.T)
    np.fill_diagonal(coupling, 0.5)
    return coupling


def _legendre(x, degree: int):
    """The Legendre polynomial of this degree, and its slope, at x inside (−1, 1)."""
    before, value = np.ones_like(x), x
    for k in range(2, degree + 1):
        before, value = value, ((2 * k - 1) * x * value - (k - 1) * before) / k
    return value, degree * (x * value - before) / (x**2 - 1)
