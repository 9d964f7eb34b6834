"""A fit that was saved comes back whole: map, law, table, messages, verdict, report."""

import json
import warnings

import numpy as np
import pytest
from analytic import rotated

import gfnn_jax as gfnn


def kicked(num=60, seed=0):
    """Pairs of the flow of ½p² + ½q² over 0.3, which is a rotation."""
    z = np.random.default_rng(seed).normal(size=(num, 2))
    return gfnn.Pairs(z, rotated(z, 0.3), 0.3)


@pytest.fixture(scope="module")
def law_of_pairs():
    return gfnn.fit(kicked(), tolerance=1e-8)


@pytest.fixture(scope="module")
def generated():
    return gfnn.fit(kicked(), tolerance=1e-3, learn="map", chart="midpoint")


@pytest.fixture(scope="module")
def law_of_recording():
    t = 0.05 * np.arange(400)
    x = np.exp(-0.05 * t) * np.cos(2 * t) + 1e-3 * np.random.default_rng(1).normal(size=t.shape)
    recording = gfnn.Recording({"t": t, "x": x}, positions=["x"])
    return gfnn.fit(recording, terms=["v**2", "V: x**2"], friction="linear")


FITS = ("law_of_pairs", "generated", "law_of_recording")


@pytest.mark.slow
@pytest.mark.parametrize("name", FITS)
def test_round_trip(name, tmp_path, request):
    fit = request.getfixturevalue(name)
    fit.save(tmp_path / "m")
    again = gfnn.load(tmp_path / "m")
    assert type(again) is type(fit) is gfnn.Fit
    for what in ("table", "messages", "verdict", "formula", "ended"):
        assert getattr(again, what) == getattr(fit, what)
    assert repr(again) == repr(fit)
    z = np.full((2, 2), 0.1)
    np.testing.assert_array_equal(again.map.step(z)[0], fit.map.step(z)[0])
    assert json.loads(json.dumps(again.report())) == again.report()
    assert again.report()["verdict"] == fit.verdict
    again.save(tmp_path / "twice")
    assert gfnn.load(tmp_path / "twice").report() == again.report()


def test_the_law_of_pairs(law_of_pairs, tmp_path):
    law_of_pairs.save(tmp_path / "m")
    again = gfnn.load(tmp_path / "m")
    assert again.verdict == "identified"
    assert again.law.terms == law_of_pairs.law.terms
    assert again.law is again.hamiltonian
    assert str(again.law) == str(law_of_pairs.law)
    assert again.law.sympy() == law_of_pairs.law.sympy()
    assert (again.lagrangian, again.friction) == (None, None)
    z = np.array([0.3, 0.2])
    found = [np.asarray(fit.law.vector_field(0.0, z)) for fit in (again, law_of_pairs)]
    np.testing.assert_array_equal(*found)


def test_the_law_of_a_recording(law_of_recording, tmp_path):
    law_of_recording.save(tmp_path / "m")
    again = gfnn.load(tmp_path / "m")
    assert again.verdict == "identified"
    for part in ("lagrangian", "friction", "hamiltonian"):
        assert getattr(again, part).terms == getattr(law_of_recording, part).terms
    for name in ("gains", "zeros", "noise", "residual", "horizon", "next_motions", "energy"):
        assert getattr(again, name) == getattr(law_of_recording, name)
    assert again.which_friction == law_of_recording.which_friction
    assert again.law.map is again.map


def test_the_folder_of_a_map_alone(generated, tmp_path):
    generated.map.save(tmp_path / "m")
    again = gfnn.load(tmp_path / "m")
    assert (again.law, again.verdict, again.messages, again.table) == (None, None, (), "")
    with pytest.raises(ValueError, match="holds a map alone"):
        again.report()
    assert "SymplecticMap" in repr(again)


def test_a_fit_stands_for_its_map_for_one_version(generated):
    with pytest.warns(DeprecationWarning, match=r"fit\.step is fit\.map\.step"):
        found, _ = generated.step(np.full(2, 0.1))
    np.testing.assert_array_equal(found, generated.map.step(np.full(2, 0.1))[0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert generated.chosen.family == "polynomial"  # of what was found: its own
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = generated.nothing
