"""Motion to record next: one that would tell the coefficients that this record hardly does.

A motion from rest is followed by the law. With J its sensitivities, its own first state eliminated,
a record of it turns the information RᵀR of the coefficients into RᵀR + JᵀJ (Fedorov, Theory of
Optimal Experiments, 1972). Beside the law's own coefficients count those of terms that it lacks and
that its own imitate where the record was.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from gfnn_jax.dataset.stretches import Arcs
from gfnn_jax.models.lagrangians import libraries
from gfnn_jax.models.lagrangians.fit import LawFit, places
from gfnn_jax.models.lagrangians.structure import Key


@dataclasses.dataclass(frozen=True)
class MotionOptions:
    """Options of the motions that are compared (`tests/test_next_motion.py`).

    further: of the largest deflections of the record. highest: radians, that an angle is let go.
    imitated: share of what a term does that others do not, below which it is hardly identifiable.
    most_terms: that are looked at: of larger libraries the first alone, of many coordinates the
    textbook's. most: motions. largest: derivative of a residual, whose square is finite.
    """

    further: tuple[float, ...] = (0.5, 1.0, 1.5, 2.0, 4.0)
    highest: float = 3.0
    imitated: float = 0.1
    most_terms: int = 40
    most: int = 3
    largest: float = 1e100


OPTIONS = MotionOptions()


class Motion(NamedTuple):
    """A start from rest (d,), by how much it makes the standard errors of coefficients (by their
    keys) smaller, the most improved first, and by how many standard deviations of its
    readings together the nearest of rivals is apart."""

    start: np.ndarray
    gains: dict[Key, float]
    apart: float = 0.0


def next_motions(fit: LawFit) -> list[Motion]:
    """The best motions to record next, the best first; each as long as an arc of the fit."""
    structure, d, problem = fit.structure, fit.form.dim, fit.problem
    rows, more = (library(d, problem.angles) for library in (libraries.first, libraries.more))
    rows = [*rows, *more] if len(rows) + len(more) <= OPTIONS.most_terms else rows
    rows = rows if d <= libraries.FEW else libraries.textbook(d, problem.angles)
    library = libraries.without_forces(rows, problem.observation.shifts())
    lacking = [("term", row) for row in library if row not in structure.terms]
    larger = structure.plus(lacking)
    keys, whole = larger.keys(), problem.linearised(larger, fit)
    own, others = places(larger, structure, lacking)
    own = [k for k in own if keys[k][0] != "sensor"]
    share = whole.added(own, others).share
    hardly = {k for k, one in zip(others, share, strict=True) if one < OPTIONS.imitated}
    kept = [k for k in range(len(keys)) if k in own or k in hardly]
    here = whole.among(kept)
    if not here.columns.any():
        return []  # the law moves no residual, nor would it elsewhere
    named = [keys[k] for k in kept]
    looked_at = larger.without(set(keys) - set(named))
    places_of = [looked_at.keys().index(key) for key in named]
    still = np.zeros((1, *problem.inputs(fit.arcs).shape[1:]))
    without_inputs = dataclasses.replace(problem, inputs=lambda arcs: still)
    found = []
    for arcs in _followed(fit, _starts(fit)):
        there = without_inputs.linearised(looked_at, fit, arcs).among(places_of)
        if not np.abs(there.columns).max() < OPTIONS.largest:
            continue  # along which a small change grows without bound
        less = here.sharpened_by(there)
        order = np.argsort(-less)
        found.append(Motion(arcs.x[0, 0, :d], {named[k]: float(less[k]) for k in order}))
    found.sort(key=lambda motion: -sum(np.log(list(motion.gains.values()))))
    return found[: OPTIONS.most]


def parting(fit: LawFit, others: Sequence[LawFit]) -> list[Motion]:
    """The motion along which the nearest of other laws is farthest from that of a fit; none where
    all leave for far away."""
    starts = _starts(fit)
    own, *theirs = (
        one.problem.observation(_lanes(one, starts)[0]).values / fit.sigma for one in (fit, *others)
    )
    apart = np.min([np.sqrt(np.sum((y - own) ** 2, axis=(1, 2))) for y in theirs], axis=0)
    if not np.isfinite(apart).any():
        return []
    best = int(np.nanargmax(apart))
    return [Motion(starts[best], {}, float(apart[best]))]


def _starts(fit: LawFit) -> list[np.ndarray]:
    """One coordinate, or all of them with either sign, let go from rest at some deflections; of
    more than three with one sign, or with signs in turn."""
    d, angles = fit.form.dim, list(fit.problem.angles)
    middle = np.median(fit.problem.gauge, axis=0)
    reach = np.max(np.abs(fit.problem.gauge - middle), axis=0)
    shapes = [np.eye(d)[i] for i in range(d)]
    if d > 3:
        shapes += [np.ones(d), (-1.0) ** np.arange(d)]
    elif d > 1:
        shapes += [np.array((1.0, *signs)) for signs in product((1.0, -1.0), repeat=d - 1)]
    starts = []
    for shape, further in product(shapes, OPTIONS.further):
        q = middle + further * reach * shape
        q[angles] = np.clip(q[angles], -OPTIONS.highest, OPTIONS.highest)
        if not any(np.allclose(q, other) for other in starts):
            starts.append(q)
    return starts


def _followed(fit: LawFit, starts: Sequence[np.ndarray]) -> list[Arcs]:
    """The motions from these starts as arcs; those that leave for far away are left out."""
    lanes, h = _lanes(fit, starts)
    length = lanes.shape[1]
    home, t = ((fit.arcs.home[0][0], 0, length),), h * np.arange(length)[None]
    arcs = []
    for lane in lanes[np.isfinite(lanes).all(axis=(1, 2))]:
        y = fit.problem.observation(lane[None]).values
        arcs.append(Arcs(t, y, lane[None], np.ones(y.shape), home))
    return arcs


def _lanes(fit: LawFit, starts: Sequence[np.ndarray]) -> tuple[np.ndarray, float]:
    """States (S, n, 2d) of the motions from these starts, without inputs, NaN of those that leave
    for far away, and the time between them."""
    d, length, problem = fit.form.dim, fit.arcs.t.shape[1], fit.problem
    steps = np.diff(fit.arcs.t, axis=1)
    h = np.full((len(starts), length - 1), np.median(steps[steps > 0]))
    still = np.zeros((*h.shape, *problem.inputs(fit.arcs).shape[2:]))
    form, coefficients = fit.form, fit.p[: fit.form.count]
    if form.powers is not None and problem.systems.names:  # of the first arc's system
        args = problem.systems.of_nodes[[fit.arcs.home[0][0]]]
        form, each, _ = form.in_systems(coefficients, args)
        coefficients = each[0]
    first = np.array(starts)
    x = np.concatenate([first, np.zeros((len(starts), d))], axis=1)
    followed = form.follow(coefficients, x, h, still, order=0).states
    states = np.concatenate([x[:, None], followed], axis=1)
    off = np.abs(states[..., :d] - first[:, None])
    far = 10 * (np.ptp(problem.gauge, axis=0) + np.abs(first))
    near = np.all(off < far[:, None], axis=(1, 2))  # no NaN either
    return np.where(near[:, None, None], states, np.nan), float(h[0, 0])
