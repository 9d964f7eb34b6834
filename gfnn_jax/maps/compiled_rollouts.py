"""Long rollouts of laws on numbers, with a bracket or canonical: by `flows.compiled_steps`."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.maps.lanes import Lanes, RolloutInfo, Saving, judged, start_lanes
from gfnn_jax.maps.programs import after, contains, outer, parts_of_two_pi
from gfnn_jax.solve.status import LEFT_DOMAIN, NON_FINITE, NOT_CONVERGED

# Fewer steps of all lanes are done before compiled code is loaded; more lanes a GPU steps together.
_FEWEST, _MOST_LANES = 10_000, 16
_AT_ONCE = 65_536  # states that are followed together


def roll_out(map_, z, args, saving: Saving) -> tuple[Any, RolloutInfo] | None:
    """`SymplecticMap.rollout` of states z (B, n) or (n,); None where JAX does it: of few steps,
    inside ``jit``, ``grad`` or ``vmap``, and where `flows.compiled_steps.Stepper` has none."""
    lanes, count = int(np.prod(np.shape(z)[:-1])), saving.blocks * saving.every
    numbers = not any(isinstance(x, Tracer) for x in jax.tree.leaves((map_, z, args)))
    if not numbers or lanes * count < _FEWEST or len(map_.pieces) > 1:
        return None
    if lanes > _MOST_LANES and jax.default_backend() != "cpu":
        return None
    from gfnn_jax.flows.compiled_steps import Stepper  # loads LLVM

    bare, given = jax.tree.map(np.asarray, (map_, args))
    known = _args(bare, given, lanes, np.arange(1))
    stepper = Stepper.of(
        map_.pieces[0],
        0 if known is None else known.shape[-1],
        bare.coordinates.angles,
        bare.angle_centre,
    )
    if stepper is None:
        return None
    begun = start_lanes(map_, np.atleast_2d(z), args, saving.stop_outside)
    states, info = _followed(stepper, bare, jax.tree.map(np.array, begun), given, saving)
    states = jnp.concatenate([np.atleast_2d(z)[:, None], states], axis=1)
    found = states, jax.tree.map(jnp.asarray, info)
    return found if np.ndim(z) > 1 else jax.tree.map(lambda a: a[0], found)


def _followed(stepper, map_, lanes: Lanes, args, saving: Saving) -> tuple[Any, RolloutInfo]:
    """States (B, blocks, n) and what became of the lanes. map_: its leaves are NumPy's."""
    num, count, done = len(lanes.y), saving.blocks * saving.every, 0
    saved = np.full((num, saving.blocks, lanes.y.shape[1]), np.nan)
    turns = np.full((num, saving.blocks, lanes.winding.shape[1]), 0.0)
    of_runs = getattr(args, "params", args)  # by which the domain is judged: (B, 1, k)
    if map_.parameters is not None and of_runs.ndim > 1:
        of_runs = of_runs[:, None]
    going = lanes.status <= LEFT_DOMAIN
    lost = np.where(going[:, None], lanes.compensation, np.nan)
    now, winding = stepper.begun(lanes.y, lost), lanes.winding.astype(float)
    while done < count and going.any():
        steps = min(count - done, max(1, _AT_ONCE // num))
        task = stepper.steps(now, steps, _args(map_, args, num, done + np.arange(steps)))
        most = np.maximum(lanes.iterations, task.most).astype(lanes.iterations.dtype)
        own = winding[:, None] + np.cumsum(task.turns, axis=1)
        whole = slice(-(done + 1) % saving.every, None, saving.every)  # of which states are saved
        states = stepper.down(task.out[:, whole])
        y = states if saving.every == 1 else stepper.lift.down(task.out[:, :, 0])  # for the domain
        fine = going & (np.arange(steps)[:, None] < task.fine)
        failed = np.where(task.most == stepper.MOST, NOT_CONVERGED, NON_FINITE)
        inside = _inside(map_, y, of_runs)
        lanes, over = judged(lanes, fine, inside, failed, saving.stop_outside)
        lanes = lanes._replace(iterations=most)
        states[over[whole].T] = np.nan
        block = slice(done // saving.every, (done + steps) // saving.every)
        saved[:, block], turns[:, block] = states, own[:, whole]
        going = lanes.status <= LEFT_DOMAIN
        now[0][~going], winding, done = np.nan, own[:, -1], done + steps
    states = _outside(map_, saved, turns)
    return states, RolloutInfo(lanes.status, lanes.left_at, lanes.iterations)


def _inside(map_, y: np.ndarray, of_runs) -> np.ndarray:
    """Return whether states y (B, M, n) lie in the domain (M, B), a few at a time: their monomials
    stay in a near memory."""
    most = max(1, _AT_ONCE // (16 * len(y)))
    parts = (y[:, first : first + most] for first in range(0, y.shape[1], most))
    return np.concatenate([contains(map_, part, of_runs) for part in parts], axis=1).T


def _args(map_, args, num: int, numbers: np.ndarray) -> Any:
    """Args (B or 1, M or 1, k) of the steps of these numbers (M,), or None."""
    if args is None:
        return None
    fixed = not hasattr(args, "coefficients") and getattr(map_.parameters, "period", None) is None
    rows = []
    for number in numbers[:1] if fixed else numbers:
        rows.append(np.atleast_2d(after(map_, args, np.full(num, number))))
    return np.stack(rows, axis=1)


def _outside(map_, y: np.ndarray, turns: np.ndarray) -> Any:
    """The user's states (B, M, n) of reduced ones and their turns."""
    if map_.coordinates.forward is not CARTESIAN.forward:
        flat = (a.reshape(y.shape[0] * y.shape[1], a.shape[-1]) for a in (y, turns))
        return outer(map_, *map(jnp.asarray, flat)).reshape(y.shape)
    angles, (near, beyond) = list(map_.coordinates.angles), parts_of_two_pi(y.dtype)
    y[..., angles] = (y[..., angles] + turns * beyond) + turns * near
    return y
