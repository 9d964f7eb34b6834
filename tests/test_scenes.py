"""The scenes: exact solutions, laws of data, symmetries, orbits that are what they claim."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from analytic import kepler
from hypothesis import given, settings
from hypothesis import strategies as st

from gfnn_jax import scenes
from gfnn_jax.coordinates import to_inner, to_user
from gfnn_jax.phase_space import hamiltonian_vector_field, symplectic_form, symplecticity_defect
from gfnn_jax.scenes import draws
from gfnn_jax.scenes import trajectories as tr
from gfnn_jax.scenes.systems import angular_momentum, kepler_energy, kepler_flow

FLOW = jax.jit(jax.vmap(kepler_flow))


@given(st.floats(0.1, 10), st.floats(0, 0.95), st.floats(-math.pi, math.pi), st.floats(-20, 20))
@settings(max_examples=100, deadline=None)
def test_kepler_flow_is_the_textbook_solution(a, e, mean_anomaly, phase):
    z0 = kepler(a, e, mean_anomaly)
    z = np.asarray(FLOW(jnp.array([z0]), jnp.array([phase * a**1.5]))[0])
    scale = np.array([a, a, a**-0.5, a**-0.5]) / (1 - e) ** 2
    np.testing.assert_array_less(np.abs(z - kepler(a, e, mean_anomaly + phase)), 1e-13 * scale)


def test_kepler_flow_on_circles_whole_periods_and_long_times():
    circle = jnp.array([[1.0, 0.0, 0.0, 1.0]])
    for t in (0.0, 0.1, math.pi, -2.5, 1e4):
        exact = [math.cos(t), math.sin(t), -math.sin(t), math.cos(t)]
        atol = 1e-15 * max(1.0, 2 * abs(t))
        np.testing.assert_allclose(FLOW(circle, jnp.array([t]))[0], exact, atol=atol, rtol=0)
    z0 = jnp.array([kepler(1.0, 0.9, 0.3)])
    z = FLOW(z0, jnp.array([2 * math.pi * 1000]))
    np.testing.assert_allclose(z, z0, atol=1e-9, rtol=0)
    for invariant in (kepler_energy, angular_momentum):
        np.testing.assert_allclose(invariant(z[0]), invariant(z0[0]), rtol=3e-14)
    # Circular orbits are an ordinary point of the derivatives too.
    jacobian = np.asarray(jax.jit(jax.jacfwd(kepler_flow))(circle[0], 0.7))
    assert symplecticity_defect(jacobian) < 1e-14
    backwards = jax.jit(jax.jacrev(kepler_flow))(circle[0], 0.7)
    np.testing.assert_allclose(backwards, jacobian, atol=1e-14)
    unbound = jnp.array([[1.0, 0.0, 0.0, 1.5]])
    assert np.isnan(FLOW(unbound, jnp.array([0.1]))).all()


def test_the_ellipse_is_filled_uniformly():
    z = scenes.UniformInEllipse((1.0, -2.0), (0.5, 3.0))(jax.random.key(0), 4_000)
    x, y = ((np.asarray(z) - [1.0, -2.0]) / [0.5, 3.0]).T
    area = x**2 + y**2
    assert area.max() < 1
    np.testing.assert_allclose(np.quantile(area, [0.25, 0.5, 0.75]), [0.25, 0.5, 0.75], atol=0.03)
    turn = np.arctan2(y, x) / (2 * np.pi) % 1
    np.testing.assert_allclose(np.quantile(turn, [0.25, 0.5, 0.75]), [0.25, 0.5, 0.75], atol=0.03)


def test_two_body_law():
    """Uniform in a, e, mean anomaly and direction of the periapsis; counterclockwise."""
    q, p = np.split(
        np.asarray(draws.sample_states(scenes.two_body(), 20_000, jax.random.key(0))), 2, 1
    )
    r = np.linalg.norm(q, axis=1)
    a = 1 / (2 / r - (p**2).sum(1))
    momentum = q[:, 0] * p[:, 1] - q[:, 1] * p[:, 0]
    assert (momentum > 0).all()
    laplace = np.stack([p[:, 1], -p[:, 0]], 1) * momentum[:, None] - q / r[:, None]
    e = np.linalg.norm(laplace, axis=1)
    ecc = np.arctan2((q * p).sum(1) / np.sqrt(a), 1 - r / a)
    mean_anomaly = (ecc - e * np.sin(ecc)) % (2 * np.pi)
    periapsis = np.arctan2(laplace[:, 1], laplace[:, 0]) % (2 * np.pi)
    for value, low, high in (
        (a, 0.8, 1.2),
        (e, 0.0, 0.05),
        (mean_anomaly, 0, 2 * np.pi),
        (periapsis, 0, 2 * np.pi),
    ):
        assert low - 1e-12 <= value.min()
        assert value.max() <= high + 1e-12
        quantiles = (np.quantile(value, [0.1, 0.3, 0.5, 0.7, 0.9]) - low) / (high - low)
        np.testing.assert_allclose(quantiles, [0.1, 0.3, 0.5, 0.7, 0.9], atol=0.015)


@pytest.mark.parametrize(
    "name",
    [
        "two-body",
        "henon-heiles-regular",
        "pcr3bp",
        "driven-pendulum",
        pytest.param("henon-heiles-printed", marks=pytest.mark.slow),
    ],
)
def test_reversor(name):
    """ρᵀJρ = −J, and H∘ρ = H in the inner coordinates, so that φ∘ρ∘φ = ρ; features keep or flip."""
    scene = scenes.make(name)
    rho = np.array(scene.reversor, float)
    form = symplectic_form(scene.dim)
    np.testing.assert_array_equal(form * np.outer(rho, rho), -form)
    z = np.random.default_rng(1).uniform(0.2, 0.6, (20, 2 * scene.dim))
    y = to_inner(scene.coordinates, z)
    energy = jax.jit(jax.vmap(lambda y: scene.hamiltonian(scene.coordinates.inverse(y))))
    np.testing.assert_allclose(energy(y * rho), energy(y), atol=1e-14, rtol=0)
    if scene.features is not None:
        features = jax.jit(jax.vmap(scene.features))
        np.testing.assert_allclose(
            np.abs(features(y)), np.abs(features(y * rho)), atol=1e-14, rtol=0
        )


def test_polar_coordinates_are_canonical():
    scene = scenes.two_body()
    z = draws.sample_states(scene, 50, jax.random.key(2))
    jacobian = jax.jit(jax.vmap(jax.jacfwd(scene.coordinates.forward)))(z)
    assert symplecticity_defect(np.asarray(jacobian)).max() < 1e-14
    y = to_inner(scene.coordinates, z)
    np.testing.assert_allclose(to_user(scene.coordinates, y), z, atol=1e-15, rtol=0)
    np.testing.assert_allclose(y[:, 3], z[:, 0] * z[:, 3] - z[:, 1] * z[:, 2], atol=1e-15, rtol=0)


def test_standard_map_is_the_papers_and_preserves_area():
    step = scenes.standard_map(k=1.2).step
    z = jnp.array([0.7, 2.0])
    p = 2.0 + 1.2 * math.sin(0.7)
    np.testing.assert_array_equal(step(z), [0.7 + p, p])
    states = np.random.default_rng(3).uniform(0, 7, (100, 2))
    jacobian = np.asarray(jax.jit(jax.vmap(jax.jacfwd(step)))(states))
    assert symplecticity_defect(jacobian).max() < 1e-15


def test_the_regular_standard_map_orbit_jumps_between_two_islands():
    scene = scenes.standard_map()
    theta, p = tr.reference_trajectories(scene, np.array([scene.sampling.start]), 10_000)[0].T
    np.testing.assert_array_less(np.abs(p - np.pi), 0.6)
    assert (np.cos(theta[::2]) > 0.4).all()
    assert (np.cos(theta[1::2]) < -0.4).all()


def test_hamiltonians():
    """Values worked out by hand, the critical energies, and the printed form's second invariant."""
    z = jnp.array([0.1, 0.2, 0.3, 0.4])
    base = (0.09 + 0.16) / 2 + (0.01 + 0.04) / 2 + 0.01 * 0.2
    for printed, sign in ((False, -1), (True, 1)):
        energy = scenes.henon_heiles(printed=printed).hamiltonian(z)
        np.testing.assert_allclose(energy, base + sign * 0.008 / 3, rtol=1e-15)
    saddle = jnp.array([0.0, 1.0, 0.0, 0.0])
    np.testing.assert_allclose(scenes.henon_heiles().hamiltonian(saddle), 1 / 6, rtol=1e-15)
    field = hamiltonian_vector_field(scenes.henon_heiles().hamiltonian)
    np.testing.assert_allclose(field(saddle), 0, atol=1e-15)
    # L4 is an equilibrium of the restricted three-body problem.
    mu, height = 0.012150585, math.sqrt(3) / 2
    l4 = jnp.array([0.5 - mu, height, -height, 0.5 - mu])
    np.testing.assert_allclose(
        hamiltonian_vector_field(scenes.pcr3bp().hamiltonian)(l4), 0, atol=1e-15
    )
    for energy in (1e-6, 1 / 12, 0.15, 1 / 6):
        scene = scenes.henon_heiles(energy=energy)
        start = jnp.array(scene.sampling.start)
        np.testing.assert_allclose(scene.hamiltonian(start), energy, rtol=1e-14)


LYAPUNOV_TIME = 2_000


def exponents(scene, states):
    """Lyapunov exponents up to LYAPUNOV_TIME, by the tangent map renormalised at every step; of a
    return map those of the flow, of which they are a multiple."""
    hamiltonian = scene.hamiltonian
    if scene.section is not None:
        hamiltonian, states = scene.section.hamiltonian, jax.vmap(scene.section.lift)(states)
    if scene.step is not None:
        h = 1.0

        def step(z, t):
            return scene.step(z)

    else:
        field = hamiltonian_vector_field(hamiltonian)
        h = 0.02 if scene.name == "pcr3bp" else 0.1

        def step(z, t):
            k1 = field(z, t)
            k2 = field(z + h / 2 * k1, t + h / 2)
            k3 = field(z + h / 2 * k2, t + h / 2)
            return z + h / 6 * (k1 + 2 * k2 + 2 * k3 + field(z + h * k3, t + h))

    def advance(carry, i):
        z, v, growth = carry
        z, v = jax.jvp(lambda z: step(z, h * i), (z,), (v,))
        norm = jnp.linalg.norm(v)
        return (z, v / norm, growth + jnp.log(norm)), None

    def one(z):
        start = (z, jnp.ones_like(z) / math.sqrt(z.size), 0.0)
        return jax.lax.scan(advance, start, jnp.arange(LYAPUNOV_TIME / h))[0][2]

    # A long run: it is worth compiling well, whatever the suite's own flags say.
    optimised = jax.jit(jax.vmap(one), compiler_options={"xla_backend_optimization_level": 2})
    return np.asarray(optimised(states)) / LYAPUNOV_TIME


LONG_ONES = """
    henon-heiles-printed henon-heiles-regular henon-heiles-chaotic henon-heiles-section pcr3bp
    toda fput froeschle driven-pendulum driven-pendulum-phase pendulum-length
"""
LONG = LONG_ONES.split()


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=pytest.mark.slow if n in LONG else ())
        for n in scenes.names()
        if n != "n-body"  # some of its bodies meet others: neither is claimed
    ],
)
def test_orbits_are_regular_or_chaotic_as_they_should_be(name):
    """An exponent that falls as log(t)/t is regular: by t = 2,000 far below any chaotic one."""
    scene = scenes.make(name)
    if name == "pcr3bp":  # the orbit is regular; about one in twenty of its neighbours is not
        assert exponents(scene, jnp.array([scene.sampling.start]))[0] < 0.008
        found = exponents(scene, draws.sample_states(scene, 60, jax.random.key(4)))
        assert np.median(found) < 0.008
        assert np.mean(~(found < 0.02)) < 0.15
    elif scene.regular:
        found = exponents(scene, draws.sample_states(scene, 60, jax.random.key(4)))
        assert np.quantile(found, 0.95) < 0.008
    else:
        found = exponents(scene, draws.sample_test_states(scene, 60, jax.random.key(4)))
        # An orbit may stick to an island for a part of the time.
        assert np.median(found) > 0.1
        assert found.min() > 2 * 0.008


@pytest.mark.slow
def test_orbits_of_the_section_stay_in_the_island_and_of_the_pendulum_near_the_disc():
    section, pendulum = scenes.henon_heiles_section(), scenes.driven_pendulum()
    law = jax.random.key(5)
    z = tr.reference_trajectories(section, draws.sample_states(section, 20, law), 30)
    y, p_y = np.moveaxis(z, -1, 0)
    assert (((y - 0.25) / 0.32) ** 2 + (p_y / 0.2) ** 2 < 1).all()
    z = tr.reference_trajectories(pendulum, draws.sample_test_states(pendulum, 40, law), 60)
    assert np.linalg.norm(z, axis=-1).max() < 0.8


@pytest.mark.slow
def test_chaotic_henon_heiles_stays_in_the_well():
    scene = scenes.henon_heiles(energy=1 / 6)
    for law in (scene.sampling, scene.test_states):
        orbit = tr.reference_trajectories(scene, np.array([law.start]), 2_000)
        assert np.abs(orbit[..., :2]).max() < 1.01


def test_the_same_scene_made_twice_has_the_same_functions():
    """Check that a program compiled for one serves the other."""
    for name in scenes.names():
        one, other = scenes.make(name), scenes.make(name)
        assert one == other
        for function in ("flow", "step", "section", "hamiltonian", "sampling", "test_states"):
            assert hash(getattr(one, function)) == hash(getattr(other, function))


def test_names_and_mistakes():
    for name in scenes.names():
        assert scenes.make(name).name == name
    assert scenes.make("two-body", dt=0.25).dt == 0.25
    assert scenes.make("driven-pendulum", dt=4 * math.pi).dt == scenes.driven_pendulum(2).dt
    for name, dt, told in (
        ("twobody", None, "'two-body'"),
        ("standard-map-chaotic", 0.5, r"its dt is 1, got 0\.5"),
        ("driven-pendulum", 3.0, r"6\.2831853"),
        ("pcr3bp", math.nan, "finite and > 0"),
    ):
        with pytest.raises(ValueError, match=told):
            scenes.make(name, dt=dt)
    with pytest.raises(ValueError, match="energy must be"):
        scenes.henon_heiles(energy=0.2)
