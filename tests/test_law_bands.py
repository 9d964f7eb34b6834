"""Bands of forecasts from recordings: their misfit, by laws without a third of the record."""

import dataclasses

import numpy as np
import pytest
from test_law_fits import chain, pendulum, recorded

import gfnn_jax as gfnn
from gfnn_jax.maps.sensors import Sensors
from gfnn_jax.models.lagrangians.calibration import Thirds, _with_shape
from gfnn_jax.models.lagrangians.fit import SearchOptions
from gfnn_jax.models.lagrangians.recordings import samples_of
from gfnn_jax.models.lagrangians.search import search


def covered(fit, recording, starts, ahead):
    """Share of the samples up to ``ahead`` seconds after each start that lie within two standard
    deviations of a forecast, and the same without the misfit, or readings that wander for it."""
    sensors = fit.map.sensors
    none = np.zeros_like(np.asarray(sensors.misfit))
    bare = dataclasses.replace(sensors, misfit=none, of_law=False, wander=None)
    inside = []
    for map_ in (fit.map, dataclasses.replace(fit.map, sensors=bare)):
        found = []
        for start in starts:
            later = recording.slice(start + 1e-9, start + ahead)
            forecast = map_.forecast(recording.slice(start - 2.0, start), later.times("0"))
            error = forecast.values["theta"][0] - later.values("theta", "0")
            found.append(np.abs(error) <= 2 * forecast.std["theta"][0])
        inside.append(np.mean(np.concatenate(found)))
    return inside


@pytest.mark.slow
def test_a_fit_without_a_third_is_that_of_the_other_two():
    """One linear step against a fit of the arcs of the other thirds."""
    recording = chain(noise=2e-3, runs=3, end=4.0)
    options = SearchOptions(frictions=("linear",), choose_friction=False)
    fit = search(samples_of(recording, options=options).problem).fit
    arcs, third = fit.in_thirds()
    error = fit.linearised.errors
    without = fit.without_thirds()
    assert [w.run for w in without] == ["0", "1", "2"]
    for k, (other, _, _) in enumerate(without):
        own = fit.again(arcs=arcs.take(third != k), rescale=False)
        np.testing.assert_allclose((other.p - own.p) / error, 0.0, atol=0.3)
    assert max(np.max(np.abs(other.p - fit.p) / error) for other, _, _ in without) > 0.5


@pytest.mark.slow
def test_bands_and_horizon_of_a_law_that_is_wrong_hold_what_it_misses():
    """Friction that the fit may not have: bands without its misfit are far too narrow."""
    t, theta = pendulum(gamma=0.01, end=60.0)
    recording = recorded(t, theta)
    fit = gfnn.fit(recording.slice(stop=40.0), friction="none")
    with_misfit, without = covered(fit, recording, np.arange(42.0, 58.0, 1.3), 2.0)
    assert with_misfit > 0.9
    assert without < with_misfit - 0.2
    passed = [h for h in fit.horizon if 0 < h.measured < np.inf]
    assert passed
    for horizon in passed:
        assert 0.5 < horizon.predicted / horizon.measured < 2


def test_bands_of_a_law_that_is_right_hold_no_more(swing):
    recording, fit = swing
    misfit = np.asarray(fit.map.sensors.misfit)
    assert np.all(misfit < (2.0 if fit.map.sensors.of_law else 1e-3))  # as large as the noise
    assert fit.map.sensors.wander is None
    with_misfit, _ = covered(fit, recording, np.arange(30.5, 38.5, 0.7), 1.5)
    assert 0.9 < with_misfit < 0.995


def test_misfit_beyond_the_last_lead_grows_as_it_did():
    """As √t, not at all where it has settled (a driven, damped motion), and no faster than t."""
    leads = np.geomspace(0.1, 10, 24)
    misfit = np.stack([np.sqrt(leads), np.minimum(leads, 3.0), leads**2], axis=1)
    sensors = Sensors(("x",), (), (), np.ones(1), 1.0, 1.0, "hold", 0.0, leads, misfit)
    far = sensors.misfit_at(np.array([1.0, 40.0]))
    np.testing.assert_allclose(far[0], [1.0, 1.0, 1.0], rtol=0.02)
    np.testing.assert_allclose(far[1], [np.sqrt(40), 3.0, 400.0], rtol=1e-6)


@pytest.mark.parametrize("kind", ["steady", "relative", "of_law"])
def test_the_misfit_is_of_the_kind_that_its_errors_are(kind):
    """Of swings that die down, an angle that has turned among them, by a law whose own deviations
    are twice the errors where these are in proportion to them."""
    rng, phase = np.random.default_rng(0), np.linspace(0, 40, 400)
    amplitude = np.exp(-phase / 20)
    x = np.stack([amplitude * np.cos(phase) + 2 * np.pi, -amplitude * np.sin(phase)], axis=1)
    rest = (1.0, 1.0, "hold", 0.0, np.ones(1), np.ones((1, 1)))
    sensors = Sensors(("theta",), (), ("theta",), 1e-4 * np.ones(1), *rest, middle=np.zeros(1))
    reach = np.sqrt(np.mean(sensors.distances(x) ** 2, axis=0))
    sensors = dataclasses.replace(sensors, reach=reach)
    law = 1e-3 * (1.5 + np.sin(3 * phase))[:, None, None] * np.ones((400, 3, 1))
    true = {"steady": 5e-3, "relative": 0.01 * amplitude[:, None, None], "of_law": 0.5 * law}[kind]
    beside = 1e-4 if kind == "of_law" else law
    errors = np.hypot(true, beside) * rng.normal(size=law.shape)
    chosen, known, unit = _with_shape(sensors, x, errors, law)
    assert (chosen.relative, chosen.of_law) == (kind == "relative", kind == "of_law")
    misfit = np.mean((errors**2 - known) / unit)
    expected = {"steady": 5e-3, "relative": 0.01 * np.sqrt(np.mean(amplitude**2)), "of_law": 0.5}
    assert np.sqrt(misfit) == pytest.approx(expected[kind], rel=0.15)


def test_thirds_begin_where_they_say():
    thirds = Thirds((None, None, None), ((0, 0.0), (0, 5.0), (1, 2.0)))
    places = [(0, 0.0), (0, 4.9), (0, 5.0), (1, 1.0), (1, 2.0), (2, 0.0)]
    assert [thirds.of(*place) for place in places] == [0, 0, 1, 1, 2, 2]
