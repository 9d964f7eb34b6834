"""Maps drawn from the posterior of a map's coefficients.

Each sample is a map of the same kind and exactly symplectic. n samples are one pytree, and one
compiled program steps them all.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import numpy as np

from gfnn_jax.arrays import pytree
from gfnn_jax.compiling import compiled_sooner
from gfnn_jax.maps.lanes import (
    Lanes,
    RolloutInfo,
    Saving,
    advanced,
    begun,
    predicted,
    require_no_inputs_backwards,
)
from gfnn_jax.maps.piece import with_params

# Fewest lanes that are stepped together. More samples at once gain nothing on a CPU: a batched
# program takes both sides of every branch (100 samples, Hénon–Heiles, µs per step: 1,000 states
# take 1.7 one by one and 2.8 by tens; one state 21 and 6.4).
_TOGETHER = 256


@pytree("piece")
class Samples:
    """Set of n maps that equal ``map`` but for the params (n, ...) of one piece."""

    map: Any
    params: Any
    piece: int

    def __len__(self) -> int:
        return self.params.shape[0]

    def __iter__(self):  # an index of JAX that is too large raises nothing and would not end it
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index) -> Any:
        return self.one(self.params[index])

    def one(self, params) -> Any:
        """Make the map with these params of its piece."""
        pieces = list(self.map.pieces)
        pieces[self.piece] = with_params(pieces[self.piece], params)
        return dataclasses.replace(self.map, pieces=tuple(pieces), posterior=None)

    def start(self, z0, *, params=None, t0=None, stop_outside: bool = False) -> Lanes:
        """Start lanes as `SymplecticMap.start` does, with leaves (n, B, ...).

        z0: (B, 2d), or (n, B, 2d) where each sample has its own.
        """
        z0, args = self._given(z0, params, t0)
        return _start(self, z0, args, stop_outside, self._together(z0))

    def advance(
        self,
        lanes: Lanes,
        num_saved: int,
        *,
        params=None,
        t0=None,
        save_every=1,
        stop_outside=False,
    ) -> tuple[Lanes, Any]:
        """Advance lanes as `SymplecticMap.advance` does; the states are (n, B, num_saved, 2d)."""
        args = self.map._args(params, lanes.y[0], t0)
        saving = Saving(num_saved, save_every, stop_outside)
        if followed := self._followed(lanes, args):
            own = [jax.tree.map(lambda a, i=i: a[i], lanes) for i in range(len(self))]
            found = [one.advance(a, args, saving) for one, a in zip(followed, own, strict=True)]
            return _stacked(found)
        return _advance(self, lanes, args, saving, self._together(lanes.y))

    def reversed(self) -> Samples:
        """Make the inverse maps."""
        piece = len(self.map.pieces) - 1 - self.piece
        return Samples(self.map.reversed(), self.params, piece)

    def rollout(
        self,
        z0,
        num_steps: int,
        *,
        params=None,
        t0=None,
        inputs=None,
        save_every: int = 1,
        stop_outside: bool = False,
    ) -> tuple[Any, RolloutInfo]:
        """Predict with every map, back by its inverse where ``num_steps`` is negative.

        z0: (B, 2d), or (n, B, 2d) where each sample has its own. inputs: argument of
        `SymplecticMap.rollout`. Returns the states (n, B, 1 + |num_steps| // save_every, 2d), and a
        RolloutInfo of leaves (n, B). Other samples of the same kind use the same compiled program.
        Raises ValueError where a shape is wrong, or inputs are given backwards.
        """
        if num_steps < 0:
            require_no_inputs_backwards(inputs)
            options = {"params": params, "t0": t0, "save_every": save_every}
            return self.reversed().rollout(z0, -num_steps, stop_outside=stop_outside, **options)
        z0, _ = self._given(z0, params, t0)
        args = self.map._schedule(params, self.map._states(z0[0]), t0, inputs, num_steps)
        saving = Saving(num_steps // save_every, save_every, stop_outside)
        if followed := self._followed(z0, args):
            found = [one.roll_out(z, args, saving) for one, z in zip(followed, z0, strict=True)]
            return _stacked(found)
        return _rollout(self, z0, args, saving, self._together(z0))

    def _followed(self, *given) -> list[Any]:
        """Each map as it is followed with the events of its dry friction, on numbers: see
        `SymplecticMap.rollout`; [] where they are stepped by JAX."""
        if self.map._followed(self.params, *given) is None:
            return []
        return [one._followed(*given) for one in self]

    def _given(self, z0, params, t0) -> tuple[Any, Any]:
        """Return the states (n, B, 2d) and their args."""
        z0 = np.asarray(z0)
        if z0.ndim not in (2, 3) or (z0.ndim == 3 and len(z0) != len(self)):
            raise ValueError(
                f"expected states of shape (B, {self.map.width}) or "
                f"({len(self)}, B, {self.map.width}), got {z0.shape}"
            )
        one = self.map._states(z0[0] if z0.ndim == 3 else z0)
        args = self.map._args(params, one, t0)
        return np.broadcast_to(z0.astype(one.dtype), (len(self), *one.shape)), args

    def _together(self, z0) -> int:
        """Number of samples at a time, a divisor of their number."""
        most = int(np.clip(_TOGETHER // max(z0.shape[1], 1), 1, len(self)))
        return next(k for k in range(most, 0, -1) if len(self) % k == 0)


def sampled(map_: Any, key, num: int) -> Samples:
    """Draw ``num`` maps from the posterior of the coefficients of ``map_``.

    key: of ``jax.random``; the same key always gives the same maps. Raises ValueError where the map
    has no posterior, or ``num`` is not above 0.
    """
    if map_.posterior is None:
        raise ValueError(
            "the map has no posterior to draw from: gfnn.fit gives one to a map fitted to the "
            "pairs themselves whose model knows the covariance of its coefficients: one that is "
            "linear in them, a law, or an ensemble of networks"
        )
    if num < 1:
        raise ValueError(f"expected a number of samples above 0, got {num}")
    piece, root = map_.pieces[map_.posterior.piece], np.asarray(map_.posterior.root)
    # NumPy's generator draws without compiling.
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel())
    drawn = rng.normal(size=(num, len(root))) @ root
    if hasattr(piece, "family"):
        drawn = piece.family.unflatten(drawn)
    params = np.asarray(piece.params) + drawn
    bare = dataclasses.replace(map_, posterior=None)
    return Samples(bare, jax.device_put(params.astype(map_.scale.dtype)), map_.posterior.piece)


def _stacked(found: list[Any]) -> Any:
    """Results of the maps side by side, their leaves (n, ...)."""
    return jax.tree.map(lambda *parts: np.stack(parts), *found)


def _mapped(samples: Samples, function, each: tuple, together: int):
    """Apply function(map, *own) to every map and its part of ``each``, ``together`` at a time."""

    def one(own):
        return function(samples.one(own[0]), *own[1:])

    each, count = (samples.params, *each), len(samples)
    if together == 1:  # no batch: a program takes one side of a branch
        return jax.lax.map(one, each)
    parts = jax.tree.map(lambda a: a.reshape(count // together, together, *a.shape[1:]), each)
    found = jax.lax.map(jax.vmap(one), parts)
    return jax.tree.map(lambda a: a.reshape(count, *a.shape[2:]), found)


@partial(compiled_sooner, static_argnums=(3, 4))
def _start(samples, z0, args, stop_outside, together):
    return _mapped(samples, lambda m, z: begun(m, z, args, stop_outside), (z0,), together)


@partial(compiled_sooner, static_argnums=(3, 4))
def _advance(samples, lanes, args, saving, together):
    return _mapped(samples, lambda m, own: advanced(m, own, args, saving), (lanes,), together)


@partial(compiled_sooner, static_argnums=(3, 4))
def _rollout(samples, z0, args, saving, together):
    return _mapped(samples, lambda m, z: predicted(m, z, args, saving), (z0,), together)
