"""Motion on a sphere, whose H has p²/sin² of an angle, which no library of products has."""

import numpy as np
import pytest
from analytic import moved

import gfnn_jax as gfnn


def spherical_pendulum_pairs(count, latitude=False):
    """Pairs at dt = 0.1, by another solver; the angle from the lower pole, or the latitude."""
    rng = np.random.default_rng(0)
    q1, q2 = rng.uniform(0.4, 2.7, count), rng.uniform(-np.pi, np.pi, count)
    p1, p2 = rng.uniform(-1, 1, (2, count))
    z0 = np.stack([q1, q2, p1, p2 * np.sin(q1)], axis=1)

    def slope(_, z):
        q1, _, p1, p2 = z
        sin, cos = np.sin(q1), np.cos(q1)
        return [p1, p2 / sin**2, p2**2 * cos / sin**3 - sin, 0 * p2]

    states = np.stack([z0, moved(slope, z0, 0.1)])
    if latitude:
        states[..., 0] -= np.pi / 2
    return gfnn.Pairs(*states, 0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("latitude", "expected"),
    [
        (False, "0.5*p1**2 + 0.5*p2**2/sin(q1)**2 - cos(q1)"),
        (True, "0.5*p1**2 + 0.5*p2**2/cos(q1)**2 + sin(q1)"),
    ],
)
def test_a_spherical_pendulum_told_nothing(latitude, expected):
    pairs = spherical_pendulum_pairs(160, latitude)
    fit = gfnn.fit(pairs, learn="hamiltonian", tolerance=1e-8, angles=(0, 1))
    assert fit.formula == expected
    assert fit.met
