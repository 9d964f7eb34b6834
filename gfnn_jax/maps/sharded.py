"""Rollouts over several devices: lanes in blocks of one size, the blocks shared out.

Each device runs the program that a single device would run, on blocks of one shape. A lane's bits
therefore depend neither on the number of devices nor on that of lanes. No loop waits for another
device, and nothing is sent from one to another. (``jax.shard_map`` compiles differently for several
devices than for one, and the last digits would differ.)
"""

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

from gfnn_jax.maps.lanes import Lanes, RolloutInfo
from gfnn_jax.maps.samples import Samples

# Lanes of a block. On a CPU 64 and 1,024 are no faster for a generated map, 64 perhaps for a law
# (benchmarks/scaling.py, on a busy machine). On an H100 a generated map gains nothing beyond 16,384
# lanes, a law and a network are 1.8 and 3.4 times as fast with 131,072 (benchmarks/gpu.sh).
_ON_CPU, _ON_ACCELERATORS = 256, 131_072


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

    map: Any
    devices: tuple[Any, ...]

    @property
    def block(self) -> int:
        """Number of lanes that are stepped together."""
        return _ON_CPU if self.devices[0].platform == "cpu" else _ON_ACCELERATORS

    def start(self, z0, **options) -> Lanes:
        """Start lanes at step 0 from z0 (B, 2d)."""
        return self._shared_out("start", *self._given(z0, options), **options)

    def advance(self, lanes: Lanes, num_saved: int, **options) -> tuple[Lanes, Any]:
        """Advance by ``num_saved`` blocks of ``save_every`` steps: the lanes after them, and the
        saved states (B, num_saved, 2d)."""
        args = self._args(options.pop("params", None), lanes.y, options.pop("t0", None))
        return self._shared_out("advance", lanes, args, num_saved, **options)

    def rollout(self, z0, num_steps: int, **options) -> tuple[Any, RolloutInfo]:
        """Predict ``num_steps`` steps from z0 (B, 2d), back where the number is negative.

        Returns the states (B, 1 + |num_steps| // save_every, 2d) and a RolloutInfo. Raises
        ValueError as the map's rollout does.
        """
        return self._shared_out("rollout", *self._given(z0, options), num_steps, **options)

    def _given(self, z0, options: dict[str, Any]) -> tuple[np.ndarray, Any]:
        """The states, and the args that take the place of params and t0 among the options."""
        params, t0 = options.pop("params", None), options.pop("t0", None)
        if isinstance(self.map, Samples):
            z0, args = self.map._given(z0, params, t0)
            return z0, self._args(args, z0, None)
        z0 = np.asarray(self.map._states(z0))
        if z0.ndim != 2 or not len(z0):
            raise ValueError(
                f"expected states of shape (B, {self.map.width}), B > 0; got {z0.shape}"
            )
        return z0, self._args(params, z0, t0)

    def _args(self, params, z, t0) -> Any:
        """Args of each lane, (B, k), or None."""
        map_, z = (self.map.map, z[0]) if isinstance(self.map, Samples) else (self.map, z)
        args = map_._args(params, z, t0)
        return args if args is None else np.broadcast_to(args, (len(z), np.shape(args)[-1]))

    def _shared_out(self, method: str, lanes: Any, args: Any, *more: Any, **options: Any) -> Any:
        """Call a method of the map on all devices, and join the results.

        The leaves of the lanes are (B, ...), for samples (n, B, ...); the args are (B, k).
        """
        axis = 1 if isinstance(self.map, Samples) else 0
        whole = jax.tree.map(np.asarray, (lanes, args))
        count, size = jax.tree.leaves(whole)[0].shape[axis], self.block
        firsts, num = range(0, count, size), len(self.devices)

        def on(index: int) -> list[Any]:
            """Compute the blocks of the device of this index."""
            map_ = jax.device_put(self.map, self.devices[index])
            found = []
            for first in firsts[index::num]:
                rows = np.minimum(np.arange(first, first + size), count - 1)
                lanes = jax.tree.map(lambda a, rows=rows: a.take(rows, axis), whole[0])
                args = jax.tree.map(lambda a, rows=rows: a[rows], whole[1])
                found.append(
                    jax.tree.map(
                        np.asarray, getattr(map_, method)(lanes, *more, params=args, **options)
                    )
                )
            return found

        with ThreadPoolExecutor(num) as pool:  # they wait for their devices
            by_device = [*pool.map(on, range(num))]
        blocks = [by_device[i % num][i // num] for i in range(len(firsts))]
        joined = jax.tree.map(lambda *parts: np.concatenate(parts, axis), *blocks)
        return jax.tree.map(lambda a: a[:, :count] if axis else a[:count], joined)
