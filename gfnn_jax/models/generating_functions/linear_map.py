"""The linear map of the pairs: what a fit leaves where nothing else fits into its budget."""

from __future__ import annotations

import dataclasses

import numpy as np
import scipy.linalg

from gfnn_jax.candidates.assemble import Candidate, composed, with_error
from gfnn_jax.coordinates import to_user
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance, measured_error
from gfnn_jax.dataset.rows import residual_weight
from gfnn_jax.fitting.linear_starts import fit_half_map
from gfnn_jax.generating.charts import MIDPOINT
from gfnn_jax.maps.piece import Affine
from gfnn_jax.phase_space import symplectic_form

_PAIRS = 20_000  # that a regression takes, at most


def linear_map(data: Dataset, tolerance: Tolerance) -> Candidate | None:
    """The affine symplectic map that is nearest to the pairs, with its error on those held out: of
    a quadratic S, or of a base map, whichever is nearer. Neither needs a solve.

    data: without a base map. None for pairs of several dt or parameters, or of a structure.
    """
    if data.varied or data.structure is not None:
        return None
    rows, held, coordinates = data.training[:_PAIRS], data.validation, data.coordinates
    y0, y1 = data.y0[rows], data.y1[rows]
    tried = [_of_quadratic(data, y0, y1)]
    half = fit_half_map(y0, y1, data.scale, angles=coordinates.angles)
    if half is not None:
        shift = half.matrix @ half.shift + half.shift
        tried.append(Affine(half.matrix @ half.matrix, half.centre, shift))
    tried = [
        (measured_error(data, tolerance, to_user(coordinates, piece.image(data.y0[held]))), piece)
        for piece in tried
    ]
    error, piece = min(tried, key=lambda found: found[0].relative)
    width = len(data.scale)
    candidate = Candidate.of(
        error,
        label="linear",
        family="linear",
        chart="affine",
        num_parameters=width * (width + 3) // 2,
        operations=2.0 * width**2,
        train_rms=error.relative,
        fit_seconds=0.0,
    )
    map_ = composed(piece, data)
    return dataclasses.replace(with_error(candidate, error), map=map_)


def _of_quadratic(data: Dataset, y0, y1) -> Affine:
    """Z − z = h J (A (w − w̄) + b), w the midpoint: A by least squares among symmetric matrices.

    With rows x = w − w̄ and t of the target gradient, in units in which all residuals count alike,
    the normal equations are of Lyapunov's kind, G A + A G = xᵀt + tᵀx with G = xᵀx: they take (2d)³
    operations, where a basis of the quadratic terms takes (2d)⁶.
    """
    dt, width = data.dt, y0.shape[1]
    w, target = MIDPOINT.evaluation_point(y0, y1), MIDPOINT.target_gradient(y0, y1, dt)
    weight = residual_weight(MIDPOINT, data.scale, dt)
    free = [*data.coordinates.angles, *data.coordinates.cyclic]
    enters = np.setdiff1d(np.arange(width), free)  # a quadratic S of an angle has no period
    centre, mean = w.mean(axis=0), np.zeros(width)
    mean[enters] = target[:, enters].mean(axis=0)
    x = (w - centre)[:, enters] / weight[enters]
    t = (target - mean)[:, enters] * weight[enters]
    gram = x.T @ x
    ridge = np.finfo(np.float64).eps * np.trace(gram) * np.eye(len(gram))
    found = scipy.linalg.solve_continuous_lyapunov(gram + ridge, x.T @ t + t.T @ x)
    matrix = np.zeros((width, width))
    matrix[np.ix_(enters, enters)] = 0.5 * (found + found.T)
    matrix /= np.outer(weight, weight)
    form, eye = symplectic_form(width // 2), np.eye(width)
    half = 0.5 * dt * form @ matrix
    step = np.linalg.solve(eye - half, np.column_stack([eye + half, dt * form @ mean]))
    return Affine(step[:, :width], centre, step[:, width])
