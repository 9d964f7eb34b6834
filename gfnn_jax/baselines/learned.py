"""Parts that all baselines share: sequences of states, the training of a map, its result.

A baseline gives a step function z -> Z of one state (2d,), q first, which `maps.rollout` rolls out.
It learns in float32, as the public codes do, and predicts in the dtype of the state.

VFNN, without structure, and HNN, that of a learned Hamiltonian, learn ż ≈ (z₁ − z₀)/dt, the paper's
finite differences, and predict with an adaptive Runge–Kutta method. The finite difference has an
error of dt/2 · z̈, which no network can remove.

HNN: Greydanus, Dzamba & Yosinski, "Hamiltonian Neural Networks", NeurIPS 2019, and their public
code, greydanus/hamiltonian-nn, experiment-2body: 200-200 tanh, Adam at 1e-3, batches of 200,
10,000 iterations, RK45. VFNN is their baseline, the same network with 2d outputs. We add: inputs
and outputs of unit size, and a decay of the rate.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.coordinates import TWO_PI, Coordinates
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.mlp import (
    PAPER_HIDDEN,
    PAPER_HIDDEN_STANDARD_MAP,
    Mlp,
    amplitude_of,
    initial,
    network,
)
from gfnn_jax.fitting.adam import (
    PAPER,
    PAPER_STANDARD_MAP,
    AdamFit,
    Recipe,
    Training,
    gradient_loss,
)
from gfnn_jax.generating.charts import TYPE2
from gfnn_jax.generating.generated import Generated
from gfnn_jax.maps.domain import covering
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import apply_j, sizes
from gfnn_jax.scenes.trajectories import flow_step


def held(num: int) -> int:
    """Number of rows that validate, of so many: at most a tenth of all."""
    return min(2_000, num // 10)


@dataclasses.dataclass(frozen=True)
class Sequences:
    """Sequences of states (N, L, 2d) that are one ``dt`` apart, float64; L = 2 makes pairs.

    angles: indices of z with period 2π for the map; z[:, 0] is reduced, the rest is continuous.
    separable: True where the system is of the form H = T(p) + V(q).
    """

    z: np.ndarray
    dt: float
    angles: tuple[int, ...] = ()
    separable: bool = True

    @property
    def dim(self) -> int:
        """Number d of degrees of freedom."""
        return self.z.shape[-1] // 2

    @property
    def num_pairs(self) -> int:
        """Number of states whose image is known."""
        return self.z.shape[0] * (self.z.shape[1] - 1)

    def derivatives(self) -> tuple[np.ndarray, np.ndarray]:
        """Compute z and ż ≈ (z₁ − z₀)/dt, both (pairs, 2d): the paper's finite differences."""
        z0, z1 = self.z[:, :-1], self.z[:, 1:]
        width = self.z.shape[-1]
        return z0.reshape(-1, width), ((z1 - z0) / self.dt).reshape(-1, width)


@dataclasses.dataclass(frozen=True)
class Budget:
    """Randomness and length of a training.

    key: a ``jax.random.key``. cap: most operations of the training, counted; None for no cap.
    on_progress: called with a line on the progress of the training.
    """

    key: Any
    cap: float | None = None
    on_progress: Callable[[str], Any] = lambda message: None


class Learned(NamedTuple):
    """Result of a baseline: its step function, with the record of its training.

    step: z (2d,) -> Z. params: float64. training: its errors are those of the method's own loss.
    """

    step: Callable
    params: Any
    label: str
    training: AdamFit

    @property
    def num_parameters(self) -> int:
        return sum(leaf.size for leaf in jax.tree.leaves(self.params))


def periodic(step: Callable, angles: tuple[int, ...]) -> Callable:
    """Evaluate ``step(params, z)`` at the image of z in [0, 2π), where the data were."""
    if not angles:
        return step
    index = np.array(angles)

    def wrapped(params, z):
        turns = TWO_PI * jnp.floor(z[index] / TWO_PI)
        return step(params, z.at[index].add(-turns)).at[index].add(turns)

    return wrapped


def train(
    loss: Callable, params: Any, rows: tuple, components: int, recipe: Recipe, budget: Budget
) -> tuple[Any, AdamFit]:
    """Minimise ``loss(params, *batch)``; the first rows validate.

    Returns the params in float64 and the record of the training.
    """
    first = held(len(rows[0]))
    training = Training(
        recipe,
        budget.key,
        cap=budget.cap,
        on_epoch=lambda epoch, _, rms: budget.on_progress(f"epoch {epoch}: error {rms:.1e}"),
    )
    apart = tuple(r[first:] for r in rows), tuple(r[:first] for r in rows)
    trained = training.of_loss(loss, params, *apart, components)
    return in_float64(trained.params), trained


def in_float64(params: Any) -> Any:
    """Convert the parameters to NumPy's float64."""
    return jax.tree.map(lambda a: np.asarray(a, np.float64), params)


def learn_map(
    step: Callable, params: Any, sequences: Sequences, recipe: Recipe, budget: Budget, label: str
) -> Learned:
    """Fit ``step(params, z) -> Z``, applied repeatedly, to all states of the sequences.

    The loss is the squared distance, averaged over the states of a sequence after the first.
    """
    step = periodic(step, sequences.angles)

    def loss(params, z):
        def advance(now, expected):
            now = jax.vmap(step, (None, 0))(params, now)
            return now, jnp.mean(jnp.sum((now - expected) ** 2, axis=-1))

        _, errors = jax.lax.scan(advance, z[:, 0], jnp.moveaxis(z[:, 1:], 1, 0))
        return jnp.mean(errors)

    width = sequences.z.shape[-1]
    params, trained = train(loss, params, (sequences.z,), width, recipe, budget)
    return Learned(lambda z: step(params, z), params, label, trained)


class _Options:
    """hidden: layers, theirs. tolerance: local error of a predicted step, as in their experiments
    on two bodies."""

    hidden: tuple[int, ...] = (200, 200)
    tolerance: float = 1e-9


_ACTIVATION = "tanh"


def vfnn(sequences: Sequences, budget: Budget) -> Learned:
    """Learn ż = N(z), N a network with 2d outputs."""
    field, params = network_field(sequences, _Options.hidden, budget.key)
    return _learn_field(field, params, sequences, budget, "vector field 200-200")


def hnn(sequences: Sequences, budget: Budget) -> Learned:
    """Learn ż = J ∇H(z), H a network."""
    z, velocity = sequences.derivatives()
    target_gradient = -apply_j(velocity)  # ∇H
    inputs = box_inputs(z, angles=q_angles(sequences))
    family = Mlp(inputs, _Options.hidden, _ACTIVATION, amplitude_of(z, target_gradient))

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
        return flow_step(lambda y: field(params, y), sequences.dt, _Options.tolerance)(z)

    step = periodic(step, sequences.angles)
    return Learned(lambda z: step(params, z), params, label, trained)


class PaperGfnn(NamedTuple):
    """Result of the paper's recipe: map in the user's coordinates, network, training of ∇S."""

    map: SymplecticMap
    family: Mlp
    training: AdamFit


def paper_gfnn(pairs: Sequences, budget: Budget) -> PaperGfnn:
    """Learn S(q, P) from pairs by the recipe of the paper for GFNN: its network as S, type 2,
    trained by Adam; where coordinates are periodic, by that for the standard map.

    Chen & Tao, ICML 2021, "Experimental Details": hidden layers 200-100-50-20 and batches of 200
    from a rate of 0.01; for the standard map 500-500-200-20 and batches of 1,000 from 0.001; 20
    passes through the pairs. The step is solved to roundoff, as everywhere in this package.
    """
    hidden, recipe = PAPER_HIDDEN, PAPER
    if pairs.angles:
        hidden, recipe = PAPER_HIDDEN_STANDARD_MAP, PAPER_STANDARD_MAP
    z0, z1 = pairs.z[:, 0], pairs.z[:, 1]
    w, target = TYPE2.evaluation_point(z0, z1), TYPE2.target_gradient(z0, z1, pairs.dt)
    inputs = box_inputs(w, angles=q_angles(pairs))
    family = Mlp(inputs, hidden, "tanh", amplitude_of(w, target))
    part = 50  # iterations between two readings of the error
    iterations = recipe.epochs * (len(w) // recipe.batch_size)
    recipe = dataclasses.replace(recipe, epochs=max(1, iterations // part), epoch_length=part)
    loss, start = gradient_loss(family, pairs.dt), family.init(budget.key, jnp.float32)
    params, training = train(loss, start, (w, target), 2 * pairs.dim, recipe, budget)
    scale = sizes(z0)
    generated = Generated(family, params, TYPE2, pairs.dt, scale)
    coordinates = Coordinates("cartesian", angles=pairs.angles)
    centre = np.full(len(pairs.angles), np.pi)  # z0 is in [0, 2π)
    domain = covering(z0[:20_000], ignore=pairs.angles)
    map_ = SymplecticMap((generated,), coordinates, domain, scale, centre, pairs.dt)
    return PaperGfnn(map_, family, training)
