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
    assert f"release from rest at theta = {best.start['theta']:.3g}. Standard" in fit.table
    both = gfnn.fit(recorded(0.3, best.start["theta"]), terms=TERMS)
    before, after = (f.lagrangian.terms[2].std for f in (fit, both))
    # What is foretold counts terms of higher modes too, which this law has not.
    assert 1 / 3 < before / after / best.gains["cos(2*theta)"] < 3
