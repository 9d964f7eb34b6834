"""Modified Hamiltonian of a symplectic map: the H̃ whose flow over h is the map.

Backward error analysis gives H̃ as a series in h, whose terms need ever higher derivatives of S:
S − h²/24 S''(J∇S, J∇S) + … in the midpoint chart (Hairer, Lubich & Wanner, "Geometric Numerical
Integration", chapter IX). Here it comes from the map's own iterates, in any chart and of any pieces
in a row, after Skeel & Hardy, "Practical construction of modified Hamiltonians", SIAM J. Sci.
Comput. 23 (2001), 1172.

Let z(t) be the solution of H̃ through the iterates. Its action about an origin z*,

    a(t) = ∫ ½ (p − p*) dq − ½ (q − q*) dp − H̃ dt,

is known at every step without H̃: over one step it is what generates the map, up to terms of the
step's two ends (each piece's ``action``). About z* = z(t) the area does not change at first order,
so that da/dt = −H̃(z(t)): H̃ is the derivative of a known function, by central differences. Over
2m cells those err by (2 sin ½ωh)^2m for a part of z(t) of frequency ω. What they leave oscillates
along the orbit, and a binomial mean over the iterates takes cos²(½ωh) of it per order.
"""

from functools import cache
from math import comb, factorial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from gfnn_jax.arrays import matmul
from gfnn_jax.phase_space import area

# Half the cells of the differences, and half the width of the mean. Hénon–Heiles at h = 0.4: 12 of
# each leave 2e-10, 16 leave 3e-12, 24 leave 1e-14.
_CELLS, _MEAN = 16, 16
NUM_STEPS = _CELLS + _MEAN  # to either side


class ModifiedHamiltonian(NamedTuple):
    """Modified Hamiltonian H̃ with its error, each () or (B,).

    The error is the last term of the differences, plus the drift of H̃ along the iterates that it
    was computed from, plus rounding.
    """

    value: Any
    error: Any


class Cells(NamedTuple):
    """N successive steps of one direction from a state.

    action: (N, B) of each step, about that state. moved: (N, B, 2d) the change of each step. place:
    (N, B, 2d) the position after each step, relative to that state.
    """

    action: Any
    moved: Any
    place: Any


def of_cells(forward: Cells, backward: Cells, dt) -> ModifiedHamiltonian:
    """Compute H̃ of the middle state from ``NUM_STEPS`` steps of the map and of its inverse.
    JAX."""
    action = jnp.concatenate([-backward.action[::-1], forward.action])
    moved = jnp.concatenate([-backward.moved[::-1], forward.moved])
    start = jnp.zeros_like(forward.place[:1])
    place = jnp.concatenate([backward.place[_MEAN - 1 :: -1], start, forward.place[:_MEAN]])

    def means(order: int):
        """Mean H̃ over the middle iterates: all, the earlier ones, the later ones, (3, B)."""
        differences = jnp.asarray(_differences(order), action.dtype)
        velocity = matmul(differences, moved.reshape(len(moved), -1)).reshape(place.shape)
        along = area(place, velocity) - matmul(differences, action)
        return matmul(jnp.asarray(_means(), action.dtype), along) / dt

    value, earlier, later = means(_CELLS)
    last_term = jnp.abs(value - means(_CELLS - 1)[0])
    rounding = float(jnp.finfo(action.dtype).eps) * jnp.max(jnp.abs(action), axis=0) / jnp.abs(dt)
    return ModifiedHamiltonian(value, last_term + jnp.abs(later - earlier) + rounding)


@cache
def _differences(m: int) -> np.ndarray:
    """Matrix (2 _MEAN + 1, 2 NUM_STEPS) of central differences of order 2m.

    It maps the changes of a function over the cells to its derivative at each middle iterate.
    """
    # The central difference is Σ_k c_k (a_k − a_−k); a cell counts in all k beyond it.
    c = [
        (-1) ** (k + 1) * factorial(m) ** 2 / (k * factorial(m - k) * factorial(m + k))
        for k in range(1, m + 1)
    ]
    inwards = np.cumsum(c[::-1])
    row = np.concatenate([inwards, inwards[::-1]])
    differences = np.zeros((2 * _MEAN + 1, 2 * NUM_STEPS))
    for k in range(len(differences)):
        first = k + _CELLS - m
        differences[k, first : first + 2 * m] = row
    return differences


@cache
def _means() -> np.ndarray:
    """Weights (3, 2 _MEAN + 1) of three means over the middle iterates.

    The first is over all of them, the others over the earlier and the later half.
    """
    means = np.zeros((3, 2 * _MEAN + 1))
    means[0] = _binomial(_MEAN)
    means[1, : _MEAN + 1] = means[2, _MEAN:] = _binomial(_MEAN // 2)
    return means


def _binomial(half: int) -> np.ndarray:
    """Binomial weights of 2 half + 1 places, of sum 1."""
    return np.array([comb(2 * half, k) for k in range(2 * half + 1)]) / 4.0**half
