"""Long rollouts of laws with a bracket, on numbers: by the compiled steps of `flows.lifted`."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from gfnn_jax.maps.inner import inner, outer
from gfnn_jax.maps.lanes import RolloutInfo, Saving
from gfnn_jax.solve.status import LEFT_DOMAIN, NON_FINITE, NOT_CONVERGED, OK, STOPPED_AT_EDGE

# Fewer steps of all lanes are done before compiled code is loaded; more lanes JAX steps together.
_FEWEST, _MOST_LANES = 10_000, 16
_AT_ONCE = 4_096  # states of a lane


def roll_out(map_, z, args, saving: Saving) -> tuple[Any, RolloutInfo] | None:
    """`SymplecticMap.rollout` of states z (B, n) or (n,); None where JAX does it: of few steps or
    many lanes, inside ``jit``, ``grad`` or ``vmap``, and where `flows.lifted.Stepper` has none."""
    lanes, count = int(np.prod(np.shape(z)[:-1])), saving.blocks * saving.every
    numbers = not isinstance(z, Tracer) and args is None and map_.dt_range is None
    if not numbers or lanes > _MOST_LANES or lanes * count < _FEWEST or len(map_.pieces) > 1:
        return None
    from gfnn_jax.flows.lifted import Stepper  # loads numba

    stepper, begun = Stepper.of(map_.pieces[0]), np.atleast_2d(np.asarray(z))
    if stepper is None or begun.dtype != np.float64:
        return None
    domain = jax.tree.map(np.asarray, map_.domain)
    own = [_lane(stepper, domain, y, saving) for y in np.asarray(inner(map_, jnp.array(begun))[0])]
    states, *info = (np.array(part) for part in zip(*own, strict=True))
    flat = outer(map_, jnp.asarray(states.reshape(-1, begun.shape[1])), jnp.zeros((1, 0)))
    states = jnp.concatenate([begun[:, None], flat.reshape(states.shape)], axis=1)
    status, left_at, iterations = map(jnp.asarray, info)
    found = states, RolloutInfo(status, left_at, iterations)
    return found if np.ndim(z) > 1 else jax.tree.map(lambda a: a[0], found)


def _lane(stepper, domain, y: np.ndarray, saving: Saving) -> tuple[np.ndarray, np.int32, int, Any]:
    """States (blocks, n) of one lane, NaN from where it ends; its status, the step at which it left
    the domain, and the most iterations of a step."""
    count, lane, done, most = saving.blocks * saving.every, stepper.begun(y), 0, 0
    saved = np.full((saving.blocks, len(y)), np.nan)
    edge = STOPPED_AT_EDGE if saving.stop_outside else LEFT_DOMAIN
    left_at = -1 if domain.contains(y) or not np.isfinite(y).all() else 0
    status = edge if left_at == 0 else OK
    while done < count and status <= LEFT_DOMAIN:
        w, fine, iterations = stepper.steps(lane, min(_AT_ONCE, count - done))
        most = max(most, iterations)
        if fine < len(w):
            status = NOT_CONVERGED if iterations == stepper.MOST else NON_FINITE
        outside = np.flatnonzero(~domain.contains(stepper.lift.down(w[:fine].sum(axis=1))))
        if len(outside):
            left_at = done + 1 + int(outside[0]) if left_at < 0 else left_at
            fine = int(outside[0]) if saving.stop_outside else fine
            status = edge if saving.stop_outside else max(status, LEFT_DOMAIN)
        numbers = done + 1 + np.arange(fine)
        whole = numbers % saving.every == 0
        if whole.any():
            saved[numbers[whole] // saving.every - 1] = stepper.down(w[:fine][whole])
        done += len(w)
    return saved, np.int32(status), left_at, np.int32(most)
