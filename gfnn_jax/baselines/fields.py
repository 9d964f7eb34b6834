"""Learned vector fields: VFNN without structure, HNN that of a learned Hamiltonian.

Both learn ż ≈ (z₁ − z₀)/dt, the paper's finite differences, and predict with an adaptive
Runge–Kutta method. The finite difference has an error of dt/2 · z̈, which no network can remove.

HNN: Greydanus, Dzamba & Yosinski, "Hamiltonian Neural Networks", NeurIPS 2019, and their public
code, greydanus/hamiltonian-nn, experiment-2body: 200-200 tanh, Adam at 1e-3, batches of 200,
10,000 iterations, RK45. VFNN is their baseline, the same network with 2d outputs. We add: inputs
and outputs of unit size, and a decay of the rate.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from gfnn_jax.baselines.learned import Budget, Learned, Sequences, periodic, train
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.mlp import Mlp, amplitude_of, initial, network
from gfnn_jax.fitting.adam import Recipe
from gfnn_jax.phase_space import apply_j, sizes
from gfnn_jax.scenes.trajectories import flow_step


@dataclasses.dataclass(frozen=True)
class _Options:
    """hidden: layers, theirs. tolerance: local error of a predicted step, as in their experiments
    on two bodies."""

    hidden: tuple[int, ...] = (200, 200)
    tolerance: float = 1e-9


_OPTIONS = _Options()
_ACTIVATION = "tanh"


def vfnn(sequences: Sequences, budget: Budget) -> Learned:
    """Learn ż = N(z), N a network with 2d outputs."""
    field, params = network_field(sequences, _OPTIONS.hidden, budget.key)
    return _learn_field(field, params, sequences, budget, "vector field 200-200")


def hnn(sequences: Sequences, budget: Budget) -> Learned:
    """Learn ż = J ∇H(z), H a network."""
    z, velocity = sequences.derivatives()
    target_gradient = -apply_j(velocity)  # ∇H
    inputs = box_inputs(z, angles=q_angles(sequences))
    family = Mlp(inputs, _OPTIONS.hidden, _ACTIVATION, amplitude_of(z, target_gradient))

    def field(params, z):
        return apply_j(jax.grad(family, argnums=1)(params, z))

    params = family.init(budget.key, jnp.float32)
    return _learn_field(field, params, sequences, budget, "Hamiltonian 200-200")


def network_field(sequences: Sequences, hidden: tuple[int, ...], key) -> tuple[Callable, Any]:
    """Make ``field(params, z)`` -> (2d,), a tanh network of unit size, and its first params."""
    z, velocity = sequences.derivatives()
    inputs, unit = Mlp(box_inputs(z, angles=q_angles(sequences)), hidden), sizes(velocity)

    def net(dtype):
        return network(inputs.num_inputs, hidden, z.shape[1], _ACTIVATION, dtype)

    def field(params, z):
        dtype = jax.tree.leaves(params)[0].dtype
        entries = inputs.network_inputs(z).astype(dtype)
        return jnp.asarray(unit, dtype) * net(dtype).apply({"params": params}, entries)

    params = initial(inputs.num_inputs, hidden, z.shape[1], _ACTIVATION, jnp.float32, key)
    return field, params


def q_angles(sequences: Sequences) -> tuple[int, ...]:
    """Indices of the angles among the q, which networks take as cosine and sine."""
    return tuple(i for i in sequences.angles if i < sequences.dim)


def _learn_field(field, params, sequences: Sequences, budget: Budget, label: str) -> Learned:
    lanes = jax.vmap(field, (None, 0))

    def loss(params, z, velocity):
        return jnp.mean(jnp.sum((lanes(params, z) - velocity) ** 2, axis=-1))

    recipe = Recipe(batch_size=200, epochs=40, epoch_length=250, rate=1e-3, schedule="cosine")
    rows = sequences.derivatives()
    params, trained = train(loss, params, rows, rows[0].shape[1], recipe, budget)

    # Along a solution the angles need not be reduced again: the field is that of the reduced state.
    def step(params, z):
        return flow_step(lambda y: field(params, y), sequences.dt, _OPTIONS.tolerance)(z)

    step = periodic(step, sequences.angles)
    return Learned(lambda z: step(params, z), params, label, trained)
