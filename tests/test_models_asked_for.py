"""Data in any form, and models as objects: each option belongs to one of them."""

import numpy as np
import pandas as pd
import pytest

import gfnn_jax as gfnn
from gfnn_jax.learn.fit import as_pairs_or_recording

Z = np.random.default_rng(0).normal(size=(60, 2))
C, S = np.cos(0.3), np.sin(0.3)
PAIRS = gfnn.Pairs(Z, Z @ np.array([[C, -S], [S, C]]), 0.3)
T = 0.05 * np.arange(300)
X = np.cos(2 * T) + 1e-3 * np.random.default_rng(1).normal(size=T.shape)
LAW = gfnn.Lagrangian(terms=["v1**2", "V: x1**2"], friction="none")


@pytest.mark.parametrize(
    ("model", "options"),
    [
        (gfnn.Hamiltonian(terms=["q1**2", "p1**2"]), {"learn": "hamiltonian"}),
        pytest.param(
            gfnn.GeneratingFunction(chart="type2"),
            {"learn": "map", "chart": "type2"},
            marks=pytest.mark.slow,
        ),
    ],
)
def test_an_object_is_its_keywords(model, options):
    terms = {"terms": model.terms} if hasattr(model, "terms") else {}
    found = gfnn.fit(PAIRS, model=model, tolerance=1e-6)
    same = gfnn.fit(PAIRS, tolerance=1e-6, **options, **terms)
    assert type(found) is gfnn.Fit
    assert (found.chosen.learns, found.chosen.label) == (same.chosen.learns, same.chosen.label)
    np.testing.assert_array_equal(found.map.step(Z)[0], same.map.step(Z)[0])


def test_times_and_positions():
    law = gfnn.fit(T, X, model=LAW)
    assert law.verdict == "identified"
    assert [t.term for t in law.lagrangian.terms] == ["v1**2", "x1**2"]
    assert law.map.sensors.positions == ("x1",)


def test_any_form_of_the_same_data(tmp_path):
    table = pd.DataFrame({"t": T, "x1": X})
    path = tmp_path / "swing.csv"
    table.to_csv(path, index=False)
    recording = gfnn.Recording(table, positions=["x1"])
    for data in ((T, X), recording, table, {"t": T, "x1": X}, path, str(path)):
        found, _ = as_pairs_or_recording(data)
        assert found.positions == ("x1",)
        np.testing.assert_array_equal(found.times("0"), T)
        np.testing.assert_array_equal(found.values("x1", "0"), X)


def test_a_file_of_states(tmp_path):
    np.savez(tmp_path / "pairs.npz", z0=PAIRS.z0, z1=PAIRS.z1, dt=PAIRS.dt)
    found = gfnn.fit(str(tmp_path / "pairs.npz"), tolerance=1e-6)
    assert found.verdict == "identified"


@pytest.mark.parametrize(
    ("make", "near"),
    [
        (lambda: gfnn.Hamiltonian(term=["q1"]), "did you mean terms"),
        (lambda: gfnn.fit(PAIRS, tolerence=1e-3), "did you mean tolerance"),
    ],
)
def test_a_wrong_name_tells_the_nearest(make, near):
    with pytest.raises(TypeError, match=near):
        make()


@pytest.mark.parametrize(
    ("data", "options"),
    [
        (PAIRS, {"model": LAW}),
        (PAIRS, {"terms": ["q1"], "chart": "type2"}),
        ({"t": T, "x1": X}, {"model": gfnn.Hamiltonian()}),
        ({"t": T, "x1": X}, {"learn": "map", "loss": object()}),
    ],
)
def test_an_option_belongs_to_one_model(data, options):
    with pytest.raises((gfnn.FitError, gfnn.InputError)):
        gfnn.fit(data, **options)
