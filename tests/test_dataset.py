"""Runs keep their identity from the file to the report; who trains, who chooses, who states."""

import itertools
import re

import numpy as np
import pytest
from analytic import rotated

import gfnn_jax as gfnn
from gfnn_jax.coordinates import CARTESIAN, Coordinates
from gfnn_jax.data.files import read_trajectories
from gfnn_jax.data.sample import read_sample
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance, bound_of_mean
from gfnn_jax.dataset.runs import identified, next_of, sampled, steps_between
from gfnn_jax.dataset.split import correlation_time, split_rows
from gfnn_jax.learn.choose import of_few
from gfnn_jax.maps.piece import Affine
from gfnn_jax.processes import Group

# Runs


def walks(*lengths):
    rng = np.random.default_rng(0)
    return [rng.normal(size=(length + 1, 2)) for length in lengths]


def in_rows(sequences, **more):
    """Pairs of consecutive states of each sequence (L, 2d), one sequence after the other."""
    z0, z1 = (np.concatenate([s[part] for s in sequences]) for part in (slice(-1), slice(1, None)))
    return gfnn.Pairs(z0, z1, 0.4, **more)


LENGTHS = (7, 1, 12, 3)
LABELS = np.repeat(["d", "b", "a", "c"], LENGTHS)
PLACES = np.concatenate([np.arange(length) for length in LENGTHS])


@pytest.mark.parametrize("given", [{"run": LABELS}, {"run": LABELS, "place": PLACES}])
def test_the_order_of_rows_that_have_a_run_does_not_matter(given):
    pairs = in_rows(walks(*LENGTHS), **given)
    order = np.random.default_rng(1).permutation(len(pairs))
    found, row = identified(pairs)
    again, moved = identified(pairs.take(order))
    for name in ("z0", "z1", "run", "place"):
        np.testing.assert_array_equal(getattr(again, name), getattr(found, name))
    np.testing.assert_array_equal(order[moved], row)
    np.testing.assert_array_equal(found.z0, pairs.z0[row])
    # Runs in the order of their labels, each a row after the other.
    assert np.array(["a", "b", "c", "d"])[found.run].tolist() == sorted(LABELS)
    assert steps_between(found).sum() == len(pairs) - len(LENGTHS)


def test_runs_without_a_label_are_those_of_rows_that_go_on():
    found = identified(in_rows(walks(3, 1, 2))).pairs
    assert found.run.tolist() == [0, 0, 0, 1, 2, 2]
    assert found.place.tolist() == [0, 1, 2, 0, 0, 1]
    few = found.take(np.array([0, 2, 3, 5]))
    assert steps_between(few).tolist() == [2, 0, 0]
    assert next_of(found, np.array([0, 1, 3, 5])).tolist() == [True, False, False]


def test_a_periodic_orbit_is_a_chain_too():
    corners = np.array([[1.0, 0], [0, 1], [-1, 0], [0, -1]])
    pairs = gfnn.Pairs(corners, np.roll(corners, -1, axis=0), 1.0, run=np.zeros(4, int))
    found, row = identified(pairs)
    assert found.place.tolist() == [0, 1, 2, 3]
    assert row.tolist() == [2, 3, 0, 1]


# Samples of large files


def continued(sample):
    """Number of rows of the sample whose image is the next row's state."""
    return int(np.sum(steps_between(identified(sample.pairs()).pairs) == 1))


@pytest.mark.parametrize(
    ("lengths", "stretches"), [([1] * 1_000, 1), ([5] * 200, 5), ([700, 300], 10)]
)
def test_a_sample_of_pairs_is_of_whole_runs_or_long_stretches(lengths, stretches):
    count = sum(lengths)
    z = np.random.default_rng(0).normal(size=(2, count, 2))
    run = np.repeat(np.arange(len(lengths)), lengths)
    place = np.concatenate([np.arange(length) for length in lengths])
    pairs = identified(gfnn.Pairs(z[0], z[1], 0.1, run=run, place=place)).pairs
    rows = sampled(pairs, 200, seed=1)
    assert len(rows) == 200
    assert (np.diff(rows) > 0).all()
    whole = rows.reshape(-1, stretches)
    assert (np.diff(whole, axis=1) == 1).all()
    assert (np.diff(pairs.run[whole], axis=1) == 0).all()
    assert (place[whole[:, 0]] % stretches == 0).all()
    np.testing.assert_array_equal(rows, sampled(pairs, 200, seed=1))
    assert set(rows) != set(sampled(pairs, 200, seed=2))


@pytest.mark.parametrize("kind", ["trajectories", "pairs", "table"])
@pytest.mark.parametrize("group", [None, Group()])
def test_a_sample_keeps_whole_arcs(tmp_path, kind, group):
    states = np.random.default_rng(0).normal(size=(1_000, 2))
    path = tmp_path / ("z.csv" if kind == "table" else "z.npz")
    if kind == "trajectories":
        np.savez(path, trajectories=states[None], dt=0.1)
    elif kind == "pairs":
        np.savez(path, z0=states[:-1], z1=states[1:], dt=0.1)
    else:
        rows = np.column_stack([0.1 * np.arange(1_000), states])
        np.savetxt(path, rows, delimiter=",", header="t,q1,p1", comments="")
    whole = read_sample(path, group=group)
    assert whole.num_pairs == 999
    assert continued(whole) == 998
    some = read_sample(path, num_pairs=500, group=group)
    assert 450 <= some.num_pairs <= 500
    assert continued(some) >= some.num_pairs - 10  # arcs of 50
    known = {tuple(z) for z in read_trajectories(path).pairs().z0}
    assert {tuple(z) for z in some.pairs().z0} <= known


def test_runs_of_several_files_are_different_runs(tmp_path):
    states = np.random.default_rng(0).normal(size=(2, 4, 9, 2))
    for i in range(2):
        np.savez(tmp_path / f"{i}.npz", trajectories=states[i], dt=0.1)
    found = identified(read_sample([tmp_path / "0.npz", tmp_path / "1.npz"]).pairs()).pairs
    assert np.bincount(found.run).tolist() == [8] * 8
    assert steps_between(found).sum() == 8 * 7


def test_a_table_keeps_the_labels_of_its_sequences(tmp_path):
    text = "sequence,t,q1,p1\n" + "".join(
        f"{label},{k},{label + k},{k}\n" for label in (7, 3) for k in range(4)
    )
    (tmp_path / "z.csv").write_text(text)
    pairs = read_trajectories(tmp_path / "z.csv").pairs()
    assert pairs.run.tolist() == [7] * 3 + [3] * 3
    assert pairs.place.tolist() == [0, 1, 2] * 2


# The split


def test_single_pairs_are_split_at_random():
    states = np.random.default_rng(0).normal(size=(2, 400, 2))
    pairs = identified(gfnn.Pairs(*states, 0.4)).pairs
    split = split_rows(pairs, seed=3)
    assert [len(rows) for rows in split[:3]] == [320, 40, 40]
    assert np.array_equal(np.sort(np.concatenate(split[:3])), np.arange(400))
    assert np.ptp(split.test) > 300
    assert all(map(np.array_equal, split, split_rows(pairs, seed=3)))
    assert not np.array_equal(split.test, split_rows(pairs, seed=4).test)


@pytest.mark.parametrize("lengths", [(20,) * 30, (7, 1, 40, 3, 12) * 10])
def test_whole_runs_are_held_out(lengths):
    pairs = identified(in_rows(walks(*lengths))).pairs
    split = split_rows(pairs, seed=1)
    assert np.array_equal(np.sort(np.concatenate(split[:3])), np.arange(len(pairs)))
    runs = [set(pairs.run[rows]) for rows in split[:3]]
    assert not any(one & other for one, other in itertools.combinations(runs, 2))
    for rows in (split.validation, split.test):
        assert 0.05 * len(pairs) <= len(rows) < 0.2 * len(pairs)


@pytest.mark.parametrize("lengths", [(1_000,), (16,), (700, 5, 5), (300, 300)])
def test_of_long_runs_blocks_of_time_are_held_out(lengths):
    pairs = identified(in_rows(walks(*lengths))).pairs
    split = split_rows(pairs, seed=1)
    assert len(split.training) > 0.55 * len(pairs)
    states = [{tuple(z) for of in (pairs.z0, pairs.z1) for z in of[r]} for r in split[:3]]
    assert not any(one & other for one, other in itertools.combinations(states, 2))


def test_a_correlation_time_lies_between_blocks():
    t = np.arange(2_001) / 40.0  # a quarter of a period of 2π is 63 samples
    states = np.stack([np.cos(t), -np.sin(t)], axis=1)
    pairs = identified(in_rows([states])).pairs
    gap = correlation_time(pairs, np.ones(len(pairs) - 1, bool))
    assert gap == 12  # a sixteenth of what is held out: its blocks would be gone else
    split = split_rows(pairs, seed=0)
    for rows in (split.validation, split.test):
        assert np.abs(rows[:, None] - split.training).min() == gap + 1
    fast = identified(in_rows([np.stack([np.cos(30 * t), -np.sin(30 * t)], axis=1)])).pairs
    # cos(0.75 k) < 1/e from k = 2 on.
    assert correlation_time(fast, np.ones(len(fast) - 1, bool)) == 2


# The bound


@pytest.mark.parametrize(("pairs", "blocks"), [(6, 6), (40, 40), (400, 400), (200, 20)])
def test_the_bound_holds_nineteen_times_in_twenty(pairs, blocks):
    """Of normal errors in four coordinates; in blocks, a fifth of the variance is the block's."""
    rng, block, held = np.random.default_rng(0), np.arange(pairs) * blocks // pairs, 0
    for _ in range(1_000):
        error = rng.normal(size=(pairs, 4))
        if blocks < pairs:
            error = np.sqrt(0.8) * error + np.sqrt(0.2) * rng.normal(size=(blocks, 4))[block]
        held += bound_of_mean(np.mean(error**2, axis=1), block) >= 1
    assert 930 <= held <= 990  # the worst block counts twice


def test_the_bound_of_heavy_tails_counts_the_worst_three_times():
    """Of Student's t with four degrees of freedom, whose squares have no variance."""
    rng, held = np.random.default_rng(0), {2: 0, 3: 0}
    for _ in range(1_000):
        square = rng.standard_t(4, size=60) ** 2 / 2
        for worst in held:
            held[worst] += bound_of_mean(square, np.arange(60), worst) >= 1
    assert held[3] >= 930
    assert held[2] < held[3]


def test_a_bound_of_exact_and_of_too_few():
    assert bound_of_mean(np.full(5, 2.0), np.arange(5)) == 2.0
    assert bound_of_mean(np.ones(5), np.zeros(5, int)) == np.inf


# What is stated


def test_the_stated_error_is_of_pairs_that_chose_nothing():
    rng = np.random.default_rng(0)
    z = rng.uniform(-1, 1, (200, 2))
    pairs = gfnn.Pairs(z, rotated(z, 0.3) + 1e-3 * rng.normal(size=z.shape), 0.3)
    fit = gfnn.fit(pairs, tolerance=1e-2, learn="map")
    assert fit.stated_by == "20 pairs that took no part in the fit or its choices"
    few = gfnn.fit(pairs.take(slice(50)), tolerance=1e-2, learn="map")
    assert "cross-validation" in few.stated_by
    fresh = rng.uniform(-1, 1, (1_000, 2))
    image = rotated(fresh, 0.3) + 1e-3 * rng.normal(size=fresh.shape)
    for one in (fit, few):
        error = (np.asarray(one.map.step(fresh)[0]) - image) / np.std(z, axis=0)
        assert 0.5 < one.chosen.validation_relative / np.sqrt(np.mean(error**2)) < 2
        assert one.chosen.validation_bound > one.chosen.validation_relative


@pytest.mark.slow
def test_a_short_orbit_is_learned_though_a_single_stretch_validates():
    """45 pairs of a hardening spring: no bound is known where four rows in a row choose."""

    def moved(z):
        for _ in range(200):  # Störmer and Verlet: within 1e-6 of the flow
            p = z[..., 1] - 0.00075 * (z[..., 0] + z[..., 0] ** 3)
            q = z[..., 0] + 0.0015 * p
            z = np.stack([q, p - 0.00075 * (q + q**3)], axis=-1)
        return z

    orbit = [np.array([1.0, 0.0])]
    for _ in range(45):
        orbit.append(moved(orbit[-1]))
    z = np.array(orbit)
    pairs = gfnn.Pairs(z[:-1], z[1:], 0.3)
    split = split_rows(identified(pairs).pairs, 0)
    assert len(np.unique(split.stretch[split.validation])) == 1
    with pytest.warns(gfnn.FitWarning):
        fit = gfnn.fit(pairs, tolerance=1e-4, learn="map")
    error = np.asarray(fit.map.step(z)[0]) - moved(z)
    assert np.sqrt(np.mean(error**2)) < 2e-3
    assert "cross-validation" in fit.stated_by
    assert fit.chosen.validation_relative <= fit.chosen.validation_bound < np.inf


@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_the_error_of_few_runs_is_stated_by_all_of_them(scale):
    """Of ten runs on circles, of which the outermost errs most: whichever run tests, all count."""
    rng = np.random.default_rng(0)
    radius = np.append(np.full(9, 0.3), 0.3 * scale)
    angle = rng.uniform(0, 6, 10)[:, None] + 0.3 * np.arange(21)
    states = radius[:, None, None] * np.stack([np.cos(angle), -np.sin(angle)], axis=-1)
    states += 1e-3 * radius[:, None, None] ** 2 * rng.normal(size=states.shape)
    z0, z1 = (states[:, part].reshape(-1, 2) for part in (slice(-1), slice(1, None)))
    pairs = gfnn.Pairs(z0, z1, 0.3, run=np.repeat(np.arange(10), 20))
    fit = gfnn.fit(pairs, tolerance=1e-2, learn="map")
    assert fit.stated_by.startswith("200 pairs of 10 runs, each predicted by a fit without")
    # The noise of one run makes nearly all of the error, and only one of ten clusters has it.
    wide = fit.chosen.validation_bound / fit.chosen.validation_relative
    assert wide > 1.4 if scale > 1 else wide < 1.2


def test_noise_that_was_given_is_told_from_what_a_map_cannot_represent():
    rng = np.random.default_rng(0)
    z = rng.uniform(-1, 1, (400, 2))
    image = rotated(z, 0.3) + 1e-3 * rng.normal(size=z.shape)
    said = {}
    for std in (1e-3, 1e-4):
        # Of each coordinate, or of each value, half of them larger: the same mean square.
        each = std * np.sqrt([[0.5, 0.5], [1.5, 1.5]])[np.arange(400) % 2]
        pairs = gfnn.Pairs(z, image, 0.3, std=[std, std] if std == 1e-3 else each)
        with pytest.warns(gfnn.FitWarning):
            fit = gfnn.fit(pairs, tolerance=1e-6, learn="map", chart="midpoint")
        np.testing.assert_allclose(fit.noise, std, rtol=1e-12)
        said[std] = " ".join(fit.messages)
    assert "the residuals are the noise that was given" in said[1e-3]
    assert "std is too small" in said[1e-4]


# The data set


def dataset_of(pairs, coordinates=CARTESIAN):
    found, row = identified(pairs)
    return Dataset.of(found, coordinates, row=row).divided(0)


def test_rows_keep_their_identity_and_their_part():
    states = walks(*[20] * 12)
    order = np.random.default_rng(2).permutation(240)
    pairs = in_rows(states, run=np.repeat(np.arange(12), 20)).take(order)
    whole = dataset_of(pairs, Coordinates("rotor", angles=(0,)))
    rows = np.random.default_rng(3).choice(240, 150, replace=False)
    few = whole.take(rows)
    assert len(few) == 150
    np.testing.assert_array_equal(few.pairs.z1, np.asarray(pairs.z1)[few.row])
    np.testing.assert_array_equal(few.run, np.asarray(pairs.run)[few.row])
    np.testing.assert_array_equal(few.y0, whole.y0[rows])
    np.testing.assert_array_equal(few.scale, few.y0.std(axis=0))
    for part in ("training", "validation", "test"):
        kept = [r for r in whole.row[getattr(whole, part)] if r in set(few.row)]
        assert few.row[getattr(few, part)].tolist() == kept  # in their order


def test_what_is_factored_out_is_put_back():
    data = dataset_of(in_rows(walks(40)))
    turn = Affine(np.array([[0.0, 1.0], [-1.0, 0.0]]), np.array([0.1, 0.2]), np.zeros(2))
    rest = data.without(turn, turn)
    np.testing.assert_array_equal(rest.y0, turn.image(data.y0))
    np.testing.assert_allclose(
        rest.whole_image(rest.y1, np.arange(len(rest.y1))), data.y1, rtol=0, atol=1e-14
    )
    assert rest.pairs is data.pairs
    assert rest.split is data.split


def test_other_pairs_train_and_the_validation_rows_choose():
    data = dataset_of(in_rows(walks(*[5] * 40)))
    others = gfnn.Pairs(np.ones((7, 2)), np.ones((7, 2)), 0.4)
    both = data.validating(others)
    np.testing.assert_array_equal(both.pairs.z0[both.training], others.z0)
    np.testing.assert_array_equal(both.pairs.z1[both.validation], data.pairs.z1[data.validation])
    assert not len(both.test)


def test_each_row_has_its_dt_and_parameters():
    dt, length = np.array([0.1, 0.3, 0.2]), np.array([1.0, 2.0, 3.0])
    data = Dataset.of(gfnn.Pairs(np.eye(3, 2), np.eye(3, 2), dt, {"l": length}), CARTESIAN)
    assert (data.dt, data.parameters, data.varied) == (0.2, ("l",), True)
    few = data.take(np.array([2, 0]))
    np.testing.assert_array_equal(few.given(np.array([1]))[0], [0.1])
    np.testing.assert_array_equal(few.args, [[3.0], [1.0]])


def test_noise_of_each_value_stays_with_its_row():
    std = np.arange(1.0, 25.0).reshape(12, 2)
    order = np.random.default_rng(0).permutation(12)
    run = np.repeat([0, 1], 6)
    data = dataset_of(in_rows(walks(6, 6), run=run, std=std).take(order))
    np.testing.assert_array_equal(data.noise, std)  # sorted by runs again
    few = data.take(np.array([3, 8]))
    np.testing.assert_array_equal(few.noise, std[[3, 8]])
    np.testing.assert_allclose(few.noise_of_channels, np.sqrt(np.mean(std[[3, 8]] ** 2, axis=0)))


def test_errors_that_few_states_make_are_told():
    """Those of a tail without a variance, and not those of noise; nor where they do not matter."""
    rng, tolerance = np.random.default_rng(0), Tolerance(1e-6)
    normal = np.abs(1e-4 * rng.normal(size=400))
    heavy = 1e-5 * rng.pareto(0.5, 400)
    assert of_few(normal, tolerance) == ""
    told = of_few(heavy, tolerance)
    limit = float(re.search(r"less than (\S+) of the spread", told)[1])
    assert np.mean(1e-5 * rng.pareto(0.5, 100_000) > limit) < 0.1
    assert of_few(1e-13 * heavy, tolerance) == ""
