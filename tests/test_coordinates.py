"""Angles lifted: wrapped images made continuous, also where the data fall into parts."""

import numpy as np

from gfnn_jax.coordinates import Coordinates, lift


def test_images_are_lifted_across_parts_that_lie_far_apart():
    """A shear turns the angle by p, several times around: no nearest image would do."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(-np.pi, np.pi, 9_000)
    p = np.concatenate([rng.uniform(low, low + 4, 3_000) for low in (0, 5, 10)])
    wrapped = np.mod(angle + p, 2 * np.pi)
    y0, y1, _, whole = lift(
        np.stack([angle, p], axis=1),
        np.stack([wrapped, p], axis=1),
        Coordinates("pendulum", angles=(0,)),
    )
    turns = (y1 - y0)[:, 0] - p
    np.testing.assert_allclose(turns, turns[0], atol=1e-12)
    assert whole.all()
