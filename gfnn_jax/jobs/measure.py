"""Rollouts measured against the reference: errors, energy, growth. The same for every method."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.evaluate import metrics, report
from gfnn_jax.jobs.rollouts import Rollouts
from gfnn_jax.phase_space import sizes
from gfnn_jax.scenes import Scene

# A first step that differs from the reference by this many roundings is roundoff.
_ROUNDINGS = 64


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
    error = metrics.position_error(predicted, reference, angles_of_z(scene))
    energy, drift = None, None
    conserved = scene.hamiltonian if scene.period is None else None
    hamiltonian = scene.invariants.get("energy", conserved)
    if hamiltonian is not None:
        values = _along(hamiltonian, predicted, params)
        energy = metrics.energy_error(np.asarray(values))
        drift = metrics.energy_drift(steps, energy)
    # Roundoff grows by other laws than the error of a model: no exponent where it is all there is.
    roundoff = _ROUNDINGS * np.finfo(float).eps * float(np.max(sizes(reference[:, 0])))
    of_model = float(np.nanmean(error[:, 1])) > roundoff
    growth = metrics.growth_exponent(steps, error) if scene.regular and of_model else None
    part = report.rollout_part(
        num_trajectories=len(predicted),
        num_steps=len(steps) - 1,
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


def angles_of_z(scene: Scene) -> tuple[int, ...]:
    """Indices of the user's coordinates that are angles."""
    coordinates = scene.coordinates
    return coordinates.angles if coordinates.forward is CARTESIAN.forward else ()


def plane_of(scene: Scene) -> tuple[tuple[str, str], bool]:
    """Names of the coordinates of one degree of freedom in figures, and True where modulo 2π."""
    return ((r"$\theta$", "$p$"), True) if angles_of_z(scene) else (("$q$", "$p$"), False)
