"""Laws of physics told nothing: shapes, arguments, matching, the search, and a fit with it.

Truths are closed formulas integrated by SciPy; derivatives are held against finite differences.
"""

import json
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from analytic import moved

import gfnn_jax as gfnn
from gfnn_jax.evaluate.report import assemble, to_json
from gfnn_jax.families.terms import given_terms
from gfnn_jax.fitting.gauss_newton import Problem
from gfnn_jax.flows.collocation import Steps, images
from gfnn_jax.flows.uniform import Uniform
from gfnn_jax.models.textbook.atoms import (
    Factor,
    arguments_of,
    atom_text,
    constants_of,
    gradient_of,
    powers_of,
    with_constants,
)
from gfnn_jax.models.textbook.dictionary import Setting
from gfnn_jax.models.textbook.matching import Matching
from gfnn_jax.models.textbook.search import Textbook
from gfnn_jax.models.textbook.shapes import constants_for, has_constant, kinds_for, values
from gfnn_jax.phase_space import apply_j, sizes

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

from posteriors.calibration import pendulum


def pairs_of(gradient, z0, dt=0.1):
    """Pairs of ż = J∇H by another solver."""
    return gfnn.Pairs(z0, moved(lambda _, z: apply_j(gradient(z.T)).T, z0, dt), dt)


def ring(count, dim=2):
    """Positions from 0.6 to 2 around the origin, momenta within 1."""
    rng = np.random.default_rng(0)
    radius, angle = rng.uniform(0.6, 2.0, count), rng.uniform(0, 2 * np.pi, count)
    p = rng.uniform(-1, 1, (count, dim))
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), p])


def kepler_pairs(count):
    def gradient(z):
        q, p = z[:, :2], z[:, 2:]
        return np.concatenate([q / np.sum(q**2, axis=1, keepdims=True) ** 1.5, p], axis=1)

    return pairs_of(gradient, ring(count))


def morse_pairs(count):
    rng = np.random.default_rng(0)
    z0 = np.column_stack([rng.uniform(-0.5, 1.8, count), rng.uniform(-0.8, 0.8, count)])

    def gradient(z):
        e = np.exp(-1.3 * z[:, :1])
        return np.concatenate([2.08 * (e - e * e), z[:, 1:]], axis=1)

    return pairs_of(gradient, z0)


def softened_pairs(count):
    """H = ½|p|² − 1/√(0.53 + |q|²)."""

    def gradient(z):
        q, p = z[:, :2], z[:, 2:]
        under = 0.53 + np.sum(q**2, axis=1, keepdims=True)
        return np.concatenate([q / under**1.5, p], axis=1)

    return pairs_of(gradient, np.random.default_rng(0).uniform(-1.5, 1.5, (count, 4)))


def outside_pairs(count):
    """H = ½p² + 0.8 q arctan(2.3 q) + 0.4 log(1 + e^(1.7 q)), of no library."""
    z0 = np.random.default_rng(0).uniform(-1, 1, (count, 2)) * [2.0, 1.0]

    def gradient(z):
        q = z[:, :1]
        force = 0.8 * (np.arctan(2.3 * q) + 2.3 * q / (1 + 5.29 * q * q))
        return np.concatenate([force + 0.68 / (1 + np.exp(-1.7 * q)), z[:, 1:]], axis=1)

    return pairs_of(gradient, z0)


def searched(pairs, **options):
    problem = Problem(pairs.z0, pairs.z1, pairs.dt, sizes(pairs.z0))
    search = Textbook(problem, np.arange(len(pairs.z0)), **options)
    return search.law(products=False) or search.law(products=True)


def two_centres(z):
    """∇ of ½p² − 0.8/|q − (−0.2, 0)| − 0.3/|q − (0.7, 0.4)|."""
    q, force = z[:, :2], np.zeros((len(z), 2))
    for weight, centre in ((0.8, (-0.2, 0.0)), (0.3, (0.7, 0.4))):
        away = q - np.array(centre)
        force += weight * away / np.linalg.norm(away, axis=1, keepdims=True) ** 3
    return np.concatenate([force, z[:, 2:]], axis=1)


def top(z):
    """∇ of ½p₂² + ½(p₁ − p₃ cos q₂)²/sin² q₂ + 0.8 p₃² + 1.5 cos q₂."""
    (_, q, _), (p1, p2, p3) = z[:, :3].T, z[:, 3:].T
    sin, cos, none = np.sin(q), np.cos(q), np.zeros(len(z))
    turned = (p1 - p3 * cos) / sin
    force = turned * p3 - turned**2 * cos / sin - 1.5 * sin
    return np.stack([none, force, none, turned / sin, p2, 1.6 * p3 - turned * cos / sin], axis=1)


def read(law):
    """text -> coefficient of the terms that are not roundoff."""
    named = zip(law.family.term_names, law.coefficients, strict=True)
    return {name: c for name, c in named if abs(c) > 1e-9}


# What laws are made of


def test_every_shape_has_the_slope_of_its_value():
    x, step = np.linspace(0.4, 1.9, 7), 1e-6
    for kind in kinds_for(x):
        for theta in constants_for(kind, x)[::5] if has_constant(kind) else [None]:
            slope = values(kind, x, theta)[1]
            ahead, behind = (values(kind, x + s, theta)[0] for s in (step, -step))
            expected = (ahead - behind) / (2 * step)
            size = 1e-7 * (np.abs(values(kind, x, theta)[0]).max() + np.abs(slope).max() + 1)
            np.testing.assert_allclose(slope, expected, rtol=1e-6, atol=size, err_msg=str(kind))


@pytest.mark.parametrize("dim", [1, 2, 3, 4])
def test_atoms_are_the_formulas_that_they_are_written_as(dim):
    """Of every argument one atom; the text, parsed and differentiated, has the atom's gradient."""
    z = np.random.default_rng(0).uniform(0.5, 1.5, (9, 2 * dim))
    arguments = arguments_of(z, angles=(0,) if dim == 2 else ())
    for place, argument in enumerate(arguments):
        one_signed = np.ptp(np.sign(argument.value)) == 0
        kinds = [("power", 3.0), ("root", 1.0), ("softened", 0.0), ("gauss", 0.0)]
        kinds.append(("exp", 1.0))
        kinds += [("power", -2.0)] if one_signed else []
        for kind in kinds:
            theta = 0.7 if has_constant(kind) else None
            atom = (Factor(0, ("power", 2.0)), Factor(place, kind, theta))
            text = atom_text(atom, arguments)
            expected = given_terms(dim, [text]).gradient(np.ones(1), z)
            np.testing.assert_allclose(
                gradient_of(atom, arguments), expected, rtol=1e-11, atol=1e-12
            )


def test_the_derivative_in_a_constant_is_that_of_the_gradient():
    z = ring(5)
    arguments = arguments_of(z)
    place = next(i for i, a in enumerate(arguments) if a.text == "sqrt(q1**2 + q2**2)")

    def gradient(theta):
        return gradient_of((Factor(place, ("exp", -1.0), theta),), arguments)

    slope = gradient_of((Factor(place, ("exp", -1.0), -0.7),), arguments, along=0)
    expected = (gradient(-0.7 + 1e-6) - gradient(-0.7 - 1e-6)) / 2e-6
    np.testing.assert_allclose(slope, expected, rtol=1e-8)


def test_a_distance_from_a_centre_is_the_formula_that_it_is_written_as():
    z = ring(5)
    arguments = arguments_of(z)
    place = next(i for i, a in enumerate(arguments) if a.axes)
    centre = (0.8, -0.3)
    atom = (Factor(place, ("power", -3.0), centre=centre),)
    assert atom_text(atom, arguments) == "1/sqrt((q1 - 0.8)**2 + (q2 + 0.3)**2)**3"
    assert constants_of(with_constants(atom, (0.0, 0.5))) == [0.0, 0.5]
    expected = given_terms(2, [atom_text(atom, arguments)]).gradient(np.ones(1), z)
    np.testing.assert_allclose(gradient_of(atom, arguments), expected, rtol=1e-12, atol=1e-12)
    for axis in (0, 1):
        ahead, behind = (
            gradient_of(with_constants(atom, centre + sign * 1e-6 * np.eye(2)[axis]), arguments)
            for sign in (1, -1)
        )
        slope = gradient_of(atom, arguments, along=axis)
        np.testing.assert_allclose(slope, (ahead - behind) / 2e-6, rtol=1e-6, atol=1e-8)


def test_products_of_coordinates_are_read_as_such():
    atom = (Factor(0, ("power", 2.0)), Factor(3, ("power", 1.0)))
    assert powers_of(atom, 4) == (2, 0, 0, 1)
    assert powers_of((Factor(0, ("power", -1.0)),), 4) is None


def test_an_atom_that_a_match_holds_twice_is_one_term():
    setting = Setting(ring(60), np.ones(4))
    distance = next(i for i, x in enumerate(setting.arguments) if x.text.startswith("sqrt"))
    pole, cube = (Factor(distance, ("power", -1.0)),), (Factor(0, ("power", 3.0)),)
    atoms = setting.ordered((pole, cube, pole))
    assert atoms[-2:] == (cube, pole)
    assert setting.terms(atoms).num_parameters == len(atoms) == len(setting.base) + 2


def test_matching_finds_atoms_that_were_put_there_and_their_constants():
    z = ring(60)
    setting = Setting(z, np.ones(4))
    setting.base = setting.base[:4]  # the coordinates
    setting.weigh(np.ones(4))
    arguments = setting.arguments
    place = {a.text: i for i, a in enumerate(arguments)}
    true = (
        (Factor(place["sqrt(q1**2 + q2**2)"], ("exp", -1.0), -0.7),),
        (Factor(place["q1 - q2"], ("power", 3.0)),),
    )
    target = sum(c * gradient_of(a, arguments) for c, a in zip((-1.5, 0.2), true, strict=True))
    best = Matching(setting, target.ravel()).best(setting.dictionary(), 3)[0]
    assert best.left < 1e-12
    found = {(f.place, f.kind): f.theta for atom in best.atoms for f in atom}
    assert found[true[0][0].place, ("exp", -1.0)] == pytest.approx(-0.7, abs=1e-11)
    assert (true[1][0].place, ("power", 3.0)) in found


# The search


def broken_kepler_pairs(count, broken):
    """Kepler with ``broken`` q1² more."""

    def gradient(z):
        q, p = z[:, :2], z[:, 2:]
        force = q / np.sum(q**2, axis=1, keepdims=True) ** 1.5
        return np.concatenate([force + 2 * broken * q * [1.0, 0.0], p], axis=1)

    return pairs_of(gradient, ring(count))


@pytest.mark.slow
def test_a_softened_distance_is_found():
    found = read(searched(softened_pairs(300)))
    expected = {"p1²": 0.5, "p2²": 0.5, "1/sqrt(0.53 + q1**2 + q2**2)": -1.0}
    assert found == pytest.approx(expected, abs=1e-11)


@pytest.mark.slow
def test_a_slightly_broken_symmetry_is_found():
    assert read(searched(broken_kepler_pairs(200, 1e-4)))["q1²"] == pytest.approx(1e-4, rel=1e-8)


def test_constants_inside_come_out_exactly():
    """Morse: ½p² + 0.8 (1 − e^(−1.3 q))²."""
    found = read(searched(morse_pairs(150)))
    expected = {"p1²": 0.5, "exp(-2.6*q1)": 0.8, "exp(-1.3*q1)": -1.6}
    assert found == pytest.approx(expected, abs=1e-11)


@pytest.mark.slow
def test_exponentials_of_either_sign_are_a_hyperbolic_cosine():
    """½(p₁² + p₂²) + e^(q₁ − q₂) + e^(q₂ − q₁)."""

    def gradient(z):
        slope = 2 * np.sinh(z[:, :1] - z[:, 1:2])
        return np.concatenate([slope, -slope, z[:, 2:]], axis=1)

    z0 = np.random.default_rng(0).uniform(-1, 1, (200, 4))
    found = read(searched(pairs_of(gradient, z0)))
    expected = {"p1²": 0.5, "p2²": 0.5, "cosh(q1 - q2)": 2.0}
    assert found == pytest.approx(expected, abs=1e-10)


@pytest.mark.slow
def test_a_mass_that_depends_on_the_distance_is_found_beside_a_pole():
    """Radial motion around a black hole (Schwarzschild), less a constant."""

    def gradient(z):
        (r, p), beyond = z.T, 1 / (z[:, 0] - 2)
        return np.stack([p**2 / r**2 - 16 / r**3 + beyond**2, (1 - 2 / r) * p], axis=1)

    rng = np.random.default_rng(0)
    z0 = np.stack([rng.uniform(8, 20, 200), rng.uniform(-0.3, 0.3, 200)], axis=1)
    pairs = pairs_of(gradient, z0, dt=1.0)
    problem = Problem(pairs.z0, pairs.z1, pairs.dt, sizes(pairs.z0))
    found = read(Textbook(problem, np.arange(200)).law(products=True))
    expected = {"p1²": 0.5, "p1**2/q1": -1.0, "1/q1**2": 8.0, "1/(-2 + q1)": -1.0}
    assert found == pytest.approx(expected, abs=1e-8)


@pytest.mark.slow
def test_centres_beside_the_origin_are_found_told_nothing():
    rng = np.random.default_rng(0)
    z0 = rng.uniform(-1, 1, (600, 4)) * [1.6, 1.6, 1, 1]
    apart = [np.linalg.norm(z0[:, :2] - c, axis=1) for c in ((-0.2, 0), (0.7, 0.4))]
    pairs = pairs_of(two_centres, z0[np.min(apart, axis=0) > 0.45][:250], dt=0.05)
    problem = Problem(pairs.z0, pairs.z1, pairs.dt, sizes(pairs.z0))
    found = read(Textbook(problem, np.arange(250)).law(centres=True))
    expected = {
        "p1²": 0.5,
        "p2²": 0.5,
        "1/sqrt((q1 + 0.2)**2 + q2**2)": -0.8,
        "1/sqrt((q1 - 0.7)**2 + (q2 - 0.4)**2)": -0.3,
    }
    assert found == pytest.approx(expected, abs=1e-12)


@pytest.mark.slow
def test_a_heavy_top_in_eulers_angles_is_found_told_nothing():
    rng = np.random.default_rng(0)
    low, high = [-3, 0.5, -3, -1, -1, -1], [3, 2.6, 3, 1, 1, 1]
    pairs = pairs_of(top, rng.uniform(low, high, (200, 6)), dt=0.05)
    problem = Problem(pairs.z0, pairs.z1, pairs.dt, sizes(pairs.z0))
    found = read(Textbook(problem, np.arange(200), angles=(0, 1, 2)).law(products=True))
    expected = {
        "p2²": 0.5,
        "p3²": 0.3,
        "cos(q2)": 1.5,
        "p1**2/sin(q2)**2": 0.5,
        "p3**2/sin(q2)**2": 0.5,
        "p1*p3*cos(q2)/sin(q2)**2": -1.0,
    }
    assert found == pytest.approx(expected, abs=1e-12)


@pytest.mark.slow
def test_a_good_approximation_is_no_formula():
    """cos(q) e^(−q²/10) is of no dictionary; five atoms of others come to 1e-11 of it."""
    z0 = np.random.default_rng(0).uniform(-1.3, 1.3, (160, 2))

    def gradient(z):
        q = z[:, :1]
        force = (np.sin(q) + 0.2 * q * np.cos(q)) * np.exp(-0.1 * q * q)
        return np.concatenate([force, z[:, 1:]], axis=1)

    assert searched(pairs_of(gradient, z0, dt=0.2)) is None


def test_noise_is_no_formula():
    pairs = morse_pairs(100)
    rng = np.random.default_rng(0)
    noisy = gfnn.Pairs(pairs.z0, pairs.z1 + 1e-4 * rng.normal(size=pairs.z1.shape), pairs.dt)
    assert searched(noisy) is None


# In a fit


@pytest.mark.slow
def test_friction_is_found_beside_a_law_of_physics():
    law, c = given_terms(1, ["p**2/2", "exp(-1.3*q)", "exp(-2.6*q)"]), [1.0, -2.0, 1.0, 0.08]
    rng = np.random.default_rng(0)
    z0 = np.column_stack([rng.uniform(-0.4, 1.5, 200), rng.uniform(-0.8, 0.8, 200)])
    z1 = images(Uniform(law), np.array(c), z0, 0.1, Steps(6, 2)).states
    fit = gfnn.fit(gfnn.Pairs(z0, z1, 0.1), tolerance=1e-10, learn="hamiltonian")
    found = {term.term: term.coefficient for term in fit.hamiltonian.terms}
    assert found == pytest.approx(
        {"p1²": 0.5, "exp(-1.3*q1)": -2.0, "exp(-2.6*q1)": 1.0}, abs=1e-10
    )
    assert fit.friction.terms[0].coefficient == pytest.approx(0.08, abs=1e-10)


@pytest.mark.slow
def test_a_law_is_found_where_sums_with_spare_atoms_leave_roundoff_too():
    # Of these pairs every sum of five atoms that holds cos q leaves roundoff, and no fewer are met.
    pairs = gfnn.sample_pairs(pendulum(), 100, jax.random.key(29))
    fit = gfnn.fit(pairs, seed=29, learn="hamiltonian", max_seconds=None)
    assert fit.formula == "0.5*p1**2 - cos(q1)"


def test_a_fit_told_nothing_finds_keplers_law():
    pairs, fresh = kepler_pairs(200), kepler_pairs(250).take(np.arange(200, 250))
    fit = gfnn.fit(pairs, tolerance=1e-8)
    assert fit.chosen.learns == "hamiltonian"
    assert fit.formula == "0.5*p1**2 + 0.5*p2**2 - 1/sqrt(q1**2 + q2**2)"
    error = np.asarray(fit.map.step(fresh.z0)[0]) - fresh.z1
    assert np.sqrt(np.mean(error**2)) < 1e-13
    of_p1, of_p2, _ = (term.coefficient for term in fit.hamiltonian.terms)
    assert abs(of_p1 - of_p2) <= 2e-15  # a rotation turns one into the other


@pytest.mark.slow
def test_a_law_outside_of_the_dictionary_ends_as_a_map():
    fit = gfnn.fit(outside_pairs(400), tolerance=1e-6, max_seconds=None)
    assert fit.chosen.learns == "map"
    assert len(fit.partial_laws) == 3
    assert all("p1²" in law.formula and 1e-10 < law.left < 1e-2 for law in fit.partial_laws)
    told = json.loads(to_json(assemble(fit)))
    assert told["partial_laws"][0]["formula"] == fit.partial_laws[0].formula
