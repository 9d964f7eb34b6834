"""Laws of physics behind noisy sequences: weak gradients, constants on arcs, the search, a fit.

Orbits are SciPy's; what is found is held against the formula that they were integrated with.
"""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import gfnn_jax as gfnn
from gfnn_jax.families.terms import given_terms
from gfnn_jax.flows.collocation import Steps
from gfnn_jax.models.hamiltonians.sequences import FlowOnArcs
from gfnn_jax.models.textbook.noisy_search import weak_gradients
from gfnn_jax.phase_space import apply_j


def orbits(gradient, z0, states=50, dt=0.1):
    """(B, L, 2d) of ż = J∇H by another solver."""
    shape = z0.shape

    def field(t, y):
        return apply_j(gradient(y.reshape(shape))).ravel()

    times = dt * np.arange(states)
    found = solve_ivp(
        field, (0, times[-1]), z0.ravel(), "DOP853", t_eval=times, rtol=1e-13, atol=1e-13
    )
    return np.moveaxis(found.y.reshape(*shape, states), -1, 1)


def morse(z):
    e = np.exp(-1.3 * z[..., :1])
    return np.concatenate([2.08 * (e - e * e), z[..., 1:]], axis=-1)


def radial(z):
    q = z[..., :1]
    return np.concatenate([1 / q**2 - 0.64 / q**3, z[..., 1:]], axis=-1)


def noisy(z, part, seed=1):
    """The orbits with noise of this part of the spread, and its deviation (2d,)."""
    noise = part * z.reshape(-1, z.shape[-1]).std(axis=0)
    return z + noise * np.random.default_rng(seed).normal(size=z.shape), noise


def pairs_of(z, dt=0.1):
    count, states, width = z.shape
    return gfnn.Pairs(
        z[:, :-1].reshape(-1, width),
        z[:, 1:].reshape(-1, width),
        dt,
        run=np.repeat(np.arange(count), states - 1),
        place=np.tile(np.arange(states - 1), count),
    )


def morse_orbits(count=20):
    rng = np.random.default_rng(0)
    z0 = np.column_stack([rng.uniform(-0.5, 1.6, count), rng.uniform(-0.7, 0.7, count)])
    return orbits(morse, z0)


def radial_orbits(count=20):
    rng = np.random.default_rng(0)
    z0 = np.column_stack([rng.uniform(0.7, 2.3, count), rng.uniform(-0.4, 0.4, count)])
    return orbits(radial, z0)


# Weak gradients


def test_weak_gradients_are_those_of_h_along_orbits_without_noise():
    z = morse_orbits(6)
    weak = weak_gradients(list(z), 0.1, np.full(2, 1e-9))
    assert weak is not None
    np.testing.assert_allclose(weak.average(morse(weak.states)), weak.target, atol=2e-5)


def test_the_noise_of_weak_gradients_is_what_they_are_said_to_have():
    clean = radial_orbits()
    z, noise = noisy(clean, 3e-3)
    weak = weak_gradients(list(z), 0.1, noise)
    assert weak is not None
    q, zero = weak.states[:, 0], np.zeros(len(weak.states))
    hessian = np.stack([-2 / q**3 + 1.92 / q**4, zero, zero, zero + 1], axis=-1)
    deviations = weak.deviations(hessian.reshape(-1, 2, 2))
    off = (weak.average(radial(weak.states)) - weak.target) / deviations
    np.testing.assert_allclose(np.sqrt(np.mean(off**2, axis=0)), 1.0, atol=0.12)


def test_sequences_shorter_than_a_window_tell_nothing():
    assert weak_gradients([np.zeros((12, 2))], 0.1, np.ones(2)) is None


# Constants inside


def test_steps_with_a_constant_inside_have_its_derivative():
    x = morse_orbits(3)[:, :4]

    def family(constants):
        return given_terms(1, ["p1**2", f"exp(-{constants[0]}*q1)", "exp(-2.6*q1)"])

    def model():
        return FlowOnArcs(family, 0.1, Steps(5, 1), np.ones((3, 3), bool), terms=3)

    p = np.array([0.5, -1.6, 0.8, 1.3])
    found = model().defects(p, x)
    for k in range(4):
        ahead, behind = (p + sign * 1e-5 * np.eye(4)[k] for sign in (1, -1))
        slope = (model().defects(ahead, x).closing - model().defects(behind, x).closing) / 2e-5
        np.testing.assert_allclose(found.by_coefficients[..., k], slope, rtol=1e-4, atol=1e-9)


# The search


@pytest.mark.slow
def test_a_fit_of_noisy_sequences_finds_morses_law_with_the_errors_of_its_numbers():
    z, noise = noisy(morse_orbits(10), 1e-3)
    fit = gfnn.fit(pairs_of(z), learn="hamiltonian", tolerance=1e-3, max_seconds=None)
    law = fit.hamiltonian
    assert [t.term[:5] for t in law.terms] == ["p1²", "exp(-", "exp(-"]
    assert len(law.constants) == 2
    true = {"p1²": 0.5}
    for constant in law.constants:
        steep = constant.coefficient < -2
        true[constant.term] = 0.8 if steep else -1.6
        assert abs(constant.coefficient - (-2.6 if steep else -1.3)) < 4 * constant.std < 0.05
    for term in law.terms:
        assert abs(term.coefficient - true[term.term]) < 4 * term.std < 0.05
    np.testing.assert_allclose(law.noise, noise, rtol=0.1)
    # What takes 3 s of a core, a second of it the laws' fits, is not foretold to take five: else
    # larger systems end for want of time.
    assert fit.operations < 1e9


@pytest.mark.slow
def test_clean_sequences_are_left_to_the_search_for_exact_laws():
    z = radial_orbits(20)[:, :20]
    fit = gfnn.fit(pairs_of(z), learn="hamiltonian", tolerance=1e-6, max_seconds=None)
    assert sorted(fit.formula.split()) == sorted(["0.5*p1**2", "-", "1/q1", "+", "0.32/q1**2"])
    assert fit.hamiltonian.constants == ()


# Pairs that stand alone


def swinging(z):
    return np.concatenate([np.sin(z[..., :1]), z[..., 1:]], axis=-1)


def hardening(z):
    return np.concatenate([z[..., :1] + z[..., :1] ** 3, z[..., 1:]], axis=-1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gradient", "true", "noise", "count"),
    [
        (swinging, {"p1²": 0.5, "cos(q1)": -1.0}, 1e-3, 150),
        # A polynomial of five terms leaves misfit there that is a third of the noise.
        (swinging, {"p1²": 0.5, "cos(q1)": -1.0}, 1e-6, 1_000),
        (hardening, {"q1²": 0.5, "p1²": 0.5, "q1⁴": 0.25}, 1e-3, 150),
    ],
)
def test_noisy_pairs_that_are_told_nothing_find_the_law_with_the_errors_of_its_numbers(
    gradient, true, noise, count
):
    z0 = np.random.default_rng(3).uniform(-1.2, 1.2, (count, 2))
    z, _ = noisy(orbits(gradient, z0, 2, 0.2), noise)
    pairs = gfnn.Pairs(z[:, 0], z[:, 1], 0.2)
    fit = gfnn.fit(pairs, learn="hamiltonian", tolerance=1e-6, max_seconds=None)
    law = fit.hamiltonian
    assert {t.term for t in law.terms} == set(true)
    for term in law.terms:
        assert abs(term.coefficient - true[term.term]) < 4 * term.std < 0.02
