"""A case of a new user: data, request and the facts about them; exact data to make it of."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

# Sets float64, so it comes before all of JAX.
from harness import SEED

# isort: split
import numpy as np
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn

Field = Callable[[np.ndarray], np.ndarray]


@dataclasses.dataclass(frozen=True)
class Case:
    """Data and request of a user, and the facts about them.

    pairs: to learn from. fresh: exact pairs of the same law, to judge by. tolerance, max_seconds,
    angles: as in `gfnn.fit`. options: more of its options. meets: whether the tolerance can be met,
    None where it may be. words, never: patterns that must occur in what is said, and that would be
    wrong there; what is said are the messages, why the search ended, the model's label and the
    formula. first: a pattern of the first message. quiet: whether there is nothing to warn of.
    sigma: standard deviation of the noise on all states; noise_measured: whether the fit has time
    to measure it. volume_change: relative, in a step.
    csv: text of a file that is fitted by the command line in the pairs' stead.
    """

    pairs: gfnn.Pairs
    fresh: gfnn.Pairs
    tolerance: float = 1e-6
    max_seconds: float = 60.0
    angles: tuple[int, ...] = ()
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    meets: bool | None = True
    words: tuple[str, ...] = ()
    never: tuple[str, ...] = ()
    first: str = ""
    quiet: bool = False
    sigma: float = 0.0
    noise_measured: bool = True
    volume_change: float = 0.0
    csv: str = ""


@dataclasses.dataclass(frozen=True)
class Refused:
    """A mistake: ``call`` must end in an error of one line that has these words."""

    call: Callable[[], Any]
    words: str


# Exact data


def flow(field: Field, z: np.ndarray, duration: float) -> np.ndarray:
    """States (N, 2d) a time later, all at once. field: (2d, N) -> its time derivative (2d, N).

    The solver's error is that of all lanes in the mean; no step is longer than an eighth, for the
    few lanes that pass a centre closely.
    """
    shape = z.T.shape
    largest = np.maximum(np.abs(z).max(axis=0), 1e-10)  # SciPy divides by it
    floor = np.broadcast_to(1e-15 * largest[:, None], shape).ravel()
    done = solve_ivp(
        lambda _, flat: field(flat.reshape(shape)).ravel(),
        (0.0, duration),
        z.T.ravel(),
        method="DOP853",
        rtol=1e-13,
        atol=floor,
        t_eval=[duration],
        max_step=duration / 8,
    )
    return done.y[:, -1].reshape(shape).T


def independent(field: Field, z: np.ndarray, dt: float) -> gfnn.Pairs:
    """Make independent pairs of states z (N, 2d) and their images."""
    return gfnn.Pairs(z, flow(field, z, dt), dt)


def sequences(field: Field, z: np.ndarray, dt: float, num_steps: int) -> np.ndarray:
    """Trajectories (N, 1 + num_steps, 2d) of states (N, 2d)."""
    states = [z]
    for _ in range(num_steps):
        states.append(flow(field, states[-1], dt))
    return np.stack(states, axis=1)


def in_sequence(states: np.ndarray, dt: float) -> gfnn.Pairs:
    """Pairs of consecutive states of trajectories (M, L, 2d), one trajectory after the other."""
    width = states.shape[2]
    return gfnn.Pairs(states[:, :-1].reshape(-1, width), states[:, 1:].reshape(-1, width), dt)


def changed(pairs: gfnn.Pairs, change: Callable[[np.ndarray], np.ndarray]) -> gfnn.Pairs:
    """The pairs with both states changed by the same function: other units or columns."""
    return gfnn.Pairs(change(pairs.z0), change(pairs.z1), pairs.dt)


def box(half: Sequence[float]) -> Callable[[int, int], np.ndarray]:
    """(number, seed) -> states (number, 2d), uniform in a box around 0 of half widths (2d,)."""
    sides = np.asarray(half)

    def draw(num: int, seed: int) -> np.ndarray:
        return np.random.default_rng([SEED, seed]).uniform(-sides, sides, (num, len(sides)))

    return draw
