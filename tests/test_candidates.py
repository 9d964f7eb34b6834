"""Candidates: which sizes exist, and on how many pairs they are fitted."""

import itertools

import numpy as np
import pytest

import gfnn_jax as gfnn
from gfnn_jax.learn import candidates
from gfnn_jax.families.inputs import box_inputs
from gfnn_jax.families.products import Products


def test_a_size_too_large_to_count_is_never_looked_at():
    """Twelve variables: degree 4 has too many terms, degree 20 would fill a disk."""
    inputs = box_inputs(np.random.default_rng(0).uniform(-1, 1, (100, 12)))
    looked_at = []

    def family(degree):
        looked_at.append(degree)
        return Products(inputs, degree)

    stages = (map(family, stage) for stage in candidates._STAGES)
    kept = list(itertools.chain(*candidates._determined(stages, 10**6)))
    assert [f.degree for f in kept] == [2, 3]
    assert looked_at == [2, 3, 4]


@pytest.mark.slow
def test_more_pairs_never_take_a_candidate_away(monkeypatch):
    """Where a factorisation of all rows would take too long, it is of a sample of them."""
    monkeypatch.setattr(candidates, "_MOST_WORK", 500 * 27**2)
    z = np.random.default_rng(0).uniform(-1, 1, (2_000, 2))
    q, p = z.T
    kicked = p - 0.3 * (q + q**3)
    pairs = gfnn.Pairs(z, np.stack([q + 0.3 * kicked, kicked], axis=1), 0.3)
    fit = gfnn.fit(pairs, chart="type2", tolerance=1e-12)
    assert fit.met
    assert fit.chosen.label == "polynomial 4"


@pytest.mark.slow
def test_a_degree_of_freedom_at_rest_does_no_harm():
    z = np.random.default_rng(0).uniform(-1, 1, (200, 2))
    q, p = z.T
    kicked = p - 0.3 * q
    rest = np.zeros_like(q)
    z0 = np.stack([q, rest, p, rest + 0.1], axis=1)
    z1 = np.stack([q + 0.3 * kicked, rest, kicked, rest + 0.1], axis=1)
    fit = gfnn.fit(gfnn.Pairs(z0, z1, 0.3), tolerance=1e-10)
    assert fit.met
    states, info = fit.map.rollout(z0[:5], 100)
    assert not np.any(info.status)
    np.testing.assert_allclose(states[:, -1, [1, 3]], z0[:5][:, [1, 3]], atol=1e-10)
