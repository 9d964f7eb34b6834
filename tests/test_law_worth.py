"""A library of H that is too dear beside the map at hand is told before it is fitted."""

import dataclasses

import numpy as np
import pytest

from gfnn_jax.coordinates import CARTESIAN
from gfnn_jax.dataset.dataset import Dataset
from gfnn_jax.dataset.measured_error import Tolerance
from gfnn_jax.dataset.runs import identified
from gfnn_jax.families.terms import given_terms, polynomial_terms
from gfnn_jax.fitting.linear_starts import midpoint_start
from gfnn_jax.flows.collocation import Steps, images
from gfnn_jax.models.hamiltonians.library_search import exceeds_cost
from gfnn_jax.models.hamiltonians.problem import LawProblem
from gfnn_jax.phase_space import Pairs


@pytest.mark.parametrize(
    ("terms", "coefficients", "dear"),
    [
        (["p1**2", "p2**2", "q1**2", "q2**2", "q1**2*q2**2"], [0.5, 0.5, 0.5, 1.0, 0.5], False),
        (["p1**2", "p2**2", "q1**2", "q2**2", "1/(2 + q1 + q2)"], [0.5, 0.5, 0.5, 1, 1], True),
    ],
)
def test_a_few_terms_of_many_are_told_from_many(terms, coefficients, dear):
    """A quartic law is among the 69 terms of degree 4; the other law needs too many of them for
    1e-5, and its step would cost more than what the map at hand is worth."""
    law, z0 = given_terms(2, terms), np.random.default_rng(0).uniform(-0.5, 0.5, (400, 4))
    z1 = images(law, np.array(coefficients, float), z0, 0.1, Steps(12, 1)).states
    pairs = Pairs(z0, z1, 0.1)
    data, asked = Dataset.of(identified(pairs).pairs, CARTESIAN).divided(0), Tolerance(1e-5)
    problem = LawProblem(data, asked).beginning(data)
    cubic, rows = polynomial_terms(2, 3), data.training[:150]
    start = midpoint_start(cubic, z0[rows], z1[rows], 0.1, data.scale)
    last = problem.fitted(cubic, start, rows)

    def told(dearest):
        beside = dataclasses.replace(problem, dearest=dearest)
        return exceeds_cost(beside, polynomial_terms(2, 4), last)

    assert told(5e3) == dear
    assert not told(np.inf)
    assert told(1.0)
