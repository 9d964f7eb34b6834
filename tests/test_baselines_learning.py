"""Learning baselines: the losses they minimise, what they learn of known systems, angles."""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gfnn_jax.baselines import METHODS, Budget, Sequences
from gfnn_jax.baselines.learned import learn_map, periodic
from gfnn_jax.fitting.adam import Recipe
from gfnn_jax.maps.rollout import rollout
from gfnn_jax.phase_space import hamiltonian_vector_field
from gfnn_jax.scenes import henon_heiles, standard_map
from gfnn_jax.scenes.draws import sample_sequences
from gfnn_jax.scenes.trajectories import flow_step, reference_trajectories

RECIPE = Recipe(batch_size=50, epochs=2, epoch_length=3, rate=1e-2, schedule="cosine")
QUICK = ("g-sympnet",)  # the others learn as this one does


def oscillator(num, length, dt=0.1, seed=0):
    z = np.random.default_rng(seed).uniform(-1, 1, (num, 2))
    cos, sin = np.cos(dt), np.sin(dt)
    states = [z]
    for _ in range(length - 1):
        q, p = states[-1].T
        states.append(np.stack([cos * q + sin * p, cos * p - sin * q], axis=1))
    return Sequences(np.stack(states, axis=1), dt)


@pytest.mark.slow
def test_the_flow_of_the_exact_hamiltonian_is_the_reference():
    """HNN's prediction, with H in place of its network: within the solver's tolerance."""
    scene = henon_heiles()
    field = hamiltonian_vector_field(scene.hamiltonian)
    step = flow_step(field, scene.dt, 1e-10)
    z0 = sample_sequences(scene, 5, 2, jax.random.key(0))[:, 0]
    expected = reference_trajectories(scene, z0, 20)
    np.testing.assert_allclose(rollout(step, z0, 20), expected, atol=2e-8)
    energy = jax.vmap(jax.vmap(scene.hamiltonian))(rollout(step, z0, 20))
    np.testing.assert_allclose(energy, energy[:, :1] * np.ones((1, 21)), rtol=1e-8)


@pytest.mark.slow
def test_a_flow_that_fails_is_nan():
    """ż = z² reaches infinity at t = 1."""
    step = flow_step(lambda z: z**2, 2.0, 1e-9)
    assert np.isnan(np.asarray(step(jnp.array([1.0, 1.0])))).any()


def smaller(monkeypatch, name, recipe, **sizes):
    """The method of this name, with another recipe and other sizes where it has these."""
    module = sys.modules[METHODS[name].learn.__module__]
    monkeypatch.setattr(module, "Recipe", lambda *args, **options: recipe)
    for size, value in sizes.items():
        if hasattr(module._Options, size):
            monkeypatch.setattr(module._Options, size, value)
    return METHODS[name]


@pytest.mark.slow
def test_ridges_of_large_states_start_finite(monkeypatch):
    """States in [0, 2π), as the standard map's, through all 24 layers."""
    method = smaller(monkeypatch, "p-sympnet", dataclasses.replace(RECIPE, epochs=1))
    z = np.random.default_rng(0).uniform(0, 2 * np.pi, (100, 2, 2))
    learned = method.learn(Sequences(z, 1.0, (0, 1)), Budget(jax.random.key(0)))
    assert np.isfinite(learned.training.validation_rms)


def test_finite_differences():
    sequences = oscillator(3, 4)
    z, velocity = sequences.derivatives()
    assert z.shape == velocity.shape == (9, 2)
    assert sequences.num_pairs == 9
    np.testing.assert_allclose(z[4] + 0.1 * velocity[4], sequences.z[1, 2], rtol=1e-14)


def test_the_loss_of_a_sequence():
    """Squared distances along the sequence, at a rate that moves hardly anything: written out."""
    sequences = oscillator(50, 4)

    def step(params, z):
        return z * params

    still = dataclasses.replace(RECIPE, rate=1e-7, epochs=1, epoch_length=1, batch_size=45)
    learned = learn_map(
        step, jnp.array([0.9, 1.1]), sequences, still, Budget(jax.random.key(0)), "scaled"
    )
    total, factor = 0.0, np.array([0.9, 1.1])
    for row in sequences.z[5:]:
        z = row[0]
        for wanted in row[1:]:
            z = factor * z
            total += np.sum((z - wanted) ** 2)
    expected = np.sqrt(total / (45 * 3 * 2))
    assert learned.training.train_rms == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in METHODS]
)
def test_every_method_ends_in_a_step(name, monkeypatch):
    """Two short epochs: finite, counted, the same for the same key, in float64."""
    sizes = {"hidden": (16,), "layers": 3, "sublayers": 2, "g_layers": 3, "p_layers": 3}
    method = smaller(monkeypatch, name, RECIPE, **sizes)
    sequences = oscillator(200, method.length)
    learned = method.learn(sequences, Budget(jax.random.key(1)))
    z = jnp.asarray(sequences.z[:3, 0])
    states = np.asarray(rollout(learned.step, z, 2))
    assert states.dtype == np.float64
    assert np.isfinite(states).all()
    assert learned.num_parameters > 10
    assert learned.training.epochs == 2
    assert np.max(np.abs(states[:, 1] - sequences.z[:3, 1])) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize(("name", "share"), [("hnn", 0.2), ("srnn-5", 0.1)])
def test_learns_an_oscillator(name, share, monkeypatch):
    """RMS error in four steps, as a share of how far the states move. HNN's is that of finite
    differences: (φ − 1)/dt is the field up to dt/2."""
    recipe = dataclasses.replace(RECIPE, epochs=10, epoch_length=100)
    method = smaller(monkeypatch, name, recipe, hidden=(32,))
    learned = method.learn(oscillator(500, method.length), Budget(jax.random.key(1)))
    states = oscillator(50, 5, seed=9).z
    predicted = np.asarray(rollout(learned.step, jnp.asarray(states[:, 0]), 4))
    moved = np.sqrt(np.mean((states[:, :1] - states) ** 2))
    assert np.sqrt(np.mean((predicted - states) ** 2)) < share * moved


def test_angles_are_reduced_and_their_turns_kept():
    """A step that knows [0, 2π) only is that of the image there, and moves as far."""
    scene = standard_map()

    def step(_, z):
        return jnp.where(jnp.all((z >= 0) & (z < 2 * np.pi)), scene.step(z), jnp.nan)

    wrapped = jax.jit(lambda z: periodic(step, (0, 1))(None, z))
    turns = np.array([6 * np.pi, -2 * np.pi])
    expected = jax.jit(scene.step)(np.array([1.0, 2.0])) + turns
    np.testing.assert_allclose(wrapped(np.array([1.0, 2.0]) + turns), expected, rtol=1e-14)
    assert periodic(step, ()) is step
