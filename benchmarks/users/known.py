"""Cases of the first turns: units, angles, order, friction, noise, satellites, traps, chains."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial

# Sets float64, so it comes before all of JAX.
from harness import SEED

# isort: split
import numpy as np
from scipy.spatial.transform import Rotation
from users.case import Case, Field, box, changed, flow, in_sequence, independent, sequences
from users.systems import (
    EARTH,
    RADIUS,
    double_pendulum,
    fput,
    henon_heiles,
    pendulum,
    penning_trap,
    satellite,
)

import gfnn_jax as gfnn

# Said where the number of pairs is the limit.
_MORE_PAIRS = "more pairs would help"


def low_orbits(highest: float, num: int, seed: int) -> np.ndarray:
    """States (num, 6) of satellites from 500 km up to highest, of any node and phase, inclined by
    50° to 56°."""
    rng = np.random.default_rng([SEED, seed])
    axis, e = RADIUS + rng.uniform(5e5, highest, num), rng.uniform(0, 5e-3, num)
    f = rng.uniform(0, 2 * np.pi, num)
    r, speed = axis * (1 - e**2) / (1 + e * np.cos(f)), np.sqrt(EARTH / (axis * (1 - e**2)))
    zero = np.zeros(num)
    turns = np.stack(
        [rng.uniform(0, 360, num), rng.uniform(50, 56, num), rng.uniform(0, 360, num)], axis=1
    )
    turn = Rotation.from_euler("ZXZ", turns, degrees=True)
    q = turn.apply(np.stack([r * np.cos(f), r * np.sin(f), zero], axis=1))
    p = turn.apply(np.stack([-speed * np.sin(f), speed * (e + np.cos(f)), zero], axis=1))
    return np.concatenate([q, p], axis=1)


def drawn(
    field: Field, draw: Callable[[int, int], np.ndarray], dt: float, num_pairs: int
) -> tuple[gfnn.Pairs, gfnn.Pairs]:
    """Independent pairs to learn from and fresh ones. draw: (number, seed) -> states (N, 2d)."""
    data, fresh = (independent(field, draw(n, i), dt) for i, n in enumerate((num_pairs, 1_000), 1))
    return data, fresh


def swings(num_pairs: int, **options) -> tuple[gfnn.Pairs, gfnn.Pairs]:
    """A pendulum that does not turn over."""
    return drawn(partial(pendulum, **options), box([1.0, 1.0]), 0.2, num_pairs)


def single_orbit() -> Case:
    """Recording of one swing: all pairs lie on one curve."""
    start = np.array([[0.9, 0.1]])
    orbit = sequences(pendulum, start, 0.2, 400)
    between = flow(pendulum, start, 0.1)
    fresh = sequences(pendulum, between, 0.2, 200)
    return Case(in_sequence(orbit, 0.2), in_sequence(fresh, 0.2), meets=None, words=("on a curve",))


def micro_units() -> Case:
    """Coordinates of size 1e-7."""
    data, fresh = (changed(pairs, partial(np.multiply, 1e-7)) for pairs in swings(1_000))
    return Case(data, fresh, quiet=True)


def satellites(highest: float, meets: bool | None) -> Case:
    """Satellites of the Earth in metres and seconds, a minute a step."""
    laws = drawn(satellite, partial(low_orbits, highest), 60.0, 5_000)
    return Case(*laws, meets=meets, never=(_MORE_PAIRS,))


def penning(quartic: float, max_seconds: float) -> Case:
    """A Penning trap, of a pure quadrupole or with a quartic part."""
    states = box([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
    laws = drawn(partial(penning_trap, quartic=quartic), states, 0.5, 10_000)
    return Case(*laws, max_seconds=max_seconds)


def double_pendula() -> Case:
    """Double pendula whose arms may both turn over."""
    laws = drawn(double_pendulum, box([np.pi, np.pi, 1.0, 1.0]), 0.1, 5_000)
    return Case(*laws, angles=(0, 1), meets=None, never=(_MORE_PAIRS,))


def chain(dim: int) -> Case:
    """A Fermi–Pasta–Ulam–Tsingou chain of so many particles."""
    laws = drawn(fput, box([0.5] * 2 * dim), 0.2, 5_000)
    return Case(*laws, meets=None, never=(_MORE_PAIRS, "no more accurate"))


def noisy_file() -> Case:
    """A recording of forty swings with errors of 1e-3, as a file."""
    data = noisy(pendulum, [1.0, 1.0], 1e-3)
    states = recorded(pendulum, [1.0, 1.0], 1e-3)
    lines = [
        f"{n},{0.2 * i:.1f},{q:.9f},{p:.9f}"
        for n, orbit in enumerate(states)
        for i, (q, p) in enumerate(orbit)
    ]
    text = "\n".join(["sequence,t,q1,p1", *lines, ""])
    return dataclasses.replace(data, tolerance=1e-4, csv=text)


def hidden_parameter() -> Case:
    """Forty pendulums, each of another length, a sequence of each: the states have no map."""
    stiffness = np.random.default_rng([SEED, 3]).uniform(0.8, 1.2, 40)
    law = partial(pendulum, stiffness=stiffness)
    states, fresh = (sequences(law, box([1.0, 1.0])(40, s), 0.2, 50) for s in (1, 2))
    words = ("differs? between (the )?sequences",)
    return Case(
        in_sequence(states, 0.2),
        in_sequence(fresh, 0.2),
        meets=False,
        words=words,
        never=("noise, or a structure",),
    )


def twenty_pairs() -> Case:
    """Too few for the tolerance."""
    return Case(*swings(20), tolerance=1e-8, meets=False, words=(_MORE_PAIRS,))


def friction() -> Case:
    """A pendulum that loses a fiftieth of its momentum per time: friction is learned with it."""
    data, fresh = swings(1_000, friction=0.02)
    never = ("carry noise", "noise, or", "noise of about", "outliers", "contradict")
    return Case(data, fresh, meets=True, never=never)


def in_degrees(z: np.ndarray) -> np.ndarray:
    return z * np.array([[np.degrees(1.0), 1.0]])


def degrees() -> Case:
    """An angle in degrees, and not declared as an angle: units, that is all."""
    data, fresh = (changed(pairs, in_degrees) for pairs in swings(1_000))
    return Case(data, fresh, quiet=True)


def degrees_as_angle() -> Case:
    """An angle in degrees that is declared to have period 2π."""
    words = ("are these degrees",)
    return dataclasses.replace(degrees(), angles=(0,), meets=False, words=words, quiet=False)


def wrapped_angle() -> Case:
    """Rotating pendulums whose angle is kept within ±π, and not declared as an angle."""

    def draw(num: int, seed: int) -> np.ndarray:
        return np.array([0.0, 2.8]) + box([np.pi, 0.6])(num, seed)

    def wrap(z: np.ndarray) -> np.ndarray:
        return np.stack([np.remainder(z[:, 0] + np.pi, 2 * np.pi) - np.pi, z[:, 1]], axis=1)

    data, fresh = (changed(pairs, wrap) for pairs in drawn(pendulum, draw, 0.1, 1_000))
    return Case(
        data,
        fresh,
        max_seconds=20.0,
        meets=False,
        words=("jumps of 2π", "angles"),
        never=("(?<!behind )noise", "contradict", "gross"),
    )


def interleaved() -> Case:
    """Columns in the order q1, p1, q2, p2."""
    laws = drawn(henon_heiles, box([0.3] * 4), 0.2, 2_000)
    data, fresh = (changed(pairs, lambda z: z[:, [0, 2, 1, 3]]) for pairs in laws)
    return Case(data, fresh, meets=False, words=("the order q1…qd, p1…pd",))


def recorded(law: Field, half: Sequence[float], sigma: float) -> np.ndarray:
    """Forty sequences (40, 51, 2d) with noise on every state."""
    states = sequences(law, box(half)(40, 1), 0.2, 50)
    rng = np.random.default_rng([SEED, 4, round(-np.log10(sigma))])
    return states + sigma * rng.normal(size=states.shape)


def noisy(law: Field, half: Sequence[float], sigma: float) -> Case:
    """Forty sequences of fifty steps with noise on every state, from a box."""
    fresh = in_sequence(sequences(law, box(half)(20, 2), 0.2, 50), 0.2)
    return Case(
        in_sequence(recorded(law, half, sigma), 0.2),
        fresh,
        tolerance=1e-8,
        meets=False,
        words=("noise of about",),
        sigma=sigma,
    )


SIGMAS = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
KNOWN: dict[str, Callable[[], Case]] = {
    "single-orbit": single_orbit,
    "micro-units": micro_units,
    "satellite": partial(satellites, 7e5, True),
    "satellite-any-height": partial(satellites, 1e6, None),
    "penning-linear": partial(penning, 0.0, 20.0),
    "penning-quartic": partial(penning, 0.02, 60.0),
    "double-pendulum": double_pendula,
    "fput-4": partial(chain, 4),
    "fput-8": partial(chain, 8),
    "noisy-file": noisy_file,
    "hidden-parameter": hidden_parameter,
    "twenty-pairs": twenty_pairs,
    "friction": friction,
    "degrees": degrees,
    "degrees-as-angle": degrees_as_angle,
    "wrapped-angle": wrapped_angle,
    "interleaved": interleaved,
    **{f"noise-pendulum-{s:.0e}": partial(noisy, pendulum, [1.0] * 2, s) for s in SIGMAS},
    **{f"noise-henon-heiles-{s:.0e}": partial(noisy, henon_heiles, [0.3] * 4, s) for s in SIGMAS},
}
