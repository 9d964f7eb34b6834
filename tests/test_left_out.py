"""Fits without each part of the rows, from one linearisation of each part."""

import numpy as np

from gfnn_jax.families.terms import given_terms
from gfnn_jax.fitting.gauss_newton import Problem, without_each
from gfnn_jax.flows.collocation import Steps, images

PENDULUM, STEPS = given_terms(1, ["p1**2", "cos(q1)", "q1**2"]), Steps(6, 1)
TRUE = np.array([0.5, -1.0, 0.0])
PARTS = np.array_split(np.arange(40), 5)


class Counted(Problem):
    """Problem that counts the rows which are linearised, and the fits."""

    rows, fits = 0, 0

    def linearised(self, family, coefficients, steps, rows):
        self.rows += len(rows)
        return super().linearised(family, coefficients, steps, rows)

    def fit(self, *args, **options):
        self.fits += 1
        return super().fit(*args, **options)


def problem(noise):
    rng = np.random.default_rng(0)
    z0 = rng.uniform(-2, 2, (40, 2))
    z1 = images(PENDULUM, TRUE, z0, 0.4, STEPS).states
    return Counted(z0, z1 + noise * rng.normal(size=z1.shape), 0.4, np.ones(2))


def refits(own, start):
    kept = (np.setdiff1d(np.arange(40), part) for part in PARTS)
    own = Problem(own.z0, own.z1, own.dt, own.scale)
    fits = (own.fit(PENDULUM, start, rows, rounds=False, steps=STEPS) for rows in kept)
    return np.array([fit.coefficients for fit in fits])


def test_each_part_is_linearised_once():
    own = problem(1e-3)
    every = Problem(own.z0, own.z1, own.dt, own.scale)
    c = every.fit(PENDULUM, TRUE, rounds=False, steps=STEPS).coefficients
    found = np.array(without_each(own, PENDULUM, c, STEPS, PARTS))
    expected = refits(own, c)
    moved = np.abs(expected - c).max()
    assert np.abs(found - expected).max() < 0.02 * moved
    assert own.rows == 40
    assert own.fits == 0


def test_pairs_without_noise_leave_the_law_as_it_is():
    own = problem(0.0)
    found = without_each(own, PENDULUM, TRUE, STEPS, PARTS)
    np.testing.assert_allclose(found, np.tile(TRUE, (5, 1)), atol=1e-14)
    assert own.rows == 0
    assert own.fits == 0


def test_far_from_the_optimum_the_fits_are_made():
    own = problem(1e-3)
    start = np.array([0.4, -0.7, 0.1])
    found = without_each(own, PENDULUM, start, STEPS, PARTS)
    np.testing.assert_allclose(found, refits(own, start), rtol=1e-10)
    assert own.fits == 5
