"""Friction that is learned with H from pairs: uniform, whose flow keeps a multiple of J, or linear,
quadratic or dry."""

import numpy as np
import pytest
from analytic import block_on_a_spring, henon_heiles, mechanics, moved

import gfnn_jax as gfnn
from gfnn_jax.families.friction import DRY, LINEAR, ONE_SIDED, POWER, QUADRATIC, Friction


def pairs_of(field, z, dt):
    """Pairs by another integrator."""
    return gfnn.Pairs(z, moved(field, z, dt, atol=1e-15), dt)


@pytest.mark.parametrize("direction", [(1, -1), (-1, 1), (1, 1), (-2, -1), (-1, 0)])
def test_texts_of_friction_are_what_it_loses(direction):
    kinds = (LINEAR, QUADRATIC, DRY, POWER, ONE_SIDED)
    friction = Friction.of([(direction, kind, 4.0 if kind == POWER else 0.0) for kind in kinds], 2)
    v = np.array([0.7, 0.4])
    said = [
        part * eval(text, {"v1": v[0], "v2": v[1]}) for text, part in friction.texts(("v1", "v2"))
    ]
    np.testing.assert_allclose(said, friction.tables(v)[0], rtol=1e-12)


def states(count=200, seed=0, dim=2):
    return np.random.default_rng(seed).uniform(-0.4, 0.4, (count, 2 * dim))


def law_of(fit):
    return {t.term: t.coefficient for t in fit.hamiltonian.terms}


HENON_HEILES = {"q1²": 0.5, "q2²": 0.5, "p1²": 0.5, "p2²": 0.5, "q1² q2": 1.0, "q2³": -1 / 3}


@pytest.fixture(scope="module")
def damped():
    pairs = pairs_of(henon_heiles([0.01, 0.01]), states(), 0.5)
    return gfnn.fit(pairs, tolerance=1e-10, learn="hamiltonian")


@pytest.mark.slow
def test_uniform_friction_is_learned_with_h(damped, tmp_path):
    assert law_of(damped) == pytest.approx(HENON_HEILES, rel=1e-12)
    (rate,) = damped.hamiltonian.friction
    assert rate.coefficient == pytest.approx(0.01, abs=1e-13)
    assert damped.chosen.validation_relative < 1e-13
    assert damped.map.multiplier() == pytest.approx(np.exp(-0.005), rel=1e-14)
    assert damped.symplecticity_defect < 1e-14
    damped.map.save(tmp_path / "m")
    z = states(5, 1)
    again = gfnn.load(tmp_path / "m").map
    np.testing.assert_array_equal(again.step(z)[0], damped.map.step(z)[0])
    assert again.multiplier() == damped.map.multiplier()
    with pytest.raises(ValueError, match="without friction"):
        damped.map.modified_hamiltonian(z)


@pytest.mark.slow
def test_a_damped_forecast_and_its_energy(damped):
    """1,000 steps against another integrator: the energy falls to e⁻⁵ of itself."""
    z = states(3, 2)
    found, _ = damped.map.rollout(z, 1_000)
    exact = pairs_of(henon_heiles([0.01, 0.01]), z, 500.0).z1
    energies = (damped.map.hamiltonian(np.asarray(s)) for s in (found[:, -1], exact, z))
    energy, expected, start = map(np.asarray, energies)
    assert np.abs(energy - expected).max() < 1e-10 * start.min()
    assert (energy < 0.02 * start).all()


def test_a_pendulum_with_friction():
    rng = np.random.default_rng(0)
    z = np.stack([rng.uniform(-np.pi, np.pi, 200), rng.uniform(-1.5, 1.5, 200)], axis=1)
    pairs = pairs_of(lambda _, z: [z[1], -np.sin(z[0]) - 0.07 * z[1]], z, 0.3)
    fit = gfnn.fit(pairs, tolerance=1e-10, angles=(0,), learn="hamiltonian")
    assert law_of(fit) == pytest.approx({"cos(q1)": -1.0, "p1²": 0.5}, rel=1e-12)
    assert fit.hamiltonian.friction[0].coefficient == pytest.approx(0.07, abs=1e-13)
    assert fit.symplecticity_defect < 1e-14


@pytest.mark.slow
def test_rates_that_differ_are_no_uniform_friction():
    """A constant determinant, and no multiple of J."""
    pairs = pairs_of(henon_heiles([0.1, 0.3]), states(), 0.5)
    fit = gfnn.fit(pairs, tolerance=1e-10, learn="hamiltonian")
    assert law_of(fit) == pytest.approx(HENON_HEILES, rel=1e-11)
    found = {t.term: t.coefficient for t in fit.hamiltonian.friction}
    assert found == pytest.approx({"½ v1²": 0.1, "½ v2²": 0.3}, rel=1e-11)
    assert fit.map.multiplier() is None
    assert np.isnan(fit.symplecticity_defect)
    with pytest.raises(gfnn.FitError, match="no friction"):
        fit.accelerate()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::gfnn_jax.FitWarning")
@pytest.mark.parametrize("noise", [0.0, 1e-5])
def test_a_system_that_keeps_its_energy_gets_no_friction(noise):
    pairs = pairs_of(henon_heiles([0.0, 0.0]), states(), 0.5)
    image = pairs.z1 + noise * np.random.default_rng(1).normal(size=pairs.z1.shape)
    fit = gfnn.fit(gfnn.Pairs(pairs.z0, image, 0.5), tolerance=1e-10, learn="hamiltonian")
    assert fit.hamiltonian.friction == ()
    assert fit.map.multiplier() == 1.0


@pytest.mark.slow
def test_quadratic_friction_is_told_from_pairs():
    """Exact where no speed turns; of the kinds not there an upper limit."""
    rng = np.random.default_rng(0)
    z, fresh = (np.c_[rng.uniform(-2, 2, n), rng.uniform(-1, 1, n)] for n in (200, 50))
    pairs, others = (
        pairs_of(lambda _, z: [z[1], -np.sin(z[0]) - 0.1 * abs(z[1]) * z[1]], states, 0.3)
        for states in (z, fresh)
    )
    fit = gfnn.fit(pairs, tolerance=1e-7, angles=(0,), learn="hamiltonian")
    law = {term: c for term, c in law_of(fit).items() if abs(c) > 1e-12}
    assert law == pytest.approx({"cos(q1)": -1.0, "p1²": 0.5}, rel=1e-12)
    (found,) = fit.hamiltonian.friction
    assert found.term == "⅓ |v1|³"
    assert found.coefficient == pytest.approx(0.1, abs=1e-12)
    error = np.abs(np.asarray(fit.map.step(fresh)[0]) - others.z1).max(axis=1)
    steady = (fresh[:, 1] * others.z1[:, 1] > 0) & (np.abs(others.z1[:, 1]) > 0.05)
    assert error[steady].max() < 1e-12
    assert error.max() < 1e-6
    assert fit.map.multiplier() is None
    which = fit.hamiltonian.which_friction
    assert which.kinds == ("quadratic",)
    assert which.odds["none"] > 1e6
    assert set(which.limits) == {"v1**2", "abs(v1)"}
    assert max(which.limits.values()) < 1e-12


def block(z, dt, held=0.05):
    """Images of states (N, 2)."""
    return np.stack([block_on_a_spring(*one, np.array([dt]), held)[:, 0] for one in z])


@pytest.mark.slow
def test_dry_friction_is_told_from_pairs():
    """A block that turns and stops in some of the steps; the law is known to roundoff."""
    rng = np.random.default_rng(1)
    z, fresh = (np.c_[rng.uniform(-1, 1, n), rng.uniform(-1, 1, n)] for n in (200, 50))
    fit = gfnn.fit(gfnn.Pairs(z, block(z, 0.3), 0.3), tolerance=1e-4, learn="hamiltonian")
    assert law_of(fit) == pytest.approx({"q1²": 0.5, "p1²": 0.5}, rel=1e-12)
    (found,) = fit.hamiltonian.friction
    assert found.term == "|v1|"
    assert found.coefficient == pytest.approx(0.05, abs=1e-12)
    exact = block(fresh, 0.3)
    error = np.abs(np.asarray(fit.map.step(fresh)[0]) - exact).max(axis=1)
    assert error.max() < 3e-3
    assert np.median(error) < 1e-6
    assert fit.hamiltonian.which_friction.kinds == ("dry",)
    assert "smoothed over speeds" in fit.hamiltonian.notes[-1]


def double_pendulum(gamma, count=200, dt=0.2):
    """Pairs of two equal rods, from the accelerations of their Lagrangian."""
    z0 = np.random.default_rng(0).uniform(-1, 1, (count, 4)) * [1.5, 1.5, 0.7, 0.7]
    none = (0, 0)
    rows = [
        ((2, 0), none, none, 0.0, 1.0),
        ((0, 2), none, none, 0.0, 0.5),
        ((1, 1), none, (1, -1), 0.0, 1.0),
        (none, none, (1, 0), 0.0, 2.0),
        (none, none, (0, 1), 0.0, 1.0),
    ]
    law = mechanics(rows, uniform=gamma)

    def field(_, y):
        return np.concatenate([y[2:], law.acceleration(y[:2].T, y[2:].T).T])

    z1 = pairs_of(field, z0, dt).z1
    both = (np.c_[z[:, :2], law.momentum(z[:, :2], z[:, 2:])] for z in (z0, z1))
    return gfnn.Pairs(*both, dt)


@pytest.mark.slow
def test_a_double_pendulum_is_a_lagrangian_of_five_terms():
    fit = gfnn.fit(
        double_pendulum(0.01), tolerance=1e-10, angles=(0, 1), learn="hamiltonian", max_seconds=None
    )
    expected = {"v1²": 1, "v2²": 0.5, "v1 v2 cos(q1 - q2)": 1, "cos(q1)": 2, "cos(q2)": 1}
    assert law_of(fit) == pytest.approx(expected, rel=1e-11)
    assert fit.hamiltonian.friction[0].coefficient == pytest.approx(0.01, abs=1e-12)
    assert fit.chosen.validation_relative < 1e-12
    assert fit.symplecticity_defect < 1e-14
    assert fit.formula is not None
    assert fit.formula.startswith("Legendre transform of L = ")
