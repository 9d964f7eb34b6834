"""Pairs drawn from a learned law: as many as a generated map wants, at any time step.

The law was learned from few pairs; a map of it that is cheaper to step needs many. They are drawn
where the data were and where the law takes them, or in a region that a user names.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from gfnn_jax.coordinates import Coordinates, to_inner, to_user
from gfnn_jax.errors import FitError, InputError
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.flows.collocation import images
from gfnn_jax.flows.flow import Flow
from gfnn_jax.phase_space import Pairs

NUM_PAIRS = 4_000


@dataclasses.dataclass(frozen=True)
class Drawing:
    """Draw of pairs; tuned on benchmarks/auto.py.

    region: (2, 2d), lowest and highest values of the user's coordinates, in which states are drawn
    uniformly; None: around given states. longest: steps of the law's own rollouts. beyond: of the
    data's extent, on either side, as far as what is drawn may go. jitter: of the spread of what
    they visit: orbits are thin, a map has to hold between them.
    """

    num_pairs: int = NUM_PAIRS
    seed: int = 0
    region: Any = None
    longest: int = 30
    beyond: float = 0.1
    jitter: float = 0.05


def drawn(
    flow: Flow, coordinates: Coordinates, states, dt: float, how: Drawing = Drawing()
) -> Pairs:
    """Pairs a time ``dt`` apart, in the user's coordinates.

    flow: the law, in the inner ``coordinates``. states: (N, 2d) of the user, around which pairs are
    drawn, where no region is given: each is taken a few steps along first.

    Raises FitError where the law gives most of these states no image.
    """
    rng, num_pairs = np.random.default_rng(how.seed), how.num_pairs
    scale = np.asarray(flow.scale)
    if how.region is None:
        y = to_inner(coordinates, np.asarray(states, np.float64))
        inside, start = _near(y, coordinates, how), y[rng.integers(0, len(y), num_pairs)]
        y = _visited(flow, start, inside, rng.integers(0, how.longest + 1, num_pairs))
        moved = y + how.jitter * np.nanstd(y, axis=0) * rng.standard_normal(y.shape)
        y = np.unique(np.where(inside(moved)[:, None], moved, y), axis=0)
    else:
        low, high = checked_region(how.region, flow.family.dim)
        y = to_inner(coordinates, rng.uniform(low, high, (num_pairs, len(low))))
    y = y[np.isfinite(y).all(axis=1)]
    problem = Problem(y, y, dt, scale)
    family, params = flow.family, np.asarray(flow.params)
    (steps,) = problem.fine_steps(family, params, np.arange(len(y)))
    z0 = to_user(coordinates, y)
    z1 = to_user(coordinates, images(family, params, y, dt, steps).states)
    good = np.isfinite(z0 + z1).all(axis=1)
    if good.sum() < 0.5 * num_pairs:
        raise FitError(
            f"accelerate: the flow of H over dt = {dt:g} fails for {num_pairs - int(good.sum())} "
            f"of {num_pairs} states of the region. Choose a smaller region= or dt="
        )
    return Pairs(z0[good], z1[good], dt)


def checked_region(region, dim: int) -> tuple[np.ndarray, np.ndarray]:
    """(lowest, highest) values (2d,). Raises InputError where they are not that."""
    try:
        box = np.asarray(region, np.float64)
    except (TypeError, ValueError):
        box = np.zeros(0)
    if box.shape != (2, 2 * dim) or not (np.isfinite(box).all() and (box[0] < box[1]).all()):
        raise InputError(
            f"expected a region of shape (2, {2 * dim}), lowest values below highest, got "
            f"{np.array2string(box, precision=3, threshold=12) if box.size else repr(region)}"
        )
    return box[0], box[1]


def _near(
    y: np.ndarray, coordinates: Coordinates, how: Drawing
) -> Callable[[np.ndarray], np.ndarray]:
    """Mark the states (N, 2d) that are in the box of the data, or not far beyond it: orbits that
    escape would be most of what is drawn."""
    low, high = np.nanmin(y, axis=0), np.nanmax(y, axis=0)
    beyond = how.beyond * (high - low)
    free = [*coordinates.angles, *coordinates.cyclic]
    beyond[free] = np.inf
    return lambda y: ((y >= low - beyond) & (y <= high + beyond)).all(axis=1)


def _visited(flow: Flow, y: np.ndarray, inside, left: np.ndarray) -> np.ndarray:
    """Each state taken along by so many of the law's own steps, or to where it leaves."""
    family, params, dt = flow.family, np.asarray(flow.params), float(np.asarray(flow.dt))
    problem = Problem(y, y, dt, np.asarray(flow.scale))
    (steps,) = problem.fine_steps(family, params, np.arange(len(y)), (1e-6,))
    going = np.flatnonzero(left)
    while going.size:
        moved = images(family, params, y[going], dt, steps).states
        good = inside(moved)
        y[going[good]] = moved[good]
        left[going] -= 1
        going = going[good & (left[going] > 0)]
    return y
