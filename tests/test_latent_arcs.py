"""Gauss–Newton over arcs: how many evaluations it takes, and arcs that are hard to close."""

import numpy as np
import pytest

from gfnn_jax.families.friction import DRY, Friction
from gfnn_jax.families.lagrangian import Terms
from gfnn_jax.flows.motion import Form
from gfnn_jax.maps.observation import Observation
from gfnn_jax.models.lagrangians.fit import LawOnArcs
from gfnn_jax.solve import latent_arcs
from gfnn_jax.solve.latent_arcs import Defects, Observed, Readings


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


def test_of_arcs_that_share_nothing_each_goes_its_own_way():
    """From 3 a whole step to arctan x = 0 goes to −9.5, from 0.1 to −7e-4."""
    sizes, start = [], np.array([0.1, 3.0, -0.2])
    x, unit = np.tile(start[:, None, None], (1, 4, 1)), np.ones(1)
    fit = Readings(_Still(sizes), 0 * x, unit).fit(np.zeros(0), x, unit, tolerance=1e-12)
    assert fit.converged
    np.testing.assert_allclose(fit.x, 0, atol=1e-6)
    assert [arcs for size, arcs in sizes[:4] if size == 1] == [[1], [1]]  # it got worse: halved
    assert 0 not in sizes[-1][1]  # it has settled
    alone = Readings(_Still([]), 0 * x[1:2], unit).fit(np.zeros(0), x[1:2], unit, tolerance=1e-12)
    np.testing.assert_allclose(fit.x[1], alone.x[0], atol=1e-9)


class _Rising:
    """A state x that does not move, of which −x + p n is seen at the sample n, and 10⁶ x + p n
    below zero."""

    def take(self, arcs):
        return self

    def defects(self, p, x):
        shape = (len(x), x.shape[1] - 1, 1)
        return Defects(x[:, :-1] - x[:, 1:], np.ones((*shape, 1)), np.zeros((*shape, 1)))

    def observe(self, p, x):
        n = np.broadcast_to(np.arange(x.shape[1])[None, :, None], x.shape)
        slope = np.where(x > 0, -1.0, 1e6)
        return Observed(slope * x + p * n, slope[..., None], n[..., None].astype(float))


def test_an_arc_that_no_step_makes_better_holds_back_no_other():
    """Of the first arc 1 is seen, which no state shows: from 1e-6 each step leads below zero. The
    others tell p = 0.7, as they would alone."""
    x = np.tile(np.array([1e-6, *5 * [0.5]])[:, None, None], (1, 4, 1))
    y = np.broadcast_to(0.7 * np.arange(4)[None, :, None], x.shape) - 1
    y[0] += 2
    unit = np.ones(1)
    fit = Readings(_Rising(), y, 0.01 * unit).fit(np.zeros(1), x, 0.01 * unit)
    np.testing.assert_allclose(fit.p, 0.7, rtol=1e-3)
    np.testing.assert_allclose(fit.x[1:], 1.0, rtol=1e-3)
    np.testing.assert_array_equal(fit.x[0], x[0])


class _Broken:
    """A state x after which 1.2 sin x comes, of which x + p is seen; but each step that is made
    from where the first arc is leaves it farther from any orbit. Beyond ``most`` of p it has
    none."""

    def __init__(self, home, begun, most=np.inf):
        self.home, self.begun, self.most = home, begun, most

    def take(self, arcs):
        return _Broken(self.home[arcs], self.begun, self.most)

    def defects(self, p, x):
        closing = 1.2 * np.sin(x[:, :-1]) - x[:, 1:]
        moved = np.abs(x - self.begun).max(axis=(1, 2)) > 1e-9
        first = self.home == 0
        closing[first] = 0.3 + 0.1 * moved[first, None, None] if p[0] < self.most else np.nan
        by_state = 1.2 * np.cos(x[:, :-1])
        return Defects(closing, by_state[..., None], np.zeros((*closing.shape, 1)))

    def observe(self, p, x):
        return Observed(x + p, np.ones((*x.shape, 1)), np.ones((*x.shape, 1)))


def _beside_a_broken_arc(most: float):
    orbit = np.empty((5, 6, 1))
    orbit[:, 0, 0] = [0.3, 1.5, 2.5, 0.2, 2.9]
    for n in range(5):
        orbit[:, n + 1] = 1.2 * np.sin(orbit[:, n])
    model, x = _Broken(np.arange(5), 0.4, most), np.full(orbit.shape, 0.4)
    return Readings(model, orbit + 0.1, 0.01 * np.ones(1)).fit(np.zeros(1), x, 0.01 * np.ones(1))


def test_an_arc_whose_defects_no_step_closes_keeps_no_other_open():
    fit = _beside_a_broken_arc(np.inf)
    assert fit.open[0] > 0
    assert fit.cost == np.inf
    np.testing.assert_array_equal(fit.open[1:], 0)


@pytest.mark.parametrize("most", [0.05, 0.15])
def test_a_step_after_which_an_arc_that_stays_has_no_orbit_at_all_is_refused(most):
    fit = _beside_a_broken_arc(most)
    assert fit.p[0] < most
    assert np.isfinite(fit.open[0])
    assert fit.iterations > 1


def test_arcs_of_a_body_that_sticks_are_closed():
    """A driven body on a spring with dry friction, at rest for a quarter of the time. States begin
    at differences of noisy positions, which slide where the body sticks. Coefficients are within
    three standard errors of the true ones."""
    true, dt, count, length = np.array([-2.0, 1.0, 1.0]), 0.1, 12, 40
    terms = Terms.of([((2,), (0,), (0,), 0.0), ((0,), (2,), (0,), 0.0)], 1)
    friction = Friction.of([((1,), DRY, 0.0)], 1)
    form = Form(terms, np.array([0.5, 0.0]), np.array([[0.0], [1.0]]), friction, 1)
    t = dt * np.arange(count * (length - 1) + 1)
    stages = t[:-1, None] + dt * np.array([0, 0.2, 0.3, 0.8, 8 / 9, 1])
    u = (2.2 * np.sin(0.9 * stages) + 0.8 * np.sin(2.3 * stages))[:, None, :, None]
    start, steps = np.array([[0.5, 0.0]]), np.full((1, len(t) - 1), dt)
    orbit = np.concatenate([start, form.follow(true, start, steps, u[None], 0).states[0]])
    assert np.mean(orbit[:, 1] == 0) > 0.2
    y = orbit[:, :1] + 0.01 * np.random.default_rng(0).normal(size=(len(t), 1))
    x = np.stack([y[:, 0], np.gradient(y[:, 0], dt)], axis=1)
    nodes = np.arange(count)[:, None] * (length - 1) + np.arange(length)
    h, p = np.full((count, length - 1), dt), np.array([-1.5, 0.6, 1.0])
    law = LawOnArcs(form, Observation.plain(["x"]), (), h, u[nodes[:, :-1]], p, np.arange(3))
    fit = Readings(law, y[nodes], np.array([0.01])).fit(p, x[nodes], np.array([0.01, 0.02]))
    assert fit.converged
    np.testing.assert_array_equal(fit.open, 0)
    errors = np.sqrt(np.diag(np.linalg.inv(fit.triangle.T @ fit.triangle)))
    assert np.all(np.abs(fit.p - true) < 3 * errors)


class _Canyon:
    """A state that does not move and is seen, beside Rosenbrock's two residuals, 30 (q − p²) and
    p, of the coefficients p and q. ``evaluations``: that were made with derivatives."""

    def __init__(self):
        self.evaluations = 0

    def take(self, arcs):
        return self

    def defects(self, p, x):
        self.evaluations += 1
        shape = (len(x), x.shape[1] - 1, 1)
        return Defects(x[:, :-1] - x[:, 1:], np.ones((*shape, 1)), np.zeros((*shape, 2)))

    def observe(self, p, x):
        some, slopes = np.zeros((*x.shape[:2], 3)), np.zeros((*x.shape[:2], 3, 2))
        some[..., 0], some[..., 1], some[..., 2] = x[..., 0], 30 * (p[1] - p[0] ** 2), p[0]
        slopes[..., 1, :], slopes[..., 2, 0] = (-60 * p[0], 30.0), 1.0
        return Observed(some, np.eye(3)[:, :1] * np.ones((*x.shape[:2], 1, 1)), slopes)


def test_no_jump_is_left_that_readings_pull_open():
    """A state that does not move, read as if it jumped by 2 σ halfway: in 2,000 readings, for the
    jump costs less than that the residuals of an orbit do."""
    y, sigma = np.zeros((1, 2_000, 3)), 0.01
    y[:, 1_000:, 0], y[..., 2] = 2 * sigma, 1.0
    fit = Readings(_Canyon(), y, np.full(3, sigma)).fit(np.ones(2), y[..., :1], np.array([sigma]))
    assert fit.converged
    np.testing.assert_allclose(fit.x, sigma, rtol=1e-2)
    assert fit.cost > 500


class _Bent(_Canyon):
    """The same with its defects alone."""

    def closing(self, p, x):
        return x[:, :-1] - x[:, 1:]


@pytest.mark.parametrize("tolerance", [1e-9, 1e-2])
def test_steps_bend_along_a_canyon_and_end_where_no_step_promises_more(tolerance):
    y, x, unit, found = np.zeros((1, 4, 3)), np.zeros((1, 4, 1)), np.ones(1), []
    y[..., 2] = 1.0
    for model in (_Canyon(), _Bent()):
        fit = Readings(model, y, np.full(3, 0.01)).fit(
            np.array([-1.2, 1.0]), x, 0.01 * unit, max_iterations=200, tolerance=tolerance
        )
        np.testing.assert_allclose(fit.p, 1.0, rtol=1e-4)
        found.append(model.evaluations)
    assert found[1] < 0.2 * found[0]


def test_straight_steps_follow_bent_ones_that_fail(monkeypatch):
    """As where a body sticks: whatever bends along a step there, the states do not."""
    y, x = np.zeros((1, 4, 3)), np.zeros((1, 4, 1))
    y[..., 2] = 1.0
    failed = []

    def curved(self, dp, dx, damping):
        failed.append(damping)
        return latent_arcs.Tried(self.here, -np.inf, damping)

    monkeypatch.setattr(latent_arcs._AtStates, "_curved", curved)
    start = np.array([-1.2, 1.0])
    fit = Readings(_Bent(), y, np.full(3, 0.01)).fit(start, x, np.array([0.01]))
    residuals = [(30 * (q - p**2), 1 - p) for p, q in (start, fit.p)]
    assert np.linalg.norm(residuals[1]) < 0.2 * np.linalg.norm(residuals[0])
    assert len(failed) < 3 * fit.iterations
