"""What a new user meets in the first hour: figures, messages, pages and names that lead on."""

import re

import numpy as np
import pytest
from command_line import gfnn as command
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import gfnn_jax as gfnn
from gfnn_jax.evaluate import figures
from gfnn_jax.evaluate.figures_of_recordings import recording_figure
from gfnn_jax.jobs.compare import TITLES
from gfnn_jax.jobs.figures import OURS, figures_of_comparison, figures_of_run
from gfnn_jax.jobs.measure import Rollouts, affine_errors, measure

T = np.arange(0.0, 12.0, 0.02)


def swing(amplitude: float) -> np.ndarray:
    noise = 1e-3 * np.random.default_rng(0).standard_normal(len(T))
    return amplitude * (np.exp(-0.06 * T) * np.cos(3.9 * T) + noise)


def drawn_on(figure: Figure) -> Figure:
    FigureCanvasAgg(figure).draw()
    return figure


def turning(num=4, steps=300):
    """Circles about the origin, (num, steps, 4), of a harmonic oscillator in the plane."""
    t, r = 0.1 * np.arange(steps), np.linspace(0.8, 1.2, num)[:, None]
    q = np.stack([r * np.cos(t), r * np.sin(t)], axis=-1)
    p = np.stack([-r * np.sin(t), r * np.cos(t)], axis=-1)
    return np.concatenate([q, p], axis=-1)


@pytest.mark.slow
def test_all_methods_of_a_comparison_differ_and_ours_looks_as_in_a_run():
    assert len(set(figures.COLOURS)) == len(figures.COLOURS) >= len(TITLES)
    assert len(set(figures.MARKERS)) >= len(TITLES)
    scene, states = gfnn.scenes.two_body(), turning()
    rolled = measure(Rollouts(1.001 * states, np.zeros(len(states), int), 1.0), scene, states)
    drawn = figures_of_comparison(scene, dict.fromkeys(TITLES.values(), rolled), states)
    for name in ("error", "coordinates"):
        ax = drawn[name].axes[0]
        lines = {line.get_label(): line for line in ax.get_lines()}
        assert lines["GFNN (ours)"].get_color() == figures.COLOURS[0]
        looks = {(one.get_color(), one.get_marker()) for one in lines.values()}
        assert len(looks) == len(lines)
        drawn_on(drawn[name])
        legend = ax.get_legend().get_window_extent()
        assert legend.x1 <= drawn[name].bbox.x1
        assert ax.get_window_extent().width > 0.7 * drawn[name].bbox.width


def test_a_run_shows_several_orbits_round_and_a_plain_map_beside_ours():
    scene, states = gfnn.scenes.two_body(), turning()
    pairs = gfnn.Pairs(states[:, :-1].reshape(-1, 4), states[:, 1:].reshape(-1, 4), dt=0.1)
    exact = affine_errors(pairs, scene, states)
    assert exact.max() < 1e-9  # a rotation is linear
    rolled = measure(Rollouts(states, np.zeros(len(states), int), 1.0), scene, states)
    fit = type("Fit", (), {"candidates": (), "chosen": None})()
    drawn = figures_of_run(fit, scene, rolled, states)
    (portrait,) = drawn["portrait"].axes
    assert portrait.get_aspect() == 1.0
    x, y = portrait.get_lines()[0].get_data()
    assert len(set(np.round(np.hypot(x, y), 6))) == 3
    assert OURS in [line.get_label() for line in portrait.get_lines()]


def test_an_angle_in_doubt_is_neither_plotted_nor_analysed_as_radians():
    record = gfnn.Recording({"t": T, "angle": swing(70.0)}, positions=["angle"])
    summary = record.summary()
    (column,) = summary.columns
    assert column.unit == "rad or deg?"
    assert column.frequencies[0] == pytest.approx(3.9 / 2 / np.pi, rel=0.02)
    assert summary.loss is not None
    assert summary.loss.per_period == pytest.approx(0.12 * 2 * np.pi / 3.9, rel=0.1)
    labels = [ax.get_ylabel() for ax in recording_figure(record, summary).axes]
    assert not any("[rad" in label and "?" not in label for label in labels)


def test_a_long_gap_makes_no_frequency_and_is_explained():
    keep = (T < 4.0) | (T > 4.9)
    record = gfnn.Recording({"t": T[keep], "theta": swing(1.0)[keep]}, positions=["theta"])
    summary = record.summary()
    (column,) = summary.columns
    assert len(column.frequencies) == 1
    assert column.frequencies[0] == pytest.approx(3.9 / 2 / np.pi, rel=0.02)
    series = recording_figure(record, summary).axes[0]
    assert "gaps shaded" in series.get_title()
    x, _ = series.get_lines()[0].get_data()
    assert np.isnan(x).sum() == 1  # no line across


@pytest.mark.parametrize("name", ["run", "look", "fit", "predict", "export", "compare"])
def test_help_of_every_command_has_an_example(name, capsys):
    with pytest.raises(SystemExit):
        command(name, "--help")
    out = capsys.readouterr().out
    assert re.search(rf"^gfnn ({name}|pendulum) ", out, re.M)
    assert max(map(len, out.splitlines())) <= 100
    if name == "fit":
        groups = ("the law of a recording:", "the map of states q, p:", "columns of a recording:")
        places = [out.index(group) for group in groups]
        assert places == sorted(places)
