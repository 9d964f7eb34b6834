"""Rollouts of laws with dry friction, from one event to the next: on numbers, by the compiled
motion that forecasts follow (`flows.kernel`).

A flow of JAX has no events: under ``jit``, ``grad`` and ``vmap`` dry friction is smoothed. On
numbers a body slides, or sticks for as long as it is held. Backwards there is no such motion, for a
body at rest does not tell when it stopped.
"""

import dataclasses
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from gfnn_jax.coordinates import TWO_PI
from gfnn_jax.families.lagrangian import functions_of
from gfnn_jax.flows.dormand_prince import NODES
from gfnn_jax.flows.legendre import Legendre
from gfnn_jax.flows.schedules import of_polynomials
from gfnn_jax.maps.estimates import Law, substeps_of
from gfnn_jax.maps.inputs import Scheduled
from gfnn_jax.maps.lanes import Lanes, RolloutInfo, Saving, judged, start_lanes
from gfnn_jax.maps.laws import is_of_law, law_of_map
from gfnn_jax.maps.programs import contains, parts_of_two_pi
from gfnn_jax.phase_space import split
from gfnn_jax.solve.status import LEFT_DOMAIN, NON_FINITE, NOT_CONVERGED, Info

_AT_ONCE = 65_536  # states that are followed together
_REST = 1e-12  # of the speeds, that rounding leaves of one that is 0


@dataclasses.dataclass(frozen=True, eq=False)
class Followed:
    """A map whose law is followed with its events. map: its leaves are NumPy's. law: in use, as in
    forecasts. substeps: of a step of the map, as many as forecasts take."""

    map: Any
    law: Law
    substeps: int

    def step(self, z, args) -> tuple[Any, Info]:
        """Implement `SymplecticMap.step`."""
        begun = start_lanes(self.map, np.atleast_2d(z), args, False)
        lanes, states = self._advanced(begun, args, Saving(1))
        status = np.where(lanes.status > LEFT_DOMAIN, lanes.status, begun.status)
        info = Info(status, lanes.iterations, np.zeros(len(status), states.dtype))
        return _of_one_or_many(z, (states[:, 0], info))

    def roll_out(self, z, args, saving: Saving) -> tuple[Any, RolloutInfo]:
        """Implement `SymplecticMap.rollout`."""
        begun = np.atleast_2d(z)
        lanes = start_lanes(self.map, begun, args, saving.stop_outside)
        lanes, states = self._advanced(lanes, args, saving)
        info = RolloutInfo(lanes.status, lanes.left_at, lanes.iterations)
        return _of_one_or_many(z, (np.concatenate([begun[:, None], states], axis=1), info))

    def advance(self, lanes: Lanes, args, saving: Saving) -> tuple[Lanes, Any]:
        """Implement `SymplecticMap.advance`. A body at rest begins as one that sticks."""
        return jax.device_put(self._advanced(lanes, args, saving))

    def _advanced(self, lanes: Lanes, args, saving: Saving) -> tuple[Lanes, np.ndarray]:
        from gfnn_jax.flows import kernel  # loads LLVM: not before a law is followed

        args, coefficients = jax.tree.map(np.asarray, self._split(args))
        form, p = self.law.form, self.law.p
        law = form.lagrangian(p)
        if form.powers is not None:
            law, p = law.at(args), functions_of(form.powers, args) * p
            form = dataclasses.replace(form, powers=None)
        lanes = jax.tree.map(np.array, lanes)
        angles = list(self.map.coordinates.angles)
        near, beyond = parts_of_two_pi(lanes.y.dtype)
        y = lanes.y + lanes.compensation
        y[lanes.status > LEFT_DOMAIN] = np.nan
        v = Legendre(law.terms).velocity(law.coefficients, y)
        x, modes = np.concatenate([split(y)[0], v], axis=-1), _modes(v, form.friction.directions)
        (num, width), left = y.shape, saving.blocks * saving.every
        saved = [np.zeros((0, num, width))]
        while left > 0:
            count = min(left, max(1, _AT_ONCE // max(1, num)))
            h = np.broadcast_to(self.map.dt, num)[:, None].repeat(count, axis=1)
            u = self._inputs(coefficients, lanes.steps + np.arange(count)[:, None])
            step = form.follow(p, x, h, u, order=0, modes=modes)
            states = np.swapaxes(step.states, 0, 1)  # (M, B, 2d)
            q, v = split(states)
            z = np.concatenate([q, law.momentum(q, v)], axis=-1)
            y, winding = z.copy(), lanes.winding.astype(z.dtype)
            turns = np.round((z[..., angles] - self.map.angle_centre) / TWO_PI)
            y[..., angles] = (z[..., angles] - turns * near) - turns * beyond
            inside, finite = contains(self.map, y, args), np.isfinite(y).all(axis=-1)
            failed = np.where(step.status == kernel.UNFINISHED, NOT_CONVERGED, NON_FINITE)
            lanes, over = judged(lanes, finite, inside, failed, saving.stop_outside)
            z[..., angles] = (z[..., angles] + winding * beyond) + winding * near
            z[over] = y[over] = np.nan
            done = saving.blocks * saving.every - left
            saved.append(z[(done + 1 + np.arange(count)) % saving.every == 0])
            turned = np.where(np.isfinite(turns[-1]), turns[-1], 0.0).astype(lanes.winding.dtype)
            lanes = lanes._replace(y=y[-1], winding=lanes.winding + turned)
            x, modes = np.concatenate([y[-1, :, : width // 2], v[-1]], axis=-1), step.modes[:, -1]
            left -= count
        lanes = lanes._replace(compensation=np.zeros_like(lanes.y))
        return lanes, np.swapaxes(np.concatenate(saved), 0, 1)

    def _split(self, args) -> tuple[Any, Any]:
        """The parameters (…, k), or None, and the inputs of steps, `Scheduled`, or None."""
        if isinstance(args, Scheduled):
            return args.params, args._replace(params=None)
        signals = self.map.signals
        if signals is None:
            return args, None
        params, own = np.split(args, [-(signals.degree + 1) * len(signals.names)], axis=-1)
        return params, Scheduled(None, own[..., None, :])

    def _inputs(self, scheduled: Scheduled | None, steps: np.ndarray) -> np.ndarray:
        """Inputs (B, M, substeps, 6, k) at the nodes of the steps of these numbers (M, B)."""
        signals = self.map.signals
        if scheduled is None or signals is None:
            return np.zeros((*steps.shape[::-1], self.substeps, len(NODES), 0))
        own = np.broadcast_to(
            scheduled.at(None, steps), (*steps.shape, scheduled.coefficients.shape[-1])
        )
        own = own.reshape(*steps.shape, signals.degree + 1, len(signals.names))
        own = own * (self.map.dt[..., None] ** np.arange(signals.degree + 1))[..., None]
        weights = of_polynomials(signals.degree, self.substeps)
        return np.einsum("pij,mbjk->bmpik", weights, own)


def followed(map_: Any, *given: Any) -> Followed | None:
    """The map as it is followed from event to event: where its law has dry friction by which bodies
    slide or stick in forecasts, its time goes forward, and it and the arrays ``given`` are
    numbers; else None."""
    if not is_of_law(map_) or any(isinstance(a, Tracer) for a in jax.tree.leaves((map_, given))):
        return None
    friction = law_of_map(map_).friction
    if not np.any(friction.dry & (friction.widths <= map_.sensors.creep)):
        return None
    bare = jax.tree.map(np.asarray, map_)
    if np.any(bare.dt <= 0):
        return None
    return Followed(bare, map_.law_in_use, substeps_of(map_.sensors, float(np.max(bare.dt))))


def _modes(v: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Modes (B, F) in which velocities v (B, d) begin that were made of momenta: bodies that stick
    to each other have nearly the same one then. NaN of lanes where the state itself tells."""
    speeds = v @ directions.T
    size = np.linalg.norm(v, axis=1)[:, None] * np.linalg.norm(directions, axis=1)
    rests = np.abs(speeds) <= _REST * size
    rounded = np.any(rests & (speeds != 0), axis=1)[:, None]
    return np.where(rounded, np.where(rests, 0.0, np.sign(speeds)), np.nan)


def _of_one_or_many(z, found):
    """Put what was found of states (B, ...) on the device: of one lane where z is one state."""
    if z.ndim == 1:
        found = jax.tree.map(lambda a: a[0], found)
    return jax.device_put(found)
