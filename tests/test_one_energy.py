"""Masses that depend on the only coordinate: what one energy shows of them, and several."""

import numpy as np
import pytest
from analytic import motion

import gfnn_jax as gfnn


def disc(amplitude, t):
    """L = ½(1 + q²) v² − ½ q²."""
    return motion(lambda q, v: -q * (1 + v**2) / (1 + q**2), [amplitude, 0.0], t)[0]


@pytest.mark.slow
@pytest.mark.parametrize(("amplitudes", "kind"), [((0.9,), "one"), ((0.9, 0.4), "identified")])
def test_masses_of_one_coordinate_are_told_by_several_energies(amplitudes, kind):
    t, rng = np.linspace(0, 60, 800), np.random.default_rng(1)
    q = np.concatenate([disc(a, t) for a in amplitudes])
    table = {
        "run": np.repeat(np.arange(len(amplitudes)), len(t)),
        "t": np.tile(t, len(amplitudes)),
        "x": q + 1e-3 * rng.normal(size=len(q)),
    }
    fit = gfnn.fit(gfnn.Recording(table, positions=["x"]), terms=["v**2", "v**2*x**2", "x**2"])
    assert fit.verdict.split()[0] == kind


@pytest.mark.parametrize(
    ("noise", "kind"), [(0.3, "one"), pytest.param(0.03, "identified", marks=pytest.mark.slow)]
)
def test_noise_of_a_large_part_of_a_radian_hides_other_laws(noise, kind):
    """A wheel that turns freely, with θ as far as 30 turns."""
    t, rng = np.linspace(0, 60, 400), np.random.default_rng(2)
    table = {"t": t, "theta": 3.1 * t + noise * rng.normal(size=len(t))}
    fit = gfnn.fit(gfnn.Recording(table), terms=["omega**2"])
    assert fit.verdict.split()[0] == kind
