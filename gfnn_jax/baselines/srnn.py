"""SRNN: a learned Hamiltonian with a symplectic integrator, fitted to whole sequences.

Chen, Zhang, Arjovsky & Bottou, "Symplectic Recurrent Neural Networks", ICLR 2020, and their public
code, zhengdao-chen/SRNN: H = T(p) + V(q), two tanh networks 256-256, one leapfrog step per time
step, the squared error of all states of a sequence, Adam at 5e-3, batches of 32. We add inputs and
outputs of unit size and a decay of the rate, and leave out their optimisation of initial states,
which serves noisy data. There are two variants for systems that are not separable:

- O-NET, theirs: leapfrog of a field N(z) with 2d outputs, which is not symplectic. The paper uses
  it for the three bodies.
- Tao's integrator of any H in a doubled phase space (Phys. Rev. E 94, 043303, 2016), the remedy
  that the paper names. Xiong et al., "Nonseparable Symplectic Neural Networks", ICLR 2021, train
  networks with it. Both copies of the state start each step equal, and the first is kept, so that
  the step is symplectic up to the distance that the copies gain in one step.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.baselines.learned import (
    Budget,
    Learned,
    Sequences,
    learn_map,
    network_field,
    q_angles,
)
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.mlp import Mlp, amplitude_of
from gfnn_jax.fitting.adam import Recipe
from gfnn_jax.phase_space import apply_j, split


class _Options:
    """Hidden layers, theirs."""

    hidden: tuple[int, ...] = (256, 256)


def _learned(step: Callable, params, sequences: Sequences, budget: Budget, label: str) -> Learned:
    recipe = Recipe(batch_size=32, epochs=1_500, epoch_length=200, rate=5e-3, schedule="cosine")
    return learn_map(step, params, sequences, recipe, budget, label)


def srnn(sequences: Sequences, budget: Budget) -> Learned:
    """Learn a leapfrog of T(p) + V(q) for a separable system, else Tao's integrator of H(q, p)."""
    z, velocity = sequences.derivatives()
    gradient = -apply_j(velocity)
    dim, dt = sequences.dim, sequences.dt
    q, p = tuple(range(dim)), tuple(range(dim, 2 * dim))

    def family(columns):
        """Make a scalar network of these columns of z alone."""
        others = tuple(i for i in range(2 * dim) if i not in columns)
        chosen = list(columns)
        return Mlp(
            box_inputs(z, angles=q_angles(sequences), cyclic=others),
            _Options.hidden,
            "tanh",
            amplitude_of(z[:, chosen], gradient[:, chosen]),
        )

    if sequences.separable:
        kinetic, potential = family(p), family(q)
        keys = jax.random.split(budget.key)
        params = tuple(
            f.init(k, jnp.float32) for f, k in zip((kinetic, potential), keys, strict=True)
        )

        def force(params, z):
            return split(apply_j(jax.grad(potential, argnums=1)(params[1], z)))[1]

        def velocity_of(params, z):
            return split(apply_j(jax.grad(kinetic, argnums=1)(params[0], z)))[0]

        step = leapfrog(velocity_of, force, dt)
        label = "leapfrog of T(p) + V(q), 256-256 each"
    else:
        hamiltonian = family((*q, *p))
        params = hamiltonian.init(budget.key, jnp.float32)
        step = tao(hamiltonian, dt)
        label = "Tao's step of H, 256-256"
    return _learned(step, params, sequences, budget, label)


def o_net(sequences: Sequences, budget: Budget) -> Learned:
    """Learn a leapfrog of a network with 2d outputs."""
    field, params = network_field(sequences, _Options.hidden, budget.key)
    step = leapfrog(
        lambda params, z: split(field(params, z))[0],
        lambda params, z: split(field(params, z))[1],
        sequences.dt,
    )
    return _learned(step, params, sequences, budget, "leapfrog of a field 256-256")


def leapfrog(velocity: Callable, force: Callable, dt: float) -> Callable:
    """Make ``step(params, z)``: half a kick, a drift, half a kick.

    velocity, force: q̇ and ṗ, (params, z) -> (d,). The step is symplectic where q̇ depends on p alone
    and ṗ on q alone, both as gradients.
    """

    def step(params, z):
        q, p = split(z)
        p = p + dt / 2 * force(params, z)
        q = q + dt * velocity(params, jnp.concatenate([q, p]))
        p = p + dt / 2 * force(params, jnp.concatenate([q, p]))
        return jnp.concatenate([q, p])

    return step


def tao(hamiltonian: Callable, dt: float, binding: float = 10.0) -> Callable:
    """Make ``step(params, z)`` of any ``hamiltonian(params, z)``: Tao's second-order splitting of

    H(q, y) + H(x, p) + ω/2 (‖q − x‖² + ‖p − y‖²),        x = q and y = p at the start.

    binding: ω, the strength with which the two copies of the state are bound.
    """
    gradient = jax.grad(hamiltonian, argnums=1)
    angle = 2 * binding * dt
    cos, sin = float(np.cos(angle)), float(np.sin(angle))

    def first(params, q, p, x, y, h):
        """Flow of H(q, y): q and y are constant."""
        g_q, g_y = split(gradient(params, jnp.concatenate([q, y])))
        return q, p - h * g_q, x + h * g_y, y

    def second(params, q, p, x, y, h):
        """Flow of H(x, p): x and p are constant."""
        g_x, g_p = split(gradient(params, jnp.concatenate([x, p])))
        return q + h * g_p, p, x, y - h * g_x

    def bind(q, p, x, y):
        """Flow of the binding: the copies' difference turns by 2ω dt, their sum is constant."""
        u, v = q - x, p - y
        u, v = cos * u + sin * v, cos * v - sin * u
        return (q + x + u) / 2, (p + y + v) / 2, (q + x - u) / 2, (p + y - v) / 2

    def step(params, z):
        q, p = split(z)
        state = first(params, q, p, q, p, dt / 2)
        state = second(params, *state, dt / 2)
        state = bind(*state)
        state = second(params, *state, dt / 2)
        q, p, _, _ = first(params, *state, dt / 2)
        return jnp.concatenate([q, p])

    return step
