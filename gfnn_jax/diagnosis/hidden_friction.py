"""Friction that a tolerance hides: a map without it meets the tolerance, and leaves it over.

What a symplectic map leaves over of another one is, to first order, J∇K of some K at the images.
Friction, −ρ_i p_i, is no such field: beside a K of as many terms as the pairs tell apart, ρ is a
coefficient like others, with a standard error.
"""

from __future__ import annotations

import numpy as np

from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products
from gfnn_jax.fitting.significance import CERTAIN
from gfnn_jax.phase_space import apply_j, sizes, split

_DEGREES = (8, 6, 5, 4, 3, 2)  # of K
_ROWS_PER_TERM, _MOST_TERMS = 10, 400
# A change of volume is reported where it is certain, in the inner half of the states by so many
# standard errors and in the outer too, and where both are the same within this factor. It is larger
# than the square of the residuals, to which order J∇K is what they are, and than roundoff.
_OF_HALVES, _ALIKE, _ROUNDOFF = 3.0, 2.0, 1e-13


def hidden_friction(images, residual, angles: tuple[int, ...] = ()) -> tuple[float, float] | None:
    """(change of phase-space volume in a step, its standard error) by friction in the residuals
    (n, 2d) of a symplectic map at its images (n, 2d); None where it is not certain, or the pairs
    are too few."""
    images, residual = np.asarray(images), np.asarray(residual)
    whole, square = _change(images, residual, angles), np.mean((residual / sizes(images)) ** 2)
    if whole is None or not abs(whole[0]) > max(CERTAIN * whole[1], square, _ROUNDOFF):
        return None
    distance = np.linalg.norm((images - images.mean(axis=0)) / sizes(images), axis=1)
    inside = distance <= np.median(distance)
    for half in (inside, ~inside):
        part = _change(images[half], residual[half], angles)
        if part is None or not abs(part[0]) > _OF_HALVES * part[1]:
            return None
        if not 1 / _ALIKE < part[0] / whole[0] < _ALIKE:
            return None
    return whole


def _change(images, residual, angles) -> tuple[float, float] | None:
    """The sum of −ρ_i and its standard error, which knows that pairs differ in what is left."""
    count, width = residual.shape
    inputs = box_inputs(images, angles=angles)
    most = min(_MOST_TERMS, count * width // _ROWS_PER_TERM)
    family = next(
        (f for f in (Products(inputs, n) for n in _DEGREES) if f.num_parameters <= most), None
    )
    if family is None:
        return None
    size, (_, p) = sizes(images), split(images)
    slopes = family.term_gradients(images)  # (n, 2d, terms)
    fields = np.moveaxis(apply_j(np.moveaxis(slopes, -1, 1)), 1, -1)
    rates = -p[..., None] * np.eye(width // 2)
    rates = np.concatenate([np.zeros_like(rates), rates], axis=1)
    design = np.concatenate([fields, rates], axis=-1) / size[:, None]
    design = design.reshape(count * width, -1)
    design = design / np.linalg.norm(design, axis=0).clip(np.finfo(float).tiny)
    norms = np.linalg.norm((rates / size[:, None]).reshape(count * width, -1), axis=0)
    inverse = np.linalg.pinv(design, rcond=1e-10)
    target = (residual / size).ravel()
    left = (target - design @ (inverse @ target)).reshape(count, width)
    own = inverse[-(width // 2) :] / norms[:, None]
    weights = own.sum(axis=0).reshape(count, width)
    rho, scores = float(np.sum(weights.ravel() * target)), np.sum(weights * left, axis=1)
    freedom = max(1.0 - design.shape[1] / design.shape[0], 0.1)
    return -rho, float(np.linalg.norm(scores) / freedom)
