"""The loop of every descent: on problems whose minima are known."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest

from gfnn_jax.solve.levenberg_marquardt import Factors, Nielsen, Tried, descended

RULES = {
    "factors": Factors(start=1e-3, first=1e-6, trials=30),
    "keeps": Factors(start=1e-3, grown_by=5.0, keeps=True, trials=30),
    "nielsen": Nielsen(start=1e-3),
}


def residual(x):
    """Rosenbrock's, whose valley is bent: 0 at (1, 1)."""
    return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def jacobian(x):
    return np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])


@dataclasses.dataclass(frozen=True)
class Valley:
    x: np.ndarray
    asked: list = dataclasses.field(default_factory=list)

    @property
    def cost(self):
        return float(np.sum(residual(self.x) ** 2))

    def tried(self, damping, failures):
        r, a = residual(self.x), jacobian(self.x)
        delta = -np.linalg.solve(a.T @ a + damping * np.eye(2), a.T @ r)
        there = Valley(self.x + delta, self.asked)
        self.asked.append((failures, damping, there.cost < self.cost))
        promised = self.cost - float(np.sum((r + a @ delta) ** 2))
        return Tried(there, self.cost - there.cost, damping, promised)

    def moved(self, there, damping):
        return there, there.cost < 1e-24


@pytest.mark.parametrize("name", RULES)
def test_follows_a_bent_valley_to_its_minimum(name):
    found = descended(Valley(np.array([-1.2, 1.0])), RULES[name], 100)
    assert found.settled
    assert not found.stuck
    np.testing.assert_allclose(found.problem.x, 1.0, atol=1e-11)
    asked = found.problem.asked
    assert sum(lower for *_, lower in asked) == found.steps
    # Damping grows from each step that fails to the next, and only from there.
    for (_, before, lower), (failures, now, _) in pairwise(asked):
        assert (failures == 0) == lower
        assert lower or now > before


def test_ends_where_no_step_lowers_the_cost():
    """Of a residual that is 1 whatever x, and of no number at all."""

    class Flat(Valley):
        def tried(self, damping, failures):
            self.asked.append(damping)
            return Tried(None, self.x[0], damping)

    for value in (0.0, np.nan):
        found = descended(Flat(np.array([value])), Factors(first=1e-3, trials=4), 10)
        assert (found.steps, found.settled, found.stuck) == (0, False, True)
        np.testing.assert_allclose(found.problem.asked, [0, 1e-3, 1e-2, 1e-1])


def test_a_hopeless_step_is_the_last():
    class Floor(Valley):
        def tried(self, damping, failures):
            self.asked.append(damping)
            return Tried(None, -1.0, damping, hopeless=True)

    found = descended(Floor(np.zeros(2)), Factors(first=1.0), 10)
    assert found.stuck
    assert len(found.problem.asked) == 1


def test_side_by_side_a_failing_problem_waits():
    """x² from −3 and 2, where a step of the second fails once: it stays, with more damping."""

    @dataclasses.dataclass(frozen=True)
    class Both:
        x: np.ndarray
        made: int = 0

        def tried(self, damping, failures):
            assert failures == 0
            delta = -self.x / (1 + damping)
            delta[1] *= -1.0 if self.made == 0 else 1.0
            decrease = self.x**2 - (self.x + delta) ** 2
            promised = self.x**2 - (self.x / (1 + 1 / damping)) ** 2
            there = np.where(decrease > 0, self.x + delta, self.x)
            return Tried(there, decrease, damping, promised)

        def moved(self, there, damping):
            return Both(there, self.made + 1), False

    start, rule = Both(np.array([-3.0, 2.0])), Nielsen(growth=4.0, trials=1)
    found = descended(start, rule, 1, np.array([0.1, 0.1]))
    np.testing.assert_allclose(found.problem.x, [-3.0 / 11, 2.0])
    np.testing.assert_allclose(found.damping, [0.1 / 3, 0.4])
    found = descended(start, rule, 60, np.array([0.1, 0.1]))
    np.testing.assert_allclose(found.problem.x, 0.0, atol=1e-12)
