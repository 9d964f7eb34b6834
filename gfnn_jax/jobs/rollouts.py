"""Rollouts of test states, timed without compilation: the same for every method."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from gfnn_jax.maps.rollout import rollout
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.solve.status import NON_FINITE, OK

NUM_STEPS, NUM_TRAJECTORIES = 1_000, 100
RUNAWAY = 100.0  # a prediction this many times larger than any reference is lost


class Rollouts(NamedTuple):
    """Rollouts: states (B, L, 2d), status (B,), and seconds without compilation."""

    states: np.ndarray
    status: np.ndarray
    seconds: float


def map_rollouts(
    map_: SymplecticMap, z0, num_steps: int = NUM_STEPS, params=None, t0=None
) -> Rollouts:
    """Roll out a symplectic map from z0 (B, 2d), with params (B, k) and the drive's time t0 (B,).

    The rollout runs twice, because the first run compiles.
    """
    predict = partial(map_.rollout, params=params, t0=t0)
    jax.block_until_ready(predict(z0, num_steps))
    (states, info), seconds = _timed(predict, z0, num_steps)
    return Rollouts(np.asarray(states), np.asarray(info.status), seconds)


def step_rollouts(step: Callable, z0, num_steps: int = NUM_STEPS) -> Rollouts:
    """Roll out a plain ``step(z)`` -> Z of one state (2d,) from z0 (B, 2d)."""
    z0 = np.asarray(z0)
    program = _rolled_out.lower(step, z0, num_steps).compile()
    states, seconds = _timed(program, z0)
    states = np.asarray(states)
    finite = np.isfinite(states).all(axis=(1, 2))
    return Rollouts(states, np.where(finite, OK, NON_FINITE), seconds)


@partial(jax.jit, static_argnums=(0, 2))
def _rolled_out(step, z0, num_steps):
    return rollout(step, z0, num_steps)


def _timed(call: Callable, *arguments: Any) -> tuple[Any, float]:
    started = time.perf_counter()
    result = jax.block_until_ready(call(*arguments))
    return result, time.perf_counter() - started


def without_runaways(rollouts: Rollouts, reference) -> Rollouts:
    """Set predictions that exceed the reference's size by `RUNAWAY` to NaN, from there on.

    They count as lost. Some learned maps continue for long with meaningless numbers, which would
    dominate every mean.
    """
    with np.errstate(invalid="ignore"):
        away = ~(np.abs(rollouts.states) < RUNAWAY * np.nanmax(np.abs(reference))).all(axis=-1)
    lost = np.logical_or.accumulate(away, axis=1)
    states = np.where(lost[..., None], np.nan, rollouts.states)
    status = np.where(lost[:, -1] & (rollouts.status == OK), NON_FINITE, rollouts.status)
    return Rollouts(states, status, rollouts.seconds)
