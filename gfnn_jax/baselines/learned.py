"""Parts that all baselines share: sequences of states, the training of a map, its result.

A baseline gives a step function z -> Z of one state (2d,), q first, which `maps.rollout` rolls out.
It learns in float32, as the public codes do, and predicts in the dtype of the state.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.coordinates import TWO_PI
from gfnn_jax.fitting.adam import AdamFit, Recipe, Training


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
