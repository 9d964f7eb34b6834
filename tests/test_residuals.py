"""Whether what a law leaves is noise."""

import numpy as np
import pytest

from gfnn_jax.models.lagrangians.residuals import Trace, whiteness

STEP = 0.05


def traces(residuals, inputs):
    """Arcs of fifty nodes; the channel itself is a wave of amplitude one."""
    t = STEP * np.arange(len(residuals))
    law = np.sin(t)[:, None]
    parts = [slice(k, k + 50) for k in range(0, len(t), 50)]
    r, u = residuals[:, None], inputs[:, None]
    return [
        Trace("0", t[p], law[p] + 0.01 * r[p], law[p], r[p], u[p], *[0 * t[p]] * 3) for p in parts
    ]


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def test_white_residuals_are_white(rng):
    found = [
        whiteness(traces(rng.normal(size=1_000), rng.normal(size=1_000)), ["x"], ["u"])["x"]
        for _ in range(40)
    ]
    assert np.mean([of.white for of in found]) > 0.85
    assert np.mean([of.inputs["u"].significant for of in found]) < 0.15
    assert found[0].fit_percent == pytest.approx(100 * (1 - 0.01 / np.sqrt(0.5)), abs=0.1)
    np.testing.assert_allclose(found[0].lags[:3], [0, STEP, 2 * STEP])


def test_coloured_residuals_and_those_of_an_input_are_told(rng):
    noise, u = rng.normal(size=(2, 1_000))
    slow = np.convolve(noise, np.ones(4) / 2, mode="same")
    of = whiteness(traces(slow, u), ["x"], ["u"])["x"]
    assert not of.white
    assert of.autocorrelation[1] == pytest.approx(0.75, abs=0.1)
    assert not of.inputs["u"].significant
    late = noise + np.roll(u, 3)
    of = whiteness(traces(late, u), ["x"], ["u"])["x"]
    assert of.inputs["u"].significant
    assert of.inputs["u"].lag == pytest.approx(3 * STEP)
    assert of.inputs["u"].correlation == pytest.approx(np.sqrt(0.5) * 47 / 50, abs=0.08)
    assert "; correlated with u (ρ = +0." in of.text


def test_values_that_are_missing_count_as_nothing(rng):
    residuals = rng.normal(size=500)
    residuals[100:300] = np.nan
    of = whiteness(traces(residuals, np.zeros(500)), ["x"], ["u"])["x"]
    assert of.bound == pytest.approx(3 / np.sqrt(300))
    assert of.white


def test_smoothed_readings_are_no_force_that_is_missing(rng):
    noise, none = rng.normal(size=(2, 1_000))
    smoothed = np.convolve(noise, np.ones(4) / 2, mode="same")
    forced = noise + 3 * np.sin(2 * np.pi * STEP * np.arange(1_000))  # of one period
    over = [
        whiteness(traces(r, none), ["x"], ["u"])["x"].smoothed_over(2.0)
        for r in (noise, smoothed, forced)
    ]
    assert over == pytest.approx([0, 4 * STEP, 0])
