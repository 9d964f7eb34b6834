"""Lengths of arcs: those that tell a law's coefficients best, where unknown forces act."""

import dataclasses
from functools import partial

import numpy as np
import pytest

import gfnn_jax as gfnn
from gfnn_jax.dataset.stretches import Arcs, arcs_of
from gfnn_jax.models.lagrangians.fit import FOLDS, ArcProblem, SearchOptions
from gfnn_jax.models.lagrangians.given_terms import given_terms
from gfnn_jax.models.lagrangians.recordings import samples_of
from gfnn_jax.models.lagrangians.search import fit_given, search, to_longer_arcs
from gfnn_jax.models.lagrangians.structure import Structure
from gfnn_jax.models.lagrangians.weak_form import weak_start

GIVEN = given_terms(
    ["w1**2 + w1*w2*cos(q1 - q2) + w2**2 + cos(q1) + cos(q2)", "R: w1**2 + w2**2"],
    ("q1", "q2"),
    ("w1", "w2"),
)
MASS, COUPLED, PULLS, DT, NOISE = 0.5, 0.4, (20.0, 8.0), 0.02, 1e-3


def swung(torque, seed=0, runs=4, end=12.0):
    """Runs of a double pendulum, mostly chaotic, whose joints unknown torques push: white ones of
    this size, as shares of gravity, another one every sample. By Runge and Kutta."""
    rng = np.random.default_rng(seed)

    def rate(x, push):
        q, v = x[..., :2], x[..., 2:]
        turn = q[..., 0] - q[..., 1]
        c, s = COUPLED * np.cos(turn), COUPLED * np.sin(turn)
        f = push - np.array(PULLS) * np.sin(q) - 0.02 * v
        f1, f2 = f[..., 0] - s * v[..., 1] ** 2, f[..., 1] + s * v[..., 0] ** 2
        det = MASS - c**2
        return np.stack([*v.T, (MASS * f1 - c * f2) / det, (f2 - c * f1) / det], axis=-1)

    x = np.concatenate([rng.uniform(1.5, 2.5, (runs, 2)), np.zeros((runs, 2))], axis=1)
    shown = []
    for _ in range(round(end / DT)):
        shown.append(x[:, :2])
        push, h = torque * np.array(PULLS) * rng.normal(size=(runs, 2)), DT / 4
        for _ in range(4):
            k1 = rate(x, push)
            k2 = rate(x + h / 2 * k1, push)
            k3 = rate(x + h / 2 * k2, push)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3, push))
    q = np.array(shown) + NOISE * rng.normal(size=(len(shown), runs, 2))
    tables = [
        {
            "run": np.full(len(q), str(k)),
            "t": DT * np.arange(len(q)),
            "theta1": q[:, k, 0],
            "theta2": q[:, k, 1],
        }
        for k in range(runs)
    ]
    names = ["theta1", "theta2"]
    return gfnn.Recording(tables, positions=names, angles=names)


def searched(recording, search=search):
    options = SearchOptions(frictions=("linear",), choose_friction=False)
    return search(samples_of(recording, options=options).problem)


def pulls_of(found):
    """The coefficients of cos θ₁ and cos θ₂."""
    waves = ((0, 0), (0, 0), (1, 0), 0.0), ((0, 0), (0, 0), (0, 1), 0.0)
    return np.array([found.fit.values["term", wave] for wave in waves])


@pytest.mark.slow
def test_longer_arcs_tell_more_where_the_law_is_all_that_acts():
    found = searched(swung(0.0))
    assert found.shorter is None
    np.testing.assert_allclose(pulls_of(found), PULLS, rtol=2e-3)


@pytest.mark.parametrize(("longest", "followed"), [(np.inf, True), (40, False)])
def test_arcs_that_no_orbit_follows_are_not_taken(longest, followed):
    """Of a law whose orbits end after some nodes longer arcs cost infinitely much."""

    @dataclasses.dataclass
    class Fit:
        problem: ArcProblem
        arcs: Arcs

        @property
        def follows(self):
            return self.arcs.t.shape[1] <= longest

        def in_arcs(self, length):
            return Fit(self.problem, arcs_of(self.problem.nodes, length))

    problem = samples_of(swung(0.0, runs=1)).problem
    longer = to_longer_arcs(Fit(problem, arcs_of(problem.nodes, 20)), 80)
    assert (longer is not None and longer.arcs.t.shape[1] > 40) == followed


def test_what_one_search_after_another_asks_of_a_fit_is_fitted_once(monkeypatch):
    """Searches in a row from one fit ask for the same terms along held-out arcs, and choices in a
    row among starts for the same longer arcs."""
    problem = samples_of(swung(0.0, runs=1, end=3.0)).problem
    whole = Structure(2, GIVEN.terms, GIVEN.friction or ())
    structure, known = weak_start(whole, problem, False)
    fit = problem.fit(structure, known, problem.arcs(1.0), problem.scales.sigma)
    fits, plain = [], ArcProblem.fit

    def counted(self, *given):
        fits.append(given)
        return plain(self, *given)

    monkeypatch.setattr(ArcProblem, "fit", counted)
    smaller = structure.without({("loss", structure.friction[0])})
    costs = [(fit.cross_validate(smaller), fit.cross_validate(), fit.costs) for _ in range(2)]
    assert len(fits) == 2 * FOLDS
    np.testing.assert_array_equal(costs[0], costs[1])
    assert not np.array_equal(costs[0][0], costs[0][1])
    longer = [to_longer_arcs(fit, 2 * fit.arcs.t.shape[1]) for _ in range(2)]
    assert longer[0] is longer[1] is not None
    assert len(fits) == 2 * FOLDS + 1


@pytest.mark.slow
@pytest.mark.parametrize("search", [search, partial(fit_given, GIVEN, 1.0)])
def test_shorter_arcs_tell_more_where_unknown_torques_act(search):
    """The oracle are the pulls that made the data: the law of shorter arcs is nearer to them."""
    # Of these runs two processors take the same terms; of those of seed 0 one leaves friction out.
    found = searched(swung(0.03, seed=3), search)
    assert found.shorter is not None
    fit, other = found.fit, found.shorter.fit
    assert other.arcs.t.shape[1] < fit.arcs.t.shape[1]
    far, near = (np.abs(pulls_of(f) / PULLS - 1).max() for f in (found, found.shorter))
    assert near < 0.5 * far
