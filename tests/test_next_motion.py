"""Which motion to record next, against the standard errors after it was recorded."""

import numpy as np
import pytest
from test_law_fits import pendulum

import gfnn_jax as gfnn

TERMS = ["V: cos(theta) + cos(2*theta)", "R: omega**2"]


def recorded(*amplitudes):
    runs = []
    for k, amplitude in enumerate(amplitudes):
        t, theta = pendulum(end=18.0, amplitude=amplitude)
        runs.append({"t": t, "theta": theta, "run": np.full(len(t), k)})
    return gfnn.Recording(runs, positions=["theta"], angles=["theta"])


@pytest.mark.slow
def test_a_wider_swing_tells_what_a_small_one_cannot():
    fit = gfnn.fit(recorded(0.3), terms=TERMS)
    best = fit.next_motions[0]
    assert best.start["theta"] > 0.6
    assert best.gains["cos(2*theta)"] > 5
    at = f"theta = {best.start['theta']:.3g} rad, read every {best.interval:.3g} s"
    assert f"release from rest at {at}" in fit.table
    both = gfnn.fit(recorded(0.3, best.start["theta"]), terms=TERMS)
    before, after = (f.lagrangian.terms[2].std for f in (fit, both))
    assert 1 / 2 < before / after / best.gains["cos(2*theta)"] < 2


@pytest.mark.slow
def test_a_body_that_only_an_input_moves_is_to_be_driven():
    rng, t = np.random.default_rng(0), 0.02 * np.arange(400)
    u = np.repeat(rng.normal(size=40), 10)
    x, v = np.zeros(400), 0.0
    for k in range(399):  # v' = u − v, u held
        last = u[k] + (v - u[k]) * np.exp(-0.02)
        x[k + 1], v = x[k] + u[k] * 0.02 + (v - u[k]) * (1 - np.exp(-0.02)), last
    x += 1e-4 * rng.normal(size=400)
    data = gfnn.Recording({"t": t, "x": x, "u": u}, positions=["x"], inputs=["u"])
    motion = gfnn.fit(data, terms=["v**2", "R: v**2"]).next_motions[0]
    name, first, second, period = motion.drive
    assert (name, first, second) == ("u", u.max(), u.min())
    assert 0 < period <= 16
    assert f"and drive u at {first:.3g} for {period / 4:.3g} s" in str(motion)
