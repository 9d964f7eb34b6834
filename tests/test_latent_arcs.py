"""Gauss–Newton over arcs: how many evaluations of a model it takes."""

import numpy as np

from gfnn_jax.solve.arc_models import Defects, Observed
from gfnn_jax.solve.latent_arcs import fit_arcs


class _Still:
    """A state x that does not move, of which arctan x is seen. ``sizes``: of each evaluation, in
    arcs."""

    def __init__(self, sizes, arcs=None):
        self.sizes, self.arcs = sizes, arcs

    def take(self, arcs):
        return _Still(self.sizes, arcs)

    def defects(self, p, x):
        self.sizes.append((len(x), None if self.arcs is None else self.arcs.tolist()))
        shape = (len(x), x.shape[1] - 1, 1)
        return Defects(x[:, :-1] - x[:, 1:], np.ones((*shape, 1)), np.zeros((*shape, 0)))

    def observe(self, p, x):
        by_state = 1 / (1 + x**2)
        return Observed(np.arctan(x), by_state[..., None], np.zeros((*x.shape, 0)))


def test_of_arcs_that_share_nothing_only_those_are_halved_that_got_worse():
    """From 3 a whole step to arctan x = 0 goes to −9.5, from 0.1 to −7e-4."""
    sizes, start = [], np.array([0.1, 3.0, -0.2])
    x, unit = np.tile(start[:, None, None], (1, 4, 1)), np.ones(1)
    fit = fit_arcs(_Still(sizes), np.zeros(0), x, 0 * x, unit, unit, tolerance=1e-12)
    assert fit.converged
    np.testing.assert_allclose(fit.x, 0, atol=1e-6)
    assert {arcs[0] for size, arcs in sizes if size == 1} == {1}
    assert {size for size, _ in sizes} == {1, 3}
    alone = fit_arcs(_Still([]), np.zeros(0), x[1:2], 0 * x[1:2], unit, unit, tolerance=1e-12)
    np.testing.assert_allclose(fit.x[1], alone.x[0], atol=1e-9)


class _Growth:
    """x' = k x² sampled at times 0.1 apart, seen directly."""

    def __init__(self):
        self.count = 0

    def take(self, arcs):
        return self

    def defects(self, p, x):
        self.count += 1
        here = x[:, :-1]
        slope = 1 / (1 - 0.1 * p[0] * here)
        by_coefficient = 0.1 * here**2 * slope**2
        return Defects(here * slope - x[:, 1:], (slope**2)[..., None], by_coefficient[..., None])

    def observe(self, p, x):
        return Observed(x, np.ones((*x.shape, 1)), np.zeros((*x.shape, 1)))


def test_a_step_whose_defects_alone_are_too_large_is_closed_and_not_made_shorter():
    """Orbits bend in the coefficient, so that of a whole step states are off by more than their
    noise; halved steps take 25 evaluations."""
    model, t, sigma = _Growth(), 0.1 * np.arange(40), np.array([1e-3])
    first = np.array([[0.2], [-0.6]])
    noise = sigma * np.random.default_rng(0).normal(size=(2, 40))
    y, x = (first / (1 - k * first * t) for k in (1.0, 0.5))
    fit = fit_arcs(model, np.array([0.5]), x[..., None], (y + noise)[..., None], sigma, sigma)
    assert fit.converged
    assert model.count <= 10
    assert abs(fit.p[0] - 1) < 4 * np.sqrt(fit.covariance()[0, 0])


class _Fork:
    """x' = x + p where x is above 0, x − p where it is not, seen directly."""

    def take(self, arcs):
        return self

    def defects(self, p, x):
        way = np.where(x[:, :-1] > 0, 1.0, -1.0)
        ones = np.ones((*way.shape, 1))
        return Defects(x[:, :-1] + p[0] * way - x[:, 1:], ones, way[..., None])

    def observe(self, p, x):
        return Observed(x, np.ones((*x.shape, 1)), np.zeros((*x.shape, 1)))


def test_arcs_that_no_step_closes_are_made_orbits():
    """The first arc stands where its steps jump, and its data pull it across: every step of the
    coefficient, which both share, leaves larger defects than those of the second."""
    n, unit = np.arange(6.0), np.ones(1)
    x = np.stack([1e-12 + n, 2 + n + 0.4 * (-1) ** n])[..., None]
    y = np.stack([-3 + n, 2 + n])[..., None]
    fit = fit_arcs(_Fork(), np.ones(1), x, y, unit, unit)
    assert np.isfinite(fit.cost)
    np.testing.assert_allclose(np.diff(fit.x, axis=1), fit.p[0], atol=0.2)
