"""Steps between nodes are as short as the coefficients ask for."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn
from gfnn_jax.dataset.stretches import arcs_of, nodes_of
from gfnn_jax.families.friction import LINEAR
from gfnn_jax.models.lagrangians import fine_steps, libraries
from gfnn_jax.models.lagrangians.arc_inputs import ArcInputs
from gfnn_jax.models.lagrangians.fine_steps import with_fine_steps
from gfnn_jax.models.lagrangians.recordings import samples_of
from gfnn_jax.models.lagrangians.structure import Structure

TRUE = {"loss": 0.05, "term": 2.0}  # θ̈ = −2 sin θ − 0.05 θ̇
TERMS = (((2,), (0,), (0,), 0.0), ((0,), (0,), (1,), 0.0))  # θ̇² and cos θ
PENDULUM = Structure(1, TERMS, tuple(libraries.losses(1, (LINEAR,), 0.0)[:1]), (), 0, ())


def fitted(noise: float, on_progress=print):
    """The fit of the law of a swinging pendulum with steps of a whole interval, along arcs of a
    period, and the law."""
    t = np.arange(0, 60, 0.45)
    rate = lambda _, x: [x[1], -2 * np.sin(x[0]) - 0.05 * x[1]]  # noqa: E731
    theta = solve_ivp(rate, (0, t[-1]), [2.6, 0.0], t_eval=t, rtol=1e-12, atol=1e-12).y[0]
    theta += noise * np.random.default_rng(3).normal(size=len(t))
    recording = gfnn.Recording({"t": t, "theta": theta}, angles="theta")
    problem = samples_of(recording, on_progress=on_progress).problem
    problem = dataclasses.replace(problem, inputs=ArcInputs(problem.nodes, 1, "hold"))
    keys = PENDULUM.keys()
    known = {key: TRUE["loss" if key[0] == "loss" else "term"] for key in keys}
    fit = problem.fit(PENDULUM, known, arcs_of(problem.nodes, 20), np.full(1, max(noise, 1e-9)))
    return fit, np.array([known[key] for key in keys])


def off(fit, true) -> float:
    """The largest error in standard errors."""
    return float(np.max(np.abs(fit.p - true) / fit.linearised.errors))


@pytest.mark.parametrize(
    "noise", [*(pytest.param(x, marks=pytest.mark.slow) for x in (0.0, 1e-6)), 1e-4]
)
def test_errors_of_steps_do_not_move_coefficients(noise):
    lines: list[str] = []
    fit, true = fitted(noise, lines.append)
    assert off(fit, true) > 10  # by steps of a whole interval
    found = with_fine_steps(fit)
    substeps = found.problem.inputs.substeps
    assert off(found, true) < 4
    assert found.correlation < 1.5  # rounding and truncation, coloured, are below the least noise
    assert substeps > 1
    assert len(lines) >= 1
    assert f"{substeps} steps between nodes" in lines[-1]


@pytest.mark.slow
def test_less_noise_asks_for_shorter_steps_and_much_noise_for_none():
    counts = [
        with_fine_steps(fitted(noise)[0]).problem.inputs.substeps for noise in (1e-6, 1e-4, 3e-2)
    ]
    assert counts[0] > counts[1] > counts[2] == 1
    fit, _ = fitted(3e-2)
    assert with_fine_steps(fit) is fit


def test_a_fit_without_an_orbit_is_left_as_it_is():
    fit, _ = fitted(1e-4)
    lost = dataclasses.replace(fit, fitted=dataclasses.replace(fit.fitted, cost=np.inf))
    assert with_fine_steps(lost) is lost


def test_no_step_goes_on_beyond_a_sample_where_inputs_jump():
    t = np.arange(0, 30, 0.02)
    x, u = np.sin(t) + 0.1 * np.sin(3 * t), np.repeat(np.sin(t[::5]), 5)
    for columns, wanted in (({}, 3), ({"u": u}, 4)):
        recording = gfnn.Recording(
            {"t": t, "x": x, **columns}, positions=("x",), inputs=tuple(columns)
        )
        samples = samples_of(recording)
        slower = dataclasses.replace(samples.problem.scales, omega=np.pi / 3.2)
        nodes = nodes_of(samples.segments, slower)
        assert np.all(np.diff(nodes[0].at) == 8)
        inputs = ArcInputs(nodes, 1, "hold")
        assert inputs.within_samples(3) == wanted
        assert inputs.within_samples(9) == (16 if columns else 9)
        for smooth in ("linear", "band"):
            assert ArcInputs(nodes, 1, smooth).within_samples(3) == 3


def test_steps_end_at_samples_where_shorter_ones_do_not_help(monkeypatch):
    """Errors of jumps: what shorter steps move falls little until none goes on beyond a sample."""
    lines: list[str] = []
    fit, _ = fitted(1e-4, lines.append)
    tried: list[int] = []

    def moved(finer, fit):
        tried.append(fit.problem.inputs.substeps)
        return 0.1 if fit.problem.inputs.substeps % 11 == 0 else 0.8

    def within(self, fewest):
        return 1 if fewest == 1 else -(-fewest // 11) * 11

    monkeypatch.setattr(fine_steps, "_moved", moved)
    monkeypatch.setattr(ArcInputs, "within_samples", within)
    finer = with_fine_steps(fit)
    assert tried == [1, 2, 11]
    assert finer.problem.inputs.substeps == 11
    assert not any("too few" in line for line in lines)
