"""The oracle of the compiled motion: the parts of a Lagrangian, and its friction, at many states:
against the family's own values."""

import dataclasses

import numpy as np
import pytest
from motion_oracle import Dissipation, Form, Quadratic, inverses

from gfnn_jax.families.lagrangian import (
    DRY,
    LINEAR,
    QUADRATIC,
    UNIFORM,
    Friction,
    Lagrangian,
    Terms,
)

ANGLES = [
    ((2, 0), (0, 0), (0, 0), 0.0),
    ((1, 1), (0, 0), (1, -1), 0.3),
    ((0, 2), (0, 0), (0, 2), 0.0),
    ((0, 1), (0, 0), (1, 0), -np.pi / 2),
    ((0, 0), (0, 0), (1, 1), 0.1),
]
MIXED = [
    ((2, 0), (0, 2), (0, 0), 0.0),
    ((1, 1), (1, 0), (0, 1), 0.3),
    ((0, 2), (0, 0), (0, 0), 0.0),
    ((1, 0), (0, 3), (0, 0), 0.0),
    ((0, 0), (2, 1), (0, 0), 0.0),
    ((0, 0), (1, 0), (0, 1), -1.1),
]


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
    slope = np.einsum("nij,ni->nj", turning + L.drift_by.transpose(2, 0, 1), v) / 2 + L.force.T
    np.testing.assert_allclose(slope, found.by_q, atol=1e-13)
    curvature = 0.5 * np.einsum("ikjln,ni,nk->njl", L.masses_by_two, v, v)
    curvature += np.einsum("ijln,ni->njl", L.drift_by_two, v) + L.force_by.transpose(2, 0, 1)
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
    first, second = found.derivatives(v.T, order=1)
    _, slope, curvature = friction.tables(v)
    np.testing.assert_allclose(first.T, slope, atol=1e-15)
    np.testing.assert_allclose(second.T, curvature, atol=1e-15)
    assert found.even.tolist() == [False, False, True, False, False]
    np.testing.assert_array_equal(found.coulomb, [0])


def law_of(d, plain, rng):
    """A Lagrangian of d coordinates with friction of each kind and two inputs, masses positive."""
    rows = [
        ((2 * np.eye(d, dtype=int)[i]), np.zeros(d, int), np.zeros(d, int), 0.0) for i in range(d)
    ]
    for i in range(1, d):
        ends = np.eye(d, dtype=int)[i - 1], np.eye(d, dtype=int)[i]
        rows.append((ends[0] + ends[1], np.zeros(d, int), ends[1] - ends[0], 0.3))
    last = np.eye(d, dtype=int)[-1]
    rows += [(last, np.zeros(d, int), last, 0.2), (0 * last, np.zeros(d, int), last, 0.0)]
    if not plain:
        rows += [(0 * last, 2 * last, 0 * last, 0.0), (2 * last, 2 * last, 0 * last, 0.0)]
    friction = [
        (last, DRY, 0.0),
        (last, DRY, 0.3),
        (last, LINEAR, 0.0),
        (last, QUADRATIC, 0.0),
        (last, UNIFORM, 0.0),
    ]
    terms = Terms.of(rows, d)
    form = Form(terms, np.zeros(len(rows)), np.eye(len(rows)), Friction.of(friction, d), 2)
    p = np.concatenate(
        [
            np.full(d, 3.0),
            rng.uniform(0.2, 0.5, len(rows) - d),
            rng.uniform(0.1, 0.3, 5),
            rng.normal(size=2 * d),
        ]
    )
    return form, p


@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("plain", [False, True])
@pytest.mark.parametrize("d", [1, 2, 3, 4])
def test_rates_are_those_of_the_lagrangian_and_their_derivatives_finite_differences(d, plain, own):
    """Of one law, and of states that each follow their own."""
    rng = np.random.default_rng(d)
    form, p = law_of(d, plain, rng)
    num = 5
    if own:
        p = p * rng.uniform(0.9, 1.1, (num, len(p)))
        moved = form.terms.phases + 0.1 * rng.normal(size=(num, form.terms.count))
        form = dataclasses.replace(form, terms=dataclasses.replace(form.terms, phases=moved))
    q, v, u = rng.normal(size=(num, d)), rng.normal(size=(num, d)), rng.normal(size=(num, 2))
    found = form.accelerate(form.lagrangian(p), q, v, u)
    for k in range(num):
        one = form.take(np.array([k]))
        if own:
            one = dataclasses.replace(
                one, terms=dataclasses.replace(one.terms, phases=one.terms.phases[0])
            )
        law = one.lagrangian(p[k] if own else p)
        a = law.acceleration(q[k : k + 1], v[k : k + 1], u[k : k + 1])
        np.testing.assert_allclose(found.a[k], a[0], rtol=1e-12, atol=1e-12)

    def rates(q, v, p):
        return form.accelerate(form.lagrangian(p), q, v, u, order=0).a

    h, at = 1e-6, np.concatenate([q, v, np.broadcast_to(p, (num, p.shape[-1]))], axis=1)
    for j in range(at.shape[1]):
        step = h * np.eye(at.shape[1])[j]
        ends = [np.split(at + s * step, [d, 2 * d], axis=1) for s in (1, -1)]
        ends = [rates(q, v, c if own else c[0]) for q, v, c in ends]
        np.testing.assert_allclose(found.by[..., j], (ends[0] - ends[1]) / (2 * h), atol=2e-7)


def test_a_form_without_free_terms_and_one_without_states():
    """As of one mass whose L is the unit, and where nothing is asked."""
    form = Form(
        Terms.of([((2,), (0,), (0,), 0.0)], 1),
        np.full(1, 0.5),
        np.zeros((1, 0)),
        Friction.of([((1,), LINEAR, 0.0)], 1),
        1,
    )
    p, one = np.array([0.3, 2.0]), np.ones((1, 1))
    found = form.accelerate(form.lagrangian(p), one, one, one)
    np.testing.assert_allclose(found.a, [[2.0 - 0.3]], rtol=1e-14)
    np.testing.assert_allclose(found.by, [[[0, -0.3, -1, 1]]], atol=1e-14)
    none = form.step(p, np.zeros((0, 2)), np.zeros(0), np.zeros((0, 1, 6, 1)))
    assert none.by_coefficients.shape == (0, 2, 2)


def test_other_terms_and_other_friction_are_those_of_a_form_made_from_another():
    form, p = law_of(2, True, np.random.default_rng(0))
    q, v, u = np.ones((1, 2)), np.ones((1, 2)), np.zeros((1, 2))
    other = dataclasses.replace(
        form,
        terms=dataclasses.replace(form.terms, modes=2 * form.terms.modes),
        friction=dataclasses.replace(form.friction, kinds=np.full(5, LINEAR)),
    )
    law = other.lagrangian(p)
    found = other.accelerate(law, q, v, u).a
    np.testing.assert_allclose(found, law.acceleration(q, v, u), rtol=1e-12)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5])
def test_inverses_and_one_singular_matrix_among_others(n):
    rng = np.random.default_rng(n)
    matrices = rng.normal(size=(6, n, n)) + 3 * np.eye(n)
    expected = np.linalg.inv(matrices)
    matrices[2] = 0
    with np.errstate(all="ignore"):
        found = inverses(matrices.transpose(1, 2, 0)).transpose(2, 0, 1)
    keep = [0, 1, 3, 4, 5]
    np.testing.assert_allclose(found[keep], expected[keep], rtol=1e-11, atol=1e-12)
    assert not np.isfinite(found[2]).all()


def test_inverses_of_nearly_singular_matrices_lose_the_condition_number_once():
    rng = np.random.default_rng(0)
    Q = np.linalg.qr(rng.normal(size=(50, 3, 3)))[0]
    matrices = Q @ np.diag([1.0, 1e-5, 2e-5]) @ Q.swapaxes(1, 2)
    found = inverses(matrices.transpose(1, 2, 0)).transpose(2, 0, 1)
    assert np.abs(found @ matrices - np.eye(3)).max() < 1e-9
