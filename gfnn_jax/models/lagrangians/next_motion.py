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
from gfnn_jax.flows import coulomb
from gfnn_jax.models.lagrangians import libraries
from gfnn_jax.models.lagrangians.fit import LawFit, Workbench, places
from gfnn_jax.models.lagrangians.structure import Key

_FURTHER = (0.5, 1.0, 1.5, 2.0, 4.0)  # of the largest deflections of the record
_NEARLY_OVER = 3.0  # radians: an angle is let go no higher
_IMITATED = 0.1  # share of what a term does that others do not, below which it is hardly told
_MOST_TERMS = 40  # that are looked at: of larger libraries the first alone
_MOST = 3


class Motion(NamedTuple):
    """A start from rest (d,), and by how much it makes the standard errors of coefficients (by
    their keys) smaller, the most improved first."""

    start: np.ndarray
    gains: dict[Key, float]


def next_motions(bench: Workbench, fit: LawFit, angles: Sequence[int]) -> list[Motion]:
    """The best motions to record next, the best first; each as long as an arc of the fit."""
    structure, d = fit.structure, fit.form.dim
    rows, more = (library(d, tuple(angles)) for library in (libraries.first, libraries.more))
    rows = [*rows, *more] if len(rows) + len(more) <= _MOST_TERMS else rows
    library = libraries.without_forces(rows, bench.observation.shifts())
    lacking = [("term", row) for row in library if row not in structure.terms]
    larger = structure.plus(lacking)
    keys, whole = larger.keys(), bench.linearised(larger, fit)
    own, others = places(larger, structure, lacking)
    own = [k for k in own if keys[k][0] != "sensor"]
    share = whole.added(own, others).share
    hardly = {k for k, one in zip(others, share, strict=True) if one < _IMITATED}
    kept = [k for k in range(len(keys)) if k in own or k in hardly]
    here = whole.among(kept)
    if not here.columns.any():
        return []  # the law moves no residual, nor would it elsewhere
    without_inputs = dataclasses.replace(
        bench, inputs=lambda arcs: np.zeros((1, *bench.inputs(fit.arcs).shape[1:]))
    )
    found = []
    for arcs in _followed(bench, fit, _starts(bench, fit, angles)):
        less = here.sharpened_by(without_inputs.linearised(larger, fit, arcs).among(kept))
        order = np.argsort(-less)
        found.append(Motion(arcs.x[0, 0, :d], {keys[kept[k]]: float(less[k]) for k in order}))
    found.sort(key=lambda motion: -sum(np.log(list(motion.gains.values()))))
    return found[:_MOST]


def _starts(bench: Workbench, fit: LawFit, angles: Sequence[int]) -> list[np.ndarray]:
    """One coordinate, or all of them with either sign, let go from rest at some deflections."""
    d = fit.form.dim
    middle = np.median(bench.gauge, axis=0)
    reach = np.max(np.abs(bench.gauge - middle), axis=0)
    shapes = [np.eye(d)[i] for i in range(d)]
    if d > 1:
        shapes += [np.array((1.0, *signs)) for signs in product((1.0, -1.0), repeat=d - 1)]
    starts = []
    for shape, further in product(shapes, _FURTHER):
        q = middle + further * reach * shape
        q[list(angles)] = np.clip(q[list(angles)], -_NEARLY_OVER, _NEARLY_OVER)
        if not any(np.allclose(q, other) for other in starts):
            starts.append(q)
    return starts


def _followed(bench: Workbench, fit: LawFit, starts: Sequence[np.ndarray]) -> list[Arcs]:
    """The motions from these starts as arcs, without inputs; those that leave for far away are left
    out."""
    d, length = fit.form.dim, fit.arcs.t.shape[1]
    steps = np.diff(fit.arcs.t, axis=1)
    h = np.full(len(starts), np.median(steps[steps > 0]))
    still = np.zeros((len(starts), *bench.inputs(fit.arcs).shape[2:]))
    form, coefficients = fit.form, fit.p[: fit.form.count]
    if form.powers is not None and bench.systems is not None:  # of the first arc's system
        form, each, _ = form.in_systems(coefficients, bench.systems(fit.arcs)[:1])
        coefficients = each[0]
    first = np.array(starts)
    x = [np.concatenate([first, np.zeros((len(starts), d))], axis=1)]
    for _ in range(length - 1):
        with np.errstate(all="ignore"):
            x.append(coulomb.step(form, coefficients, x[-1], h, still, order=0)[0].states)
    states = np.stack(x, axis=1)
    off = np.abs(states[..., :d] - first[:, None])
    far = 10 * (np.ptp(bench.gauge, axis=0) + np.abs(first))
    home, t = ((fit.arcs.home[0][0], 0, length),), h[0] * np.arange(length)[None]
    arcs = []
    for lane in states[np.all(off < far[:, None], axis=(1, 2))]:  # no NaN either
        y = bench.observation(lane[None]).values
        arcs.append(Arcs(t, y, lane[None], np.ones(y.shape), home))
    return arcs
