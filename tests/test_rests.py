"""Rests of a recording: where dry friction holds a body, its samples are no equation of motion."""

from typing import Any

import numpy as np
import pytest
from analytic import block_on_a_spring
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn
from gfnn_jax.dataset.stretches import measure, stretches, without_rests

HELD, NOISE, DT = 0.1, 1e-3, 0.05


def record(seed=0):
    """Three runs, more than half of which the block stands still, where it has come to rest."""
    rng, t = np.random.default_rng(seed), np.arange(0, 36, DT)
    tables = [
        {
            "run": np.full(len(t), str(k)),
            "t": t,
            "x": block_on_a_spring(*start, t, HELD)[0] + NOISE * rng.normal(size=len(t)),
        }
        for k, start in enumerate(((1.0, 0.0), (0.7, 0.2), (-0.8, 0.5)))
    ]
    return gfnn.Recording(tables, positions=["x"])


def test_what_stands_still_is_left_out():
    found = stretches(record())
    parts, seconds, short = without_rests(found, measure(found))
    assert 50 < seconds < 75
    assert short == 0
    assert len(parts) == 3
    for part, whole in zip(parts, found, strict=True):
        assert part.t[0] == whole.t[0]
        left = np.setdiff1d(whole.t, part.t)
        assert np.std(whole.q[np.isin(whole.t, left)]) < 1.5 * NOISE


def test_what_creeps_at_the_end_is_left_out():
    """A body that friction holds creeps by more than the noise, and turns no more; one that swings
    as little is kept."""
    t = np.arange(0, 60, DT)
    dies = np.where(t < 20, np.cos(t), 0) * (1 - t / 25)
    creeps, swings = 0.05 * np.exp(-t / 40), 0.002 * np.cos(t)
    for end, left in ((creeps, 35), (creeps + swings, 0)):
        x = dies + end + 1e-6 * np.random.default_rng(0).normal(size=len(t))
        found = stretches(gfnn.Recording({"t": t, "x": x}, positions=["x"]))
        assert without_rests(found, measure(found)).resting == pytest.approx(left, abs=5)


def test_noise_is_that_of_what_moves():
    """A sensor's steps hide the noise of a body at rest."""
    t = np.arange(0, 60, DT)
    x = 0.01 * np.round(100 * np.where(t < 20, np.cos(t), np.cos(20)))
    found = stretches(gfnn.Recording({"t": t, "x": x}, positions=["x"]))
    assert measure(found).sigma[0] == pytest.approx(0.01 / np.sqrt(12), rel=0.3)


def test_a_run_shorter_than_a_period_is_kept():
    t = np.concatenate([np.arange(0, 40, DT), np.arange(45, 48, DT)])
    x = np.sin(t) + NOISE * np.random.default_rng(0).normal(size=len(t))
    found = stretches(gfnn.Recording({"t": t, "x": x}, positions=["x"]))
    parts, *seconds = without_rests(found, measure(found))
    assert seconds == [0, 0]
    assert [len(part.t) for part in parts] == [len(s.t) for s in found]


@pytest.mark.slow
def test_dry_friction_of_a_record_that_rests_half_its_time():
    fit: Any = gfnn.fit(record())
    assert fit.which_friction.kinds == ("dry",)
    spring, dry = fit.lagrangian.terms[1], fit.friction.terms[0]
    assert abs(spring.coefficient + 0.5) < 3 * spring.std
    assert abs(dry.coefficient - HELD) < 3 * dry.std
    assert dry.std < 1e-4
    assert any("at rest" in message for message in fit.messages)


@pytest.mark.slow
def test_coupled_coordinates_that_dry_friction_stops():
    """One coordinate is at rest long before the other, and both creep in the end, where the law
    without inertia leads; the coupling is seen in a few periods."""

    def rates(t, z):
        x, y, *v = z
        dry = 0.008 * np.tanh(np.array(v) / 1e-3)
        return [*v, *(np.array([-x - 2 * x * y, -y - x * x + y * y]) - dry)]

    t = np.arange(0, 90, 0.15)
    q = solve_ivp(rates, (0, 90), [0.15, 0.25, 0, 0], t_eval=t, rtol=1e-9, atol=1e-11).y[:2].T
    q = q + 1e-5 * np.random.default_rng(0).normal(size=q.shape)
    fit: Any = gfnn.fit(gfnn.Recording({"t": t, "x": q[:, 0], "y": q[:, 1]}, positions=["x", "y"]))
    found = {term.term: term.coefficient for term in fit.lagrangian.terms}
    exact = {"x**2": -0.5, "y**2": -0.5, "x**2*y": -1.0, "y**3": 1 / 3}
    assert {name: found[name] for name in exact} == pytest.approx(exact, rel=0.05)
    assert fit.which_friction.kinds == ("dry",)
