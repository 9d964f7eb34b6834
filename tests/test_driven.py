"""Driven systems: the time of the drive from the pairs to the prediction."""

import dataclasses
import re
import warnings
from fractions import Fraction

import jax
import numpy as np
import pytest
import scipy.integrate

import gfnn_jax as gfnn
from gfnn_jax import cli
from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.data.files import read_initial, read_trajectories
from gfnn_jax.data.sample import read_sample
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.varied import as_varied
from gfnn_jax.families.terms import given_terms, polynomial_terms
from gfnn_jax.flows.collocation import Steps, images
from gfnn_jax.flows.flow import Flow
from gfnn_jax.generating.charts import CHARTS
from gfnn_jax.generating.generated import Generated
from gfnn_jax.maps.parameters import Parameters, sampled
from gfnn_jax.models.hamiltonians.covariance import leaves_white
from gfnn_jax.models.parameters import functions_of_parameters, walked
from gfnn_jax.scenes.draws import sample_t0

PERIOD = 5.0
RATE = 2 * np.pi / PERIOD
DT = PERIOD / 16
LAW = given_terms(1, ["p**2/2", "cos(q)", f"cos(q)*cos({RATE!r}*t)"], ("t",))
C = np.array([1.0, -1.0, -0.15])
FINE = Steps(8, 2)
GIVEN = {"learn": "auto", "family": "auto", "chart": "auto", "base": None}


def states(count, seed=0):
    """States of the pendulum, and times of the drive over several of its periods."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-0.8, 0.8, (count, 2)), rng.uniform(0, 3 * PERIOD, count)


def image(z, t0, dt=DT):
    return images(LAW, C, z, dt, FINE, args=np.asarray(t0)[:, None]).states


def after(z, t0, steps):
    for n in range(steps):
        z = image(z, np.mod(t0 + (n % 16) * DT, PERIOD))
    return z


def test_a_torque_on_an_angle_is_found_from_pairs():
    law, rng = given_terms(1, ["p**2/2", "cos(q)", "q*u"], ("u",)), np.random.default_rng(0)
    z0, u = rng.uniform(-3, 3, (300, 2)), rng.uniform(-1, 1, 300)
    z1 = images(law, np.array([1.0, -2.0, -0.7]), z0, 0.1, FINE, args=u[:, None]).states
    fit = gfnn.fit(gfnn.Pairs(z0, z1, 0.1, args={"u": u}), angles=(0,), tolerance=1e-10)
    found = {term.term: term.coefficient for term in fit.hamiltonian.terms}
    assert found == pytest.approx({"p1²": 0.5, "cos(q1)": -2.0, "q1 u": -0.7}, abs=1e-10)


@pytest.fixture(scope="module")
def learned():
    z, t0 = states(300)
    pairs = gfnn.Pairs(z, image(z, t0), DT, t0=t0, period=PERIOD)
    return gfnn.fit(pairs, angles=(0,), tolerance=1e-11)


def test_a_driven_law_is_white_where_it_is_right():
    """Of the right law noise is left over, of one without the drive's term more."""
    z, t0 = states(1_000, 5)
    rng = np.random.default_rng(6)
    z0, z1 = (x + 1e-3 * rng.normal(size=x.shape) for x in (z, image(z, t0)))
    pairs = gfnn.Pairs(z0, z1, DT, t0=t0, period=PERIOD)
    data = Dataset.of(pairs, CARTESIAN).trained_on(np.arange(1_000))

    def white(c):
        flow = Flow(LAW, np.array(c), DT, np.ones(2), 6, 1)
        return leaves_white(flow, data)

    assert white(C)
    assert not white([1.0, -1.0, -0.14])


# The arithmetic.


@pytest.mark.slow
def test_the_stages_stand_at_their_times():
    z, t0 = states(4)
    dt = np.array([0.3, 0.1, 1.0, 0.5])

    def field(t, z):
        return [z[1], -np.sin(z[0]) * (1 + 0.15 * np.cos(RATE * t))]

    expected = [
        scipy.integrate.solve_ivp(field, (t, t + h), y, method="DOP853", rtol=1e-13, atol=1e-15).y[
            :, -1
        ]
        for y, t, h in zip(z, t0, dt, strict=True)
    ]
    np.testing.assert_allclose(image(z, t0, dt), expected, atol=1e-13)
    for newton in (False, True):
        flow = Flow(LAW, C, dt, np.ones(2), 8, 2, newton)
        found, _ = jax.jit(Flow.step)(flow, z, t0[:, None])
        np.testing.assert_allclose(found, expected, atol=1e-13)
        back, _ = jax.jit(Flow.step)(flow.inverse(), found, (t0 + dt)[:, None])
        np.testing.assert_allclose(back, z, atol=1e-15)


def test_derivatives_in_the_coefficients_and_in_the_time():
    z, t0 = states(3)
    found = images(LAW, C, z, DT, FINE, args=t0[:, None], derivatives=True)
    for j, e in enumerate(1e-5 * np.eye(3)):
        ahead, behind = (
            images(LAW, C + s * e, z, DT, FINE, args=t0[:, None]).states for s in (1, -1)
        )
        np.testing.assert_allclose(
            found.by_coefficient[:, :, j], (ahead - behind) / 2e-5, atol=1e-9
        )
    flow = Flow(LAW, C, DT, np.ones(2), 6, 2)
    slope = jax.jit(jax.jacfwd(lambda t: flow.step(z[:1], t)[0][0]))(t0[:1, None])
    ahead, behind = (image(z[:1], t0[:1] + s) for s in (1e-5, -1e-5))
    np.testing.assert_allclose(slope[:, 0, 0], (ahead - behind)[0] / 2e-5, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["type2", "type3", "midpoint"])
def test_s_is_that_of_the_time_in_the_middle(name):
    """Whichever way the step is made."""
    z, t0 = states(5)
    piece = Generated(LAW, C, CHARTS[name], 0.2, np.ones(2))
    found, _ = jax.jit(Generated.step)(piece, z, t0[:, None])
    back, _ = jax.jit(Generated.step)(piece.inverse(), found, t0[:, None] + 0.2)
    np.testing.assert_allclose(back, z, atol=1e-14)
    w = CHARTS[name].evaluation_point(z, np.asarray(found))
    target = CHARTS[name].target_gradient(z, np.asarray(found), 0.2)
    gradient = LAW.gradient(C, w, t0[:, None] + 0.1)
    np.testing.assert_allclose(target, gradient, atol=1e-14)


def test_the_time_is_counted_and_not_summed():
    """Check the phase after 10⁷ steps, to its last digits, where no step divides the period."""
    known = Parameters(("l", "t"), np.zeros(2), np.ones(2), np.float64(PERIOD))
    dt, steps, t0 = 0.1, 10_000_001, 1.3
    exact = float((Fraction(t0) + steps * Fraction(dt)) % Fraction(PERIOD))
    found = known.after(np.array([0.7, t0]), steps, np.float64(dt))
    assert found[0] == 0.7
    assert abs(found[1] - exact) < 4e-15
    traced = jax.jit(known.after)(np.array([0.7, t0]), steps, np.float64(dt))
    np.testing.assert_array_equal(traced, found)


def test_times_of_the_drive_that_no_pair_saw():
    t0 = np.linspace(4, 7, 50)  # across the end of a period
    known = sampled(("t",), np.mod(t0, PERIOD)[:, None], 0.5, PERIOD)
    inside = known.contains(np.array([[4.1], [0.0], [2.4], [2.6], [3.9], [14.1]]))
    assert inside.tolist() == [True, True, True, False, False, True]
    everywhere = sampled(("t",), np.arange(16)[:, None] * DT, DT, PERIOD)
    assert everywhere.contains(np.linspace(-9, 9, 40)[:, None]).all()


def test_libraries_of_an_even_law_grow_past_odd_degrees():
    """cos q (1 + a cos νt) as polynomials: degree 3 is no better than 2, degree 4 is."""
    z, t0 = states(400)
    args = t0[:, None]
    gradient = LAW.gradient(C, z, args)
    plain = (polynomial_terms(1, n) for n in (2, 3, 4, 6, 8, 10, 12, 14))
    libraries = [dataclasses.replace(family, parameters=("t",)) for family in plain]

    def attempt(family):
        terms = family.term_gradients(z, args).reshape(-1, family.num_parameters)
        c, *_ = np.linalg.lstsq(terms, gradient.ravel(), rcond=1e-14)
        return np.abs(terms @ c - gradient.ravel()).max()

    functions = functions_of_parameters(1, ("t",), args, own=False, period=PERIOD)
    errors = list(walked(libraries, functions, attempt, float, bound=1e-11, most=300))
    assert errors[-1] < 1e-11
    both = functions_of_parameters(1, ("l", "t"), np.stack([t0 + 1, t0], 1), False, PERIOD)
    assert all("l" in " ".join(f.variables) for row in both for f in row)


# A fit and its map.


@pytest.mark.slow
def test_a_driven_law_is_read_and_predicts_many_periods(learned):
    terms = {t.term: t.coefficient for t in learned.hamiltonian.terms}
    drive = f"cos(q1) cos({RATE!r}*t)"
    assert terms == pytest.approx({"cos(q1)": -1.0, drive: -0.15, "p1²": 0.5}, rel=1e-12)
    z, t0 = states(20, seed=1)
    z = 0.7 * z
    found, info = learned.map.rollout(z, 320, t0=t0, save_every=320)
    np.testing.assert_allclose(found[:, -1], after(z, t0, 320), atol=1e-12)
    assert not np.asarray(info.status).any()
    assert learned.symplecticity_defect < 1e-13
    one, _ = learned.map.step(z, {"t": t0})
    np.testing.assert_allclose(one, image(z, t0), atol=1e-14)
    np.testing.assert_allclose(learned.map.inverse(one, t0=t0)[0], z, atol=1e-14)
    energy = learned.map.hamiltonian(z, t0=t0)
    np.testing.assert_allclose(energy, LAW.value(C, z, t0[:, None]), rtol=1e-12)


@pytest.mark.slow
def test_any_dt_and_lanes_in_parts(learned):
    z, t0 = states(6, seed=2)
    found, _ = learned.map.step(z, t0=t0, dt=1.7)
    np.testing.assert_allclose(found, image(z, t0, 1.7), atol=1e-12)
    whole, _ = learned.map.rollout(z, 20, t0=t0)
    lanes, part = learned.map.advance(learned.map.start(z, t0=t0), 12, t0=t0)
    _, rest = learned.map.advance(lanes, 8, t0=t0)
    np.testing.assert_array_equal(np.concatenate([z[:, None], part, rest], axis=1), whole)
    there = whole[:, -1]
    back, _ = learned.map.reversed().rollout(there, 20, t0=t0 + 20 * DT)
    np.testing.assert_allclose(back[:, -1], z, atol=1e-13)


@pytest.mark.slow
def test_the_stroboscopic_map_is_a_period_of_steps(learned, tmp_path):
    z, _ = states(5, seed=3)
    z = 0.7 * z
    once = gfnn.stroboscopic(learned.map, t0=0.7)
    assert float(once.dt) == PERIOD
    found, _ = once.rollout(z, 3)
    steps, _ = learned.map.rollout(z, 48, t0=0.7, save_every=16)
    np.testing.assert_allclose(found, steps, atol=1e-13)
    np.testing.assert_allclose(once.inverse(found[:, 1])[0], z, atol=1e-13)
    assert np.asarray(once.defect(z)).max() < 1e-13
    once.save(tmp_path / "m")
    np.testing.assert_array_equal(gfnn.load(tmp_path / "m").map.step(z)[0], once.step(z)[0])
    with pytest.raises(ValueError, match="a whole part of the period"):
        gfnn.stroboscopic(learned.map.over(0.3))
    with pytest.raises(ValueError, match="a driven map"):
        gfnn.stroboscopic(once)


@pytest.mark.slow
def test_a_drive_that_was_seen_in_part_has_a_status(learned):
    z, t0 = states(300)
    t0 = np.mod(t0, 0.5 * PERIOD)
    known = sampled(("t",), t0[:, None], DT, PERIOD)
    map_ = dataclasses.replace(learned.map, parameters=known)
    _, info = map_.step(0.1 * z[:2], t0=np.array([1.0, 4.0]))
    assert info.status.tolist() == [0, 1]
    _, info = map_.rollout(0.1 * z[:2], 16, t0=np.array([1.0, 4.0]))
    assert info.left_at.tolist() == [6, 0]  # 1 + 6 dt is beyond what was seen


# What is refused or said.


Z, T0 = states(40)


@pytest.mark.parametrize(
    ("options", "fit", "message"),
    [
        ({"t0": T0}, {}, "got t0 without a period"),
        ({"t0": T0[:7], "period": 5.0}, {}, "expected args['t'] of shape (40,), got (7,)"),
        ({"t0": T0, "period": 5.0}, {"chart": "type1"}, "another chart than type1"),
    ],
)
def test_pairs_that_cannot_be_used(options, fit, message):
    with pytest.raises(gfnn.FitError, match=re.escape(message)) as caught:
        gfnn.fit(gfnn.Pairs(Z, Z, 0.1, **options), **fit)
    assert "\n" not in str(caught.value)


def test_times_that_are_not_the_maps(learned):
    with pytest.raises(ValueError, match="expected t0, the time of the drive"):
        learned.map.step(np.zeros((2, 2)))
    with pytest.raises(ValueError, match="energy"):
        learned.map.modified_hamiltonian(np.zeros(2))


def test_one_phase_is_no_drive():
    pairs, _, messages = as_varied(gfnn.Pairs(Z, Z, 10.0, t0=0.3, period=5.0), **GIVEN)
    assert pairs.args is None
    assert "t = 0.3" in messages[0]
    assert "2 whole periods" in messages[0]
    _, _, messages = as_varied(gfnn.Pairs(Z, Z, 1.0, t0=0.3, period=5.0), **GIVEN)
    assert "A second step begins at another phase" in messages[0]


def test_pairs_are_a_pytree_with_their_time():
    pairs = gfnn.Pairs(Z, Z, 0.1, {"l": T0}, T0, 5.0)
    half = jax.tree.map(lambda a: a[:20], pairs)
    assert list(half.args) == ["l", "t"]
    assert half.period == pairs.take(slice(20)).period == 5.0
    np.testing.assert_array_equal(half.t0, T0[:20])


# The scene, files and the command line.


@pytest.mark.slow
def test_the_scene_begins_at_any_time():
    scene = gfnn.scenes.driven_pendulum_phase(steps=8)
    key = jax.random.key(0)
    pairs = gfnn.sample_pairs(scene, 40, key)
    law = given_terms(1, ["p**2/2", "cos(q)", "cos(q)*cos(t)"], ("t",))
    found = images(law, C, pairs.z0, pairs.dt, FINE, args=pairs.t0[:, None]).states
    np.testing.assert_allclose(found, pairs.z1, atol=1e-13)
    np.testing.assert_array_equal(sample_t0(scene, 40, key), pairs.t0)
    with pytest.raises(ValueError, match="expected t0"):
        gfnn.reference_trajectories(scene, pairs.z0, 2)


def write_npz(path, count=60, length=4):
    z, t0 = states(count, seed=5)
    rows = [after(z, t0, n) for n in range(length)]
    np.savez(path, trajectories=np.stack(rows, axis=1), dt=DT, t0=t0, period=PERIOD)
    return np.stack(rows, axis=1), t0


@pytest.mark.slow
def test_files_of_pairs_and_of_trajectories(tmp_path):
    path = tmp_path / "t.npz"
    rows, t0 = write_npz(path)
    times = t0[:, None] + DT * np.arange(4)
    np.savez(tmp_path / "p.npz", z0=rows[:, 0], z1=rows[:, 1], dt=DT, t0=t0, period=PERIOD)
    np.savez(tmp_path / "u.npz", trajectories=rows, times=times, period=PERIOD)
    sequence = np.repeat(np.arange(60), 4)
    table = np.column_stack([sequence, times.ravel(), rows.reshape(-1, 2), 0 * sequence + PERIOD])
    about = {"header": "sequence,t,q1,p1,period", "comments": ""}
    np.savetxt(tmp_path / "c.csv", table, "%.17g", ",", **about)
    for name in ("t.npz", "u.npz", "c.csv"):
        data = read_trajectories(tmp_path / name)
        assert data.period == data.pairs().period == PERIOD
        np.testing.assert_allclose(data.args["t"], times[:, :-1].ravel(), atol=1e-13)
        assert np.asarray(data.dt) == pytest.approx(DT)
        _, at = read_initial(tmp_path / name, 1, ("t",))
        np.testing.assert_allclose(at[:, 0], times[:, -1], atol=1e-13)
    pairs = read_trajectories(tmp_path / "p.npz").pairs()
    np.testing.assert_allclose(pairs.t0, np.mod(t0, PERIOD), atol=1e-14)
    assert read_sample(tmp_path / "t.npz", num_pairs=20).pairs().period == PERIOD


@pytest.mark.slow
def test_fit_and_predict_on_the_command_line(tmp_path):
    rows, t0 = write_npz(tmp_path / "t.npz")
    terms = ["--angles", "0", "--terms", f"p**2; cos(q); cos(q)*cos({RATE!r}*t)"]
    model, out = str(tmp_path / "m"), tmp_path / "p.npz"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fit = ["fit", str(tmp_path / "t.npz"), "--out", model, "--tolerance", "1e-9", *terms]
        assert cli.main(fit) == 0
    np.savez(tmp_path / "z.npz", z0=rows[:, 0], t0=t0)
    predict = ["predict", model, "--num-steps", "3", "--out", str(out), "--initial"]
    assert cli.main([*predict, str(tmp_path / "z.npz")]) == 0
    predicted = np.load(out)
    np.testing.assert_allclose(predicted["trajectories"], rows, atol=1e-11)
    np.testing.assert_array_equal(predicted["t0"], t0)
    assert predicted["period"] == PERIOD
    assert "params" not in predicted
    again = read_trajectories(out)  # a prediction serves as data, and to go on from
    assert again.period == PERIOD
