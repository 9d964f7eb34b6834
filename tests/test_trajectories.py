"""Reference trajectories against other solutions, their errors over long times, and draws."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import gfnn_jax.scenes.trajectories as tr
from gfnn_jax import scenes
from gfnn_jax.phase_space import hamiltonian_vector_field
from gfnn_jax.scenes import draws

KEY = jax.random.key(0)  # made once: that compiles as well
INTEGRATED = ("henon-heiles-regular", "henon-heiles-printed", "pcr3bp")
# Each like another, but for the energy, a term of H or the parameters, or drawn by other tests:
# and long to compile.
LIKE_OTHERS = """
    henon-heiles-regular henon-heiles-printed henon-heiles-chaotic henon-heiles-section pcr3bp
    driven-pendulum driven-pendulum-phase fput pendulum-length n-body toda
"""
ALIKE = LIKE_OTHERS.split()


def long_ones_slow(names):
    return [pytest.param(n, marks=pytest.mark.slow if n in ALIKE else ()) for n in names]


def integrated(name, **changes):
    """The scene with its exact flow, if it has one, taken away."""
    return dataclasses.replace(scenes.make(name), flow=None, **changes)


def neighbours(scene):
    """Three states beside the start of the scene's orbit."""
    return np.array([scene.sampling.start]) + 0.01 * np.arange(3.0)[:, None]


@pytest.mark.slow
@pytest.mark.parametrize("name", long_ones_slow(INTEGRATED))
def test_flow_agrees_with_another_solver(name):
    scene = scenes.make(name)
    z0 = neighbours(scene)
    z = tr.reference_trajectories(scene, z0, 10)
    field = jax.jit(hamiltonian_vector_field(scene.hamiltonian))
    for lane in range(3):
        other = solve_ivp(
            lambda t, y: np.asarray(field(y)),
            (0, 10 * scene.dt),
            z0[lane],
            method="DOP853",
            rtol=3e-14,
            atol=1e-14,
        )
        np.testing.assert_allclose(z[lane, -1], other.y[:, -1], atol=3e-13, rtol=0)


@pytest.mark.slow
def test_the_stroboscopic_map_agrees_with_another_solver_and_starts_at_time_0_every_time():
    scene = scenes.driven_pendulum(periods=3)
    z0 = draws.sample_states(scene, 3, jax.random.key(9))
    z = tr.reference_trajectories(scene, z0, 2)
    for start, path in zip(z0, z, strict=True):
        other = solve_ivp(
            lambda t, y: [y[1], -np.sin(y[0]) * (1 + 0.15 * np.cos(t))],
            (0, 2 * scene.dt),
            start,
            t_eval=[scene.dt, 2 * scene.dt],
            method="DOP853",
            rtol=3e-14,
            atol=1e-15,
        )
        np.testing.assert_allclose(path[1:], other.y.T, atol=1e-12, rtol=0)
    np.testing.assert_array_equal(tr.reference_trajectories(scene, z[:, 1], 2)[:, 1], z[:, 2])
    assert 0 < tr.reference_error(scene, z0, 2) < 1e-12


def returned(z):
    """(y, p_y) of Hénon and Heiles at E = 0.1 at its next crossing of x = 0 upwards, by SciPy."""

    def field(_, x):
        return [x[2], x[3], -x[0] - 2 * x[0] * x[1], -x[1] - x[0] ** 2 + x[1] ** 2]

    def crossing(_, x):
        return x[0]

    crossing.direction = 1.0
    start = [0.0, z[0], np.sqrt(0.2 - z[1] ** 2 - z[0] ** 2 + 2 / 3 * z[0] ** 3), z[1]]
    options = {"rtol": 3e-14, "atol": 1e-15, "max_step": 0.05}
    found = solve_ivp(field, (0, 9), start, "DOP853", events=crossing, **options)
    return next(x for t, x in zip(*found.t_events, *found.y_events, strict=True) if t > 1)[[1, 3]]


@pytest.mark.slow
def test_the_return_map():
    """Check against an event of another solver; a fixed point; area; orbits without return."""
    scene = scenes.henon_heiles_section()

    def step(z):
        """Step at most ten states: one compilation."""
        return tr.reference_trajectories(scene, np.resize(z, (10, 2)), 1)[: len(z), 1]

    z0 = draws.sample_states(scene, 8, jax.random.key(9))
    z1 = step(z0)
    np.testing.assert_allclose(z1, [returned(z) for z in z0], atol=3e-13, rtol=0)
    assert np.linalg.norm(z1 - z0, axis=1).min() > 1e-2
    # Central differences of order 4 of the map's Jacobian.
    h, unit = 5e-4, np.eye(2)
    columns = [
        (8 * (step(z0 + h * e) - step(z0 - h * e)) - step(z0 + 2 * h * e) + step(z0 - 2 * h * e))
        / (12 * h)
        for e in unit
    ]
    np.testing.assert_allclose(np.linalg.det(np.stack(columns, axis=-1)), 1, atol=1e-8, rtol=0)

    rho = np.array([1, -1])
    np.testing.assert_allclose(step(z1 * rho) * rho, z0, atol=3e-13, rtol=0)
    fixed = np.array([[0.2755, 0.0]])
    assert np.abs(step(fixed) - fixed).max() < 2e-5
    # Beyond the energy no state is on the section; the others' bits do not change.
    mixed = step(np.concatenate([z0, [[0.9, 0.0], [np.nan, 0.0]]]))
    assert np.isnan(mixed[8:]).all()
    np.testing.assert_array_equal(mixed[:8], step(np.concatenate([z0, z0[:2]]))[:8])
    assert 0 < tr.reference_error(scene, np.resize(z0, (10, 2)), 1) < 1e-13


@pytest.mark.slow
def test_integration_against_the_exact_kepler_solution():
    scene = scenes.two_body()
    z0 = draws.sample_states(scene, 10, jax.random.key(1))
    exact = tr.reference_trajectories(scene, z0, 1000, save_every=10)
    z = tr.reference_trajectories(integrated("two-body"), z0, 1000, save_every=10)
    distance = np.linalg.norm(z - exact, axis=-1)
    assert distance[:, 1].max() < 5e-14
    assert distance.max() < 2e-11


@pytest.mark.slow
def test_measured_error_of_the_reference():
    z0 = np.array([scenes.henon_heiles().sampling.start])
    assert 0 < tr.reference_error(scenes.henon_heiles(), z0, 1) < 2e-15
    assert 1e-15 < tr.reference_error(scenes.henon_heiles(), z0, 1000) < 1e-11
    # It sees a bad reference: the solver out of steps in one dt, and a chaotic orbit's growth.
    assert np.isnan(tr.reference_error(scenes.henon_heiles(dt=5_000.0), z0, 1))
    chaotic = scenes.henon_heiles(energy=1 / 6)
    assert tr.reference_error(chaotic, np.array([chaotic.sampling.start]), 1_000) > 1e-6
    start = np.array([scenes.standard_map().sampling.start])
    assert 0 < tr.reference_error(scenes.standard_map(), start, 100) < 1e-11


def test_a_collision_is_nan_and_leaves_the_others_alone():
    """A body released at rest falls into the centre at t = π/√8 ≈ 1.11; NaN stays NaN."""
    scene = integrated("two-body", dt=0.3)
    good = np.array([[1.0, 0.0, 0.0, 1.0], [0.0, 1.1, -0.9, 0.1]])
    falling = np.array([[1.0, 0.0, 0.0, 0.0]])
    broken = np.full((1, 4), np.nan)
    z = tr.reference_trajectories(scene, np.concatenate([good, falling, broken]), 8)
    assert np.isfinite(z[2, :4]).all()
    assert np.isnan(z[2, 4:]).all()
    assert np.isnan(z[3]).all()
    alone = tr.reference_trajectories(scene, np.concatenate([good, good]), 8)
    np.testing.assert_array_equal(z[:2], alone[:2])


@pytest.mark.slow
def test_time_dependent_hamiltonian():
    """Forced oscillator q'' = −q + cos 2t from rest: q = (cos t − cos 2t)/3."""

    def hamiltonian(z, t):
        return (z[0] ** 2 + z[1] ** 2) / 2 - z[0] * jnp.cos(2.0 * t)

    law = scenes.DrawnFrom(lambda key, num: jnp.zeros((num, 2)))
    scene = scenes.Scene("forced", "test", 1, 0.7, law, hamiltonian=hamiltonian)
    z = tr.reference_trajectories(scene, np.zeros((1, 2)), 20, save_every=2)
    t = 1.4 * np.arange(11)
    np.testing.assert_allclose(z[0, :, 0], (np.cos(t) - np.cos(2 * t)) / 3, atol=1e-13, rtol=0)


@pytest.mark.parametrize("name", long_ones_slow(scenes.names()))
def test_pairs_are_the_same_bits_for_the_same_seed_and_conserve_the_invariants(name):
    scene = scenes.make(name)
    pairs, again, other = (draws.sample_pairs(scene, 16, jax.random.key(s)) for s in (3, 3, 4))
    assert pairs.z0.shape == pairs.z1.shape == (16, 2 * scene.dim)
    assert isinstance(pairs.z0, np.ndarray)
    assert pairs.z0.dtype == pairs.z1.dtype == np.float64
    assert pairs.dt == scene.dt
    np.testing.assert_array_equal(pairs.z0, again.z0)
    np.testing.assert_array_equal(pairs.z1, again.z1)
    assert not (pairs.z0 == other.z0).all(axis=1).any()
    columns = [pairs.args[name] for name in scene.parameters]
    params = np.stack(columns, axis=-1) if columns else None
    found = tr.reference_trajectories(scene, pairs.z0, 1, params=params, t0=pairs.t0)
    np.testing.assert_array_equal(pairs.z1, found[:, 1])
    for invariant in scene.invariants.values():
        start, end = (jax.jit(jax.vmap(invariant))(z) for z in (pairs.z0, pairs.z1))
        np.testing.assert_allclose(end, start, atol=1e-14, rtol=1e-15)
        # It tells states apart, or is that of a centre of mass at rest.
        assert np.ptp(start) > 1e-4 or np.abs(start).max() < 1e-15


@pytest.mark.slow
def test_a_scene_with_a_parameter():
    """Check that each length conserves its energy; pairs at random times are those of the flow."""
    scene, key = scenes.pendulum_length(), jax.random.key(3)
    pairs = draws.sample_pairs(scene, 30, key, dt_range=(0.1, 0.5))
    length = pairs.args["l"]
    assert ((length > 0.5) & (length < 2)).all()
    assert ((pairs.dt > 0.1) & (pairs.dt < 0.5)).all()
    np.testing.assert_array_equal(draws.sample_states(scene, 30, key), pairs.z0)
    np.testing.assert_array_equal(draws.sample_params(scene, 30, key)[:, 0], length)

    def energy(z):
        return z[:, 1] ** 2 / (2 * length**2) - 9.81 * length * np.cos(z[:, 0])

    np.testing.assert_allclose(energy(pairs.z1), energy(pairs.z0), rtol=1e-12, atol=1e-12)
    later = tr.reference_trajectories(
        dataclasses.replace(scene, dt=pairs.dt[0]), pairs.z0[:1], 1, params=length[:1]
    )
    np.testing.assert_allclose(later[0, 1], pairs.z1[0], rtol=1e-12)
    with pytest.raises(ValueError, match="params l"):
        tr.reference_trajectories(scene, pairs.z0, 1)
    for unfit in (scenes.standard_map(), scenes.driven_pendulum()):
        with pytest.raises(ValueError, match=r"dt from 0\.1 to 0\.2"):
            draws.sample_pairs(unfit, 5, key, dt_range=(0.1, 0.2))


@pytest.mark.parametrize("name", ["henon-heiles-regular", "pcr3bp", "standard-map-regular"])
def test_spread_around_the_orbit(name):
    """Centred Gaussian perturbations of every coordinate, of the paper's variance."""
    scene = scenes.make(name)
    law = dataclasses.replace(scene.sampling, num_steps=0)  # one state, so that σ is seen alone
    z = draws.sample_states(dataclasses.replace(scene, sampling=law), 4_000, jax.random.key(6))
    offset = z - np.array(law.start)
    if scene.coordinates.angles:
        offset = (offset + np.pi) % (2 * np.pi) - np.pi
        assert ((z >= 0) & (z < 2 * np.pi)).all()
    sigma = {"henon-heiles-regular": 0.01, "pcr3bp": 0.05, "standard-map-regular": 0.5}[name]
    np.testing.assert_allclose(offset.std(axis=0), sigma, rtol=0.06)
    np.testing.assert_allclose(offset.mean(axis=0), 0, atol=0.06 * sigma)
    assert np.abs(np.corrcoef(offset.T) - np.eye(2 * scene.dim)).max() < 0.08


@pytest.mark.slow
def test_draws_run_all_along_the_orbit():
    scene = scenes.henon_heiles(energy=1 / 6)
    z = draws.sample_test_states(scene, 400, jax.random.key(7))
    energy = jax.jit(jax.vmap(scene.hamiltonian))(z)
    np.testing.assert_allclose(energy, 1 / 6 - 1e-3, atol=1e-12, rtol=0)
    orbit = tr.reference_trajectories(scene, np.array([scene.test_states.start]), 10_000)[0]
    index = np.array([np.flatnonzero((orbit == row).all(axis=1))[0] for row in z])
    assert abs(index.mean() / 5_000 - 1) < 0.1
    assert index.max() > 9_800


def test_data_of_a_scene_take_one_compilation_per_program(compilations):
    """Draw and step of the pairs, draw of the test states; nothing of it eagerly."""
    flow = scenes.two_body().flow
    scene = dataclasses.replace(scenes.two_body(), flow=lambda z, t: flow(z, t))  # seen by no test
    with compilations() as of_pairs:
        draws.sample_pairs(scene, 37, KEY)
    with compilations() as of_tests:
        z0 = draws.sample_test_states(scene, 11, KEY)
        tr.reference_trajectories(scene, z0, 13)
    with compilations() as again:
        draws.sample_pairs(dataclasses.replace(scene, dt=0.2), 37, KEY)
        tr.reference_trajectories(scene, z0, 13)
    assert (of_pairs.count, of_tests.count, again.count) == (2, 1, 0)
    with compilations() as of_an_orbit:
        draws.sample_pairs(scenes.standard_map(), 37, KEY)
        draws.sample_test_states(scenes.standard_map(), 37, KEY)
    assert of_an_orbit.count <= 2  # the orbit and the pairs by one program
    with compilations() as of_more:
        draws.sample_pairs(scenes.standard_map(), 38, KEY)
        draws.sample_test_states(scenes.standard_map(), 1, KEY)
    assert of_more.count == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["henon-heiles-section", "driven-pendulum-phase", "two-body"])
def test_a_state_has_the_same_bits_beside_any_others(name, compilations):
    """Alone, in another order, in blocks that are full or not, and for any number of steps."""
    scene = integrated("two-body") if name == "two-body" else scenes.make(name)
    num = 2 * tr.Options.lanes_on_cpu + 1
    z0, t0 = draws.sample_states(scene, num, KEY), draws.sample_t0(scene, num, KEY)

    def followed(rows, num_steps=3):
        times = None if t0 is None else t0[rows]
        return tr.reference_trajectories(scene, z0[rows], num_steps, t0=times)

    whole = followed(np.arange(num))
    with compilations() as found:
        for rows in (np.arange(num)[::-1], np.arange(5, num), np.array([num - 1]), np.arange(0)):
            np.testing.assert_array_equal(followed(rows), whole[rows])
        np.testing.assert_array_equal(followed(np.arange(4), 2), whole[:4, :3])
    assert found.count == 0


def test_first_draws_are_those_of_more():
    scene, driven = scenes.standard_map(), scenes.make("driven-pendulum-phase")
    for num in (1, 37):
        for draw in (partial(draws.sample_states, scene), partial(draws.sample_t0, driven)):
            np.testing.assert_array_equal(draw(num, KEY), draw(1025, KEY)[:num])


def test_long_trajectories_go_on_from_call_to_call():
    """More states than one call returns, against a plain loop over the map."""
    scene, num_steps = scenes.standard_map(), 2 * tr.Options.saved_at_once + 6
    z0 = draws.sample_states(scene, 3, KEY)
    found = tr.reference_trajectories(scene, z0, num_steps, save_every=2)
    path, step = [z0], jax.jit(jax.vmap(scene.step))
    for _ in range(num_steps):
        path.append(np.asarray(step(path[-1])))
    np.testing.assert_allclose(found, np.stack(path[::2], axis=1), rtol=1e-9, atol=1e-9)
