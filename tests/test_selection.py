"""gfnn.fit: what is refused, what is chosen, and that the choice is as accurate as it says."""

import dataclasses
import math
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gfnn_jax as gfnn
from gfnn_jax.learn import candidates
from gfnn_jax.learn import fit as selection
from gfnn_jax.learn.local_maps import local_jacobians, look_symplectic
from gfnn_jax.learn.prepare import prepare
from gfnn_jax.scenes import DrawnFrom, Scene, henon_heiles
from gfnn_jax.scenes.two_body import angular_momentum


def pendulum(z, num_steps=50, dt=0.4):
    """A map that is exactly symplectic: small leapfrog steps of a pendulum. NumPy, z (N, 2)."""
    q, p = np.array(z).T
    h = dt / num_steps
    for _ in range(num_steps):
        p = p - h / 2 * np.sin(q)
        q = q + h * p
        p = p - h / 2 * np.sin(q)
    return np.stack([q, p], axis=1)


def disc(num, radius=1.0, seed=0):
    rng = np.random.default_rng(seed)
    r, angle = radius * np.sqrt(rng.uniform(size=num)), rng.uniform(0, 2 * np.pi, num)
    return np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)


def pendulum_pairs(num=400, seed=0):
    z = disc(num, seed=seed)
    return gfnn.Pairs(z, pendulum(z), 0.4)


def quiet_fit(*arguments, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        return gfnn.fit(*arguments, **options)


def rms(map_, z0, z1):
    return float(np.sqrt(np.mean((np.asarray(map_.step(z0)[0]) - np.asarray(z1)) ** 2)))


@pytest.fixture(scope="module")
def pendulum_fit():
    return quiet_fit(pendulum_pairs(), tolerance=1e-8)


@pytest.fixture(scope="module")
def long_steps():
    """Hénon–Heiles at dt = 1.3, states all over the well below E = 1/8."""
    energy = henon_heiles().invariants["energy"]

    def draw(key, num):
        box = jnp.array([[0.7, 0.7, 0.5, 0.5]])
        z = box * jax.random.uniform(key, (100 * num, 4), jnp.float64, -1, 1)
        return z[np.flatnonzero(np.asarray(jax.vmap(energy)(z)) < 1 / 8)[:num]]

    scene = dataclasses.replace(henon_heiles(dt=1.3), sampling=DrawnFrom(draw))
    return scene, gfnn.sample_pairs(scene, 1_500, jax.random.key(0))


# Refusals


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"chart": "type4"}, "expected a chart among"),
        ({"scalar": "spline"}, "expected a scalar among"),
        ({"scalar": "features"}, "needs a scene that declares features"),
        ({"tolerance": 0.0}, "tolerance > 0"),
        ({"tolerance": math.nan}, "tolerance > 0"),
        ({"angles": (2,)}, "angles among 0..1"),
        ({"scene": "two-body"}, "has dim 2, the pairs have 1"),
        ({"scene": "standard-map-regular", "angles": (0,)}, "a scene or angles"),
        ({"rows": 5}, "at least 8 different pairs"),
        ({"nan": True}, "row 3"),
        ({"cut": True}, "of one shape"),
        ({"angles": (0,), "chart": "type1"}, "no meaning for angles"),
    ],
)
def test_refuses_in_one_line(change, words):
    pairs = pendulum_pairs().take(slice(0, change.pop("rows", 400)))
    if change.pop("nan", False):
        pairs.z1[3, 0] = np.nan
    if change.pop("cut", False):
        pairs = gfnn.Pairs(pairs.z0[1:], pairs.z1, pairs.dt)
    if "scene" in change:
        change["scene"] = gfnn.scenes.make(change["scene"])
    with pytest.raises(gfnn.FitError, match=words) as refused:
        gfnn.fit(pairs, **change)
    assert "\n" not in str(refused.value)


def test_needs_float64():
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.raises(RuntimeError, match="jax_enable_x64"):
            gfnn.fit(pendulum_pairs())
    finally:
        jax.config.update("jax_enable_x64", True)


def test_a_folded_chart_is_refused_with_advice(long_steps):
    scene, pairs = long_steps
    with pytest.raises(gfnn.FitError, match=r"falls to -.*negative for 6\d %.*midpoint") as refused:
        gfnn.fit(pairs, scene, chart="type2")
    assert "\n" not in str(refused.value)


@pytest.mark.slow
def test_auto_takes_the_chart_that_covers(long_steps):
    scene, pairs = long_steps
    fit = quiet_fit(pairs, scene, tolerance=1e-2, scalar="polynomial")
    assert fit.met
    assert fit.chosen.chart == "midpoint"
    assert not fit.judgements["type2"].valid or fit.based


def test_friction_is_noticed():
    z = disc(400)
    damped = gfnn.Pairs(z, pendulum(z) * np.array([[1.0, 0.5]]), 0.4)
    with pytest.warns(gfnn.FitWarning, match="do not look symplectic"):
        gfnn.fit(damped, tolerance=1.0)


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
        prepared = prepare(gfnn.Pairs(z0, z1, 0.02), scene.coordinates)
        jacobians, error = local_jacobians(prepared.y0, prepared.y1, prepared.scale)
        return not look_symplectic(jacobians, error, prepared.scale)

    assert told(z0, z1)
    assert not told(pairs.z0, pairs.z1)


def test_copies_of_a_pair_judge_nothing():
    """Seven pairs, however often written down, are seven."""
    few = pendulum_pairs(7)
    many = gfnn.Pairs(np.tile(few.z0, (40, 1)), np.tile(few.z1, (40, 1)), 0.4)
    with (
        pytest.raises(gfnn.FitError, match="at least 8 different pairs"),
        pytest.warns(gfnn.FitWarning, match="273 of 280 pairs are copies"),
    ):
        gfnn.fit(many)


def test_a_map_without_all_images_is_still_given(monkeypatch):
    """The most accurate there is, with a warning, even where no candidate could be judged."""

    def failing(map_, pairs, rows):
        return candidates.ValidationError(np.inf, np.inf, np.full(2, np.inf), np.ones(len(rows)))

    monkeypatch.setattr(candidates, "validation_error", failing)
    with pytest.warns(gfnn.FitWarning, match="leaves held-out states without an image"):
        fit = gfnn.fit(pendulum_pairs(60), chart="midpoint", scalar="polynomial")
    assert not fit.met
    assert fit.chosen.train_rms == min(c.train_rms for c in fit.candidates)


@pytest.mark.parametrize(
    ("dt", "angles", "message"),
    [
        (0.0, (), "time step"), (np.nan, (), "time step"), (-0.4, (), "time step"),
        (0.4, (0, 0), "different angles"), (0.4, (2,), "among 0..1, got .2,."),
    ],
)  # fmt: skip
def test_bad_requests_are_refused(dt, angles, message):
    z = disc(60)
    with pytest.raises(gfnn.FitError, match=message):
        gfnn.fit(gfnn.Pairs(z, pendulum(z), dt), angles=angles)


def test_states_without_coordinates_are_refused():
    """The body at the centre has no polar angle."""
    scene = gfnn.scenes.two_body()
    pairs = gfnn.sample_pairs(scene, 40, jax.random.key(0))
    z0 = np.array(pairs.z0)
    z0[7, :2] = 0.0
    with pytest.raises(gfnn.FitError, match="1 pairs without, the first is row 7"):
        gfnn.fit(gfnn.Pairs(z0, pairs.z1, pairs.dt), scene)


@pytest.mark.parametrize(
    ("unit", "words"), [(1.0, None), (2.0, None), (3.8e5, "3.8e.05 times the size"), (0.2, "0.2 t")]
)
def test_features_in_other_units_are_noticed(unit, words):
    """1/r₁ of kilometres means nothing: the scene's lengths are in the distance of its bodies."""

    class LookedAt(Exception):
        pass

    def stop(message):
        raise LookedAt

    z = np.array([[0.49, 0.0, 0.0, 1.4]]) + 0.1 * np.random.default_rng(0).normal(size=(100, 4))
    pairs = gfnn.Pairs(unit * z, unit * z, 0.1)
    with warnings.catch_warnings(record=True) as caught, pytest.raises(LookedAt):
        gfnn.fit(pairs, gfnn.scenes.pcr3bp(), on_progress=stop)
    told = [str(w.message) for w in caught]
    assert len(told) == (2 if words else 0)
    assert all(words in t.replace("+", ".") for t in told)


@pytest.mark.slow
def test_a_tolerance_out_of_reach_gives_the_best_and_says_so():
    with pytest.warns(gfnn.FitWarning, match="no candidate meets"):
        fit = gfnn.fit(pendulum_pairs(60), chart="midpoint", scalar="polynomial", tolerance=1e-18)
    assert not fit.met
    assert fit.chosen.relative_rms == min(c.relative_rms for c in fit.candidates)


# What is held out


def in_sequence(*sequences):
    """Pairs of consecutive states of each sequence (L, 2d), one sequence after the other."""
    return gfnn.Pairs(
        np.concatenate([s[:-1] for s in sequences]), np.concatenate([s[1:] for s in sequences]), 0.4
    )


def walks(*lengths):
    rng = np.random.default_rng(0)
    return [rng.normal(size=(length + 1, 2)) for length in lengths]


def test_independent_pairs_are_held_out_at_random():
    pairs = pendulum_pairs(400)
    training, held_out = selection._split(pairs, seed=3)
    assert np.array_equal(np.sort(np.concatenate([training, held_out])), np.arange(400))
    assert len(held_out) == 40
    assert np.ptp(held_out) > 300
    assert np.array_equal(held_out, selection._split(pairs, seed=3)[1])
    assert not np.array_equal(held_out, selection._split(pairs, seed=4)[1])


@pytest.mark.parametrize("lengths", [(20,) * 30, (7, 1, 40, 3, 12) * 10])
def test_whole_sequences_are_held_out(lengths):
    pairs = in_sequence(*walks(*lengths))
    sequence = np.repeat(np.arange(len(lengths)), lengths)
    training, held_out = selection._split(pairs, seed=1)
    assert np.array_equal(np.sort(np.concatenate([training, held_out])), np.arange(len(pairs)))
    assert not set(sequence[training]) & set(sequence[held_out])
    assert 0.1 * len(pairs) <= len(held_out) < 0.2 * len(pairs)
    assert np.array_equal(held_out, selection._split(pairs, seed=1)[1])
    assert not np.array_equal(held_out, selection._split(pairs, seed=2)[1])


@pytest.mark.parametrize("lengths", [(1_000,), (16,), (700, 5, 5), (300, 300)])
def test_of_long_sequences_blocks_in_time_are_held_out(lengths):
    pairs = in_sequence(*walks(*lengths))
    training, held_out = selection._split(pairs, seed=1)
    blocks = np.split(np.sort(held_out), np.flatnonzero(np.diff(np.sort(held_out)) > 1) + 1)
    assert len(held_out) / len(blocks) >= 4
    assert len(training) > 0.6 * len(pairs)
    assert not set(training) & set(held_out)
    states = {tuple(z) for z in np.concatenate([pairs.z0[held_out], pairs.z1[held_out]])}
    assert not states & {tuple(z) for z in np.concatenate([pairs.z0[training], pairs.z1[training]])}


# The choice


@pytest.mark.slow
def test_three_tolerances_choose_three_maps_of_rising_cost():
    scene = henon_heiles()
    pairs = gfnn.sample_pairs(scene, 1_000, jax.random.key(0))
    fresh = gfnn.sample_pairs(scene, 500, jax.random.key(1))
    tolerances = (1e-3, 1e-5, 1e-6)
    fits = [quiet_fit(pairs, scene, tolerance=t) for t in tolerances]
    work = [fit.chosen.work for fit in fits]
    assert work[0] < work[1] < work[2]
    for fit, tolerance in zip(fits, tolerances, strict=True):
        assert fit.met
        assert rms(fit.map, fresh.z0, fresh.z1) <= tolerance
        cheaper = [c for c in fit.candidates if c.work < fit.chosen.work]
        assert all(c.validation_bound > tolerance for c in cheaper)


def test_one_seed_chooses_one_map(pendulum_fit):
    again = quiet_fit(pendulum_pairs(), tolerance=1e-8)
    names = [(c.chart, c.label, c.validation_rms) for c in pendulum_fit.candidates]
    assert names == [(c.chart, c.label, c.validation_rms) for c in again.candidates]
    z = disc(20, seed=2)
    np.testing.assert_array_equal(again.map.step(z)[0], pendulum_fit.map.step(z)[0])


def test_the_choice_is_as_accurate_as_it_says(pendulum_fit):
    fit, z = pendulum_fit, disc(2_000, seed=3)
    assert fit.met
    assert rms(fit.map, z, pendulum(z)) < 2 * fit.chosen.validation_bound
    assert fit.symplecticity_defect < 1e-13
    assert sum(c.chosen for c in fit.candidates) == 1
    assert fit.chosen.map is fit.map
    assert fit.chosen.microseconds_per_step is not None
    assert fit.chosen.label in fit.table


def test_coarse_maps_start_from_their_own_images(pendulum_fit):
    """The data's starts are no closer to the roots of a coarse map than it is to the data."""
    coarse = [c for c in pendulum_fit.candidates if c.validation_rms > 1e-5][-2:]
    updates = [int(c.map.step(disc(200, seed=2))[1].iterations.max()) for c in coarse]
    assert updates == [1, 1]


def test_units_do_not_matter():
    """q, p and time in other units, each in its own: the same functions give the same map, and the
    same states are outside the domain."""
    pairs, unit = pendulum_pairs(), np.array([[3e3, 7e-2]])
    one = quiet_fit(pairs, chart="midpoint", tolerance=1e-4)
    other = gfnn.Pairs(pairs.z0 * unit, pairs.z1 * unit, 60.0 * pairs.dt)
    other = quiet_fit(other, chart="midpoint", tolerance=1e-4)
    maps = {(c.chart, c.label): c.map for c in one.candidates}
    z, compared = np.concatenate([disc(200, seed=4), 1.5 * disc(50, seed=5)]), 0
    for candidate in other.candidates:
        if (candidate.chart, candidate.label) in maps:
            theirs, status = candidate.map.step(z * unit)
            ours, expected = maps[candidate.chart, candidate.label].step(z)
            np.testing.assert_allclose(np.asarray(theirs) / unit, ours, rtol=0, atol=1e-9)
            np.testing.assert_array_equal(status.status, expected.status)
            assert set(np.asarray(expected.status)) == {0, 1}
            compared += 1
    assert compared >= 2


# What must come out


@pytest.mark.slow
def test_the_standard_map_is_found_to_roundoff():
    scene = gfnn.scenes.standard_map()
    pairs = gfnn.sample_pairs(scene, 300, jax.random.key(0))
    fresh = gfnn.sample_pairs(scene, 500, jax.random.key(1))
    fit = quiet_fit(pairs, scene, tolerance=1e-12)
    assert fit.chosen.chart == "type2"
    assert rms(fit.map, fresh.z0, fresh.z1) < 1e-13


@pytest.mark.slow
def test_angular_momentum_is_conserved_to_roundoff():
    """By a map of low accuracy too: the angle is cyclic, S does not see it."""
    scene = gfnn.scenes.two_body()
    pairs = gfnn.sample_pairs(scene, 500, jax.random.key(0))
    fit = quiet_fit(pairs, scene, chart="midpoint", scalar="polynomial", tolerance=1e-2)
    z0 = gfnn.sample_test_states(scene, 10, jax.random.key(1))
    states, info = fit.map.rollout(z0, 1_000)
    momentum = jax.vmap(jax.vmap(angular_momentum))(states)
    assert not np.any(info.status)
    assert float(jnp.max(jnp.abs(momentum - momentum[:, :1]))) < 1e-13


@pytest.mark.slow
def test_a_base_map_is_found_where_it_is_needed():
    """A driven pendulum, one period of the drive per step: no chart covers it by itself."""

    def hamiltonian(z, t):
        return z[1] ** 2 / 2 - jnp.cos(z[0]) * (1 + 0.15 * jnp.cos(1.8 * t))

    scene = Scene(
        name="driven", purpose="", dim=1, dt=2 * math.pi / 1.8, hamiltonian=hamiltonian,
        sampling=DrawnFrom(lambda key, num: jnp.asarray(disc(num, 0.8, int(key[-1])))),
    )  # fmt: skip
    data = gfnn.sample_pairs(scene, 600, np.array([0, 5]))
    fresh = gfnn.sample_pairs(scene, 200, np.array([0, 6]))
    fit = quiet_fit(data, tolerance=1e-6)
    assert fit.based
    assert fit.met
    assert rms(fit.map, fresh.z0, fresh.z1) < 1e-6
    assert fit.symplecticity_defect < 1e-12


SIGMA = 1e-3


@pytest.fixture(scope="module")
def noisy_pairs():
    pairs = pendulum_pairs(1_000)
    noise = SIGMA * np.random.default_rng(7).normal(size=(2, *pairs.z0.shape))
    return gfnn.Pairs(pairs.z0 + noise[0], pairs.z1 + noise[1], 0.4)


@pytest.fixture(scope="module")
def noisy_fit(noisy_pairs):
    with pytest.warns(gfnn.FitWarning, match="carry noise"):
        return gfnn.fit(noisy_pairs, chart="midpoint", tolerance=1e-18)


def test_noise_is_told_in_the_units_of_each_coordinate(noisy_pairs, noisy_fit):
    """The choice, and whether there is noise, do not depend on units; how much is in those."""
    unit = np.array([1e9, 1e-9])
    z0, z1 = noisy_pairs.z0 * unit[None, :], noisy_pairs.z1 * unit[None, :]
    other = quiet_fit(gfnn.Pairs(z0, z1, 60 * 0.4), chart="midpoint", tolerance=1e-18)
    assert other.noise is not None
    np.testing.assert_allclose(other.noise / unit, noisy_fit.noise, rtol=1e-6)
    labels = [[(c.chart, c.label) for c in fit.candidates] for fit in (other, noisy_fit)]
    assert labels[0] == labels[1]


def test_noise_is_not_learned(noisy_fit):
    """Noise of size σ leaves an error of order σ, a symplectic map and bounded rollouts."""
    sigma, fit = SIGMA, noisy_fit
    assert fit.noise is not None
    assert np.all((0.5 * sigma < fit.noise) & (fit.noise < 2 * sigma))
    z = disc(500, radius=0.9, seed=8)
    assert rms(fit.map, z, pendulum(z)) < sigma
    assert fit.symplecticity_defect < 1e-13
    states, info = fit.map.rollout(z[:20], 2_000)
    assert np.all(np.asarray(info.status) <= 1)
    assert float(jnp.max(jnp.abs(states))) < 1.5
