"""Hamiltonians in ``gfnn.fit``: when one is learned, when it is preferred, what comes with it."""

import json
import types

import numpy as np
import pytest
import sympy
from analytic import henon_heiles_pairs, moved

import gfnn_jax as gfnn
from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.evaluate import report
from gfnn_jax.learn import searches
from gfnn_jax.models.hamiltonians import search
from gfnn_jax.models.hamiltonians.search import preferred
from gfnn_jax.models.maps_of_laws.law_maps import Drawing, drawn

FORMULA = "0.5 q1² + 0.5 q2² + 0.5 p1² + 0.5 p2² + q1² q2 - 0.333333333333 q2³"


@pytest.fixture(scope="module")
def pairs():
    """Hénon–Heiles at dt = 0.5, from another solver, told nothing of it."""
    return henon_heiles_pairs(200)


@pytest.fixture(scope="module")
def law(pairs):
    return gfnn.fit(pairs, tolerance=1e-12)


@pytest.mark.slow
def test_a_law_of_six_numbers_comes_out_of_raw_pairs(law):
    assert law.chosen.learns == "hamiltonian"
    assert str(law.hamiltonian) == FORMULA
    exact = [0.5, 0.5, 0.5, 0.5, 1.0, -1 / 3]
    found = [term.coefficient for term in law.hamiltonian.terms]
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-11)
    assert law.met
    assert law.symplecticity_defect < 1e-13
    assert np.isnan(law.model_determinant_min)


def test_the_law_holds_where_no_pair_was(law, pairs):
    fresh = henon_heiles_pairs(50, seed=1, radius=0.6)  # the data reach 0.4
    assert np.abs(fresh.z0).max() > np.abs(pairs.z0).max()
    np.testing.assert_allclose(law.map.step(fresh.z0)[0], fresh.z1, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_h_can_be_evaluated_and_does_not_drift(law, pairs):
    q1, q2, p1, p2 = pairs.z0[:20].T
    energy = 0.5 * (q1**2 + q2**2 + p1**2 + p2**2) + q1**2 * q2 - q2**3 / 3
    np.testing.assert_allclose(law.map.hamiltonian(pairs.z0[:20]), energy, rtol=0, atol=1e-12)
    assert law.map.hamiltonian(pairs.z0[0]).shape == ()
    states, info = law.map.rollout(0.5 * pairs.z0[:5], 2_000, save_every=2_000)
    assert not info.status.any()
    drift = law.map.hamiltonian(states[:, -1]) - law.map.hamiltonian(states[:, 0])
    assert np.abs(drift).max() < 1e-13


def test_the_report_holds_the_formula(law):
    told = report.assemble(law)
    told = json.loads(report.to_json(told))
    code = "0.5*q1**2 + 0.5*q2**2 + 0.5*p1**2 + 0.5*p2**2 + q1**2*q2 - 0.333333333333*q2**3"
    assert told["hamiltonian"]["formula"] == law.formula == code
    energy = sympy.sympify(code).subs({"q1": 1, "p1": 1, "q2": 2, "p2": 2})
    assert abs(energy - (5 + 2 - 8 / 3)) < 1e-11  # ½ (1 + 4 + 1 + 4) + 1² 2 − 2³/3
    assert told["hamiltonian"]["terms"][0].keys() == {"term", "coefficient", "std"}
    assert told["map"]["chart_determinant_min"] is None
    assert told["model"]["learns"] == "hamiltonian"


@pytest.mark.slow
def test_a_map_asked_for_is_a_map(pairs):
    fit = gfnn.fit(pairs, tolerance=1e-3, learn="map")
    assert fit.chosen.learns == "map"
    assert fit.hamiltonian is None
    assert fit.formula is None
    energy, error = fit.map.modified_hamiltonian(pairs.z0[:5])
    again = fit.map.hamiltonian(fit.map.step(pairs.z0[:5])[0])
    np.testing.assert_allclose(again, energy, rtol=0, atol=4 * np.max(error))


def candidate(operations, error, bound=None, num_parameters=3):
    return types.SimpleNamespace(
        operations=operations,
        validation_bound=error if bound is None else bound,
        validation_relative=error,
        validation_rms=error,
        num_parameters=num_parameters,
    )


@pytest.mark.parametrize(
    ("law", "map_", "taken"),
    [
        (candidate(4.0, 1e-9), candidate(1.0, 1e-9), True),  # four times as dear, and it holds
        (candidate(4.1, 1e-9), candidate(1.0, 1e-9), False),
        (candidate(100.0, 1e-9), candidate(1.0, 1e-7), True),  # it alone meets the tolerance
        (candidate(1.0, 1e-7), candidate(100.0, 1e-9), False),
        (candidate(9.0, 1e-6), candidate(1.0, 1e-5), True),  # neither does
        (candidate(1.0, 1e-5), candidate(9.0, 1e-6), False),
        (candidate(9.0, 1.005e-5), candidate(1.0, 1e-5), True),  # noise tells them not apart
        # By chance, of pairs so few that the bound is 1.21 times the error.
        (candidate(9.0, 1.09e-5, 1.32e-5), candidate(1.0, 1e-5), True),
        (candidate(9.0, 1.11e-5, 1.34e-5), candidate(1.0, 1e-5), False),
        (candidate(9.0, 1.09e-5, 1.32e-5, 4), candidate(1.0, 1e-5), False),  # of more numbers
        (candidate(1.0, np.inf), candidate(9.0, np.inf), False),
    ],
)
def test_when_a_law_is_preferred(law, map_, taken):
    assert preferred(law, map_, Tolerance(1e-8)) is taken


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"scene": "driven-pendulum"}, "depends on time"),
        ({"terms": ["p3**2"]}, "p3"),
        ({"terms": ["sqrt(q1)"]}, "finite at all states, got 'sqrt"),
        ({"angles": 0}, "a tuple of indices"),
        ({"family": "sines"}, "of S"),
    ],
)
def test_refusals(options, words):
    options = {"learn": "hamiltonian", **options}
    z = np.random.default_rng(0).normal(size=(100, 2))
    scene = gfnn.scenes.make(options.pop("scene")) if "scene" in options else None
    with pytest.raises(gfnn.FitError, match=words) as refused:
        gfnn.fit(gfnn.Pairs(z, z + 0.1, 0.1), scene, **options)
    assert "\n" not in str(refused.value)


def pendulums(_, z):
    return [z[1], -np.sin(z[0])]


@pytest.mark.slow
def test_a_law_that_misses_the_tolerance_is_the_best_there_is():
    """½p² − cos(q) e^(−q²/10), which no dictionary has: the degrees of its series, whose odd ones
    bring nothing."""
    z0 = np.random.default_rng(0).uniform(-1.3, 1.3, (300, 2))

    def slope(_, z):
        q, p = z
        return [p, -(np.sin(q) + 0.2 * q * np.cos(q)) * np.exp(-0.1 * q * q)]

    pairs = gfnn.Pairs(z0, moved(slope, z0, 0.2), 0.2)
    with pytest.warns(gfnn.FitWarning, match="no candidate meets"):
        fit = gfnn.fit(pairs, learn="hamiltonian", tolerance=1e-10)
    assert fit.hamiltonian is not None
    found = {term.term: term.coefficient for term in fit.hamiltonian.terms}
    assert list(found) == ["q1²", "p1²", "q1⁴", "q1⁶", "q1⁸"]
    series = [0.6, 0.5, -(1 / 24 + 0.05 + 0.005), 1 / 720 + 0.1 / 24 + 0.0025 + 1 / 6000]
    np.testing.assert_allclose(list(found.values())[:4], series, rtol=3e-2)
    assert fit.chosen.validation_relative < 5e-6
    assert repr(fit).startswith("Fit(flow H, 5 terms, 5 parameters: one-step error ")
    assert "not met" in repr(fit)
    assert repr(fit.map) == "SymplecticMap(Flow; cartesian, d = 1, dt = 0.2)"


@pytest.mark.slow
def test_a_known_term_makes_a_hard_law_easy():
    """A rational potential, which no polynomial of few terms is."""

    z0 = np.random.default_rng(0).uniform(-1, 1, (300, 2))
    z1 = moved(lambda _, z: [z[1], -8 * z[0] / (1 + 4 * z[0] ** 2) ** 2], z0, 0.2)
    pairs = gfnn.Pairs(z0, z1, 0.2)
    fit = gfnn.fit(pairs, tolerance=1e-12, learn="hamiltonian", terms=["1/(1 + 4*q1**2)"])
    assert fit.met
    terms = {t.term: t.coefficient for t in fit.hamiltonian.terms}
    assert len(terms) == 2
    np.testing.assert_allclose(sorted(terms.values()), [-1, 0.5], rtol=0, atol=1e-10)


def test_what_the_pairs_do_not_determine_is_named():
    """Two oscillators, and the second one stands still in all pairs."""
    z = np.random.default_rng(0).uniform(-1, 1, (200, 4)) * np.array([1.0, 0.0, 1.0, 0.0])
    c, s = np.cos(0.3), np.sin(0.3)
    turn = np.kron(np.array([[c, -s], [s, c]]), np.eye(2))
    fit = gfnn.fit(gfnn.Pairs(z, z @ turn, 0.3), learn="hamiltonian")
    assert fit.formula == "0.5*q1**2 + 0.5*p1**2"
    assert "3 terms of H (q2², q2 p2, p2²)" in " ".join(fit.messages)


@pytest.mark.slow
def test_what_a_law_leaves_over_is_diagnosed():
    """Pendulums of different length, told nothing of it: the states have no law."""
    rng = np.random.default_rng(0)
    rates = np.repeat(rng.uniform(0.8, 1.2, 20), 30)
    phase = np.repeat(rng.uniform(0, 6, 20), 30) + 0.2 * np.tile(np.arange(30), 20) * rates
    size = np.repeat(rng.uniform(0.3, 1, 20), 30)

    def states(phase):
        return np.stack([size * np.cos(phase), -size * rates * np.sin(phase)], axis=1)

    z = states(phase)
    later = states(phase + 0.2 * rates)
    for i in range(20):  # to the bit, as those of a recording
        later[30 * i : 30 * i + 29] = z[30 * i + 1 : 30 * i + 30]
    fit = gfnn.fit(gfnn.Pairs(z, later, 0.2), tolerance=1e-10, learn="hamiltonian")
    assert "differs between the sequences" in fit.ended


@pytest.mark.slow
def test_an_alias_is_named_and_the_map_is_had_in_time():
    """A quarter turn and more in a step: the slowest of many laws. Half a turn: none at all."""

    def turned(angle):
        c, s = np.cos(angle), np.sin(angle)
        z = np.random.default_rng(0).uniform(-1, 1, (300, 2))
        return gfnn.Pairs(z, z @ np.array([[c, -s], [s, c]]), 1.0)

    with pytest.warns(gfnn.FitWarning, match="the motion turns by ωh"):
        fit = gfnn.fit(turned(4.0), tolerance=1e-8)
    assert fit.met
    fit = gfnn.fit(turned(np.pi), tolerance=1e-8, max_seconds=20)
    assert fit.met
    assert fit.chosen.learns == "map"
    assert fit.seconds < 20


@pytest.mark.slow
def test_a_law_is_made_a_map_at_another_time_step(law):
    fast = law.accelerate(dt=0.2, tolerance=1e-6, num_pairs=800)
    assert fast.chosen.learns == "map"
    assert fast.met
    fresh = henon_heiles_pairs(100, seed=5, dt=0.2)
    error = np.asarray(fast.map.step(fresh.z0)[0]) - fresh.z1
    assert np.sqrt(np.mean(error**2)) < 1e-6 * np.std(fresh.z0)


def test_pairs_are_drawn_in_the_region_that_is_named(law):
    region = [[-0.2, 0.1, -0.3, 0.0], [0.2, 0.4, 0.3, 0.1]]
    pairs = drawn(law.hamiltonian.flow, CARTESIAN, None, 0.3, Drawing(500, region=region))
    assert pairs.dt == 0.3
    np.testing.assert_allclose(pairs.z0.min(axis=0), region[0], atol=0.02)
    np.testing.assert_allclose(pairs.z0.max(axis=0), region[1], atol=0.02)
    with pytest.raises(gfnn.InputError, match=r"region"):
        law.accelerate(region=region[::-1])
    with pytest.raises(
        gfnn.FitError, match="expected an H within the tolerance, this fit has none"
    ):
        law.replaced(hamiltonian=None).accelerate()


@pytest.mark.slow
def test_a_map_that_is_far_cheaper_than_the_law_is_fitted_to_pairs_of_the_law(pairs, monkeypatch):
    few = pairs.take(np.arange(60))
    for module in (searches, search):  # as if the law's step were ten times as dear
        monkeypatch.setattr(module, "MAX_COST_RATIO", 0.4)
    found = gfnn.fit(few, tolerance=1e-5)
    assert found.chosen.learns == "map"
    assert found.chosen.num_parameters * 3 > 60 * 4  # more than the pairs alone determine
    assert str(found.hamiltonian) == FORMULA
    assert "drawn from H" in found.ended
    fresh = henon_heiles_pairs(100, seed=5)
    error = np.asarray(found.map.step(fresh.z0)[0]) - fresh.z1
    assert np.sqrt(np.mean(error**2)) < 1e-5 * np.std(fresh.z0)


@pytest.mark.slow
def test_a_known_law_leaves_little_to_learn(tmp_path):
    """A pendulum that is kicked after every step: no H has that map, and S of what the pendulum's
    flow leaves over is k cos(3q)/3h."""

    def kicked(num, seed):
        rng = np.random.default_rng(seed)
        z0 = np.column_stack([rng.uniform(-np.pi, np.pi, num), rng.uniform(-1.5, 1.5, num)])
        z1 = moved(pendulums, z0, 1.0)
        z1[:, 1] += 0.5 * np.sin(3 * z1[:, 0])
        return gfnn.Pairs(z0, z1, 1.0)

    fit = gfnn.fit(kicked(300, 0), angles=(0,), base="0.5*p**2 - cos(q)", tolerance=1e-11)
    assert fit.met
    assert fit.chosen.num_parameters < 30
    fit.map.save(tmp_path / "m")
    fresh = kicked(100, 1)
    for map_ in (fit.map, gfnn.load(tmp_path / "m").map):
        error = np.asarray(map_.step(fresh.z0)[0]) - fresh.z1
        assert np.abs(error).max() < 1e-10
    assert fit.symplecticity_defect < 1e-12
    back = np.asarray(fit.map.inverse(fresh.z1)[0])
    np.testing.assert_allclose(back, fresh.z0, rtol=0, atol=1e-10)


def test_a_law_holds_outside_the_states_that_it_was_fitted_to(law):
    assert law.chosen.outside < 1e-13


@pytest.mark.slow
def test_a_map_holds_less_outside_the_states_that_it_was_fitted_to(pairs):
    few = gfnn.fit(pairs, learn="map", tolerance=1e-4)
    assert few.chosen.outside > 2 * few.chosen.validation_relative
