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
RUNAWAY = 100.0  # a prediction so many times larger than any reference is lost


class Rollouts(NamedTuple):
    """States (B, L, 2d), status (B,), and how long they took, without compilation."""

    states: np.ndarray
    status: np.ndarray
    seconds: float


def map_rollouts(
    map_: SymplecticMap, z0, num_steps: int = NUM_STEPS, params=None, t0=None
) -> Rollouts:
    """Rollouts of a symplectic map from z0 (B, 2d) with its params (B, k), from the drive's time t0
    (B,); predicted twice, as the first time compiles."""
    predict = partial(map_.rollout, params=params, t0=t0)
    jax.block_until_ready(predict(z0, num_steps))
    (states, info), seconds = _timed(predict, z0, num_steps)
    return Rollouts(np.asarray(states), np.asarray(info.status), seconds)


def step_rollouts(step: Callable, z0, num_steps: int = NUM_STEPS) -> Rollouts:
    """Rollouts of a plain ``step(z)`` -> Z of one state (2d,) from z0 (B, 2d)."""
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
    """What has left the reference's size by far is lost, as what is not finite: NaN from there on.

    Some learned maps go on for long with numbers of no meaning, which would fill every mean.
    """
    with np.errstate(invalid="ignore"):
        away = ~(np.abs(rollouts.states) < RUNAWAY * np.nanmax(np.abs(reference))).all(axis=-1)
    lost = np.logical_or.accumulate(away, axis=1)
    states = np.where(lost[..., None], np.nan, rollouts.states)
    status = np.where(lost[:, -1] & (rollouts.status == OK), NON_FINITE, rollouts.status)
    return Rollouts(states, status, rollouts.seconds)
