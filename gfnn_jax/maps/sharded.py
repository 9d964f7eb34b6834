"""Rollouts over several devices: lanes in blocks of one size, the blocks shared out.

Each device runs the program that a single device would run, on blocks of one shape. A lane's bits
therefore depend neither on the number of devices nor on that of lanes. No loop waits for another
device, and nothing is sent from one to another. (``jax.shard_map`` compiles differently for several
devices than for one, and the last digits would differ.)
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

from gfnn_jax.maps.lanes import Lanes, RolloutInfo
from gfnn_jax.maps.samples import Samples
from gfnn_jax.maps.symplectic_map import SymplecticMap

# Lanes of a block. On a CPU 64 and 1,024 are no faster for a generated map, 64 perhaps for a law
# (benchmarks/scaling.py, on a busy machine). An accelerator needs many; the best number was not
# measured.
_ON_CPU, _ON_ACCELERATORS = 256, 16_384


def local_devices(devices: int | str = "all") -> tuple[Any, ...]:
    """Devices of this process: "all", or the first ``devices`` of them.

    Raises ValueError where there are fewer.
    """
    own = jax.local_devices()
    count = len(own) if devices == "all" else devices
    if isinstance(count, bool) or not isinstance(count, int):
        raise ValueError(f"expected a number of devices or 'all', got {devices!r}")
    if not 1 <= count <= len(own):
        raise ValueError(f"expected 1 to {len(own)} devices, all that exist here; got {count}")
    return tuple(own[:count])


@dataclasses.dataclass(frozen=True, eq=False)
class Sharded:
    """Map, or samples of it, with rollouts shared out among devices of this process.

    ``start``, ``advance`` and ``rollout`` have the arguments and results of those of the map or the
    samples, for batches of states. Their results are NumPy arrays, joined from all devices. Each
    device steps all samples of its lanes. The last block is filled up with copies of the last lane.
    """

    map: SymplecticMap | Samples
    devices: tuple[Any, ...]

    @property
    def block(self) -> int:
        """Number of lanes that are stepped together."""
        return _ON_CPU if self.devices[0].platform == "cpu" else _ON_ACCELERATORS

    def start(self, z0, *, params=None, t0=None, stop_outside: bool = False) -> Lanes:
        """Start lanes at step 0 from z0 (B, 2d)."""

        def start(map_, z, args):
            return map_.start(z, params=args, stop_outside=stop_outside)

        return self._shared_out(start, *self._given(z0, params, t0))

    def advance(
        self,
        lanes: Lanes,
        num_saved: int,
        *,
        params=None,
        t0=None,
        save_every: int = 1,
        stop_outside: bool = False,
    ) -> tuple[Lanes, Any]:
        """Advance by ``num_saved`` blocks of ``save_every`` steps: the lanes after them, and the
        saved states (B, num_saved, 2d)."""
        options = {"save_every": save_every, "stop_outside": stop_outside}

        def advance(map_, lanes, args):
            return map_.advance(lanes, num_saved, params=args, **options)

        return self._shared_out(advance, lanes, self._args(params, lanes.y, t0))

    def rollout(
        self,
        z0,
        num_steps: int,
        *,
        params=None,
        t0=None,
        save_every: int = 1,
        stop_outside: bool = False,
    ) -> tuple[Any, RolloutInfo]:
        """Predict ``num_steps`` steps from z0 (B, 2d), back where the number is negative.

        Returns the states (B, 1 + |num_steps| // save_every, 2d) and a RolloutInfo. Raises
        ValueError as the map's rollout does.
        """
        options = {"save_every": save_every, "stop_outside": stop_outside}

        def rollout(map_, z, args):
            return map_.rollout(z, num_steps, params=args, **options)

        return self._shared_out(rollout, *self._given(z0, params, t0))

    def _given(self, z0, params, t0) -> tuple[np.ndarray, Any]:
        if isinstance(self.map, Samples):
            z0, args = self.map._given(z0, params, t0)
            return z0, self._args(args, z0, None)
        z0 = np.asarray(self.map._states(z0))
        if z0.ndim != 2 or not len(z0):
            raise ValueError(
                f"expected states of shape (B, {2 * self.map.dim}), B > 0; got {z0.shape}"
            )
        return z0, self._args(params, z0, t0)

    def _args(self, params, z, t0) -> Any:
        """Args of each lane, (B, k), or None."""
        if isinstance(self.map, Samples):
            map_, z = self.map.map, z[0]
        else:
            map_ = self.map
        args = map_._args(params, z, t0)
        return args if args is None else np.broadcast_to(args, (len(z), np.shape(args)[-1]))

    def _shared_out(self, function: Callable, lanes: Any, args: Any) -> Any:
        """Compute ``function(map, lanes, args)`` on all devices, and join the results.

        The leaves of the lanes are (B, ...), for samples (n, B, ...); the args are (B, k).
        """
        axis = 1 if isinstance(self.map, Samples) else 0
        own = jax.tree.map(np.asarray, (lanes, args))
        count, size = jax.tree.leaves(own)[0].shape[axis], self.block
        firsts, num = range(0, count, size), len(self.devices)

        def on(index: int) -> list[Any]:
            """Compute the blocks of the device of this index."""
            map_ = jax.device_put(self.map, self.devices[index])
            found = []
            for first in firsts[index::num]:
                rows = np.minimum(np.arange(first, first + size), count - 1)
                block = (
                    jax.tree.map(lambda a, rows=rows: a.take(rows, axis), own[0]),
                    jax.tree.map(lambda a, rows=rows: a[rows], own[1]),
                )
                found.append(jax.tree.map(np.asarray, function(map_, *block)))
            return found

        with ThreadPoolExecutor(num) as pool:  # they wait for their devices
            by_device = [*pool.map(on, range(num))]
        blocks = [by_device[i % num][i // num] for i in range(len(firsts))]
        whole = jax.tree.map(lambda *parts: np.concatenate(parts, axis), *blocks)
        return jax.tree.map(lambda a: a[:, :count] if axis else a[:count], whole)
