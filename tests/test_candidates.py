"""Candidates: which sizes exist, and on how many pairs they are fitted."""

import itertools

import numpy as np

import gfnn_jax as gfnn
from gfnn_jax import candidates
from gfnn_jax.scalars.inputs import box_inputs
from gfnn_jax.scalars.products import Products


def test_a_size_too_large_to_count_is_never_looked_at():
    """Twelve variables: the terms of degree 4 are too many, those of degree 20 would fill a disk."""
    inputs = box_inputs(np.random.default_rng(0).uniform(-1, 1, (100, 12)))
    looked_at = []

    def family(degree):
        looked_at.append(degree)
        return Products(inputs, degree)

    stages = (map(family, stage) for stage in candidates._STAGES)
    kept = list(itertools.chain(*candidates._determined(stages, 10**6)))
    assert [f.degree for f in kept] == [2, 3]
    assert looked_at == [2, 3, 4]


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
