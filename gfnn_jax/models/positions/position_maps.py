"""The map of an S(q, Q) that was learned from positions: its states, domain, predictor, sensors."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import numpy as np

from gfnn_jax.coordinates import Coordinates, circle_centre, whole_turns
from gfnn_jax.dataset.structures import Sites
from gfnn_jax.families.displacements import OfDisplacement
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.sums import matrix_free
from gfnn_jax.generating.charts import TYPE1
from gfnn_jax.generating.generated import Generated
from gfnn_jax.generating.predictor import affordable, fit_predictors
from gfnn_jax.maps.domain import covering
from gfnn_jax.maps.posterior import Posterior
from gfnn_jax.maps.sensors import Sensors
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.models.positions.discrete_lagrangian import Triples
from gfnn_jax.phase_space import Pairs, sizes

_SOLVED = 1e-10  # a step in NumPy whose residual is larger has not been solved
_TURNS = 1e-8  # radians, to which momenta must turn with the moves to be angles


def states_of(
    family: OfDisplacement, params: Any, triples: Triples
) -> tuple[np.ndarray, np.ndarray]:
    """z = (q, p) at q₋ and at q, (N, 2d) each: p = −h ∂S/∂q on the way from q₋, h ∂S/∂Q on that to
    q."""
    w = triples.ends[: len(triples)]
    into, out = np.split(triples.dt * np.asarray(family.gradient(params, w)), 2, axis=1)
    before = np.concatenate([triples.before, -into], axis=1)
    return before, np.concatenate([triples.middle, out], axis=1)


def images_of(piece: Generated, triples: Triples) -> np.ndarray:
    """q₊ as the step from q predicts it (N, d), NaN where it does not converge. NumPy."""
    z = states_of(piece.family, piece.params, triples)[1]
    images, error = piece.refined_step(z, triples.ends[len(triples) :])
    solved = (error < _SOLVED) & np.isfinite(images).all(axis=1)
    return np.where(solved[:, None], images, np.nan)[:, : triples.dim]


def map_of(
    piece: Generated, root: np.ndarray, sensors: Sensors, triples: Triples, sites: Sites | None
) -> tuple[SymplecticMap, Pairs]:
    """The map of this S, and its states at q₋ and at q, as pairs.

    root: (k, m), rootᵀ root the covariance of its coefficients.
    """
    dim, angles = triples.dim, list(triples.angles)
    turning, factor = _turning(piece, triples)
    if turning:
        params = jax.tree.map(lambda leaf: leaf * factor, piece.params)
        piece = dataclasses.replace(piece, params=params)
    before, middle = states_of(piece.family, piece.params, triples)
    centres, whole = _reduced(before, middle, angles, angles)
    if turning:
        momenta = [dim + i for i in angles]
        own, covered = _reduced(before, middle, momenta, [*momenta, *angles])
        centres, whole, angles = [*centres, *own], [*whole, *covered], [*angles, *momenta]
    domain = covering(before, ignore=tuple(whole)) if sites is None else sites.domain(before)
    if sites is not None and turning:
        domain = dataclasses.replace(sites, angles="qp").domain(before)
    if not matrix_free(piece.family):
        inputs = partial(box_inputs, angles=triples.angles)
        fitted = fit_predictors(TYPE1, before, middle, triples.dt, inputs)
        piece = dataclasses.replace(piece, predictor=affordable(fitted, piece.family).predictor)
    map_ = SymplecticMap(
        pieces=(piece,),
        coordinates=Coordinates("positions", tuple(angles)),
        domain=domain,
        scale=sizes(before),
        angle_centre=np.array(centres),
        dt=triples.dt,
    )
    map_ = jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf)), map_)
    map_ = dataclasses.replace(map_, posterior=Posterior(0, factor * root), sensors=sensors)
    return map_, Pairs(before, middle, triples.dt)


def _reduced(before, middle, of: list[int], moved: list[int]) -> tuple[list[float], list[int]]:
    """The angles ``of`` of the states before reduced, in place, by whole turns that are taken from
    the angles ``moved`` of the images too: their centres, and which cover their circle."""
    centres, whole = [], []
    for k, i in enumerate(of):
        centre, covered = circle_centre(before[:, i])
        turns = whole_turns(before[:, i] - centre)
        before[:, i] -= turns
        for j in moved[k :: len(of)]:
            middle[:, j] -= turns
        centres.append(centre)
        whole += [i] if covered else []
    return centres, whole


def _turning(piece: Generated, triples: Triples) -> tuple[bool, float]:
    """Return whether a move that is longer by a turn only adds a turn to both momenta, and the
    factor of S by which it is a turn to the last digit. A map of angles that were measured modulo
    their period has momenta of this period too; its mixed term is a mean of differences."""
    if not triples.wrapped:
        return False, 1.0
    w, dim, turn = triples.ends[: len(triples)], triples.dim, 2 * np.pi
    gradient, added = np.asarray(piece.family.gradient(piece.params, w)), []
    for i in triples.angles:
        further = w.copy()
        further[:, dim + i] += turn
        slope = np.asarray(piece.family.gradient(piece.params, further))
        moved = triples.dt * (slope - gradient)
        added.append(-moved[:, i])
        moved[:, i] += turn
        moved[:, dim + i] -= turn
        if not np.abs(moved).max() < _TURNS:
            return False, 1.0
    return True, turn / float(np.mean(added))
