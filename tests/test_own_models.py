"""What a user writes in a module of their own goes through fit, save, load, sample and predict."""

import jax
import numpy as np
import own_module
import pytest
from analytic import motion, moved
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn

SCENE = own_module.double_well()


def pairs_of(num, seed):
    """Of the double well, whose states are drawn by the scene."""
    z0 = np.asarray(own_module.draw(jax.random.key(seed), num))
    return gfnn.Pairs(z0, moved(lambda _, z: [z[1], z[0] - z[0] ** 3], z0, SCENE.dt), SCENE.dt)


@pytest.fixture(scope="module")
def pairs():
    return pairs_of(400, 0)


@pytest.fixture(scope="module")
def fresh():
    return pairs_of(200, 1)


def error_of(map_, pairs):
    return np.sqrt(np.mean((np.asarray(map_.step(pairs.z0)[0]) - np.asarray(pairs.z1)) ** 2))


def covariance_of(pairs, map_):
    """Of the force, by the normal equations of all pairs, with the noise that they leave."""
    (q0, p0), (q1, p1) = np.asarray(pairs.z0).T, np.asarray(pairs.z1).T
    force = np.asarray(map_.pieces[0].params)
    powers = np.arange(len(force))
    design = pairs.dt / 2 * (q0[:, None] ** powers + q1[:, None] ** powers)
    left = np.sum((p1 - p0 - design @ force) ** 2) / (len(q0) - len(force))
    return left * np.linalg.inv(design.T @ design)


def kept(map_, folder):
    """The map, saved and loaded."""
    map_.save(folder)
    return gfnn.load(folder).map


@pytest.mark.slow
def test_a_family(pairs, fresh, tmp_path):
    def sizes(inputs):
        return (own_module.RadialBumps(inputs, n, width=0.5) for n in (20, 40, 80))

    fit = gfnn.fit(pairs, SCENE, family=sizes, chart="midpoint", tolerance=1e-2)
    assert fit.met
    assert (fit.chosen.family, fit.chosen.label) == ("own", "bumps 80")
    assert error_of(fit.map, fresh) < 1e-2 * np.std(np.asarray(fresh.z0), axis=0).max()
    assert fit.symplecticity_defect < 1e-10
    again = kept(fit.map, tmp_path / "m")
    np.testing.assert_array_equal(*(np.asarray(m.step(fresh.z0)[0]) for m in (again, fit.map)))
    drawn = np.asarray(again.sample(jax.random.key(2), 3).params)
    piece = again.pieces[0]
    of_kicks = piece.family.term_gradients(fresh.z0[:5]) @ (drawn - np.asarray(piece.params)).T
    assert 0 < SCENE.dt * np.abs(of_kicks).max() < 1e-2


@pytest.mark.slow
def test_a_model_and_its_piece(pairs, fresh, tmp_path):
    fit = gfnn.fit(pairs, SCENE, model=own_module.Kicks(), tolerance=2e-2)
    assert fit.met
    assert (fit.chosen.family, fit.chosen.label) == ("kicks", "kicks 3")
    assert error_of(fit.map, fresh) < 2e-2
    assert fit.symplecticity_defect < 1e-14
    with pytest.raises(ValueError, match="Verlet"):
        fit.map.modified_hamiltonian(fresh.z0)
    again = kept(fit.map, tmp_path / "m")
    states, info = again.rollout(fresh.z0[:5], 20)
    assert not np.any(info.status)
    back, _ = again.inverse(states[:, -1])
    np.testing.assert_allclose(back, states[:, -2], rtol=0, atol=1e-14)
    drawn = again.sample(jax.random.key(2), 200)
    spread = np.std(np.asarray(drawn.params), axis=0)
    np.testing.assert_allclose(spread, np.sqrt(np.diag(covariance_of(pairs, again))), rtol=0.2)
    many, _ = drawn.rollout(fresh.z0[:5], 1)
    assert np.all(np.std(many[:, :, 1, 1], axis=0) > 0)


def swinging(seed, num=400, dt=0.03):
    """A record of q̈ = −9 q − q³ with noise of heavy tails, and the positions themselves."""
    state, seconds = [np.array([1.0, 0.0])], 0.001
    for _ in range(num - 1):
        q, v = state[-1]
        for _ in range(round(dt / seconds)):
            v -= seconds / 2 * (9 * q + q**3)
            q += seconds * v
            v -= seconds / 2 * (9 * q + q**3)
        state.append(np.array([q, v]))
    q, rng = np.array(state)[:, 0], np.random.default_rng(seed)
    noise = 5e-3 * rng.standard_t(1.2, num)
    return gfnn.Recording({"t": dt * np.arange(num), "x": q + noise}, positions=["x"]), q


@pytest.mark.slow
def test_a_noise_model(tmp_path):
    recording, q = swinging(0)
    law = dict(terms=["v**2", "V: x**2", "V: x**4"], friction="none")
    part, ahead = recording.slice(0, 6), 0.03 * np.arange(201, 231)
    maps, errors = [], []
    for loss in (own_module.HeavyTails(1.2), own_module.Normal()):
        maps.append(gfnn.fit(recording, loss=loss, **law).map)
        values = maps[-1].forecast(part, ahead).values["x"][0]
        errors.append(np.abs(values - q[201:231]).max())
    assert errors[0] < 3e-3  # the noise has a median of 4e-3
    assert errors[0] < errors[1] / 2
    again = kept(maps[0], tmp_path / "m")
    assert again.sensors.observation_model.loss == own_module.HeavyTails(1.2)
    found, same = (map_.forecast(part, ahead) for map_ in (maps[0], again))
    np.testing.assert_array_equal(found.values["x"], same.values["x"])
    np.testing.assert_array_equal(found.std["x"], same.std["x"])
    states, _ = again.sample(jax.random.key(0), 3).rollout(again.estimate(part)[0], 5)
    assert np.isfinite(states).all()
    assert np.ptp(states[:, 0, -1, 0]) > 0


@pytest.mark.slow
def test_a_sensor(tmp_path):
    """An angle seen through a camera of unknown scale and tilt: ÿ = −4 sin y − 0.05 ẏ."""
    t = 0.04 * np.arange(300)
    (swing,) = motion(lambda q, v: -4 * np.sin(q) - 0.05 * v, [1.5, 0.0], t)
    seen = 2.0 * np.tan((swing - 0.1) / 2) + 1e-3 * np.random.default_rng(0).normal(size=300)
    recording = gfnn.Recording(
        {"t": t, "x": seen}, coordinates="theta", observe={"x": own_module.Tilted()}
    )
    fit = gfnn.fit(recording.slice(stop=8.0), friction="linear")
    assert abs(fit.sensors["scale"][0] - 2.0) < 5e-3
    past, later = recording.slice(5.0, 8.0), t[201:226]
    again = kept(fit.map, tmp_path / "m")
    values, same = (map_.forecast(past, later).values for map_ in (fit.map, again))
    assert np.abs(values["x"][0] - 2.0 * np.tan((swing[201:226] - 0.1) / 2)).max() < 5e-3
    np.testing.assert_array_equal(values["x"], same["x"])


@pytest.mark.slow
def test_a_term(tmp_path):
    """A particle that a soft wall, one of the terms, sends back: H = p²/2 + q²/2 + 4 wall(q)."""
    z0 = np.random.default_rng(0).uniform(-2, 2, (300, 2))
    z1 = moved(lambda _, z: [z[1], -z[0] - 8 * np.maximum(z[0] - 1, 0)], z0, 0.1)
    smooth = (np.maximum(z0[:, 0], z1[:, 0]) < 0.9) | (np.minimum(z0[:, 0], z1[:, 0]) > 1.1)
    pairs = gfnn.Pairs(z0[smooth], z1[smooth], 0.1)
    fit = gfnn.fit(pairs, learn="hamiltonian", terms=["p**2", "q**2", "wall(q)"], tolerance=1e-7)
    found = {term.term: term.coefficient for term in fit.hamiltonian.terms}
    assert found == pytest.approx({"p1**2": 0.5, "q1**2": 0.5, "wall(q1)": 4.0}, rel=1e-6)
    again = kept(fit.map, tmp_path / "m")
    np.testing.assert_array_equal(*(np.asarray(m.step(z0[:9])[0]) for m in (again, fit.map)))
    assert "wall" in str(fit.hamiltonian.sympy())
    with pytest.raises(gfnn.InputError, match="another function"):
        gfnn.register_function(own_module.Wall())


@pytest.mark.slow
def test_a_term_of_a_recording(tmp_path):
    """The same particle, recorded: V = x²/2 + 4 wall(x), with friction."""
    t = 0.05 * np.arange(600)

    def field(_, z):
        return [z[1], -z[0] - 8 * max(z[0] - 1, 0) - 0.05 * z[1]]

    options = {"t_eval": t, "rtol": 1e-10, "atol": 1e-10, "max_step": 0.05}
    x = solve_ivp(field, (0, t[-1]), [-2.0, 0.0], **options).y[0]
    seen = x + 1e-3 * np.random.default_rng(0).normal(size=len(t))
    recording = gfnn.Recording({"t": t, "x": seen}, positions=["x"])
    terms = ["V: x**2 + wall(x)"]
    fit = gfnn.fit(recording.slice(stop=20.0), terms=terms, friction="linear")
    found = {term.term: term for term in fit.lagrangian.terms}
    assert abs(found["wall(x)"].coefficient + 4) < 4 * found["wall(x)"].std < 0.1
    again = kept(fit.map, tmp_path / "m")
    past, later = recording.slice(15.0, 20.0), t[401:440]
    ahead, same = (map_.forecast(past, later).values["x"] for map_ in (fit.map, again))
    assert np.abs(ahead[0] - x[401:440]).max() < 3e-3
    np.testing.assert_array_equal(ahead, same)
    assert gfnn.export(fit.map, "stablehlo", tmp_path / "m.zip").exists()
    with pytest.raises(gfnn.InputError, match="your own function"):
        gfnn.export(fit.map, "c", tmp_path / "m.c")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"model": own_module.Kicks(), "learn": "map"}, "nothing else is learned"),
        ({"family": lambda inputs: [inputs]}, "Inputs has no .*name"),
    ],
)
def test_what_is_none(options, message, pairs):
    with pytest.raises(gfnn.FitError, match=message):
        gfnn.fit(pairs, SCENE, **options)


def test_a_name_is_taken_once():
    class Flow:
        pass

    with pytest.raises(gfnn.InputError, match="dataclass"):
        gfnn.register(Flow)
    import dataclasses

    with pytest.raises(gfnn.InputError, match="Flow"):
        gfnn.register(dataclasses.dataclass(Flow))
