"""Errors in variables: rows of a fit at the states that pairs with noise most likely had.

∇S(w) = g holds at the true states. Both w and g of a pair are linear in its two states and carry
their noise, and a fit at the measured w is biased, however many pairs there are. Given an S that
is near, the pair of states z* nearest to the measured one, in units of the noise, for which
∇S(w*) = g* follows from a linear problem for each pair; so do rows whose fit minimises the squared
distance of the pairs from the map's graph to first order (orthogonal distance regression: Britt &
Luecke, Technometrics 15 (1973) 233; Boggs, Byrd & Schnabel, SIAM J. Sci. Stat. Comput. 8 (1987)
1052).
With F = ∇S(w) − g, B its derivative in the states in units of their noise, and H = S'':

    z* = z − Bᵀ (B Bᵀ)⁻¹ (F(w*) + H (w − w*)),    (B Bᵀ)^(−½) (∇S(w*) − (g − H (w − w*))) → min.

Whitened so, residuals have variance one where noise is all that is left, in any chart.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

_BLOCK = 4_096  # pairs whose matrices are held at once
_PASSES = 2  # from the measured states; a third moves them by nothing that a fit could see


class Nearest(NamedTuple):
    """points: w* (n, 2d). target: (n, 2d) and whitening: (n, 2d, 2d), by which rows of ∇φ(w*) are
    to be multiplied; the target has been."""

    points: np.ndarray
    target: np.ndarray
    whitening: np.ndarray


def nearest(
    gradient_and_hessian: Callable, w: np.ndarray, target: np.ndarray, of_point: np.ndarray,
    of_target: np.ndarray,
) -> Nearest:  # fmt: skip
    """The rows of the nearest states.

    gradient_and_hessian: of an S that is near, (w (n, 2d)) -> (n, 2d), (n, 2d, 2d). w, target:
    (n, 2d) as measured. of_point, of_target: (2d, 4d), what one standard deviation of each number
    of both states adds to them.

    Raises numpy.linalg.LinAlgError where a pair's B Bᵀ is singular.
    """
    parts = [
        _of_block(gradient_and_hessian, w[k : k + _BLOCK], target[k : k + _BLOCK], of_point,
                  of_target)
        for k in range(0, len(w), _BLOCK)
    ]  # fmt: skip
    return Nearest(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _of_block(gradient_and_hessian, w, target, of_point, of_target) -> Nearest:
    points = w
    for _ in range(_PASSES):
        gradient, hessian = gradient_and_hessian(points)
        by = hessian @ of_point - of_target
        left = gradient - _target_at(points, w, target, hessian)
        across = np.linalg.solve(by @ by.swapaxes(1, 2), left[..., None])
        points = w - (by.swapaxes(1, 2) @ across)[..., 0] @ of_point.T
    _, hessian = gradient_and_hessian(points)
    by = hessian @ of_point - of_target
    whitening = np.linalg.inv(np.linalg.cholesky(by @ by.swapaxes(1, 2)))
    moved = (whitening @ _target_at(points, w, target, hessian)[..., None])[..., 0]
    if not (np.isfinite(points).all() and np.isfinite(moved).all()):
        raise np.linalg.LinAlgError("expected states near the measured ones")
    return Nearest(points, moved, whitening)


def _target_at(points, w, target, hessian):
    """g − H (w − w*)."""
    return target - (hessian @ (w - points)[..., None])[..., 0]


@dataclasses.dataclass(frozen=True)
class Whitened:
    """A family whose rows are multiplied by a matrix (n, 2d, 2d) each."""

    family: Any

    @property
    def num_parameters(self) -> int:
        return self.family.num_parameters

    def term_gradients(self, w, whitening):
        return whitening @ self.family.term_gradients(w)
