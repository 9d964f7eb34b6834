"""Rollouts of test states, timed without compilation, and measured against the reference: errors,
energy, growth. The same for every method."""

import dataclasses
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from gfnn_jax.coordinates import nearest_image
from gfnn_jax.evaluate import metrics, report
from gfnn_jax.maps.rollout import rollout
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import Pairs, sizes
from gfnn_jax.scenes import Scene
from gfnn_jax.scenes.draws import sample_pairs
from gfnn_jax.solve.status import NON_FINITE, OK

NUM_STEPS, NUM_TRAJECTORIES = 1_000, 100
RUNAWAY = 100.0  # a prediction this many times larger than any reference is lost
_ROUNDINGS = 64  # a first step that differs from the reference by so many is roundoff


def finite_pairs(scene: Scene, num_pairs: int, key: Any) -> Pairs:
    """Pairs of a scene in NumPy, without states that collide and have no image."""
    pairs = sample_pairs(scene, num_pairs, key)
    z0, z1 = np.asarray(pairs.z0), np.asarray(pairs.z1)
    return dataclasses.replace(pairs, z0=z0, z1=z1).take(np.isfinite(z1).all(axis=1))


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
    z0, rolled_out = np.asarray(z0), jax.jit(rollout, static_argnums=(0, 2))
    states, seconds = _timed(rolled_out.lower(step, z0, num_steps).compile(), z0)
    states = np.asarray(states)
    finite = np.isfinite(states).all(axis=(1, 2))
    return Rollouts(states, np.where(finite, OK, NON_FINITE), seconds)


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


def affine_errors(pairs: Pairs, scene: Scene, reference: np.ndarray) -> np.ndarray:
    """Position errors (B, L) of the simplest map: the linear regression Z = A z + b of the same
    pairs, rolled out from the reference's first states."""
    angles = scene.coordinates.user_angles
    table = np.column_stack([pairs.z0, np.ones(len(pairs.z0))])
    moved = nearest_image(np.asarray(pairs.z1) - pairs.z0, angles)
    a = np.linalg.lstsq(table, moved, rcond=None)[0]
    states = np.empty_like(reference)
    states[:, 0] = reference[:, 0]
    for k in range(1, reference.shape[1]):
        z = states[:, k - 1]
        states[:, k] = z + z @ a[:-1] + a[-1]
    rolled = Rollouts(states, np.full(len(states), OK), 0.0)
    return metrics.position_error(without_runaways(rolled, reference).states, reference, angles)


class Measured(NamedTuple):
    """Rollouts (B, L, 2d) of the test states with their errors (B, L), and the report's part."""

    steps: np.ndarray
    predicted: np.ndarray
    error: np.ndarray
    energy_error: np.ndarray | None
    report: dict[str, Any]


def measure(rollouts: Rollouts, scene: Scene, reference: np.ndarray, params=None) -> Measured:
    """Measure rollouts against the reference (B, L, 2d): errors, energy, growth.

    params: (B, k), for a scene that has parameters.
    """
    predicted, steps = rollouts.states, np.arange(reference.shape[1])
    error = metrics.position_error(predicted, reference, scene.coordinates.user_angles)
    energy, drift = None, None
    conserved = scene.hamiltonian if scene.period is None else None
    hamiltonian = scene.invariants.get("energy", conserved)
    if hamiltonian is not None:
        energy = metrics.energy_error(np.asarray(_along(hamiltonian, predicted, params)))
        drift = metrics.energy_drift(steps, energy)
    # Roundoff grows by other laws than the error of a model: no exponent where it is all there is.
    roundoff = _ROUNDINGS * np.finfo(float).eps * float(np.max(sizes(reference[:, 0])))
    of_model = float(np.nanmean(error[:, 1])) > roundoff
    growth = metrics.growth_exponent(steps, error) if scene.regular and of_model else None
    part = report.rollout_part(
        seconds=rollouts.seconds,
        status=rollouts.status,
        statistics=metrics.error_statistics(error),
        growth=growth,
        drift=drift,
    )
    return Measured(steps, predicted, error, energy, part)


@partial(jax.jit, static_argnums=0)
def _along(invariant, states, params):
    """Values (B, L) of an invariant along trajectories (B, L, 2d)."""
    if params is None:
        return jax.vmap(jax.vmap(invariant))(states)
    return jax.vmap(jax.vmap(lambda z, a: invariant(z, 0.0, a), (0, None)))(states, params)


def plane_of(scene: Scene) -> tuple[tuple[str, str], bool]:
    """Names of the coordinates of one degree of freedom in figures, and True where modulo 2π."""
    modulo = bool(scene.coordinates.user_angles)
    return (r"$\theta$" if modulo else "$q$", "$p$"), modulo
