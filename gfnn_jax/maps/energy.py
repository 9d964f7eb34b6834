"""The energy of a system with forces: what friction takes, what inputs bring, and what is left.

stored = supplied − lost,      d/dt H = Σ_k u_k (Gᵀv)_k − v·∂R/∂v − γ p·v
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.compiling import compiled_sooner
from gfnn_jax.flows.flow import Flow
from gfnn_jax.flows.uniform import Power, power
from gfnn_jax.maps.programs import after, inner


class Ledger(NamedTuple):
    """Energy ledger of rollouts, per unit of time: stored (B,), lost (B, F) by each
    friction, supplied (B, k) by each input; closure (B,) is what these leave unexplained."""

    stored: Any
    lost: Any
    supplied: Any
    closure: Any


def power_of(map_: Any, z, args=None, inputs=None) -> Power:
    """`SymplecticMap.power`."""
    z = map_._states(z)
    _check_flow(map_)
    found = _power(map_, np.atleast_2d(z), map_._args(args, z, None, inputs))
    return found if z.ndim == 2 else jax.tree.map(lambda a: a[0], found)


def ledger(map_: Any, z0, num_steps: int, *, params=None, inputs=None) -> Ledger:
    """The energies of rollouts from z0 (B, 2d), in the mean over ``num_steps`` steps: what is lost
    and supplied is integrated by the quadrature of the steps themselves. params, inputs: as of
    `SymplecticMap.rollout`. Raises ValueError for a map that is no flow."""
    _check_flow(map_)
    z0 = np.atleast_2d(map_._states(z0))
    return _ledger(map_, z0, map_._schedule(params, z0, None, inputs, num_steps), num_steps)


def _check_flow(map_: Any) -> None:
    """Raises ValueError where the map is none."""
    if len(map_.pieces) != 1 or not isinstance(map_.pieces[0], Flow):
        raise ValueError("expected the flow of a Hamiltonian, whose energy is known")


@compiled_sooner
def _power(map_, z, args):
    flow = map_.pieces[0]
    return power(flow.family, flow.params, inner(map_, z)[0], args)


@partial(compiled_sooner, static_argnums=(3,))
def _ledger(map_, z0, args, num_steps):
    flow = map_.pieces[0]

    def step(carry, number):
        z, done = carry
        given = after(map_, args, jnp.full(len(z), number))
        image, more = flow.work(z, given)
        return (image, jax.tree.map(jnp.add, done, more)), None

    start = inner(map_, z0)[0]
    begin = after(map_, args, jnp.zeros(len(z0), int))
    none = jax.tree.map(jnp.zeros_like, power(flow.family, flow.params, start, begin))
    (end, done), _ = jax.lax.scan(step, (start, none), jnp.arange(num_steps))
    finish = after(map_, args, jnp.full(len(z0), num_steps))
    time = num_steps * map_.dt
    stored = (flow.value(end, finish) - flow.value(start, begin)) / time
    lost, supplied = (a / time for a in done)
    closure = stored - jnp.sum(supplied, axis=-1) + jnp.sum(lost, axis=-1)
    return Ledger(stored, lost, supplied, closure)
