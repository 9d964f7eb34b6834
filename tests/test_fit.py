"""gfnn.fit: what is refused, what is held out, and that the choice is as accurate as it says."""

import dataclasses
import math
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from analytic import disc, leapfrog, rms

import gfnn_jax as gfnn
from gfnn_jax.candidates.assemble import Assembled
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.diagnosis.local_jacobians import local_jacobians, look_symplectic
from gfnn_jax.learn import choose
from gfnn_jax.models.hamiltonians.search import MAX_COST_RATIO
from gfnn_jax.scenes import DrawnFrom, Scene, henon_heiles
from gfnn_jax.scenes.systems import angular_momentum


def pendulum(z, dt=0.4):
    return leapfrog(z, dt, 50)


def pendulum_pairs(num=400, seed=0):
    z = disc(num, seed=seed)
    return gfnn.Pairs(z, pendulum(z), 0.4)


def quiet_fit(*arguments, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        return gfnn.fit(*arguments, **options)


@pytest.fixture(scope="module")
def pendulum_fit():
    return quiet_fit(pendulum_pairs(), tolerance=1e-7, learn="map")


class LookedAt(Exception):
    """Ends a fit that has told what it is asked for."""


def stop(_):
    raise LookedAt


# Refusals


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"chart": "type4"}, "expected one of auto, type1, .* as chart"),
        ({"tolerance": 0.0}, "a finite number > 0 as .*tolerance, got"),
        ({"angles": (2,)}, "angles among 0..1, got .2,."),
        ({"scene": "two-body"}, "has dim 2, the pairs have 1"),
        ({"rows": 5}, "at least 8 different pairs"),
        ({"nan": True}, "row 3"),
        ({"seed": 1.5}, "as seed, got 1.5"),
        ({"dt": math.nan}, "time step"),
    ],
)
def test_refuses_in_one_line(change, words):
    change = dict(change)
    pairs = pendulum_pairs().take(slice(0, change.pop("rows", 400)))
    pairs = dataclasses.replace(pairs, dt=change.pop("dt", 0.4))
    if change.pop("nan", False):
        pairs.z1[3, 0] = np.nan
    if "scene" in change:
        change["scene"] = gfnn.scenes.make(change["scene"])
    with pytest.raises(gfnn.FitError, match=words) as refused:
        gfnn.fit(pairs, **change)
    assert "\n" not in str(refused.value)


def test_a_folded_chart_is_refused_with_advice():
    """Type 2 of a turn by 2 radians: ∂P/∂p = cos 2 < 0 near the centre of a pendulum."""
    z = disc(400, radius=2.0)
    pairs = gfnn.Pairs(z, pendulum(z, dt=1.8), 1.8)
    with pytest.raises(gfnn.FitError, match=r"falls to -.*negative for \d+ %.*midpoint") as refused:
        gfnn.fit(pairs, chart="type2")
    assert "\n" not in str(refused.value)


@pytest.mark.slow
@pytest.mark.parametrize("wrong", ["columns", "friction"])
def test_what_is_not_symplectic_is_noticed_at_short_steps(wrong):
    """A short step is close to the identity whatever it does."""
    scene = gfnn.scenes.make("henon-heiles-regular", 0.02)
    pairs = gfnn.sample_pairs(scene, 1_000, jax.random.key(0))
    if wrong == "columns":
        z0, z1 = (np.asarray(z)[:, [0, 2, 1, 3]] for z in (pairs.z0, pairs.z1))
    else:
        z0, z1 = pairs.z0, pairs.z1 * np.exp([0, 0, -0.2 * 0.02, -0.2 * 0.02])[None, :]

    def told(z0, z1):
        data = Dataset.of(gfnn.Pairs(z0, z1, 0.02), scene.coordinates)
        jacobians, error = local_jacobians(data.y0, data.y1, data.scale)
        return not look_symplectic(jacobians, error, data.scale)

    assert told(z0, z1)
    assert not told(pairs.z0, pairs.z1)


def test_copies_of_a_pair_judge_nothing():
    """Seven pairs, however often written down, are seven."""
    few = pendulum_pairs(7)
    many = gfnn.Pairs(np.tile(few.z0, (40, 1)), np.tile(few.z1, (40, 1)), 0.4)
    with pytest.raises(gfnn.FitError, match="got 7"):
        gfnn.fit(many)
    few = pendulum_pairs(70)
    many = gfnn.Pairs(np.tile(few.z0, (4, 1)), np.tile(few.z1, (4, 1)), 0.4)
    with (
        pytest.raises(LookedAt),
        pytest.warns(gfnn.FitWarning, match="210 of 280 pairs are copies"),
    ):
        gfnn.fit(many, on_candidate=stop)


def test_states_without_coordinates_are_refused():
    """The body at the centre has no polar angle."""
    z0 = np.random.default_rng(0).normal(size=(40, 4))
    z0[7, :2] = 0.0
    with pytest.raises(gfnn.FitError, match=r"number 7"):
        gfnn.fit(gfnn.Pairs(z0, z0 + 1e-3, 0.1), gfnn.scenes.two_body())


@pytest.mark.parametrize(
    ("unit", "words"), [(1.0, None), (2.0, None), (3.8e5, "3.8e.05 times the size"), (0.2, "0.2 t")]
)
def test_features_in_other_units_are_noticed(unit, words):
    """1/r₁ of kilometres means nothing: the scene's lengths are in the distance of its bodies."""

    z = np.array([[0.49, 0.0, 0.0, 1.4]]) + 0.1 * np.random.default_rng(0).normal(size=(100, 4))
    pairs = gfnn.Pairs(unit * z, unit * (z + 1e-2 * z[::-1]), 0.1)
    with warnings.catch_warnings(record=True) as caught, pytest.raises(LookedAt):
        gfnn.fit(pairs, gfnn.scenes.pcr3bp(), on_progress=stop)
    told = [str(w.message) for w in caught]
    assert len(told) == (2 if words else 0)
    assert all(words in t.replace("+", ".") for t in told)


@pytest.mark.slow
def test_too_many_degrees_of_freedom_for_so_few_pairs_are_answered_at_once():
    """32 degrees of freedom: one line, or a map, and no hour of work."""
    z = np.random.default_rng(0).normal(size=(300, 64))
    turned = np.concatenate([z[:, 32:], -z[:, :32]], axis=1)
    pairs = gfnn.Pairs(z, math.cos(0.3) * z + math.sin(0.3) * turned, 0.3)
    refused = None
    try:
        fit = quiet_fit(pairs, tolerance=1e-6, max_seconds=20.0)
    except gfnn.FitError as error:
        refused = str(error)
    assert "\n" not in refused if refused else fit.seconds < 180


# The choice


def test_the_choice_is_as_accurate_as_it_says(pendulum_fit):
    fit, z = pendulum_fit, disc(200, seed=3)
    assert fit.met
    assert fit.ended == "the tolerance is met"
    spread = disc(400).std(axis=0)
    error = (np.asarray(fit.map.step(z)[0]) - pendulum(z)) / spread
    assert np.sqrt(np.mean(error**2)) < 2 * fit.chosen.validation_bound
    assert fit.symplecticity_defect < 1e-13
    assert fit.model_determinant_min > 0.5
    assert fit.num_pairs == 400
    assert not fit.base_map
    assert fit.messages == ()


def test_predictions_that_leave_the_data_say_so(pendulum_fit):
    with pytest.warns(gfnn.FitWarning, match="1 of 2 orbits leave the states"):
        pendulum_fit.predict([[0.1, 0.0], [0.0, 1.6]], 50)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pendulum_fit.predict([0.1, 0.0], 50)


@pytest.mark.slow
def test_one_of_the_candidates_is_chosen(pendulum_fit):
    chosen = pendulum_fit.chosen
    assert sum(c.chosen for c in pendulum_fit.candidates) == 1
    assert all(c.map is None for c in pendulum_fit.candidates)  # the map is that of the fit
    assert chosen.validated
    assert chosen.newton_iterations_max == 1
    assert chosen.microseconds_per_step > 0
    others = [c for c in pendulum_fit.candidates if not c.chosen]
    assert len(others) >= 2
    assert all(c.map is None and c.microseconds_per_step is None for c in others)
    cheaper = [c for c in others if c.validated and c.operations < chosen.operations]
    assert all(c.validation_bound > pendulum_fit.tolerance for c in cheaper)


@pytest.mark.slow
def test_an_absolute_tolerance_is_in_the_users_units(pendulum_fit):
    unit = np.array([1e3, 1e3])
    pairs = pendulum_pairs()
    pairs = gfnn.Pairs(pairs.z0 * unit, pairs.z1 * unit, pairs.dt)
    fit = quiet_fit(pairs, absolute_tolerance=1e-4, learn="map")
    assert fit.met
    assert fit.tolerance == 1e-4
    z = disc(200, seed=3)
    assert 1e-7 < rms(fit.map, z * unit, pendulum(z) * unit) < 1e-4
    assert fit.chosen.label == pendulum_fit.chosen.label


def test_units_do_not_matter(pendulum_fit):
    """q, p and time in other units, each in its own: the same functions give the same map, and the
    same states are outside the domain."""
    pairs, unit = pendulum_pairs(), np.array([[3e3, 7e-2]])
    pairs = gfnn.Pairs(pairs.z0 * unit, pairs.z1 * unit, 60.0 * pairs.dt)
    other = quiet_fit(pairs, tolerance=1e-7, learn="map")
    assert other.chosen.label == pendulum_fit.chosen.label
    assert other.chosen.chart == pendulum_fit.chosen.chart
    z = np.concatenate([disc(150, seed=4), 1.5 * disc(50, seed=5)])
    theirs, status = other.map.step(z * unit)
    ours, expected = pendulum_fit.map.step(z)
    np.testing.assert_allclose(np.asarray(theirs) / unit, ours, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(status.status, expected.status)
    assert set(np.asarray(expected.status).tolist()) == {0, 1}


def test_outliers_are_left_out(pendulum_fit):
    pairs = pendulum_pairs()
    z1 = pairs.z1.copy()
    z1[[50, 300]] += 0.7
    with pytest.warns(gfnn.FitWarning, match=r"2 of 400 pairs.*50, 300"):
        fit = gfnn.fit(gfnn.Pairs(pairs.z0, z1, 0.4), learn="map", tolerance=1e-7)
    assert fit.met
    assert fit.num_pairs == 398
    z = disc(200, seed=6)
    assert rms(fit.map, z, pendulum(z)) < 3 * rms(pendulum_fit.map, z, pendulum(z))


def test_a_tolerance_out_of_reach_gives_the_best_and_says_so():
    kept = []
    with pytest.warns(gfnn.FitWarning, match=r"no candidate"):
        fit = gfnn.fit(
            pendulum_pairs(60),
            chart="midpoint",
            family="polynomial",
            tolerance=1e-18,
            on_better=lambda *kind: kept.append(kind),
        )
    assert not fit.met
    # As it was chosen by: what is stated of it is of other pairs. A few per cent are not worth a
    # larger model.
    chosen = kept[-1][1]
    assert chosen.label == fit.chosen.label
    others = [c.validation_relative for c in fit.candidates if c.validated and not c.chosen]
    assert chosen.validation_relative <= 1.03 * min(others)


def test_what_is_found_on_the_way_is_handed_on(pendulum_fit):
    """Maps of falling error, the last of them the chosen one's."""
    kept = []
    fit = quiet_fit(
        pendulum_pairs(), tolerance=1e-7, learn="map", on_better=lambda *kind: kept.append(kind)
    )
    bounds = [candidate.validation_bound for _, candidate in kept]
    assert len(bounds) > 1
    assert bounds == sorted(bounds, reverse=True)
    assert fit.chosen.label == pendulum_fit.chosen.label == kept[-1][1].label
    z = disc(200, seed=2)
    np.testing.assert_allclose(kept[-1][0].step(z)[0], fit.map.step(z)[0], rtol=0, atol=1e-14)


SIGMA = 1e-3


@pytest.fixture(scope="module")
def noisy_pairs():
    pairs = pendulum_pairs(500)
    noise = SIGMA * np.random.default_rng(7).normal(size=(2, *pairs.z0.shape))
    return gfnn.Pairs(pairs.z0 + noise[0], pairs.z1 + noise[1], 0.4)


@pytest.fixture(scope="module")
def noisy_fit(noisy_pairs):
    with pytest.warns(gfnn.FitWarning, match="noise of about"):
        return gfnn.fit(noisy_pairs, chart="midpoint", tolerance=1e-18)


@pytest.mark.slow
def test_noise_is_not_learned(noisy_fit):
    """Noise of size σ leaves an error of order σ, a symplectic map and bounded rollouts."""
    assert noisy_fit.noise is not None
    assert np.all((noisy_fit.noise > 0.5 * SIGMA) & (noisy_fit.noise < 2 * SIGMA))
    z = disc(200, radius=0.9, seed=8)
    assert rms(noisy_fit.map, z, pendulum(z)) < SIGMA
    states, info = noisy_fit.map.rollout(z[:20], 500)
    assert np.all(np.asarray(info.status) <= 1)
    assert np.abs(states).max() < 1.5
    assert "no more accurate" in noisy_fit.ended


@pytest.mark.slow
def test_a_law_that_explains_less_than_half_of_the_steps_is_none():
    """A harmonic law of a pendulum, and the same error beside steps that are hardly larger."""
    model = gfnn.Hamiltonian(terms=["p1**2", "q1**2"])
    found = quiet_fit(pendulum_pairs(100), model=model).found
    assert found.verdict.startswith("partly: ")
    z0 = found.pairs.z0
    pairs = gfnn.Pairs(z0, z0 + 1.2 * found.chosen.deviations, 0.4)
    assert dataclasses.replace(found, pairs=pairs).verdict.startswith("no law: ")


@pytest.mark.slow
def test_noise_is_told_in_the_units_of_each_coordinate(noisy_pairs, noisy_fit):
    """The choice, and whether there is noise, do not depend on units; how much is in those."""
    unit = np.array([1e9, 1e-9])
    z0, z1 = noisy_pairs.z0 * unit[None, :], noisy_pairs.z1 * unit[None, :]
    other = quiet_fit(gfnn.Pairs(z0, z1, 60 * 0.4), chart="midpoint", tolerance=1e-18)
    assert other.noise is not None
    np.testing.assert_allclose(other.noise / unit, noisy_fit.noise, rtol=1e-6)
    labels = [[(c.chart, c.label) for c in fit.candidates] for fit in (other, noisy_fit)]
    assert labels[0] == labels[1]


@pytest.mark.slow
def test_friction_that_is_left_over_is_told_from_noise():
    """A pendulum that loses a thousandth of its momentum a step still looks symplectic. Beside a
    base that the user knows, which keeps areas, no friction is learned."""
    z = disc(1_000)
    damped = gfnn.Pairs(z, pendulum(z) * np.array([[1.0, 1 - 1e-3]]), 0.4)
    with pytest.warns(gfnn.FitWarning, match=r"volumes change by -0.001") as caught:
        gfnn.fit(damped, base="p1**2", chart="midpoint", tolerance=1e-9)
    assert not any("do not look symplectic" in str(w.message) for w in caught)


# What must come out


@pytest.mark.slow
def test_states_that_cover_the_torus_have_no_outside():
    scene = gfnn.scenes.standard_map(1.2)
    fit = quiet_fit(gfnn.sample_pairs(scene, 600, jax.random.key(0)), scene, tolerance=1e-12)
    assert fit.met
    assert fit.chosen.outside is None


@pytest.mark.slow
def test_a_degree_of_freedom_at_rest_does_no_harm():
    z = np.random.default_rng(0).uniform(-1, 1, (200, 2))
    q, p = z.T
    moved = p - 0.3 * q
    rest = np.zeros_like(q)
    z0 = np.stack([q, rest, p, rest + 0.1], axis=1)
    z1 = np.stack([q + 0.3 * moved, rest, moved, rest + 0.1], axis=1)
    fit = quiet_fit(gfnn.Pairs(z0, z1, 0.3), tolerance=1e-10)
    assert fit.met
    states, info = fit.map.rollout(z0[:5], 100)
    assert not np.any(info.status)
    np.testing.assert_allclose(states[:, -1, [1, 3]], z0[:5][:, [1, 3]], atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("family", ["sines", "mlp"])
def test_other_families_fit_too(family):
    options = {"max_iterations": 60} if family == "mlp" else {}
    fit = quiet_fit(pendulum_pairs(), family=family, chart="midpoint", tolerance=1e-3, **options)
    assert fit.met
    assert fit.chosen.family == family


@pytest.mark.slow
def test_angular_momentum_is_conserved_to_roundoff():
    """By a map of low accuracy too: the angle is cyclic, S does not see it."""
    scene = gfnn.scenes.two_body()
    pairs = gfnn.sample_pairs(scene, 500, jax.random.key(0))
    fit = quiet_fit(pairs, scene, chart="midpoint", family="polynomial", tolerance=1e-2)
    z0 = gfnn.sample_test_states(scene, 10, jax.random.key(1))
    states, info = fit.map.rollout(z0, 1_000)
    momentum = jax.vmap(jax.vmap(angular_momentum))(states)
    assert not np.any(info.status)
    assert float(jnp.max(jnp.abs(momentum - momentum[:, :1]))) < 1e-13


@pytest.mark.slow
def test_three_tolerances_choose_three_maps_of_rising_cost():
    scene = henon_heiles()
    pairs = gfnn.sample_pairs(scene, 1_000, jax.random.key(0))
    fresh = gfnn.sample_pairs(scene, 500, jax.random.key(1))
    tolerances = (1e-3, 1e-5, 1e-6)
    fits = [quiet_fit(pairs, scene, absolute_tolerance=t) for t in tolerances]
    operations = [fit.chosen.operations for fit in fits]
    assert operations[0] < operations[1] < operations[2]
    for fit, tolerance in zip(fits, tolerances, strict=True):
        assert fit.met
        assert rms(fit.map, fresh.z0, fresh.z1) <= tolerance
        worth = MAX_COST_RATIO if fit.chosen.learns == "hamiltonian" else 1.0
        cheaper = [
            c
            for c in fit.candidates
            if c.validated and worth * c.operations < fit.chosen.operations
        ]
        assert all(c.validation_bound > tolerance for c in cheaper)


@pytest.mark.slow
def test_auto_takes_the_chart_that_covers():
    """Hénon–Heiles at dt = 1.3, states all over the well below E = 1/8."""
    energy = henon_heiles().invariants["energy"]

    def draw(key, num):
        box = jnp.array([[0.7, 0.7, 0.5, 0.5]])
        z = box * jax.random.uniform(key, (100 * num, 4), jnp.float64, -1, 1)
        return z[np.flatnonzero(np.asarray(jax.vmap(energy)(z)) < 1 / 8)[:num]]

    scene = dataclasses.replace(henon_heiles(dt=1.3), sampling=DrawnFrom(draw))
    pairs = gfnn.sample_pairs(scene, 1_500, jax.random.key(0))
    with pytest.raises(gfnn.FitError, match=r"falls to -.*negative for 6\d %.*midpoint"):
        gfnn.fit(pairs, scene, chart="type2")
    fit = quiet_fit(pairs, scene, tolerance=1e-2, family="polynomial")
    assert fit.met
    assert fit.chosen.chart == "midpoint"
    assert not fit.determinants["type2"].valid or fit.base_map


@pytest.mark.slow
def test_a_base_map_is_found_where_it_is_needed():
    """A driven pendulum, one period of the drive per step: no chart covers it by itself."""

    def hamiltonian(z, t):
        return z[1] ** 2 / 2 - jnp.cos(z[0]) * (1 + 0.15 * jnp.cos(1.8 * t))

    scene = Scene(
        name="driven",
        purpose="",
        dim=1,
        dt=2 * math.pi / 1.8,
        hamiltonian=hamiltonian,
        sampling=DrawnFrom(lambda key, num: jnp.asarray(disc(num, 0.8, int(key[-1])))),
    )
    data = gfnn.sample_pairs(scene, 600, np.array([0, 5]))
    fresh = gfnn.sample_pairs(scene, 200, np.array([0, 6]))
    fit = quiet_fit(data, absolute_tolerance=1e-6)
    assert fit.base_map
    assert fit.met
    assert rms(fit.map, fresh.z0, fresh.z1) < 1e-6
    assert fit.symplecticity_defect < 1e-12


@pytest.mark.slow
def test_where_steps_do_not_bear_the_search_out_a_larger_map_is_taken(monkeypatch):
    measured, refused = choose.measured, []

    def the_first_fails(candidate, *rest):
        assembled = measured(candidate, *rest)
        if not refused:
            refused.append(candidate)
            worse = dataclasses.replace(assembled.candidate, validation_bound=np.inf)
            return assembled._replace(candidate=worse)
        return assembled

    monkeypatch.setattr(choose, "measured", the_first_fails)
    fit = gfnn.fit(pendulum_pairs(), learn="map", tolerance=1e-4)
    assert fit.met
    assert (fit.chosen.chart, fit.chosen.family) == (refused[0].chart, refused[0].family)
    assert fit.chosen.num_parameters > refused[0].num_parameters


def test_where_every_map_has_failing_steps_the_one_with_the_fewest_is_taken(monkeypatch):
    seen = []

    def second_fails_least(candidate, map_, *rest):
        seen.append(candidate)
        failing = dataclasses.replace(candidate, map=map_, validation_bound=np.inf)
        return Assembled(failing, 0.0, failed=1 if len(seen) == 2 else 9)

    monkeypatch.setattr(choose, "measured", second_fails_least)
    fit = quiet_fit(pendulum_pairs(), learn="map", tolerance=1e-20)
    assert len(seen) > 2
    assert (fit.chosen.chart, fit.chosen.label) == (seen[1].chart, seen[1].label)


@pytest.mark.slow
def test_where_every_map_has_failing_steps_smaller_ones_are_looked_at(monkeypatch):
    measured, of_ranking, counts, seen = choose.measured, choose._of_ranking, [], []

    def noted(ranking, request):
        counts.append(len(ranking))
        return of_ranking(ranking, request)

    def finalists_fail(candidate, map_, *rest):
        seen.append(candidate)
        if len(seen) > counts[0]:
            return measured(candidate, map_, *rest)
        failing = dataclasses.replace(candidate, map=map_, validation_bound=np.inf)
        return Assembled(failing, 0.0, failed=len(seen))

    monkeypatch.setattr(choose, "_of_ranking", noted)
    monkeypatch.setattr(choose, "measured", finalists_fail)
    fit = quiet_fit(pendulum_pairs(), learn="map", tolerance=1e-20)
    assert len(seen) == counts[0] + 1
    assert (fit.chosen.chart, fit.chosen.family) == (seen[0].chart, seen[0].family)
    assert fit.chosen.num_parameters < seen[0].num_parameters
