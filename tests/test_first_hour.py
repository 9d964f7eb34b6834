"""What a new user meets in the first hour: figures, messages, pages and names that lead on."""

import ast
import dataclasses
import inspect
import json
import re
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from command_line import gfnn as command
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from test_report_page import discovered

import gfnn_jax as gfnn
from gfnn_jax.coordinates import polar
from gfnn_jax.diagnosis.symmetries import generators
from gfnn_jax.errors import InputError
from gfnn_jax.evaluate import figures
from gfnn_jax.evaluate.figures_of_recordings import law_figure, recording_figure
from gfnn_jax.jobs.compare import TITLES
from gfnn_jax.jobs.figures import OURS, figures_of_comparison, figures_of_run
from gfnn_jax.jobs.measure import Rollouts, affine_errors, measure
from gfnn_jax.models.lagrangians.calibration import Horizon

DOCS = Path(__file__).parent.parent / "docs"
T = np.arange(0.0, 12.0, 0.02)


def swing(amplitude: float) -> np.ndarray:
    noise = 1e-3 * np.random.default_rng(0).standard_normal(len(T))
    return amplitude * (np.exp(-0.06 * T) * np.cos(3.9 * T) + noise)


def drawn_on(figure: Figure) -> Figure:
    FigureCanvasAgg(figure).draw()
    return figure


def boxes(figure: Figure) -> list:
    drawn_on(figure)
    return [ax.get_tightbbox() for ax in figure.axes]


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


def test_symmetries_of_polar_coordinates_have_polar_names():
    names = polar(cyclic=True).names
    assert "translation of φ: p_φ conserved" in [text for text, _ in generators(2, (1,), names)]


@pytest.mark.slow
def test_panels_of_a_law_do_not_cover_each_other():
    fit = discovered()
    found = boxes(law_figure(fit.found, fit.seen))
    for i, one in enumerate(found):
        for other in found[i + 1 :]:
            wide = min(one.x1, other.x1) - max(one.x0, other.x0)
            high = min(one.y1, other.y1) - max(one.y0, other.y0)
            assert min(wide, high) < 2


@pytest.mark.slow
def test_results_come_before_details_and_horizons_are_told_once():
    law = discovered().law
    lines = law.table.splitlines()
    assert lines[0].startswith("L = ")
    assert lines[1].startswith("R = ")
    below = lines.index("details:")
    assert any(line.startswith("95 % of forecasts") for line in lines[:below])
    assert all(line.startswith("  ") for line in lines[below + 1 :])
    assert any("scale of L" in line for line in lines[below:])
    told = (Horizon(0.01, 3.0, 3.0), Horizon(0.05, np.inf, 9.0), Horizon(0.2, np.inf, 9.0))
    first, second = dataclasses.replace(law, horizon=told).horizon_lines
    assert "less than 1 % of the spread" in first
    assert "less than 5 % of the spread" in second


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


def test_a_sole_column_that_is_called_an_input_is_refused_with_the_option(tmp_path):
    path = tmp_path / "one.csv"
    np.savetxt(path, np.c_[T, swing(1.0)], delimiter=",", header="t,u", comments="")
    with pytest.raises(InputError, match=r"positions=\[.u.\]"):
        gfnn.read(path)
    assert gfnn.read(path, positions=["u"]).positions == ("u",)


def test_a_record_is_looked_at_by_its_name(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert command("look", "pendulum", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert next(iter(told["columns"])) == "theta"


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


@pytest.mark.slow
def test_lanes_are_asked_for_where_states_are_given():
    map_ = discovered().map
    with pytest.raises(ValueError, match=r"map\.rollout takes these"):
        map_.advance(np.array([0.1, 0.0]), 3)


@pytest.mark.slow
def test_a_gradient_through_twenty_steps_of_a_law_compiles_once():
    map_ = discovered().map

    def later(z):
        return map_.rollout(z, 20)[0][-1, 0]

    z = np.array([0.3, 0.1])
    seconds = []
    for start in (z, z + 0.01):
        began = time.process_time()
        gradient = jax.grad(later)(start)
        seconds.append(time.process_time() - began)
    off = 1e-5 * np.eye(2)
    expected = [(later(start + d) - later(start - d)) / 2e-5 for d in off]
    np.testing.assert_allclose(gradient, expected, rtol=1e-6)
    assert seconds[1] < 0.1 * seconds[0]


def test_the_signature_of_a_fit_is_for_users():
    told = inspect.signature(gfnn.fit)
    assert told.return_annotation == "Fit"
    assert not {"clock", "spent", "factors", "checkpoints"} & set(told.parameters)
    first = (gfnn.fit.__doc__ or "").splitlines()
    assert "recording" in first[0]
    assert any("gfnn.fit(" in line for line in first[:6])
    assert (Path(gfnn.__file__).parent / "py.typed").exists()


def test_the_home_of_the_docs_has_a_picture_three_starts_and_links_to_every_notebook():
    home = (DOCS / "index.md").read_text(encoding="utf-8")
    assert "![" in home
    starts = home.split("## Which workflow", 1)[1].split("\n| ", 1)[0]
    assert starts.count("```text") == 3
    notebooks = {path.name for path in (DOCS.parent / "notebooks").glob("*.ipynb")}
    assert notebooks == set(re.findall(r"\.\./notebooks/([\w]+\.ipynb)", home))


def test_the_notebook_of_ones_own_data_reads_a_file_by_public_names():
    text = (DOCS.parent / "notebooks" / "your_own_data.ipynb").read_text(encoding="utf-8")
    code = "\n".join(
        "".join(cell["source"]) for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"
    )
    imported = [
        node.module
        for node in ast.walk(ast.parse(code.replace("%", "#")))
        if isinstance(node, ast.ImportFrom)
    ]
    assert not [module for module in imported if module and module.startswith("gfnn_jax")]
    assert "gfnn.read(" in code
