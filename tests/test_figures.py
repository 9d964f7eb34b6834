"""Figures show the arrays they were given, are labelled, and leave matplotlib's globals alone."""

import importlib
import sys

import matplotlib
import numpy as np
import pytest
from matplotlib.patches import StepPatch

from gfnn_jax.evaluate import figures, metrics

RNG = np.random.default_rng(0)
STEPS = np.arange(101)


def power_laws(num=8):
    return 1e-6 * STEPS * RNG.lognormal(size=(num, 1))


def samples(num=500):
    return RNG.normal(size=num), RNG.normal(size=num)


def line(ax, label):
    (found,) = [line for line in ax.get_lines() if line.get_label() == label]
    return np.array(found.get_data())


def legend(ax):
    return [text.get_text() for text in ax.get_legend().get_texts()]


QUICK = ("energy_error", "phase_portrait", "work_precision")  # the others are made as these are


def every_figure():
    """name -> a function that draws it; used for what must hold of all."""
    error = {"GFNN": (STEPS, power_laws()), "HNN": (STEPS, 10 * power_laws())}
    elements = {name: (STEPS, e, e) for name, (_, e) in error.items()}
    orbits = {"reference": samples(), "GFNN": samples(), "HNN": samples(), "VFNN": samples()}
    wave = np.sin(STEPS)
    return {
        "error_growth": lambda: figures.error_growth(error),
        "element_errors": lambda: figures.element_errors(elements),
        "energy_error": lambda: figures.energy_error(error),
        "coordinates": lambda: figures.coordinates_against_time(
            STEPS, wave, {"GFNN": wave}, "$q_1$"
        ),
        "phase_portrait": lambda: figures.phase_portrait(orbits, modulo=True),
        "sections": lambda: figures.sections(orbits),
        "marginals": lambda: figures.marginals(
            samples()[0], {"GFNN": samples()[0]}, 20, (-3, 3), "$q_2$"
        ),
        "speed": lambda: figures.speed_against_error(
            [1.0, 2.0], [1e-3, 1e-6], ["one", "two"], 1, tolerance=1e-5
        ),
        "work_precision": lambda: figures.work_precision({"GFNN": ([1, 2], [1e-3, 1e-6])}),
    }


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in QUICK else pytest.mark.slow)
        for name in every_figure()
    ],
)
def test_every_figure_is_labelled_saved_and_leaves_matplotlib_as_it_was(name, tmp_path):
    before = dict(matplotlib.rcParams)
    axes = every_figure()[name]()
    axes = list(axes) if isinstance(axes, (tuple, list)) else [axes]
    assert axes[0].get_ylabel()
    assert axes[-1].get_xlabel()
    assert name == "sections" or all(ax.get_legend() is not None for ax in axes)
    figure = axes[0].figure
    was = figure.canvas, figure.dpi, figure.get_layout_engine()
    figures.save(figure, tmp_path / "figure.png")
    assert (figure.canvas, figure.dpi, figure.get_layout_engine()) == was
    drawn, size = figure.get_tightbbox(), figure.get_size_inches()
    assert (drawn.min >= 0).all(), "a label is cut off"
    assert (drawn.max <= size).all(), "a label is cut off"
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")
    assert dict(matplotlib.rcParams) == before


def test_pyplot_is_never_imported(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)  # an import of it raises
    for module in [name for name in sys.modules if name.startswith("gfnn_jax.evaluate.figures")]:
        monkeypatch.delitem(sys.modules, module)
    figures = importlib.import_module("gfnn_jax.evaluate.figures")
    figures.save(figures.work_precision({"one": ([1, 2], [1, 2])}).figure, tmp_path / "figure.png")


def test_error_growth_shows_the_mean_and_a_band_that_stays_positive():
    error = power_laws()
    ax = figures.error_growth({"GFNN": (STEPS, error)})
    mean, std = error.mean(axis=0)[1:], error.std(axis=0)[1:]
    np.testing.assert_allclose(line(ax, "GFNN"), [STEPS[1:], mean])
    (band,) = ax.collections
    corners = np.array(band.get_paths()[0].vertices)
    at_last = corners[corners[:, 0] == STEPS[-1], 1]
    assert at_last.max() == pytest.approx((mean + std)[-1])
    assert 0 < at_last.min() == pytest.approx((mean / (1 + std / mean))[-1])
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    x, guide = line(ax, r"$\propto n$")
    np.testing.assert_allclose(guide / guide[0], x / x[0])
    assert (guide < mean).all()


def test_a_lost_prediction_ends_its_curve_and_is_counted():
    error = power_laws(4)
    error[0, 50:] = np.inf
    error[1] = np.nan
    ax = figures.error_growth({"HNN": (STEPS, error)})
    assert line(ax, "HNN (1 of 3 lost)")[0].max() == 49


def test_energy_error_is_a_root_mean_square():
    error = RNG.normal(size=(16, 101))
    ax = figures.energy_error({"GFNN": (STEPS, error)})
    np.testing.assert_allclose(line(ax, "GFNN")[1], np.sqrt(np.mean(error**2, axis=0))[1:])


def test_marginals_show_densities_and_the_divergence():
    reference, predicted = samples(5000)[0], 0.5 * samples(5000)[0]
    ax = figures.marginals(reference, {"GFNN": predicted}, 30, (-4, 4), "$q_2$")
    divergence = metrics.kl_divergence(predicted, reference, 30, (-4, 4))
    assert legend(ax) == ["reference", f"GFNN, KL {divergence:.2g}"]
    (stairs,) = (patch for patch in ax.patches[1:] if isinstance(patch, StepPatch))
    values, edges, _ = stairs.get_data()
    assert np.sum(values * np.diff(edges)) == pytest.approx(1)
    np.testing.assert_allclose(values, np.histogram(predicted, 30, (-4, 4), density=True)[0])


def test_speed_against_error_marks_the_choice_and_the_front():
    cost, error = [4.0, 1.0, 2.0, 3.0], [1e-8, 1e-2, 1e-5, 1e-4]
    ax = figures.speed_against_error(cost, error, list("abcd"), chosen=2, tolerance=1e-4)
    np.testing.assert_array_equal(line(ax, "candidate"), [cost, error])
    np.testing.assert_array_equal(line(ax, "chosen").ravel(), [2.0, 1e-5])
    np.testing.assert_array_equal(line(ax, "best for its cost"), [[1, 2, 4], [1e-2, 1e-5, 1e-8]])
    texts = [text.get_text() for text in ax.texts]
    assert texts[:4] == ["1", "2", "3", "4"]
    assert texts[4].splitlines() == ["1  b", "2  c  (chosen)", "3  d", "4  a"]
