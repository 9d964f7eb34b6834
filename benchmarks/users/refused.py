"""Mistakes of a user: each ends in one clear line, before any work."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

# Sets float64, so it comes before all of JAX.
from harness import SEED

# isort: split
import jax
import numpy as np
from users.case import Refused
from users.known import swings

import gfnn_jax as gfnn


def fitted(**options) -> Callable[[], Any]:
    """A call of `gfnn.fit` of a hundred swings with these options."""
    return lambda: gfnn.fit(swings(100)[0], **options)


def of_pairs(change: Callable[[gfnn.Pairs], gfnn.Pairs]) -> Callable[[], Any]:
    """A call of `gfnn.fit` of a hundred swings with this mistake in them."""
    return lambda: gfnn.fit(change(swings(100)[0]))


def with_nan(pairs: gfnn.Pairs) -> gfnn.Pairs:
    z1 = np.array(pairs.z1)
    z1[7, 0] = np.nan
    return gfnn.Pairs(pairs.z0, z1, pairs.dt)


def by_numpy() -> gfnn.Scene:
    """A scene whose field is written with NumPy's functions, which JAX cannot trace."""
    scene = gfnn.scenes.henon_heiles()
    return dataclasses.replace(scene, hamiltonian=lambda q, p: np.sum(np.square(np.asarray(q))) / 2)


def inverse_without_state() -> Any:
    """The inverse of a map, asked for as if it were a map."""
    fit = gfnn.fit(swings(200)[0], tolerance=1e-2, learn="map")
    return fit.map.inverse()


def step_backwards() -> Any:
    """A step of a law over −dt, which its inverse is."""
    fit = gfnn.fit(swings(200)[0], tolerance=1e-6, learn="hamiltonian")
    return fit.map.over(-0.2)


def mixed_lengths() -> Any:
    pairs = swings(100)[0]
    return gfnn.fit(gfnn.Pairs(pairs.z0, pairs.z1[:50], pairs.dt))


REFUSED: dict[str, Callable[[], Refused]] = {
    "terms-none": lambda: Refused(fitted(terms=None), "as terms, got None"),
    "terms-as-text": lambda: Refused(fitted(terms="p1**2"), "as terms, got 'p1**2'"),
    "unknown-name": lambda: Refused(fitted(terms=["p1**2 + x**2"]), "the name 'x'"),
    "dt-backwards": lambda: Refused(
        of_pairs(lambda p: gfnn.Pairs(p.z0, p.z1, -0.2)), "exchange them"
    ),
    "same-columns": lambda: Refused(
        of_pairs(lambda p: gfnn.Pairs(p.z0, p.z0, 0.2)), "states that move"
    ),
    "nan": lambda: Refused(of_pairs(with_nan), "the first is row 7"),
    "transposed": lambda: Refused(
        of_pairs(lambda p: gfnn.Pairs(np.asarray(p.z0).T, np.asarray(p.z1).T, 0.2)), "transposed"
    ),
    "mixed-lengths": lambda: Refused(mixed_lengths, "shape"),
    "no-time": lambda: Refused(fitted(max_seconds=0), "as max_seconds, got 0"),
    "tolerance-text": lambda: Refused(fitted(tolerance="1e-6"), "as tolerance, got '1e-6'"),
    "angle-of-five": lambda: Refused(fitted(angles=(5,)), "different angles among"),
    "step-backwards": lambda: Refused(step_backwards, "num_steps"),
    "inverse-without-state": lambda: Refused(inverse_without_state, "inverse"),
    "numpy-scene": lambda: Refused(
        lambda: gfnn.sample_pairs(by_numpy(), 10, jax.random.key(SEED)), "jax.numpy"
    ),
}
