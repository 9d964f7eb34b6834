"""Levenberg–Marquardt for several networks at once: one program linearises and tries a step of all.

A member whose step does not lower its loss waits with more damping for the next iteration, so that
no member's search makes the others wait.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gfnn_jax.families import Family
from gfnn_jax.fitting import row_blocks
from gfnn_jax.fitting.levenberg_marquardt import (
    OF_LARGEST,
    Rows,
    attempt,
    chunked,
    flattened,
    linearize,
    prepared,
    residual,
    unflattened,
)
from gfnn_jax.fitting.training import Limits, LMResult, LMState, first_state, result_of, trained
from gfnn_jax.solve.levenberg_marquardt import Nielsen, Tried

# One trial in an iteration: a member whose step fails waits with four times the damping.
WAITING = Nielsen(growth=4.0, trials=1)


def levenberg_marquardt_together(
    family: Family,
    members: Sequence[Any],
    w: Rows,
    target_gradient: Rows,
    *,
    validation: tuple[Rows, Rows],
    weight: Any = 1.0,
    shares: Float[np.ndarray, "_ _"],
    limits: Limits = Limits(),  # noqa: B008, it is frozen
    chunk: int = 500,
    resume: LMState | None = None,
) -> LMResult:
    """Minimise that loss for E members of a family at once, each from its own start and with its
    own shares of the pairs; one program linearises and tries a step of all of them.

    members: E starts, pytrees of one structure. shares: (E, N), 0 or more, of mean 1: what the
    square of a pair's residual counts in each member's loss. All else is as for
    `levenberg_marquardt`, but for this: a member whose step does not lower its loss waits with four
    times the damping for the next iteration; validation errors are those of the members' mean ∇S;
    theta and best_theta of a state are (E, P), its damping (E,); the params that are returned have
    a leading axis E. The memory is E times as much.

    On the devices of the fit (`fitting.row_blocks`) members are trained one at a time on each: to
    the same bits on any number of devices, which one batch of all members would not give.
    """
    flat = [flattened(member) for member in members]
    theta, layout = np.stack([t for t, _ in flat]), flat[0][1]
    w, target_gradient, weight, held = prepared(theta, w, target_gradient, validation, weight)
    *points, weights = chunked(w, target_gradient, weight, chunk)
    padding = weights.shape[0] * weights.shape[1] - len(w)
    parts = np.pad(np.sqrt(shares), ((0, 0), (0, padding))).reshape(-1, *weights.shape[:2], 1)
    on_device = tuple(points), parts * weights

    def linearised(theta):
        """The trial step of every member from θ (E, P)."""

        def tried(damping) -> Tried:
            theta_, losses, decrease, promised, used = program(theta, damping)
            if not np.isfinite(losses).all():
                raise ValueError("∇S(params, w) is not finite on the training pairs at the start")
            there = theta_, float(np.mean(losses))
            return Tried(there, np.asarray(decrease), np.asarray(used), np.asarray(promised))

        return tried

    def validation_rms(theta):
        return math.sqrt(float(_loss_of_mean(family, held, theta, layout=layout)))

    started, unknown = time.perf_counter(), np.full(len(theta), math.nan)
    compiled = _compiled_on_devices if row_blocks.devices() else _compiled_together
    program = compiled(family, on_device, theta, layout)
    _loss_of_mean.lower(family, held, theta, layout=layout).compile()
    compile_seconds = time.perf_counter() - started
    first = first_state(theta, unknown, validation_rms(theta)) if resume is None else resume
    state, why = trained(first, linearised, WAITING, validation_rms, w.size, limits)
    each = [unflattened(one, layout) for one in np.asarray(state.best_theta)]
    return result_of(state, jax.tree.map(lambda *a: np.stack(a), *each), compile_seconds, why)


def _compiled_together(family, rows, theta, layout):
    """One trial step of all members, compiled: `_try_together`'s of (θ, μ)."""
    given = (family, *jax.device_put(rows))
    unknown = np.full(len(theta), math.nan)
    _try_together.lower(*given, theta, unknown, layout=layout).compile()
    return partial(_try_together, *given, layout=layout)


def _compiled_on_devices(family, rows, theta, layout):
    """The same, each member by itself on the next device that is free."""
    points, weights = rows
    own = [weights[i : i + 1] for i in range(len(theta))]
    placed = {d: jax.device_put((family, points, own), d) for d in row_blocks.devices()}

    def compile_on(device, _) -> None:
        family, points, own = placed[device]
        unknown = np.full(1, math.nan)
        _try_together.lower(family, points, own[0], theta[:1], unknown, layout=layout).compile()

    def program(theta, damping):
        def of_one(i: int, device):
            family, points, own = placed[device]
            start = theta[i : i + 1], damping[i : i + 1]
            found = _try_together(family, points, own[i], *start, layout=layout)
            return jax.tree.map(np.asarray, found)

        found = row_blocks.each(of_one, range(len(theta)))
        return tuple(np.concatenate(parts) for parts in zip(*found, strict=True))

    row_blocks.each(compile_on, placed)
    return program


@partial(jax.jit, static_argnames="layout")
def _try_together(family, points, weights, thetas, dampings, *, layout):
    """One trial step of every member: θ (E, P) and F (E,) after it, as before where F did not fall;
    the decrease of F, the promised one, and μ (E,). The products AᵀA of all members are one batched
    product of matrices."""

    def of_one(theta, damping, weight):
        chunks = (*points, weight)
        matrix, slope, loss = linearize(family, chunks, theta, layout=layout)
        first = OF_LARGEST * jnp.max(jnp.diagonal(matrix))
        damping = jnp.where(jnp.isnan(damping), first, damping)
        trial, trial_loss, promised = attempt(
            family, chunks, theta, matrix, slope, damping, layout=layout
        )
        better = loss - trial_loss > 0
        theta = jnp.where(better, trial, theta)
        losses = jnp.where(better, trial_loss, loss)
        return theta, losses, loss - trial_loss, promised, damping

    return jax.vmap(of_one)(thetas, dampings, weights)


@partial(jax.jit, static_argnames="layout")
def _loss_of_mean(family, held, thetas, *, layout):
    """The mean square of a component of the residual of the members' mean ∇S."""
    each = jax.vmap(lambda theta: residual(family, layout, theta, *held))(thetas)
    return jnp.mean(jnp.mean(each, axis=0) ** 2)
