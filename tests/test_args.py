"""Arguments of a step beside the state: its own dt, and parameters of the system."""

import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from analytic import standard_map

import gfnn_jax as gfnn
from gfnn_jax import cli
from gfnn_jax.data.files import read_trajectories
from gfnn_jax.dataset.varied import as_varied
from gfnn_jax.families.terms import Terms, given_terms
from gfnn_jax.flows.collocation import Steps, images
from gfnn_jax.models.parameters import functions_of_parameters, walked

LENGTH = given_terms(1, ["p**2/(2*l**2) - 9.81*l*cos(q)"], ("l",))
FINE = Steps(8, 4)


def pendulums(count, seed=0):
    """States, lengths and times of pendulums."""
    rng = np.random.default_rng(seed)
    length, dt = rng.uniform(0.5, 2, count), rng.uniform(0.02, 0.1, count)
    z = np.stack([rng.uniform(-2, 2, count), length**2 * rng.uniform(-2, 2, count)], axis=1)
    return z, length, dt


def image(z, length, dt):
    return images(LENGTH, np.ones(1), z, dt, FINE, args=length[:, None]).states


@pytest.fixture(scope="module")
def learned():
    z, length, dt = pendulums(400)
    pairs = gfnn.Pairs(z, image(z, length, dt), dt, {"l": length})
    return gfnn.fit(pairs, angles=(0,), tolerance=1e-11)


# The arithmetic.


def test_terms_of_parameters_have_the_gradients_of_jax():
    texts = ["p1**2/l**2", "l*cos(q1)", "T7(0.5*log(l) - 0.1)*q1*p1", "T3(q1)*l"]
    family = given_terms(1, texts, ("l",))
    rng = np.random.default_rng(0)
    c, z, args = rng.normal(size=4), rng.normal(size=(5, 2)), rng.uniform(0.5, 2, (5, 1))

    def by_hand(z, a):
        x = 0.5 * jnp.log(a) - 0.1
        t7 = 64 * x**7 - 112 * x**5 + 56 * x**3 - 7 * x
        values = [z[1] ** 2 / a**2, a * jnp.cos(z[0]), t7 * z[0] * z[1]]
        values.append((4 * z[0] ** 3 - 3 * z[0]) * a)
        return sum(x * v for x, v in zip(c, values, strict=True))

    gradient, hessian = jax.jit(
        lambda z, a: (jax.vmap(jax.grad(by_hand))(z, a), jax.vmap(jax.hessian(by_hand))(z, a))
    )(z, args[:, 0])
    found = family.gradient_and_hessian(c, z, args)
    np.testing.assert_allclose(found[0], gradient, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(found[1], hessian, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(family.term_gradients(z, args) @ c, gradient, rtol=1e-12, atol=1e-13)
    # A parameter is no coordinate of the state: stages have one more axis than lanes.
    stages = family.gradient(c, np.stack([z, z + 1]), args)
    np.testing.assert_allclose(stages[1], family.gradient(c, z + 1, args), rtol=1e-14)


def test_images_of_lanes_are_those_of_each_lane_alone():
    """Newton's lanes too: at the longest dt the fixed point does not contract."""
    z, length, _ = pendulums(6)
    dt, c = np.array([0.01, 0.3, 0.9, 0.05, 1.5, 0.2]), np.ones(1)
    together = images(LENGTH, c, z, dt, Steps(4, 1), args=length[:, None], derivatives=True)
    for i in range(len(z)):
        own = {"args": length[i : i + 1, None], "derivatives": True}
        alone = images(LENGTH, c, z[i : i + 1], float(dt[i]), Steps(4, 1), **own)
        for found, expected in zip(together, alone, strict=True):
            np.testing.assert_allclose(found[i], expected[0], rtol=1e-11, atol=1e-12)


# Irregular sampling.


@pytest.mark.slow
def test_irregular_sampling_serves_any_dt():
    law = given_terms(1, ["p**2/2 + q**2/2 + q**4/4"])
    rng = np.random.default_rng(0)
    z0, dt = rng.uniform(-1, 1, (150, 2)), rng.uniform(0.1, 1.2, 150)
    z1 = images(law, np.ones(1), z0, dt, FINE).states
    fit = gfnn.fit(gfnn.Pairs(z0, z1, dt), tolerance=1e-11)
    assert fit.chosen.validation_relative < 1e-13  # by steps, each pair's at its own dt
    assert float(fit.map.dt) == np.median(dt)
    found, info = fit.map.step(z0, dt=3.0)  # beyond what was sampled: more substeps
    expected = images(law, np.ones(1), z0, 3.0, Steps(8, 16)).states
    np.testing.assert_allclose(found, expected, atol=1e-12)
    assert not info.status.any()


def test_a_gap_in_uniform_data_costs_a_pair_and_not_the_map():
    z = np.random.default_rng(0).normal(size=(50, 2))
    dt = np.where(np.arange(50) == 7, 0.3, 0.1)
    options = {"learn": "auto", "family": "auto", "chart": "auto", "base": None}
    pairs, learn, messages = as_varied(gfnn.Pairs(z, z, dt), **options)
    assert (len(pairs), pairs.dt, learn) == (49, pytest.approx(0.1), "auto")
    assert "1 of 50 pairs are not dt = 0.1 apart" in messages[0]
    pairs, *_ = as_varied(gfnn.Pairs(z, z, dt), **{**options, "learn": "hamiltonian"})
    assert len(pairs) == 50


# Parameters.


@pytest.mark.slow
def test_a_law_is_read_with_its_parameter(learned):
    assert len(learned.hamiltonian.terms) == 2
    terms = {t.term: t.coefficient for t in learned.hamiltonian.terms}
    assert terms == pytest.approx({"cos(q1) l": -9.81, "p1² (1/l)²": 0.5}, rel=1e-12)
    z, length, _ = pendulums(50, seed=1)
    found, _ = learned.map.step(z, {"l": length}, dt=0.05)
    np.testing.assert_allclose(found, image(z, length, 0.05), atol=1e-13)
    assert learned.symplecticity_defect < 1e-13


def test_a_dependence_that_is_no_power_is_a_series():
    """1/(l + 0.3)² in Chebyshev polynomials of log l; no flow is compiled."""
    law = given_terms(1, ["p**2/(2*(l + 0.3)**2) + 5*q**2"], ("l",))
    z, length, _ = pendulums(800)
    args = length[:, None]
    gradient = law.gradient(np.ones(1), z, args)
    base = given_terms(1, ["p**2", "q**2"], ("l",))
    tried = []

    def attempt(family):
        tried.append(family.num_parameters)
        terms = family.term_gradients(z, args).reshape(-1, family.num_parameters)
        c, *_ = np.linalg.lstsq(terms, gradient.ravel(), rcond=1e-14)
        return np.abs(terms @ c - gradient.ravel()).max()

    rows = functions_of_parameters(1, ("l",), args, own=False)
    errors = list(walked([base], rows, attempt, float, bound=1e-10, most=100))
    assert errors[-1] < 1e-10
    assert errors[0] > 1e-3  # powers do not serve
    assert tried[-1] <= 42


@pytest.mark.slow
def test_auto_finds_a_law_of_many_functions_of_a_parameter():
    """The series needs a library of more than the sixty terms that a law beside a map may have."""
    law = given_terms(1, ["p**2/(2*(0.3 + l**2)) - 9.81*(0.2 + l)*cos(q)"], ("l",))
    rng = np.random.default_rng(0)
    length = rng.uniform(0.5, 2, 1_000)
    z = np.stack([rng.uniform(-2, 2, 1_000), length**2 * rng.uniform(-2, 2, 1_000)], axis=1)
    steps = images(law, np.ones(1), z, np.full(1_000, 0.05), FINE, args=length[:, None])
    pairs = gfnn.Pairs(z, steps.states, 0.05, {"l": length})
    fit = gfnn.fit(pairs, angles=(0,), tolerance=1e-8)
    assert fit.chosen.learns == "hamiltonian"
    assert fit.chosen.validation_bound <= 1e-8


@pytest.mark.slow
def test_noise_hides_no_law_with_a_parameter():
    """Powers of a parameter from −2 to 2 stand in for one another where there is noise."""
    rng = np.random.default_rng(22)
    z, k, dt = rng.uniform(-1, 1, (1_000, 2)), rng.uniform(0.5, 2.0, 1_000), 0.2
    law = given_terms(1, ["p1**2/2 - k*cos(q1)"], ("k",))
    later = images(law, np.ones(1), z, dt, FINE, args=k[:, None]).states
    z0, z1 = (x + 1e-3 * rng.normal(size=x.shape) for x in (z, later))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fit = gfnn.fit(gfnn.Pairs(z0, z1, dt, {"k": k}), angles=(0,), learn="hamiltonian")
    piece = fit.map.pieces[fit.map.posterior.piece]
    assert set(piece.family.term_names) == {"cos(q1) k", "p1²"}
    root = fit.map.posterior.root
    true = [{"cos(q1) k": -1.0, "p1²": 0.5}[name] for name in piece.family.term_names]
    off = (np.asarray(piece.params) - true) / np.linalg.norm(root, axis=0)
    assert np.abs(off).max() < 4


@pytest.mark.slow
def test_a_map_without_a_flow_has_parameters_too():
    rng = np.random.default_rng(0)
    z, strength = rng.uniform(0, 2 * np.pi, (500, 2)), rng.uniform(0.5, 2, 500)
    pairs = gfnn.Pairs(z, np.mod(standard_map(z, strength), 2 * np.pi), 1.0, {"k": strength})
    fit = gfnn.fit(pairs, angles=(0, 1), tolerance=1e-12)
    assert fit.chosen.learns == "map"
    assert set(fit.map.pieces[0].family.term_names) == {"p1²", "cos(q1) k"}
    z, strength = rng.uniform(0, 2 * np.pi, (50, 2)), rng.uniform(0.5, 2, 50)
    found, _ = fit.map.step(z, {"k": strength}, dt=1.0)  # its own dt
    error = np.asarray(found) - standard_map(z, strength)
    assert np.abs(error - 2 * np.pi * np.round(error / (2 * np.pi))).max() < 1e-13
    with pytest.raises(ValueError, match="this is a map of dt = 1 only"):
        fit.map.step(z, {"k": strength}, dt=0.5)


def test_parameters_outside_the_data_are_a_status_of_their_lane(learned):
    z, _, _ = pendulums(3, seed=3)
    length = np.array([1.0, 2.5, 1.5])
    _, info = learned.map.step(0.1 * z, {"l": length})
    assert info.status.tolist() == [0, 1, 0]
    _, info = learned.map.rollout(0.1 * z, 5, params={"l": length}, stop_outside=True)
    assert info.status.tolist() == [0, 2, 0]
    assert info.left_at.tolist() == [-1, 0, -1]


@pytest.mark.slow
def test_a_length_is_found_from_an_orbit(learned):
    """Gauss–Newton on one number, by `jax.grad` through a rollout."""
    start, true = np.array([[0.5, 0.2]]), np.array([1.3])
    orbit = start
    for _ in range(20):
        orbit = image(orbit, true, 0.05)

    def missed(length):
        return learned.map.rollout(start[0], 20, params=length, dt=0.05)[0][-1, 0] - orbit[0, 0]

    value_and_slope = jax.jit(jax.value_and_grad(missed))
    length = jnp.array([1.1])
    for _ in range(6):
        value, slope = value_and_slope(length)
        length = length - value / slope
    assert abs(float(length[0]) - 1.3) < 1e-12


def test_a_saved_map_knows_its_parameters(learned, tmp_path):
    learned.map.save(tmp_path / "m")
    map_ = gfnn.load(tmp_path / "m").map
    assert map_.parameters.names == ("l",)
    z, length, _ = pendulums(3)
    for one, other in zip(map_.step(z, length), learned.map.step(z, length), strict=True):
        np.testing.assert_array_equal(jax.tree.leaves(one)[0], jax.tree.leaves(other)[0])
    assert map_.hamiltonian(z[0], {"l": 1.5}) == pytest.approx(
        float(LENGTH.value(np.ones(1), z[0], np.array([1.5]))), rel=1e-12
    )


# A series in the state and a parameter.


def turned(z, delta):
    """A kick and a rotation that both depend on δ: the fixed point moves with it too."""
    (q, p), angle = z.T, 2.2 * (1 + delta)
    p = p - (1 - delta) * 0.3 * q**2 + 0.1 * delta
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * q + s * p, c * p - s * q], axis=1)


@pytest.fixture(scope="module")
def series():
    rng = np.random.default_rng(5)
    z, delta = rng.uniform(-0.5, 0.5, (900, 2)), rng.uniform(-0.1, 0.1, 900)
    pairs = gfnn.Pairs(z, turned(z, delta), 1.0, {"delta": delta})
    return gfnn.fit(pairs, family="polynomial", tolerance=1e-7)


@pytest.mark.slow
def test_a_series_in_state_and_parameter_steps_other_ones(series):
    assert series.met
    assert series.base_map  # an angle of 2.2
    rng = np.random.default_rng(6)
    z, delta = rng.uniform(-0.45, 0.45, (200, 2)), rng.uniform(-0.1, 0.1, 200)
    image, info = series.map.step(z, {"delta": delta})
    assert np.sqrt(np.mean((image - turned(z, delta)) ** 2)) < 1e-7
    assert np.max(info.iterations) <= 2  # the predictor knows δ
    assert series.symplecticity_defect < 1e-14
    back, _ = series.map.inverse(image, {"delta": delta})
    np.testing.assert_allclose(back, z, rtol=0, atol=1e-13)
    outside = series.map.rollout(z[:2], 1, params={"delta": np.array([0.0, 0.2])})[1]
    np.testing.assert_array_equal(outside.status, [0, 1])


@pytest.mark.slow
def test_a_series_is_differentiated_in_its_parameter(series):
    z, h = np.array([0.2, -0.1]), 1e-5

    def step(delta):
        return series.map.step(z, {"delta": delta})[0]

    exact = (turned(z[None], 0.03 + h) - turned(z[None], 0.03 - h))[0] / (2 * h)
    np.testing.assert_allclose(jax.jacfwd(step)(0.03), exact, rtol=0, atol=1e-5)


@pytest.mark.slow
def test_a_series_with_a_parameter_is_saved_and_put_in_a_row(series, tmp_path):
    z, delta = np.array([[0.2, -0.1], [0.1, 0.3]]), {"delta": np.array([0.05, -0.02])}
    series.map.save(tmp_path / "model")
    again = gfnn.load(tmp_path / "model").map
    image = series.map.step(z, delta)[0]
    np.testing.assert_array_equal(again.step(z, delta)[0], image)
    twice = again.then(again).step(z, delta)[0]
    np.testing.assert_allclose(twice, series.map.step(image, delta)[0], rtol=0, atol=1e-14)


# What is refused.


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"m": 1.0}, "expected params l; got m"),
        (np.ones((4, 2)), "of shape (1,) or (3, 1), got (4, 2)"),
    ],
)
def test_params_that_are_not_the_maps(learned, given, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        learned.map.step(np.zeros((3, 2)), given)


def test_a_dt_that_a_map_does_not_serve(learned):
    for dt in (0.0, -1.0, np.nan, "long"):
        with pytest.raises(ValueError, match="finite and above 0"):
            learned.map.step(np.zeros(2), {"l": 1.0}, dt=dt)
    with pytest.raises(ValueError, match="time step"):
        learned.map.step(np.zeros((3, 2)), {"l": 1.0}, dt=np.ones(2))


Z = np.random.default_rng(0).normal(size=(40, 2))
DT = np.linspace(0.1, 0.2, 40)


@pytest.mark.parametrize(
    ("dt", "args", "options", "message"),
    [
        (DT[:7], None, {}, "one number or one per pair (40,), got shape (7,)"),
        (0.1, {"q1": DT}, {}, "'q1' cannot name a parameter"),
        (DT, {"l": DT}, {"learn": "map"}, "dt and in parameters: expected learn='hamiltonian'"),
    ],
)
def test_pairs_that_cannot_be_used(dt, args, options, message):
    with pytest.raises(gfnn.FitError, match=re.escape(message)) as caught:
        gfnn.fit(gfnn.Pairs(Z, Z, dt, args), **options)
    assert "\n" not in str(caught.value)


def test_a_parameter_that_never_varies_is_left_out():
    given = {"learn": "auto", "family": "auto", "chart": "auto", "base": None}
    pairs, learn, messages = as_varied(gfnn.Pairs(Z, Z, 0.1, {"l": np.ones(40), "m": DT}), **given)
    assert list(pairs.args) == ["m"]
    assert learn == "auto"
    assert messages == [
        "the parameter l is 1 in all pairs: it is left out, for its effect is not known"
    ]


# Files and the command line.


def write_csv(path):
    """Eight pendulums, measured when it suited: uneven t, and a column for the length."""
    rng, rows = np.random.default_rng(4), []
    z, length, _ = pendulums(8, seed=4)
    t = np.zeros(8)
    for _ in range(30):
        rows += [[i, t[i], *z[i], length[i]] for i in range(8)]
        dt = rng.uniform(0.02, 0.1, 8)
        z, t = image(z, length, dt), t + dt
    rows = np.array(rows)
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    header = "sequence,t,q1,p1,l"
    np.savetxt(path, rows, "%.17g", ",", header=header, comments="")
    return rows


@pytest.mark.slow
def test_a_csv_with_uneven_times_and_a_column_more(tmp_path):
    rows = write_csv(tmp_path / "d.csv")
    data = read_trajectories(tmp_path / "d.csv")
    assert data.dt.shape == data.args["l"].shape == (8 * 29,)
    np.testing.assert_allclose(data.dt[:29], np.diff(rows[:30, 1]), rtol=1e-13)
    model, out = str(tmp_path / "m"), str(tmp_path / "p.npz")
    terms = ["--angles", "0", "--terms", "p**2/l**2; l*cos(q)", "--tolerance", "1e-9"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert cli.main(["fit", str(tmp_path / "d.csv"), "--out", model, *terms]) == 0
    predict = ["predict", model, "--num-steps", "10", "--dt", "0.05", "--out", out]
    assert cli.main([*predict, "--initial", str(tmp_path / "d.csv")]) == 0
    predicted = np.load(out)
    last, length = rows[29::30, 2:4], rows[29::30, 4]
    np.testing.assert_array_equal(predicted["params"][:, 0], length)
    assert predicted["dt"] == 0.05
    assert predicted["param_names"].tolist() == ["l"]
    np.testing.assert_allclose(
        predicted["trajectories"][:, 1], image(last, length, 0.05), atol=1e-10
    )


def test_npz_of_params_and_times(tmp_path):
    z, length, dt = pendulums(20)
    z1 = image(z, length, dt)
    np.savez(tmp_path / "p.npz", z0=z, z1=z1, dt=dt, params=length, param_names=["l"])
    pairs = read_trajectories(tmp_path / "p.npz").pairs()
    np.testing.assert_array_equal(pairs.args["l"], length)
    np.testing.assert_allclose(pairs.dt, dt, rtol=1e-13)
    both = np.stack([z, z1], axis=1)
    times = np.stack([0 * dt, dt], axis=1)
    np.savez(tmp_path / "t.npz", trajectories=both, times=times, params=length[:, None])
    pairs = read_trajectories(tmp_path / "t.npz").pairs()
    np.testing.assert_array_equal(pairs.args["a1"], length)
    np.testing.assert_array_equal(pairs.z1, z1)
    np.savez(tmp_path / "u.npz", trajectories=both, times=times * 0 + [0, 0.5])
    assert read_trajectories(tmp_path / "u.npz").dt == 0.5


def test_the_plan_of_terms_without_coordinates():
    """A factor of parameters alone has no slope, and costs none."""
    family = Terms(1, ("p1", "l"), ((2, 1), (2, 2)), ("l",))
    found = family.gradient(np.array([1.0, 2.0]), np.array([[0.3, 0.5]]), np.array([[2.0]]))
    np.testing.assert_allclose(found, [[0.0, 2 * 0.5 * (2.0 + 2 * 4.0)]])
