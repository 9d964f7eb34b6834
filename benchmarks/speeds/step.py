"""A predicted step: evaluations of ∇S, microseconds in a batch and alone, textbook Newton."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any
from unittest import mock

# Sets float64, so it comes before all of JAX.
from harness import SEED, Numbers, drawn, fitted, timed

# isort: split
import jax
import jax.numpy as jnp
import numpy as np

import gfnn_jax as gfnn
from gfnn_jax.generating.generated import Generated
from gfnn_jax.maps.rollout import rollout
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.solve import newton
from gfnn_jax.solve.linear import small_solve

LANES = 1_000
# scene, absolute tolerance, pairs, and how many microseconds a step may take: of a batch, alone.
STEPS = {
    "henon-heiles-regular": (1e-10, 4_000, 2.0, 12.0),
    "two-body": (1e-9, 4_000, None, None),
    "standard-map-regular": (1e-12, 1_000, None, 5.0),
    "pcr3bp": (1e-6, 10_000, None, None),
}
FEWER_STEPS = {"pcr3bp": 50}  # a batch of it has a solve that fails at nearly every step


def textbook(map_: SymplecticMap) -> Callable:
    """``step(z)`` as it is written first: Newton from z itself, a fresh Jacobian every time, until
    the residual is at roundoff; for a map without coordinates of its own."""
    (piece,) = map_.pieces
    assert isinstance(piece, Generated)
    gradient = functools.partial(piece.family.gradient, piece.params)

    def step(z):
        free = piece.chart.free(z.shape[0] // 2)
        known = piece.chart.first_guess(z)

        def residual(x):
            w = known.at[free].set(x)
            return piece.chart.residual(z, w, gradient(w), piece.dt)

        def update(state):
            x, r, count = state
            x = x - small_solve(jax.jacfwd(residual)(x), r)
            return x, residual(x), count + 1

        def is_open(state):
            return (jnp.max(jnp.abs(state[1])) > 1e-15) & (state[2] < 8)

        x = known[free]
        x, _, _ = jax.lax.while_loop(is_open, update, (x, residual(x), 0))
        w = known.at[free].set(x)
        return piece.chart.image(z, w, gradient(w), piece.dt)

    return step


def evaluations(map_: SymplecticMap, states) -> Numbers:
    """Evaluations of ∇S per step, what else is done counted as parts of one by its operations."""
    piece = next(p for p in map_.pieces if isinstance(p, Generated))
    gradient, with_jacobian = piece.family.operations
    updates = np.asarray(map_.step(states)[1].iterations)
    start = 0 if piece.predictor is None else piece.predictor.forward.operations
    return {
        "updates_mean": float(updates.mean()),
        "updates_max": int(updates.max()),
        "start": start / gradient,
        "evaluations": float((with_jacobian + start) / gradient + updates.mean()),
        "flop": float(with_jacobian + start + gradient * updates.mean()),
    }


def step(quick: bool) -> Numbers:
    measured = {}
    for name in ["standard-map-regular"] if quick else STEPS:
        num_steps = 200 if quick else FEWER_STEPS.get(name, 500)
        tolerance, num_pairs, _, _ = STEPS[name]
        scene = gfnn.scenes.make(name)
        pairs, fresh = drawn(scene, num_pairs, quick)
        fit, about = fitted(pairs, scene, fresh, absolute_tolerance=tolerance)
        z = gfnn.sample_test_states(scene, LANES, jax.random.key(SEED))
        states, info = fit.map.rollout(z, num_steps, save_every=num_steps // 10)
        inside = np.asarray(info.status) == 0
        visited = np.asarray(states)[inside].reshape(-1, z.shape[1])[::10]
        lanes = fit.map.start(z)

        def together(map_=fit.map, lanes=lanes, num_steps=num_steps):
            return map_.advance(lanes, 1, save_every=num_steps)[1]

        one = fit.map.start(z[:1])

        def alone(map_=fit.map, one=one, num_steps=num_steps):
            return map_.advance(one, 1, save_every=10 * num_steps)[1]

        batch, single = timed(together, 5).seconds, timed(alone, 5).seconds
        row = {
            **evaluations(fit.map, visited),
            "one_step_rms": about["one_step_rms"],
            "label": about["label"],
            "chart": about["chart"],
            "defect": float(np.max(fit.map.defect(visited[:500]))),
            "microseconds_batch": 1e6 * batch / num_steps / LANES,
            "microseconds_single": 1e6 * single / (10 * num_steps),
            "bytes_saved_per_lane": 8 * z.shape[1],
            "against_newton": None,
            "against_waiting": waiting(together) / batch,
        }
        if len(fit.map.pieces) == 1 and not fit.map.coordinates.angles:
            plain = textbook(fit.map)
            fresh_newton = timed(lambda: rollout(plain, z, num_steps, save_every=num_steps), 3)  # noqa: B023
            row["against_newton"] = fresh_newton.seconds / batch
        measured[name] = row
        print(f"  {name}: {row}", flush=True)
    return measured


def waiting(batch: Callable[[], Any]) -> float:
    """Seconds of a rollout in which every lane of a batch waits for the one that takes longest."""
    with mock.patch.object(newton, "_FEWEST", LANES):
        jax.clear_caches()
        seconds = timed(batch, 1).seconds
    jax.clear_caches()
    return seconds
