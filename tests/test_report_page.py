"""The report page, the physical quantities of a law, its equation of motion, objects of a fit."""

import dataclasses
import functools
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from command_line import gfnn as command

import gfnn_jax as gfnn
from gfnn_jax.evaluate.page import page
from gfnn_jax.evaluate.physics import _count, _of_swings, _System, physics
from gfnn_jax.exports.symbolic import Formula, equations_of_motion
from gfnn_jax.families.friction import QUADRATIC, Friction
from gfnn_jax.families.text import Term

OMEGA, DAMPING, REST = 3.0, 0.06, 0.2  # 1/s, 1/s, m


def swing(seconds=24.0, dt=0.04, sigma=1e-3):
    """A damped oscillator x'' = −ω² (x − rest) − 2 δ x' that is let go one metre from rest."""
    t = np.arange(0.0, seconds, dt)
    fast = np.sqrt(OMEGA**2 - DAMPING**2)
    x = np.exp(-DAMPING * t) * (np.cos(fast * t) + DAMPING / fast * np.sin(fast * t))
    noise = sigma * np.random.default_rng(0).standard_normal(len(t))
    return t, REST + x + noise


@functools.cache
def discovered():
    t, x = swing()
    table = {"t": t, "x": x}
    return gfnn.discover(table, positions=["x"])


@pytest.mark.slow
def test_quantities_are_those_of_the_oscillator():
    by_name = {q.name: q for q in physics(discovered().law).quantities}
    known = {
        "rest position, x": REST,
        "small swings: frequency": np.sqrt(OMEGA**2 - DAMPING**2) / (2 * np.pi),
        "small swings: damping ratio ζ": DAMPING / OMEGA,
        "small swings: quality factor Q": OMEGA / (2 * DAMPING),
        "small swings: time of decay to 1/e": 1 / DAMPING,
    }
    for name, value in known.items():
        found = by_name[name]
        assert abs(found.value - value) < 4 * found.std, (name, found)
        assert found.std < 0.02 * abs(value)
    assert by_name["small swings: frequency"].unit == "Hz"


def test_quadratic_friction_alone_has_no_damping_ratio():
    t, x = swing(12.0)
    system = _System.of(gfnn.fit(gfnn.Recording({"t": t, "x": x}, positions=["x"])).law)
    drag = Friction(np.array([[1]]), np.array([QUADRATIC]), np.zeros(1))
    law = dataclasses.replace(system.law, friction=drag, losses=np.array([0.1]), uniform=0.0)
    system = system._replace(law=law, root=np.zeros((0, _count(law))))
    rest = system.rests()[0][0]
    names = [one.name for one in system.at_rest(rest, True, False)]
    assert names == ["rest position, x", "small swings: frequency"]
    quality = _of_swings(system.swings(rest), system)[1]
    assert "depends on the amplitude" in quality.about


@pytest.mark.slow
def test_a_pendulum_slows_down_as_elliptic_integrals_say():
    from scipy.special import ellipk

    law = discovered().law
    theta = dataclasses.replace(law)  # the map stays: a spring swings at one frequency
    swings = physics(theta).swings
    np.testing.assert_allclose(swings.frequency, swings.frequency[0], rtol=1e-9)
    record = gfnn.records.path("pendulum")
    pendulum = gfnn.fit(gfnn.read(record, positions=["theta"], angles=["theta"], stop=40.0))
    found = physics(pendulum.law).swings
    expected = ellipk(0.0) / ellipk(np.sin(found.amplitude / 2) ** 2)
    np.testing.assert_allclose(
        found.frequency / found.frequency[0], expected / expected[0], rtol=2e-5
    )


def test_the_equation_of_motion():
    lagrangian = Formula((Term("v1**2", 0.5, 0.0), Term("v1*v2*cos(x1 - x2)", 2.0, 0.1)))
    friction = Formula((Term("abs(v2)**3", 0.1, 0.01), Term("(v2 - v1)**2", 0.2, 0.02)))
    forces = [[Term("u", 3.0, 0.5)], []]
    both = [lagrangian, lagrangian]
    first, second = equations_of_motion(both, friction, forces, ["x1", "x2"], ["v1", "v2"])
    assert str(first.left) == "x₁_ddot + 2.0(1) x₂_ddot cos(x₁−x₂)"
    assert str(first.right) == "-2.0(1) v₂² sin(x₁−x₂) - 0.40(4) (v₁−v₂) + 3.0(5) u"
    assert "- 0.30(3) v₂ |v₂|" in str(second.right)


class _Outline(HTMLParser):
    """Collects ids, headings' text, and whatever a browser would fetch."""

    def __init__(self):
        super().__init__()
        self.fetched, self.open = [], []

    def handle_starttag(self, tag, attrs):
        fetching = {"src", "href", "xlink:href", "data"}
        self.fetched += [v for k, v in attrs if k in fetching and not (v or "#").startswith("#")]


@pytest.mark.slow
def test_the_page_is_whole_small_and_needs_no_network():
    text = page(discovered())
    outline = _Outline()
    outline.feed(text)
    assert outline.fetched == []
    assert "url(http" not in text
    assert len(text.encode()) < 3e6
    for title in ("Law", "Physical quantities", "Forecasts", "Residuals", "How this was made"):
        assert f"<h2>{title}</h2>" in text
    assert discovered().verdict.partition(":")[0] in text


@pytest.mark.slow
def test_the_simulation_begins_at_its_first_dot_and_names_the_columns():
    found = re.search("const shown = (.*);\n", page(discovered()))
    assert found is not None
    shown = json.loads(found[1])
    t = shown["t"][0]
    moved = np.exp(-DAMPING * t) * np.cos(np.sqrt(OMEGA**2 - DAMPING**2) * t)
    assert shown["start"][0] == pytest.approx(REST + moved, abs=0.01)
    assert [slider["label"] for slider in shown["sliders"]] == ["x", "x²", "damping rate"]


def test_one_command_writes_the_report(tmp_path, capsys, monkeypatch):
    """The law of two thirds of a file, and what it says of the third that it has not seen."""
    monkeypatch.chdir(tmp_path)
    swung = np.stack(swing(12.0), axis=1)
    np.savetxt("swing.csv", swung, "%.5f", ",", header="t,x", comments="")
    assert command("swing.csv") == 0
    shown, folder = capsys.readouterr().out, tmp_path / "runs" / "swing"
    assert "which no fit has seen: median error of x 0.00" in shown
    found = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    assert found["data"]["num_samples"] == pytest.approx(200, abs=1)
    assert found["forecasts"]["begin"] == pytest.approx(8.0, abs=0.1)
    assert max(found["forecasts"]["median"]["x"]) < 2e-3  # noise of 1e-3, the law's own on top
    assert found["forecasts"]["within_two_deviations"] > 0.85
    assert (folder / "forecasts.png").stat().st_size > 10_000
    assert gfnn.load(folder / "model").map.sensors.positions == ("x",)
    assert command("swing.csv") == 2  # exists already
    assert command("swing.csv", "--overwrite", "--tolerance", "1e-3") == 2
    assert "--tolerance" in capsys.readouterr().err
    assert json.loads((folder / "report.json").read_text(encoding="utf-8")) == found
    assert "runs/swing/report.html" in shown
    assert "small swings: frequency = 0.477" in shown
    text = (folder / "report.html").read_text(encoding="utf-8")
    assert "gfnn swing.csv" in text


@pytest.mark.slow
def test_a_fit_forecasts_plots_and_shows_itself(tmp_path):
    fit = discovered()
    times = fit.learned_to + np.array([0.5, 1.0])
    ahead = fit.forecast(times)
    t, x = swing(sigma=0.0)
    np.testing.assert_allclose(ahead.values["x"][0], np.interp(times, t, x), atol=5e-3)
    assert fit.plot().axes
    assert "<math>" in fit._repr_html_()
    assert fit._repr_latex_().startswith("$L = ")
    fit.report(tmp_path / "r.html")
    fit.save(tmp_path / "model")
    with pytest.raises(ValueError, match="after=gfnn"):
        gfnn.load(tmp_path / "model").forecast(times)
    assert gfnn.load(tmp_path / "model").forecast(times, after=fit.seen).values["x"].shape == (1, 2)
