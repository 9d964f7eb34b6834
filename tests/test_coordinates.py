"""Angles lifted: wrapped images made continuous, also where the data fall into parts."""

import numpy as np

from gfnn_jax.coordinates import Coordinates, lift
from gfnn_jax.data.files import read_trajectories


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


def test_angles_in_a_file_may_be_wrapped_or_not(tmp_path):
    """A free rotor over many turns: the same pairs for a fit, however its angle was written."""
    p, t = np.linspace(1, 5, 20)[:, None], np.arange(50)
    angle = 0.3 + p * t
    prepared = []
    for name, written in (("unwrapped", angle), ("wrapped", np.angle(np.exp(1j * angle)))):
        columns = [np.repeat(np.arange(20), 50), np.tile(t, 20), written.ravel(), np.repeat(p, 50)]
        path = tmp_path / f"{name}.csv"
        header = "sequence,t,q1 [rad],p1"
        np.savetxt(path, np.column_stack(columns), "%.17g", ",", header=header, comments="")
        pairs = read_trajectories(path).pairs()
        prepared.append(lift(pairs.z0, pairs.z1, Coordinates("rotor", angles=(0,)))[:2])
    np.testing.assert_allclose(prepared[0], prepared[1], rtol=0, atol=1e-12)
