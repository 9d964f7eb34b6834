"""Zeros of a sensor that differ from run to run: found with the law, and estimated with a state."""

import numpy as np
import pytest
from test_law_fits import pendulum

import gfnn_jax as gfnn
from gfnn_jax.maps.estimates import estimates_of, law_of, windows_of

ZEROS = np.array([0.05, -0.03, 0.0, -0.06, 0.04])


def swings(zeros):
    """A recording of swings of 10 s, each by a sensor with a zero of its own."""
    tables = []
    for k, zero in enumerate(zeros):
        t, theta = pendulum(gamma=0.02, noise=0.0, end=10.0, amplitude=0.8 + 0.15 * k)
        theta = theta + zero + 1e-3 * np.random.default_rng(k).normal(size=len(t))
        tables.append({"run": np.full(len(t), str(k)), "t": t, "theta": theta})
    return gfnn.Recording(tables, positions=["theta"], angles=["theta"])


@pytest.fixture(scope="module")
def fit():
    return gfnn.fit(swings(ZEROS), friction="linear")


@pytest.mark.slow
def test_zeros_of_runs_are_found_with_the_law(fit):
    wander = fit.map.sensors.wander
    assert wander is not None
    assert wander.time == np.inf
    assert wander.size * fit.noise["theta"] == pytest.approx(np.std(ZEROS, ddof=1), rel=0.02)
    (_, potential), (loss,) = fit.lagrangian.terms, fit.friction.terms
    assert abs(potential.coefficient - 2) < 4 * potential.std < 0.01
    assert abs(loss.coefficient - 0.01) < 4 * loss.std < 0.003
    assert fit.residual["theta"] == pytest.approx(1e-3, rel=0.1)
    assert "differs from run to run by 0.046" in fit.table


@pytest.mark.slow
def test_an_estimate_tells_the_zero_of_its_run(fit):
    """The law's own zero is the mean of those of the runs it was learned from."""
    law, other = law_of(fit.map), swings([0.07])
    (x,), (covariance,) = estimates_of([law], np.zeros(1, int), windows_of(law.sensors, other))
    error = np.sqrt(covariance[2, 2])
    assert error < 0.02
    assert abs(x[2] - (0.07 - ZEROS.mean())) < 3 * error


@pytest.mark.slow
def test_runs_with_one_zero_keep_it():
    fit = gfnn.fit(swings(np.full(5, 0.05)), friction="linear")
    assert fit.map.sensors.wander is None
    assert fit.zeros["theta"][0] == pytest.approx(0.05, abs=1e-3)
