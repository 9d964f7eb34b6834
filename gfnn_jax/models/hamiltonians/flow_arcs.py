"""H along arcs of measured states: coefficients, latent states and noise together.

Both states of a noisy pair are measured, so that noise stands among the regressors too, and a drift
of the coefficients that a pair hides beneath its noise grows along a sequence. An arc of measured
states is that of latent ones, each the image of the one before: the maximum of the likelihood where
noise is normal (`solve.latent_arcs`). An arc ends where noise would have grown beyond the linear.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from gfnn_jax.budget import UNBOUNDED, Allowance
from gfnn_jax.dataset.runs import Arcs
from gfnn_jax.errors import InputError
from gfnn_jax.flows.collocation import Steps, images
from gfnn_jax.solve.latent_arcs import Defects, Fitted, Known, Observed, Readings, observed_whole
from gfnn_jax.solve.noise import Biweight, robust


@dataclasses.dataclass(frozen=True)
class FlowArcOptions:
    """Tuned on Hénon–Heiles at dt 0.5 and 0.05 with noise of 1e-3 to 1e-2 (benchmarks/bands.py).

    longest: steps of an arc. grown: noise ÷ spread at its end, if that of its first state goes on
    along it. contradicted: robust deviations of both steps at a state, from which on it is not
    where the arc starts from. gained: part of the cost from which an iteration counts. block: lanes
    whose derivatives are computed at once.
    """

    longest: int = 100
    grown: float = 0.1
    contradicted: float = 8.0
    gained: float = 1e-5
    block: int = 4_096


OPTIONS, BIWEIGHT = FlowArcOptions(), Biweight()
_FORWARD = 1e-6  # of a constant: a forward difference, whose error is as large a part of it


@dataclasses.dataclass(frozen=True, eq=False)
class FlowOnArcs:
    """The flow over dt of H = Σ c_j φ_j on arcs in which these steps ``moves`` (A, L − 1); what
    comes after an arc's end stays as it is. allowance: checked before each block of lanes."""

    family: Any
    dt: float
    how: Steps
    moves: np.ndarray
    allowance: Allowance = UNBOUNDED

    def defects(self, p: np.ndarray, x: np.ndarray) -> Defects:
        arcs, length, width = x.shape
        ends = x[:, :-1].copy()
        by_state = np.empty((arcs, length - 1, width, width))
        by_state[:] = np.eye(width)
        by_p = np.zeros((arcs, length - 1, width, len(p)))
        lanes = np.flatnonzero(self.moves)
        for first in range(0, len(lanes), OPTIONS.block):
            self.allowance.check()
            some = np.unravel_index(lanes[first : first + OPTIONS.block], self.moves.shape)
            found = images(self.family, p, x[some], self.dt, self.how, derivatives=True)
            ends[some], by_state[some] = found.states, found.by_state
            by_p[some] = found.by_coefficient
        return Defects(ends - x[:, 1:], by_state, by_p)

    def observe(self, p: np.ndarray, x: np.ndarray) -> Observed:
        return observed_whole(x, len(p))

    def take(self, arcs: np.ndarray) -> FlowOnArcs:
        return dataclasses.replace(self, moves=self.moves[arcs])

    def images(self, p: np.ndarray, z: np.ndarray, direction: int = 1) -> np.ndarray:
        """Images of states z (n, 2d), a step ahead or back."""
        self.allowance.check()
        return images(self.family, p, z, direction * self.dt, self.how).states


def fit_flow(
    model: FlowOnArcs,
    coefficients,
    arcs: Arcs,
    least,
    angles: tuple[int, ...] = (),
    *,
    only_states: bool = False,
    relative: np.ndarray | float = 1.0,
    gained: float = OPTIONS.gained,
    iterations: int = 30,
) -> Fitted | None:
    """Coefficients, states and noise, from coefficients that are close, or with these as they are
    (``only_states``). None where the flow fails. gained: as of the options; iterations: at most.

    least: (2d,) of what is left over, what is no noise. angles: coordinates that are measured
    modulo 2π. relative: (A, L, 2d) the noise of each value, in parts of the usual one.
    """
    c = np.array(coefficients, float)
    y = _lifted(model, c, arcs, angles)
    x, noise = _starts(model, c, arcs._replace(states=y))
    noise = np.hypot(noise, least)
    if not (np.isfinite(x).all() and np.isfinite(noise).all()):
        return None
    given, free = (Known(model, c), c[:0]) if only_states else (model, c)
    readings = Readings(given, y, noise * relative, BIWEIGHT)
    found = readings.fit(free, x, noise, max_iterations=iterations, tolerance=gained, least=least)
    if not np.isfinite(found.cost):
        return None
    return dataclasses.replace(found, p=c) if only_states else found


def _lifted(model: FlowOnArcs, c, arcs: Arcs, angles: tuple[int, ...]) -> np.ndarray:
    """The measured states with angles that go on over turns, as the flow leads from each to the
    next."""
    y = arcs.states.copy()
    if angles:
        off = _defects(model, c, arcs)[..., list(angles)]
        turns = np.round(np.where(np.isfinite(off), off, 0.0) / (2 * np.pi))
        y[:, 1:, list(angles)] += 2 * np.pi * np.cumsum(turns, axis=1)
    return y


def _starts(model: FlowOnArcs, c, arcs: Arcs) -> tuple[np.ndarray, np.ndarray]:
    """States (A, L, 2d) to start from, and a first guess of the noise (2d,).

    A measured state stands for itself, unless all steps to and from it miss: it may be a gross
    error. That one, and one that was not measured, is led to from its neighbours in the arc.
    """
    x, off = np.nan_to_num(arcs.states), _defects(model, c, arcs)
    size = robust(off[np.isfinite(off).all(axis=-1)], axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        near = (np.abs(off) <= OPTIONS.contradicted * size).all(axis=-1)
    good = np.zeros(x.shape[:2], bool)
    good[:, :-1] |= near
    good[:, 1:] |= near
    good &= arcs.measured
    good[:, 0] |= ~good.any(axis=1)  # nothing tells which state of a single pair is wrong
    first = np.argmax(good, axis=1)
    for n in range(1, x.shape[1]):
        lost = np.flatnonzero(~good[:, n] & (n > first))
        moved = model.moves[lost, n - 1]
        x[lost, n] = x[lost, n - 1]
        if moved.any():
            x[lost[moved], n] = model.images(c, x[lost[moved], n - 1])
    for n in range(x.shape[1] - 2, -1, -1):
        lost = np.flatnonzero(n < first)
        if len(lost):
            x[lost, n] = model.images(c, x[lost, n + 1], -1)
    return x, size / np.sqrt(2)


def _defects(model: FlowOnArcs, c, arcs: Arcs) -> np.ndarray:
    """Defects between measured states and the next (A, L − 1, 2d); NaN where one is missing."""
    off = np.full(arcs.states[:, 1:].shape, np.nan)
    both = arcs.measured[:, :-1] & arcs.measured[:, 1:] & model.moves
    off[both] = model.images(c, arcs.states[:, :-1][both]) - arcs.states[:, 1:][both]
    return off


def longest_arc(family, c, z, dt: float, how: Steps, noise) -> int:
    """Steps of an arc: as many as it takes noise (÷ spread) to grow to ``grown`` from nearly all of
    the states z (n, 2d), and no more than ``longest``."""
    width = z.shape[1]
    carried = np.broadcast_to(np.eye(width), (len(z), width, width))
    size = z.std(axis=0)
    unit = size[None, :] / size[:, None]
    for k in range(1, OPTIONS.longest + 1):
        step = images(family, c, z, dt, how, derivatives=True)
        z, carried = step.states, step.by_state @ carried
        grown = np.linalg.norm(carried * unit, axis=(1, 2))
        size_at_end = np.quantile(np.where(np.isfinite(grown), grown, np.inf), 0.9) * noise
        if not size_at_end < OPTIONS.grown:
            return max(k - 1, 1)
    return OPTIONS.longest


@dataclasses.dataclass(frozen=True, eq=False)
class FlowWithConstants(FlowOnArcs):
    """The flow of H = Σ c_j φ_j(z; θ) on arcs, p = (c, θ). family: θ (k,) -> that of the terms,
    which are so many. Raises nothing for θ without terms: the steps are then not finite."""

    terms: int = 0

    def defects(self, p: np.ndarray, x: np.ndarray) -> Defects:
        c, constants = p[: self.terms], p[self.terms :]
        try:
            found = self._at(constants).defects(c, x)
            by_constant = []
            for k, theta in enumerate(constants):
                moved, slope = constants.copy(), np.zeros(found.closing.shape)
                moved[k] += _FORWARD * abs(theta)
                ends = self._at(moved).images(c, x[:, :-1][self.moves])
                slope[self.moves] = ends - (found.closing + x[:, 1:])[self.moves]
                by_constant.append(slope / (_FORWARD * abs(theta)))
        except InputError:
            arcs, length, width = x.shape
            lost = np.full((arcs, length - 1, width, max(width, len(p))), np.nan)
            return Defects(lost[..., 0], lost[..., :width], lost[..., : len(p)])
        slopes = np.stack([*np.moveaxis(found.by_coefficients, -1, 0), *by_constant], axis=-1)
        return Defects(found.closing, found.by_state, slopes)

    def images(self, p: np.ndarray, z: np.ndarray, direction: int = 1) -> np.ndarray:
        return self._at(p[self.terms :]).images(p[: self.terms], z, direction)

    def _at(self, constants: np.ndarray) -> FlowOnArcs:
        return FlowOnArcs(self.family(constants), self.dt, self.how, self.moves, self.allowance)
