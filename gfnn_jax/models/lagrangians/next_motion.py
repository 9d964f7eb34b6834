"""Motion to record next: one that would tell the coefficients that this record hardly does.

A motion from rest, let go or driven by an input, is followed by the law. With J its sensitivities,
its own first state eliminated, a record of it turns the information RᵀR of the coefficients into
RᵀR + JᵀJ (Fedorov, Theory of Optimal Experiments, 1972). The best is the one after which forecasts
of all motions that are compared err least. All have as many readings, at some intervals: of a slow
or faint force a longer motion tells more.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from gfnn_jax.dataset.stretches import Arcs
from gfnn_jax.models.lagrangians.fit import LawFit
from gfnn_jax.models.lagrangians.structure import Key


class Options:
    """Options of the motions that are compared (`tests/test_next_motion.py`).

    further: of the largest deflections of the record. highest: radians, that an angle is let go.
    intervals: between readings, of the time between nodes. most: motions. largest: derivative of a
    residual, whose square is finite. turns: periods of a square wave of an input, between its ends
    in the record, in a motion. known: information, to the largest, that is taken for what a record
    which tells nothing has.
    """

    further: tuple[float, ...] = (0.5, 1.0, 1.5, 2.0, 4.0)
    highest: float = 3.0
    intervals: tuple[int, ...] = (1, 2, 4)
    most: int = 3
    largest: float = 1e100
    turns: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
    known: float = 1e-9


class Drive(NamedTuple):
    """A square wave of an input, by its place among them, its two values, the first one first, and
    its period in seconds, of which it begins in the middle of a half: motions stay where they
    began."""

    place: int
    first: float
    second: float
    period: float

    def at(self, t: np.ndarray) -> np.ndarray:
        """Values (n,) at times since its start."""
        turned = (t / self.period + 0.25) % 1.0
        return np.where(turned < 0.5, self.first, self.second)


class Motion(NamedTuple):
    """A start from rest (d,), the interval of its readings in seconds, by how much it makes the
    standard errors of coefficients (by their keys) smaller, the most improved first, by how many
    standard deviations of its readings together the nearest of rivals is apart, and what drives
    it."""

    start: np.ndarray
    interval: float
    gains: dict[Key, float]
    apart: float = 0.0
    drive: Drive | None = None


def next_motions(fit: LawFit, steered: Sequence[int] = ()) -> list[Motion]:
    """The best motions to record next, the best first; each of as many readings as an arc of the
    fit. steered: places of inputs that can be chosen; motions that they drive stay as near as other
    starts. None of modes, of which nobody can let go one."""
    structure, problem = fit.structure, fit.problem
    if problem.observation.hidden is not None and not problem.angles:
        return []
    own = [k for k, key in enumerate(structure.keys()) if key[0] != "sensor"]
    here = problem.linearised(structure, fit).among(own)
    if not here.columns.any():
        return []  # the law moves no residual, nor would it elsewhere
    found = [told for times in Options.intervals for told in _told(fit, own, list(steered), times)]
    if not found:
        return []
    motions, each = zip(*found, strict=True)
    left, gains = _after(here.columns, np.stack(each))
    named = [structure.keys()[k] for k in own]
    gained = [{named[j]: float(row[j]) for j in np.argsort(-row)} for row in gains]
    return [motions[k]._replace(gains=gained[k]) for k in np.argsort(left)[: Options.most]]


def _told(
    fit: LawFit, own: list[int], steered: Sequence[int], times: int
) -> Iterator[tuple[Motion, np.ndarray]]:
    """Motions whose readings are so many times as far apart as nodes are, and their derivatives (m,
    n) in coefficients, by their places."""
    structure, d, problem = fit.structure, fit.form.dim, fit.problem
    middle, reach = _middle(fit)
    begun = [(start, None) for start in _starts(fit)]
    begun += [(middle, drive) for drive in _drives(fit, steered, times)]
    reach = max(Options.further) * reach
    lanes, inputs, h = _lanes(fit, begun, times)
    for (start, drive), lane, u in zip(begun, lanes, inputs, strict=True):
        if not np.isfinite(lane).all() or (drive and np.any(abs(lane[:, :d] - middle) > reach)):
            continue
        y = problem.observation(lane[None]).values
        home, t = ((fit.arcs.home[0][0], 0, len(lane)),), h * np.arange(len(lane))[None]
        arcs = Arcs(t, y, lane[None], np.ones(y.shape), home)
        acted = dataclasses.replace(problem, inputs=lambda arcs, own=u[None]: own)
        there = acted.linearised(structure, fit, arcs).among(own)
        if np.abs(there.columns).max() < Options.largest:  # else a small change grows without bound
            yield Motion(start, h, {}, drive=drive), there.columns


def _after(here: np.ndarray, each: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """After each motion, of derivatives ``each`` (S, m, n), was recorded beside what is ``here``
    (l, n): the logarithms (S,) of errors of forecasts of all these motions, in the mean, and
    by how much (S, n) standard errors of the coefficients are smaller."""
    scale = np.linalg.norm(here, axis=0)
    here, each = (columns / np.where(scale > 0, scale, 1.0) for columns in (here, each))
    known = here.T @ here
    least = Options.known * np.linalg.eigvalsh(known)[-1] * np.eye(len(known))
    before, told = np.linalg.inv(known + least), each.swapaxes(1, 2) @ each
    after = np.linalg.inv(known + least + told)
    left = np.tensordot(after, told, axes=([1, 2], [1, 2]))  # traces of products
    gains = np.sqrt(np.diag(before) / np.diagonal(after, axis1=1, axis2=2))
    return np.mean(np.log(np.maximum(left, 1e-300)), axis=1), gains


def parting(fit: LawFit, others: Sequence[LawFit]) -> list[Motion]:
    """The motion along which the nearest of other laws is farthest from that of a fit; none where
    all leave for far away."""
    starts = _starts(fit)
    each = [(one, *_lanes(one, [(q, None) for q in starts])) for one in (fit, *others)]
    own, *theirs = (one.problem.observation(lanes).values / fit.sigma for one, lanes, *_ in each)
    apart = np.min([np.sqrt(np.sum((y - own) ** 2, axis=(1, 2))) for y in theirs], axis=0)
    if not np.isfinite(apart).any():
        return []
    best = int(np.nanargmax(apart))
    return [Motion(starts[best], each[0][-1], {}, float(apart[best]))]


def _starts(fit: LawFit) -> list[np.ndarray]:
    """One coordinate, or all of them with either sign, let go from rest at some deflections; of
    more than three with one sign, or with signs in turn."""
    d, angles = fit.form.dim, list(fit.problem.angles)
    middle, reach = _middle(fit)
    shapes = [np.eye(d)[i] for i in range(d)]
    if d > 3:
        shapes += [np.ones(d), (-1.0) ** np.arange(d)]
    elif d > 1:
        shapes += [np.array((1.0, *signs)) for signs in product((1.0, -1.0), repeat=d - 1)]
    starts = []
    for shape, further in product(shapes, Options.further):
        q = middle + further * reach * shape
        q[angles] = np.clip(q[angles], -Options.highest, Options.highest)
        if not any(np.allclose(q, other) for other in starts):
            starts.append(q)
    return starts


def _middle(fit: LawFit) -> tuple[np.ndarray, np.ndarray]:
    """The middle (d,) of the recorded positions, and how far (d,) they went from it."""
    middle = np.median(fit.problem.gauge, axis=0)
    return middle, np.max(np.abs(fit.problem.gauge - middle), axis=0)


def _drives(fit: LawFit, steered: Sequence[int], times: int) -> list[Drive]:
    """Square waves of each input that can be chosen, between the ends of what it was, in motions so
    many times as long as an arc."""
    u = np.concatenate([n.stretch.u for n in fit.problem.nodes])
    high, low = np.nanmax(u, axis=0), np.nanmin(u, axis=0)
    long = times * float(np.max(fit.arcs.t[:, -1] - fit.arcs.t[:, 0]))
    return [
        Drive(i, float(high[i]), float(low[i]), long / n) for i in steered for n in Options.turns
    ]


def _lanes(
    fit: LawFit, begun: Sequence[tuple[np.ndarray, Drive | None]], times: int = 1
) -> tuple[np.ndarray, np.ndarray, float]:
    """States (S, n, 2d) of the motions from starts at rest, driven or free, NaN of those that leave
    for far away, their inputs (S, n − 1, substeps, 6, k), and the time between states, so many
    times that between nodes."""
    d, length, problem = fit.form.dim, fit.arcs.t.shape[1], fit.problem
    steps = np.diff(fit.arcs.t, axis=1)
    h = np.full((len(begun), length - 1), times * np.median(steps[steps > 0]))
    substeps, *of_step = problem.inputs(fit.arcs).shape[2:]
    u = np.zeros((*h.shape, times * substeps, *of_step))
    for k, (_, drive) in enumerate(begun):
        if drive:
            u[k, ..., drive.place] = drive.at(h[0, 0] * np.arange(length - 1))[:, None, None]
    form, coefficients = fit.form, fit.p[: fit.form.count]
    if form.powers is not None and problem.systems.names:  # of the first arc's system
        args = problem.systems.of_nodes[[fit.arcs.home[0][0]]]
        form, each, _ = form.in_systems(coefficients, args)
        coefficients = each[0]
    first = np.array([start for start, _ in begun])
    x = np.concatenate([first, np.zeros(first.shape)], axis=1)
    followed = form.follow(coefficients, x, h, u, order=0).states
    states = np.concatenate([x[:, None], followed], axis=1)
    off = np.abs(states[..., :d] - first[:, None])
    far = 10 * (np.ptp(problem.gauge, axis=0) + np.abs(first))
    near = np.all(off < far[:, None], axis=(1, 2))  # no NaN either
    return np.where(near[:, None, None], states, np.nan), u, float(h[0, 0])
