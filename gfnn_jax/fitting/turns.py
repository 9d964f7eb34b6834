"""Turns of the states around their centre in a step, with their sense; a quadratic H of such turns.

A step tells a turn only up to whole ones: 4 radians forwards are 2π − 4 = 2.28 backwards. The sense
is that of the eigenvector v, the sign of i v*Jv (Krein's): an H with a minimum turns forwards, as a
positive kinetic energy does beside a well. What turns backwards is either an H with a maximum, or a
turn by π to 2π in a step; a longer one looks like a short one.
"""

from __future__ import annotations

import math
from itertools import combinations_with_replacement

import numpy as np

from gfnn_jax.phase_space import symplectic_form

# Rows per term of a cubic regression, those nearest to the centre; with fewer it is affine. Tuned
# on Hénon–Heiles at dt 0.5 to 6: all of 400 pairs miss the turns at dt 4, the nearest half do not.
_ROWS_PER_TERM = 6
_ON_CIRCLE, _SENSE = (
    0.3,
    0.05,
)  # how far |λ| may be from 1, and the least |i v*Jv| ÷ |v|², of a turn
_REAL = 1e-6  # of a logarithm: a larger imaginary part is none of rounding


def tangent(z0, z1, scale) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(centre, its image (2d,), Jacobian there (2d, 2d)) of the map z0 -> z1 (N, 2d), by a cubic
    regression or, where the pairs are few, an affine one."""
    width, centre = z0.shape[1], z0.mean(axis=0)
    x = (z0 - centre) / scale
    order = np.argsort(np.linalg.norm(x, axis=1), kind="stable")

    degree = 3 if len(x) >= _ROWS_PER_TERM * math.comb(width + 3, 3) else 1
    products = [
        list(t)
        for k in range(1, degree + 1)
        for t in combinations_with_replacement(range(width), k)
    ]
    near = order[: _ROWS_PER_TERM * (1 + len(products))]
    columns = [np.ones(len(near)), *(np.prod(x[near][:, t], axis=1) for t in products)]
    moved = (z1 - z0)[near] / scale
    known = np.linalg.lstsq(np.column_stack(columns), moved, rcond=None)[0]
    jacobian = np.eye(width) + known[1 : 1 + width].T * (scale[:, None] / scale[None, :])
    return centre, centre + scale * known[0], jacobian


def turns(jacobian, scale) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(angles, λ, V): of each eigenvalue λ of a Jacobian (2d, 2d) the angle by which its plane
    turns, in (−π, π), forwards positive; 0 where it is no turn. V: the eigenvectors. scale: (2d,)
    sizes of the coordinates."""
    eigenvalues, vectors = np.linalg.eig(jacobian)
    dim = len(scale) // 2
    form = symplectic_form(dim) / np.mean(scale[:dim] * scale[dim:])
    sense = -np.real(1j * np.einsum("ai,ab,bi->i", vectors.conj(), form, vectors))
    sense /= np.sum(np.abs(vectors / scale[:, None]) ** 2, axis=0)
    turn = (np.abs(np.abs(eigenvalues) - 1) < _ON_CIRCLE) & (np.abs(sense) > _SENSE)
    angles = np.where(turn, np.sign(sense) * np.angle(eigenvalues), 0.0)
    return angles, eigenvalues, vectors


def backwards(angles) -> float:
    """The largest of the angles that turn backwards, as a positive number; 0 where none does."""
    return float(max(0.0, -np.min(angles)))


def forward_logarithm(jacobian, scale) -> np.ndarray | None:
    """The real logarithm that turns every plane forwards, by up to 2π. None where there is none."""
    angles, eigenvalues, vectors = turns(jacobian, scale)
    whole = np.where(angles < 0, -2j * np.pi * np.sign(np.angle(eigenvalues)), 0.0)
    logarithm = (vectors * (np.log(eigenvalues.astype(complex)) + whole)) @ np.linalg.inv(vectors)
    if not np.abs(logarithm.imag).max() <= _REAL * (1 + np.abs(logarithm).max()):
        return None
    return logarithm.real
