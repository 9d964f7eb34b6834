"""Rollouts of a map, lane by lane: the state of each, what ends it, and the compiled programs."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from gfnn_jax.compiling import compiled_sooner
from gfnn_jax.maps.posterior import Bands
from gfnn_jax.maps.programs import after, contains, inner, of_one_or_many, outer, reduced, worst
from gfnn_jax.maps.rollout import scan_steps
from gfnn_jax.solve.status import LEFT_DOMAIN, NON_FINITE, OK, STOPPED_AT_EDGE


class Lanes(NamedTuple):
    """Complete state of a batch of rollouts, from which it can be continued.

    y: inner coordinates with angles reduced (B, 2d). compensation: their rounding error, less than
    their last digit (B, 2d). winding: whole turns of the angles (B, a). status, left_at (step at
    which the lane left the domain, −1 if never), iterations (most Newton updates of a step), steps
    (number of steps done): each (B,).
    """

    y: Any
    compensation: Any
    winding: Any
    status: Any
    left_at: Any
    iterations: Any
    steps: Any


class RolloutInfo(NamedTuple):
    """Result of each lane of a rollout, (B,): status, left_at, iterations; and bands.

    left_at: step at which the lane left the domain, −1 if it never did. iterations: most Newton
    updates in a step. bands: those of the samples, where samples were asked for.
    """

    status: Any
    left_at: Any
    iterations: Any
    bands: Bands | None = None


class Saving(NamedTuple):
    """States that a rollout saves: ``blocks`` of them, one every ``every`` steps; and whether
    lanes stop where they leave the domain. Hashable: a constant of compiled code."""

    blocks: int
    every: int = 1
    stop_outside: bool = False


def _by_domain(status, inside, stop_outside: bool):
    """Update the status by the domain; only lanes that have not ended can change."""
    outside = STOPPED_AT_EDGE if stop_outside else LEFT_DOMAIN
    return jnp.where((status <= LEFT_DOMAIN) & ~inside, outside, status)


def judged(lanes: Lanes, finite, inside, failed, stop_outside: bool) -> tuple[Lanes, Any]:
    """The lanes after states of M steps on numbers, but for their states; and where these (M, B)
    come after a lane's end.

    finite, inside: (M, B) of each state. failed: (B,) the status of a lane that ceases to be
    finite.
    """
    leaves = finite & ~inside
    ended = leaves | ~finite if stop_outside else ~finite
    going, leaving = lanes.status <= LEFT_DOMAIN, leaves.any(axis=0)
    lost = ~finite[ended.argmax(axis=0), np.arange(len(going))]
    status = np.where(leaving, LEFT_DOMAIN, lanes.status)
    status = np.where(ended.any(axis=0), np.where(lost, failed, STOPPED_AT_EDGE), status)
    new = going & leaving & (lanes.left_at < 0)
    then = lanes._replace(
        status=np.where(going, status, lanes.status).astype(np.int32),
        left_at=np.where(new, lanes.steps + 1 + leaves.argmax(axis=0), lanes.left_at),
        steps=lanes.steps + len(finite),
    )
    return then, np.logical_or.accumulate(ended, axis=0)


def require_no_inputs_backwards(inputs) -> None:
    """Raise ValueError for inputs of a rollout backwards, where nothing says which come first."""
    if inputs is not None:
        raise ValueError("expected no inputs of a rollout backwards (num_steps below 0)")


def begun(map_, z, args, stop_outside) -> Lanes:
    """Implement `SymplecticMap.start` for states z (B, 2d), inside ``jit``."""
    y, compensation, turns = inner(map_, z)
    inside, finite = contains(map_, y, args), jnp.all(jnp.isfinite(y), axis=-1)
    status = _by_domain(jnp.where(finite, OK, NON_FINITE), inside, stop_outside)
    count = jnp.zeros(z.shape[0], jnp.result_type(int))
    left_at = jnp.where(inside | ~finite, count - 1, count)
    return Lanes(
        y,
        compensation,
        turns.astype(count.dtype),
        status.astype(jnp.int32),
        left_at,
        jnp.zeros(z.shape[0], jnp.int32),
        count,
    )


start_lanes = compiled_sooner(begun, (3,))


def advanced(map_, lanes, args, saving: Saving) -> tuple[Lanes, Any]:
    """Implement `SymplecticMap.advance` inside ``jit``."""

    def step(lanes: Lanes) -> Lanes:
        going = lanes.status <= LEFT_DOMAIN
        y, compensation = jnp.where(going[:, None], lanes.y, jnp.nan), lanes.compensation
        now, then = after(map_, args, lanes.steps), after(map_, args, lanes.steps + 1)
        infos = []
        for piece in map_.pieces:
            y, compensation, info = piece.compensated_step(y, compensation, now)
            infos.append(info)
        info = worst(infos)
        y, compensation, turns = reduced(map_, y, compensation)
        inside, finite = contains(map_, y, then), jnp.all(jnp.isfinite(y), axis=-1)
        failed = jnp.where(finite, info.status, NON_FINITE)
        status = jnp.where(
            failed == OK, _by_domain(lanes.status, inside, saving.stop_outside), failed
        )
        status = jnp.where(going, status, lanes.status).astype(jnp.int32)
        leaves = going & (failed == OK) & ~inside & (lanes.left_at < 0)
        winding = jnp.where(jnp.isfinite(turns), turns, 0.0).astype(lanes.winding.dtype)
        return Lanes(
            jnp.where((status <= LEFT_DOMAIN)[:, None], y, jnp.nan),
            compensation,
            lanes.winding + winding,
            status,
            jnp.where(leaves, lanes.steps + 1, lanes.left_at),
            jnp.maximum(lanes.iterations, jnp.where(going, info.iterations, 0)),
            lanes.steps + 1,
        )

    def observe(lanes: Lanes):
        return outer(map_, lanes.y, lanes.winding.astype(lanes.y.dtype))

    lanes, saved = scan_steps(step, lanes, saving.blocks, save_every=saving.every, observe=observe)
    return lanes, jnp.moveaxis(saved, 0, 1)


advance_lanes = compiled_sooner(advanced, (3,))


def predicted(map_, z, args, saving: Saving) -> tuple[Any, RolloutInfo]:
    """Implement `SymplecticMap.rollout` for states z (B, 2d), inside ``jit``."""
    lanes = begun(map_, z, args, saving.stop_outside)
    lanes, saved = advanced(map_, lanes, args, saving)
    info = RolloutInfo(lanes.status, lanes.left_at, lanes.iterations)
    return jnp.concatenate([z[:, None], saved], axis=1), info


roll_out = compiled_sooner(of_one_or_many(predicted), (3,))
