"""Start of the fit of a law: linear least squares of the weak form, with terms eliminated."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gfnn_jax.dataset.stretches import Nodes, Scales
from gfnn_jax.errors import FitError
from gfnn_jax.models.lagrangians.libraries import SINE
from gfnn_jax.models.lagrangians.structure import Key, Loss, Row, Structure
from gfnn_jax.models.lagrangians.weak_form import weak_rows

_LENGTHS = (0.5, 1.0)  # of the windows, in periods
_OVERLAP = 3.0  # rows that share samples: as many count as one
_APART = 100.0  # weights of coordinates: a wrong library would make one of them all
_SIGNIFICANT = 4.0  # standard errors


def protected(structure: Structure) -> set[Key]:
    """Constant masses of each coordinate, without which there would be no motion; of several that
    depend on parameters of the system none alone."""
    masses = [
        row for row in structure.terms if max(row[0]) == 2 and not any(row[1]) and not any(row[2])
    ]
    alone = [row for row in masses if sum(other[0] == row[0] for other in masses) == 1]
    return {("term", row) for row in alone}


def weak_start(
    structure: Structure, nodes: Sequence[Nodes], scales: Scales, prune: bool = True
) -> tuple[Structure, dict[Key, float]]:
    """The structure less what is not seen at four standard errors (if ``prune``), and its
    coefficients.

    Raises FitError where a coordinate without mass and force solves the equations.
    """
    d = structure.dim
    args = np.repeat([n.stretch.args for n in nodes], [len(n.t) for n in nodes], axis=0)
    form = structure.form(np.concatenate([n.x[:, :d] for n in nodes]), args)
    rows, targets = [], []
    for node in nodes:
        u = node.stretch.u[node.at]
        for length in _LENGTHS:
            q, v = node.x[:, :d], node.x[:, d:]
            row, target = weak_rows(
                form, node.t, q, v, u, length * scales.period, node.stretch.args
            )
            rows.append(row)
            targets.append(target)
    X, Y = np.concatenate(rows), -np.concatenate(targets)
    keys = structure.keys()[: form.count]
    keep = [k for k in range(form.count) if np.any(X[..., k])]
    fixed = protected(structure)
    weight = np.ones(d)
    while True:
        for _ in range(2):  # each coordinate's rows in units of their own residual
            c, residual, inverse = _solve(X[..., keep] * weight[:, None], Y * weight)
            size = np.sqrt(np.mean(residual**2, axis=0))
            if not np.min(size) > 1e-9 * np.linalg.norm(X[..., keep] * c):
                raise FitError(
                    "terms: a combination of them vanishes all along the recording, so that their "
                    "coefficients are not determined. Leave one out, or add a force"
                )
            weight = np.maximum(weight / size, np.max(weight / size) / _APART)
        error = np.sqrt(_OVERLAP * np.mean(residual**2)) * np.linalg.norm(inverse, axis=1)
        z = [
            np.inf if keys[k] in fixed else abs(value) / e
            for k, value, e in zip(keep, c, error, strict=True)
        ]
        if not prune or not z or min(z) > _SIGNIFICANT:
            break
        del keep[int(np.argmin(z))]
    kept = {keys[k]: float(value) for k, value in zip(keep, c, strict=True)}
    return structure.without({k for k in keys if k not in kept}), kept


def zeros_of_angles(
    terms: Sequence[Row],
    friction: Sequence[Loss],
    num_inputs: int,
    nodes: Sequence[Nodes],
    scales: Scales,
) -> np.ndarray:
    """Zeros (d,) of angles, up to a quarter of a turn, from which their own potentials cos q_i have
    no sine; 0 of coordinates without.

    Raises FitError as `weak_start`.
    """
    sines = [(*row[:3], row[3] + SINE) for row in terms if any(row[2])]
    structure = Structure(len(terms[0][0]), (*terms, *sines), tuple(friction), (), num_inputs)
    known = weak_start(structure, nodes, scales, prune=False)[1]
    zeros = np.zeros(structure.dim)
    for row in terms:
        speeds, powers, wave, phase = row
        if any(speeds) or any(powers) or sum(map(abs, wave)) != 1:
            continue
        own = known.get(("term", row), 0.0), known.get(("term", (*row[:3], phase + SINE)), 0.0)
        if any(own):
            zeros[list(map(abs, wave)).index(1)] = np.arctan2(own[1], own[0])
    return np.where(np.abs(zeros) > np.pi / 2, zeros - np.pi * np.sign(zeros), zeros)


def _solve(X: np.ndarray, Y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least squares X c = Y: c, residuals in the shape of Y, and R⁻¹ of the factor."""
    flat = X.reshape(X.shape[0] * X.shape[1], X.shape[2])
    scale = np.linalg.norm(flat, axis=0)
    Q, R = np.linalg.qr(flat / scale)
    inverse = np.linalg.pinv(R, rcond=1e-12)
    c = inverse @ (Q.T @ Y.reshape(-1))
    residual = Y - (flat / scale @ c).reshape(Y.shape)
    return c / scale, residual, inverse / scale[:, None]
