"""The parts of a Lagrangian, and its friction, at many states: against the family's own values."""

import dataclasses

import numpy as np
import pytest

from gfnn_jax.families.lagrangian import (
    DRY,
    LINEAR,
    QUADRATIC,
    UNIFORM,
    Friction,
    Lagrangian,
    Terms,
)
from gfnn_jax.flows.dissipation import Dissipation
from gfnn_jax.flows.quadratic import Quadratic

ANGLES = [
    ((2, 0), (0, 0), (0, 0), 0.0), ((1, 1), (0, 0), (1, -1), 0.3), ((0, 2), (0, 0), (0, 2), 0.0),
    ((0, 1), (0, 0), (1, 0), -np.pi / 2), ((0, 0), (0, 0), (1, 1), 0.1),
]  # fmt: skip
MIXED = [
    ((2, 0), (0, 2), (0, 0), 0.0), ((1, 1), (1, 0), (0, 1), 0.3), ((0, 2), (0, 0), (0, 0), 0.0),
    ((1, 0), (0, 3), (0, 0), 0.0), ((0, 0), (2, 1), (0, 0), 0.0), ((0, 0), (1, 0), (0, 1), -1.1),
]  # fmt: skip


@pytest.mark.parametrize("own", ["one law", "each state its own"])
@pytest.mark.parametrize("rows", [ANGLES, MIXED])
def test_parts_are_the_derivatives_of_the_lagrangian(rows, own):
    rng, num = np.random.default_rng(0), 7
    terms = Terms.of(rows, 2)
    q, v, a = rng.normal(size=(3, num, 2))
    theta = rng.normal(size=(num, len(rows)) if own != "one law" else len(rows))
    quadratic = Quadratic.of(terms)
    if own != "one law":
        moved = terms.phases + rng.normal(size=(num, len(rows)))
        terms = dataclasses.replace(terms, phases=moved)
    L = quadratic.parts(terms, theta.T.reshape(len(rows), -1), q.T, 2)
    none = Friction.of([], 2)
    law = Lagrangian(terms, theta, none, np.zeros(0), 0.0, np.zeros((2, 0)))
    found = law.derivatives(q, v)
    np.testing.assert_allclose(L.masses.transpose(2, 0, 1), found.by_vv, atol=1e-13)
    momentum = np.einsum("ikn,nk->ni", L.masses, v) + L.drift.T
    np.testing.assert_allclose(momentum, found.by_v, atol=1e-13)
    turning = np.einsum("ikjn,nk->nij", L.masses_by, v) + L.drift_by.transpose(2, 0, 1)
    np.testing.assert_allclose(turning, found.by_vq, atol=1e-13)
    slope = np.einsum("nij,ni->nj", turning + L.drift_by.transpose(2, 0, 1), v) / 2 + L.pull.T
    np.testing.assert_allclose(slope, found.by_q, atol=1e-13)
    curvature = 0.5 * np.einsum("ikjln,ni,nk->njl", L.masses_by_two, v, v)
    curvature += np.einsum("ijln,ni->njl", L.drift_by_two, v) + L.pull_by.transpose(2, 0, 1)
    np.testing.assert_allclose(curvature, found.by_qq, atol=1e-13)
    residuals = quadratic.residuals(L, v.T, a.T).transpose(2, 0, 1)
    np.testing.assert_allclose(residuals, terms.residuals(q, v, a), atol=1e-13)
    of_terms = [
        Lagrangian(terms, np.eye(len(rows))[j], none, np.zeros(0), 0.0, np.zeros((2, 0)))
        for j in range(len(rows))
    ]
    momenta = np.stack([one.momentum(q, v) for one in of_terms])
    np.testing.assert_allclose(quadratic.momenta(L, v.T).transpose(0, 2, 1), momenta, atol=1e-13)


def test_friction_is_that_of_the_family_and_uniform_friction_is_left_out():
    rows = [
        ((1, 0), DRY, 0.0),
        ((0, 1), DRY, 0.2),
        ((1, -1), LINEAR, 0.0),
        ((1, 0), QUADRATIC, 0.0),
    ]
    friction = Friction.of(rows, 2)
    v = np.random.default_rng(0).normal(size=(9, 2))
    v[0] = 0
    found = Dissipation.of(Friction.of([*rows[:2], ((0, 0), UNIFORM, 0.0), *rows[2:]], 2))
    first, second = found.slopes(v.T, order=1)
    _, slope, curvature = friction.tables(v)
    np.testing.assert_allclose(first.T, slope, atol=1e-15)
    np.testing.assert_allclose(second.T, curvature, atol=1e-15)
    assert found.even.tolist() == [False, False, True, False, False]
    np.testing.assert_array_equal(found.coulomb, [0])
