"""Maps that are learned from positions alone: discrete Lagrangians and the maps they generate."""

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn
from gfnn_jax import cli
from gfnn_jax.coordinates import Coordinates, nearest_image
from gfnn_jax.data.recording import Recording
from gfnn_jax.dataset.structures import structure_of
from gfnn_jax.errors import InputError
from gfnn_jax.evaluate.gauge import beside_flow
from gfnn_jax.families.displacements import OfDisplacement
from gfnn_jax.families.inputs import box_inputs, variable_signs
from gfnn_jax.families.products import Products
from gfnn_jax.models.positions.discrete_lagrangian import Triples, residuals, solve, triples_of
from gfnn_jax.models.positions.latent_positions import arcs_of, fit_latent, starting_noise

K = 0.6


def turns(number, steps, seed):
    """θ (number, steps + 1, 1) of standard maps, lifted: what one monitor reads turn by turn."""
    theta, p = np.random.default_rng(seed).uniform(0, 2 * np.pi, (2, number))
    read = [theta]
    for _ in range(steps):
        p = p + K * np.sin(theta)
        theta = theta + p
        read.append(theta)
    return np.stack(read, axis=1)[..., None]


def recorded(q, names, angles=(), dt=1.0):
    """Positions (runs, steps, d) as a recording."""
    runs, steps, _ = q.shape
    table = {"run": np.repeat(np.arange(runs), steps), "t": np.tile(dt * np.arange(steps), runs)}
    return Recording(
        table | {name: q[..., i].ravel() for i, name in enumerate(names)},
        positions=names,
        angles=angles,
    )


@pytest.fixture(scope="module")
def lifted():
    recording = recorded(turns(600, 2, 0), ["theta"], ["theta"])
    return gfnn.fit(recording, learn="map", tolerance=1e-12)


@pytest.fixture(scope="module")
def wrapped():
    recording = recorded(np.mod(turns(2_000, 2, 0), 2 * np.pi), ["theta"], ["theta"])
    return gfnn.fit(recording, learn="map", tolerance=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["lifted", "wrapped"])
def test_the_standard_map_from_its_angle_alone(kind, request):
    learned = request.getfixturevalue(kind)
    assert learned.met
    assert learned.positions.symmetric
    read = turns(100, 100, 1)
    given = read if kind == "lifted" else np.mod(read, 2 * np.pi)
    states, _ = learned.map.rollout(positions=(given[:, 0], given[:, 1]), num_steps=100)
    error = np.abs(nearest_image(np.asarray(states)[..., :1] - read, (0,)))[..., 0]
    assert error[:, 2].max() < 1e-12
    assert np.median(error[:, 100]) < 1e-11
    if kind == "lifted":
        assert learned.symplecticity_defect < 1e-14


@pytest.mark.slow
def test_a_lift_is_trusted(lifted):
    """Rollouts of lifted readings go on with their turns."""
    read = turns(50, 10, 2)
    states, _ = lifted.map.rollout(positions=(read[:, 0], read[:, 1]), num_steps=10)
    assert np.abs(np.asarray(states)[:, 1:3, :1] - read[:, 1:3]).max() < 1e-11


@pytest.mark.slow
def test_momenta_are_the_maps_own(lifted):
    """Of S = ½ (Q − q)² + ½ K (cos q + cos Q): p is the move less half a kick."""
    read = turns(50, 1, 3)
    q, other = read[:, 0], read[:, 1]
    z = np.asarray(lifted.map.from_positions(q, other))
    assert np.array_equal(z[:, :1], q)
    assert np.abs(z[:, 1:] - (other - q - 0.5 * K * np.sin(q))).max() < 1e-11
    one = np.asarray(lifted.map.from_positions(q[0], other[0]))
    assert np.array_equal(one, z[0])


def henon_heiles(number, steps, seed):
    """x, y (number, steps + 1, 2) below E = 1/12 at dt 0.5."""
    return flow_of_henon_heiles(number, steps, seed)[..., :2]


def flow_of_henon_heiles(number, steps, seed):
    """z = (q, p) (number, steps + 1, 4) of the same."""
    rng, starts = np.random.default_rng(seed), []
    while len(starts) < number:
        q, energy, angle = rng.uniform(-0.5, 0.5, 2), rng.uniform(0, 1 / 12), rng.uniform(0, 7)
        left = energy - (0.5 * q @ q + q[0] ** 2 * q[1] - q[1] ** 3 / 3)
        if left > 0:
            speed = np.sqrt(2 * left)
            starts.append([*q, speed * np.cos(angle), speed * np.sin(angle)])

    def field(_, z):
        x, y, px, py = z.reshape(4, -1)
        return np.concatenate([px, py, -x - 2 * x * y, -y - x**2 + y**2])

    begun, t = np.array(starts).T.ravel(), 0.5 * np.arange(steps + 1)
    solution = solve_ivp(field, (0, 0.5 * steps), begun, "DOP853", t, rtol=1e-13, atol=1e-15)
    return solution.y.reshape(4, number, -1).transpose(1, 2, 0)


@pytest.mark.slow
def test_where_a_flow_exists_the_map_is_the_flow_but_for_a_factor_of_momenta():
    """A symmetric S leaves no f(Q) − f(q); the kicks of half a step make c unlike 1."""
    recording = recorded(henon_heiles(1_200, 2, 0), ["x", "y"], dt=0.5)
    learned = gfnn.fit(recording, learn="map", tolerance=1e-6)
    assert learned.met
    z = flow_of_henon_heiles(200, 1, 1)
    found = beside_flow(learned.map, gfnn.Pairs(z[:, 0], z[:, 1], 0.5))
    assert max(found.momenta, found.positions, found.images) < 1e-5
    assert found.gauge < 1e-5
    assert 0.001 < abs(found.factor - 1) < 0.1
    off = dataclasses.replace(learned.map.pieces[0], params=1.01 * learned.map.pieces[0].params)
    other = dataclasses.replace(learned.map, pieces=(off,))  # S → cS: the factor, nothing else
    scaled = beside_flow(other, gfnn.Pairs(z[:, 0], z[:, 1], 0.5))
    assert abs(scaled.factor / found.factor - 1.01) < 1e-9
    assert scaled.images < 1e-5


def ring(number, steps, dim, seed):
    """θ of Froeschlé's rings (number, steps + 1, dim), wrapped."""
    q, p = np.random.default_rng(seed).uniform(-np.pi, np.pi, (2, number, dim))
    read = [q]
    for _ in range(steps):
        bond = 0.1 * np.sin(np.roll(q, -1, axis=1) - q)
        p = p + 0.5 * np.sin(q) + bond - np.roll(bond, 1, axis=1)
        q = q + p
        read.append(q)
    return np.mod(np.stack(read, axis=1), 2 * np.pi)


@pytest.mark.slow
def test_a_ring_of_64_that_is_told_to_be_one():
    names = [f"theta{i}" for i in range(1, 65)]
    recording = recorded(ring(200, 2, 64, 0), names, names)
    learned = gfnn.fit(recording, learn="map", structure="ring", tolerance=1e-10)
    assert learned.met
    read = ring(20, 2, 64, 1)
    states, _ = learned.map.rollout(positions=(read[:, 0], read[:, 1]), num_steps=2)
    error = nearest_image(np.asarray(states)[:, 2, :64] - read[:, 2], tuple(range(64)))
    assert np.sqrt(np.mean(error**2)) < 1e-10


@pytest.mark.slow
def test_a_map_that_is_not_reversible_needs_an_s_without_symmetry():
    """S = ½ (Q − q)² + V(q) + 0.1 (Q − q)³, whose kicks differ from those of its inverse."""
    rng = np.random.default_rng(0)

    def next_of(q, other):
        """−(x + 0.3 x²) = (d + 0.3 d²) … solved for the move x from ``other``."""
        d = other - q
        momentum = d + 0.3 * d**2 - 0.2 * other
        return other + (np.sqrt(1 + 1.2 * momentum) - 1) / 0.6

    q, move = rng.uniform(-0.5, 0.5, (2, 600, 1))
    read = [q, q + 0.5 * move]
    read.append(next_of(*read[-2:]))
    recording = recorded(np.stack(read, axis=1), ["x"])
    learned = gfnn.fit(recording, learn="map", tolerance=1e-12)
    assert learned.met
    assert not learned.positions.symmetric


# What positions leave open


def test_s_is_fixed_by_its_mixed_term_and_nearest_to_free_motion():
    """Two oscillators without coupling: the ratio of their factors is open too, and is 1."""
    rates, dt = np.array([1.0, 1.7]), 0.4
    phase = np.random.default_rng(0).uniform(0, 2 * np.pi, (400, 1, 2))
    size = np.random.default_rng(1).uniform(0.1, 1.0, (400, 1, 2))
    read = size * np.cos(phase + rates * dt * np.arange(3)[:, None])
    triples = triples_of(recorded(read, ["x", "y"], dt=dt))
    box = np.random.default_rng(2).uniform(-1, 1, (100, 4))
    inputs = box_inputs(box, reversor=(1, 1, -1, -1))
    family = OfDisplacement(Products(inputs, 2), 0.5)
    solved = solve(family, triples)
    params = family.unflatten(solved.coefficients)
    assert np.abs(residuals(family, params, triples)).max() < 1e-13
    assert solved.rank < family.num_parameters - 4
    hessian = family.gradient_and_hessian(params, triples.ends[:1])[1][0]
    mixed = -(dt**2) * hessian[:2, 2:]
    move = np.mean(triples.moves**2, axis=0)
    assert abs(np.sum(mixed.diagonal() * move) / move.sum() - 1) < 1e-9
    assert np.abs(mixed - np.diag(mixed.diagonal())).max() < 1e-9
    # The terms hold Q² − q² = 2 m (Q − q), which no triple tells: without it S is symmetric.
    values = [family.value(params, w) for w in (triples.ends, np.roll(triples.ends, 2, axis=1))]
    assert np.abs(values[0] - values[1]).max() < 1e-12


def test_the_family_of_displacements_is_differentiated_right():
    rng = np.random.default_rng(0)
    w = rng.uniform(-1, 1, (20, 4))
    for part, both in ((0.0, False), (0.0, True), (0.5, True), (0.5, False)):
        family = OfDisplacement(Products(box_inputs(rng.uniform(-2, 2, (50, 4))), 4), part, both)
        params = family.unflatten(rng.normal(size=family.num_parameters))
        gradient, hessian = family.gradient_and_hessian(params, w)
        assert np.array_equal(gradient, family.gradient(params, w))
        for i, off in enumerate(1e-6 * np.eye(4)):
            slope = (family.value(params, w + off) - family.value(params, w - off)) / 2e-6
            np.testing.assert_allclose(slope, gradient[:, i], atol=1e-6)
            bend = family.gradient(params, w + off) - family.gradient(params, w - off)
            np.testing.assert_allclose(bend / 2e-6, hessian[:, i], atol=1e-5)
        turned = np.roll(w, 2, axis=1)
        if both:
            assert np.array_equal(family.value(params, w), family.value(params, turned))


# Noise of readings


def noisy(q, noise, seed):
    return q + noise * np.random.default_rng(seed).normal(size=q.shape)


def test_latent_positions_take_the_bias_of_noise_away():
    """Hénon–Heiles, of equal masses, from runs whose noise is 1e-3: least squares of the same terms
    finds masses that differ by some four per cent."""
    read = noisy(henon_heiles(200, 16, 0), 1e-3, 2)
    triples = triples_of(recorded(read, ["x", "y"], dt=0.5))
    middle, moves = 0.5 * (triples.ends[:, :2] + triples.ends[:, 2:]), triples.moves
    x, turned = np.concatenate([middle, moves], axis=1), (1, 1, -1, -1)
    inputs = box_inputs(x, reversor=turned)
    family = OfDisplacement(Products(inputs, 4, variable_signs(inputs, turned, x)), 0.5)
    solved = solve(family, triples)
    sigma = starting_noise(family, solved.coefficients, triples)
    found = fit_latent(family, solved, triples, sigma, arcs_of(triples))

    def ratio(coefficients):
        params = family.unflatten(coefficients)
        hessian = family.gradient_and_hessian(params, np.zeros((1, 4)))[1][0]
        return hessian[0, 2] / hessian[1, 3]

    steps = 1e-5 * np.eye(len(found.coefficients))
    slope = [ratio(found.coefficients + s) - ratio(found.coefficients - s) for s in steps]
    std = np.linalg.norm(found.root @ np.array(slope)) / 2e-5
    assert found.converged
    assert np.abs(found.sigma / 1e-3 - 1).max() < 0.05
    assert abs(ratio(solved.coefficients) - 1) > 0.02
    assert abs(ratio(found.coefficients) - 1) < 3 * std < 0.01


@pytest.fixture(scope="module")
def of_noisy():
    read = noisy(turns(150, 12, 0), 1e-3, 50)
    return gfnn.fit(recorded(read, ["theta"], ["theta"]), learn="map", tolerance=1e-2)


@pytest.mark.slow
def test_bands_of_forecasts_hold(of_noisy):
    """Of what is read, and, without the noise of a reading, of what is true."""
    (sigma,) = of_noisy.positions.noise
    assert abs(sigma / 1e-3 - 1) < 0.1
    true = turns(300, 30, 1)
    read, ahead = noisy(true, 1e-3, 51), np.array([1, 5, 20])
    found = of_noisy.map.forecast(recorded(read[:, :11], ["theta"], ["theta"]), 10.0 + ahead)
    std = found.std["theta"]
    off = found.values["theta"] - read[:, 10 + ahead, 0]
    assert ((np.abs(off) < 2 * std).mean(axis=0) > 0.9).all()
    off = np.abs(found.values["theta"] - true[:, 10 + ahead, 0])
    inside = (off < 2 * np.sqrt(std**2 - sigma**2)).mean(axis=0)
    assert ((inside > 0.9) & (inside < 0.99)).all()
    assert np.median(off[:, 0]) < 0.6e-3  # a reading's own error is 0.67e-3 in the median


@pytest.mark.slow
def test_forecasts_of_wrapped_readings_go_on_over_whole_turns(of_noisy):
    """Moves of a kicked map reach beyond half a turn: each reading is lifted to where S leads."""
    read = noisy(np.mod(turns(150, 12, 0), 2 * np.pi), 1e-3, 50)
    learned = gfnn.fit(recorded(read, ["theta"], ["theta"]), learn="map", tolerance=1e-2)
    true = turns(200, 14, 1)
    begun = noisy(np.mod(true[:, :11], 2 * np.pi), 1e-3, 51)
    found = learned.map.forecast(recorded(begun, ["theta"], ["theta"]), 10.0 + np.array([1, 2, 4]))
    off = nearest_image(found.values["theta"] - true[:, [11, 12, 14], 0], (0, 1, 2))
    own = np.sqrt(found.std["theta"] ** 2 - learned.positions.noise[0] ** 2)
    assert ((np.abs(off) < 2 * own).mean(axis=0) > 0.9).all()
    assert np.median(np.abs(off[:, 0])) < 1e-3


@pytest.mark.slow
def test_latent_positions_of_a_ring_of_equal_sites():
    """The coupling of a ring of six from noisy angles, given that it is a ring."""
    names = [f"theta{i}" for i in range(1, 7)]
    recording = recorded(noisy(ring(60, 12, 6, 0), 1e-3, 5), names, names)
    triples = triples_of(recording, sites=True)
    sites = structure_of("ring", 6, Coordinates("positions", triples.angles))
    family = OfDisplacement(next(iter(sites.libraries(6))), 0.0, True)
    solved = solve(family, triples)
    sigma = starting_noise(family, solved.coefficients, triples)
    found = fit_latent(family, solved, triples, sigma, arcs_of(triples))
    assert found.converged
    assert np.abs(found.sigma / 1e-3 - 1).max() < 0.15
    coupling = family.family.term_names.index("cos(q_{i+1} - q_i)")
    std = np.linalg.norm(found.root[:, coupling])
    assert abs(found.coefficients[coupling] - 0.1) < 3 * std < 1e-3


@pytest.mark.slow
def test_a_state_is_estimated_from_all_readings_before_it(of_noisy):
    true = turns(300, 10, 1)
    recording = recorded(noisy(true, 1e-3, 51), ["theta"], ["theta"])
    z, covariance = of_noisy.map.estimate(recording)
    off = np.abs(z[:, 0] - true[:, 10, 0]) / np.sqrt(covariance[:, 0, 0])
    assert 0.9 < (off < 2).mean() < 0.99
    with pytest.raises(InputError, match="whole steps of 1 s"):
        of_noisy.map.forecast(recording, 10.5)


@pytest.mark.slow
def test_samples_start_from_the_same_two_positions(of_noisy):
    """Each with the momentum of its own S; their spread is that of the coefficients."""
    read = turns(5, 8, 3)
    positions = read[:, 0], read[:, 1]
    options = {"num_steps": 8, "samples": 50, "key": jax.random.key(0)}
    states, info = of_noisy.map.rollout(positions=positions, **options)
    std = np.asarray(info.bands.std)[..., 0]
    assert std[:, 1].max() < 1e-12  # the second position is given
    assert (std[:, 8] > 1e-6).all()
    off = np.abs(np.asarray(states)[..., 0] - read[..., 0])[:, 2:]
    assert (off < 4 * std[:, 2:]).mean() > 0.9


# The command line


@pytest.mark.slow
def test_positions_in_a_file_are_fitted_and_continued(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    def written(name, read):
        runs, steps = read.shape[:2]
        rows = np.column_stack(
            [np.repeat(np.arange(runs), steps), np.tile(np.arange(steps), runs), read.ravel()]
        )
        np.savetxt(name, rows, delimiter=",", header="run,t,theta", comments="", fmt="%.17g")

    read = np.mod(turns(300, 7, 5), 2 * np.pi)[..., 0]
    written("turns.csv", turns(500, 2, 0)[..., 0] % (2 * np.pi))
    written("begun.csv", read[:20, :4])
    said = ["fit", "turns.csv", "--positions", "theta", "--angles", "theta", "--out", "model"]
    assert cli.main([*said, "--learn", "hamiltonian"]) == 2
    assert "not options of a recording" in capsys.readouterr().err
    assert cli.main([*said, "--learn", "map", "--tolerance", "1e-12"]) == 0
    report = json.loads(Path("model/report.json").read_text())
    assert report["model"]["chart"] == "type1"
    assert report["fit"]["tolerance_met"]
    assert report["map"]["positions"]["symmetric"]
    go_on = ["predict", "model", "--initial", "begun.csv", "--num-steps", "4", "--out", "on.npz"]
    assert cli.main(go_on) == 0
    ahead = np.load("on.npz")["trajectories"][..., 0]
    assert np.abs(nearest_image(ahead - read[:20, 3:], tuple(range(5)))).max() < 1e-11


# What is refused, in a line


def test_what_no_map_can_be_learned_from_is_refused():
    read = turns(4, 2, 0)
    with pytest.raises(gfnn.FitError, match="got 4"):
        gfnn.fit(recorded(read, ["x"]), learn="map")
    with pytest.raises(gfnn.FitError, match="three rows in succession"):
        gfnn.fit(recorded(read[:, :2], ["x"]), learn="map")
    uneven = Recording({"t": [0.0, 1.0, 2.5, 3.0, 4.0], "x": np.arange(5.0)}, positions=["x"])
    with pytest.raises(gfnn.FitError, match="even times"):
        gfnn.fit(uneven, learn="map")


def test_missing_readings_break_a_run():
    read = turns(3, 6, 0)[..., 0]
    read[1, 3] = np.nan
    triples = triples_of(recorded(read[..., None], ["x"]))
    assert isinstance(triples, Triples)
    assert len(triples) == 5 + 2 + 5
    assert np.bincount(triples.run).tolist() == [5, 2, 5]
