"""The compiled motion of laws against steps along their accelerations and differences of these, and
what it does with hopeless lanes."""

import concurrent.futures
import dataclasses
import pickle
from itertools import pairwise

import numpy as np
import own_module  # noqa: F401
import pytest

from gfnn_jax.families.friction import (
    DRY,
    ISOTROPIC,
    LINEAR,
    LOADED,
    ONE_SIDED,
    PLACED,
    POWER,
    QUADRATIC,
    STRIBECK,
    UNIFORM,
    Friction,
)
from gfnn_jax.families.lagrangian import Terms
from gfnn_jax.flows import kernel
from gfnn_jax.flows.dormand_prince import STAGES, WEIGHTS
from gfnn_jax.flows.motion import Form


def law_of(d, powers, dry, seed=0, shapes=False):
    """A law of d coordinates in a gauge, with powers and shapes or without, and friction of each
    kind."""
    rng, unit, none = np.random.default_rng(seed), np.eye(d, dtype=int), np.zeros(d, int)
    last = unit[-1]
    rows = [(2 * one, none, none, 0.0) for one in unit]
    rows += [(a + b, none, b - a, 0.3) for a, b in pairwise(unit)]
    rows += [(last, none, last, 0.2), (none, none, last, 0.0)]
    if powers:
        rows += [(none, 2 * last, none, 0.0), (2 * last, 2 * last, none, 0.0)]
        rows += [(none, unit[0] + 2 * last, last, 0.4), (last, 3 * unit[0], unit[0], 0.1)]
    if shapes:
        radius = " + ".join(f"q{i + 1}**2" for i in range(d))
        rows += [(none, none, none, 0.0, f"1/sqrt(1 + {radius})")]
        rows += [(last, unit[0], last, 0.4, f"exp(-q1)*tanh(q{d})**2")]
    friction = [(last, DRY, 0.3), (last, LINEAR, 0.0), (last, QUADRATIC, 0.0)]
    if dry:
        friction[1:1] = [(last, DRY, 0.0)]
        friction += [(unit[0], DRY, 0.0), (last - unit[0], DRY, 0.0)][: 2 * (d > 1)]
    friction += [(last, UNIFORM, 0.0)]
    basis, fixed = np.eye(len(rows))[:, 1:], np.zeros(len(rows))
    basis[0], fixed[0] = 0.1 * rng.normal(size=len(rows) - 1), 3.0
    form = Form(Terms.of(rows, d), fixed, basis, Friction.of(friction, d), 2)
    own = np.full(len(rows) - 1, 3.0)
    own[d - 1 :] = rng.uniform(0.1, 0.3, len(own) - d + 1)
    p = np.concatenate([own, rng.uniform(0.1, 0.3, len(friction)), rng.normal(size=2 * d)])
    return form, p


def lanes_of(d, num, seed=1):
    """States of which some are at rest, steps, and inputs that are held for two substeps."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(num, 2 * d))
    x[::3, d:] *= 1e-2
    x[::5, d:] = 0
    return x, np.full(num, 0.1), np.repeat(rng.normal(size=(num, 2, 1, 2)), 6, axis=2)


def each_its_own(form, p, num):
    """A law of each lane: other coefficients and phases."""
    rng = np.random.default_rng(2)
    phases = form.terms.phases + 0.1 * rng.normal(size=(num, form.terms.count))
    terms = dataclasses.replace(form.terms, phases=phases)
    return dataclasses.replace(form, terms=terms), p * rng.uniform(0.9, 1.1, (num, len(p)))


def lane_of(form, p, lane):
    """The law of one lane, where each follows its own."""
    terms = dataclasses.replace(form.terms, phases=form.terms.phases[lane])
    return dataclasses.replace(form, terms=terms).lagrangian(p[lane])


def stepped(law, x, h, u):
    """Steps of Dormand and Prince along the law's own accelerations."""
    d, h = law.terms.dim, h[:, None] / u.shape[1]
    for now in u.swapaxes(0, 1):
        rates = []
        for stage, inputs in zip(STAGES, now.swapaxes(0, 1), strict=False):
            q, v = np.hsplit(x + h * sum(w * r for w, r in zip(stage, rates, strict=False)), [d])
            rates.append(np.hstack([v, law.acceleration(q, v, inputs)]))
        x = x + h * sum(w * r for w, r in zip(WEIGHTS, rates, strict=False))
    return x


def differences(form, p, x, h, u, e=1e-6):
    """Derivatives of steps in the states and in the coefficients, by central differences."""

    def slope(vary, count):
        ends = [
            [form.step(*vary(s * e * row), h, u, 0).states for s in (1, -1)]
            for row in np.eye(count)
        ]
        return np.stack([(up - down) / (2 * e) for up, down in ends], axis=-1)

    return (slope(lambda by: (p, x + by), x.shape[1]), slope(lambda by: (p + by, x), form.count))


@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("dry", [False, True])
@pytest.mark.parametrize("powers", [False, True])
@pytest.mark.parametrize("d", [*(pytest.param(d, marks=pytest.mark.slow) for d in (1, 3)), 2, 5])
def test_steps_are_those_of_the_law(d, powers, dry, own):
    """And derivatives are differences; bodies that turn or stop are those of test_coulomb.py."""
    num = 60
    (form, p), (x, h, u) = law_of(d, powers, dry), lanes_of(d, num)
    if own:
        form, p = each_its_own(form, p, num)
    found = form.step(p, x, h, u)
    assert not found.status.any()
    for order in (0, 1):
        step = form.step(p, x, h, u, order)
        np.testing.assert_array_equal(step.states, found.states)
    np.testing.assert_array_equal(step.by_state, found.by_state)
    speeds = x[:, d:] @ form.friction.directions[form.friction.jumps].T
    modes = found.modes[:, form.friction.jumps]
    slides = ((np.abs(speeds) > 0.1) & (modes == np.sign(speeds))).all(axis=1)
    assert slides.mean() > (0.3 if dry else 0.99)
    rows = np.flatnonzero(slides)
    for k in np.split(rows[:12], len(rows[:12])) if own else [rows]:
        law = lane_of(form, p, k[0]) if own else form.lagrangian(p)
        np.testing.assert_allclose(found.states[k], stepped(law, x[k], h[k], u[k]), atol=2e-14)
    by_state, by_coefficients = differences(form, p, x, h, u)
    np.testing.assert_allclose(found.by_state[slides], by_state[slides], atol=1e-8)
    np.testing.assert_allclose(found.by_coefficients, by_coefficients, atol=1e-8)
    assert len(kernel.follow.made) == 1


SHAPES = """
sin(q1*q2) cos(q1)**3 tan(q2/3) exp(-q1) log(2+q1*q1) sqrt(2+q2) sinh(q1) cosh(q2) tanh(q1-q2)
arctan(q1)/(2+q2*q2) (q1*q1+2)**-1.5 abs(q1-3) T4(q1)*q2 1/(1+q2/8)**9
wall(1.2-q1)*exp(q2)/(2+wall(1+q2))
"""


@pytest.mark.parametrize("shape", SHAPES.split())
def test_shapes_are_those_of_the_law(shape):
    """The steps of a law with a term of this shape, and their derivatives."""
    none, rows = (0, 0), [((2, 0), (0, 0), (0, 0), 0.0), ((0, 2), (0, 0), (0, 0), 0.0)]
    rows += [(k, none, none, 0.0, shape) for k in ((0, 0), (1, 0), (1, 1))]
    form = Form(Terms.of(rows, 2), np.zeros(5), np.eye(5), Friction.of([], 2))
    p, (x, h, _) = np.array([1.0, 1.2, 0.3, 0.2, 0.1]), lanes_of(2, 20)
    x, u = 0.3 * x, np.zeros((20, 2, 6, 0))
    found = form.step(p, x, h, u)
    np.testing.assert_allclose(found.states, stepped(form.lagrangian(p), x, h, u), atol=1e-13)
    for one, other in zip(found[1:3], differences(form, p, x, h, u), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-8)


@pytest.mark.parametrize("leaders", [(), (0,), (1,)])
def test_derivatives_are_finite_differences(leaders):
    """And steps are along accelerations of the law, with powers of speeds and sides, of coordinates
    that drive others."""
    (form, p), (x, h, u) = law_of(2, True, False, shapes=True), lanes_of(2, 20)
    more = [((1, 0), POWER, 3.0), ((0, 1), POWER, 1.5), ((0, 1), ONE_SIDED, 0.0)]
    more += [((1, 1), ISOTROPIC, 2.0), ((0, 1), STRIBECK, 0.5), ((1, 0), LOADED + 1, 0.2)]
    more += [((0, 1), LOADED, 0.0), ((1, -2), PLACED, 0.3)]
    friction = Friction.of([*form.friction.rows()[:2], *more, *form.friction.rows()[-1:]], 2)
    terms = dataclasses.replace(form.terms, leaders=leaders)
    form = dataclasses.replace(form, terms=terms, friction=friction)
    p = np.insert(p, form.basis.shape[1] + 3, [0.2, 0.3, 0.25, 0.15, 0.1, 0.2, 0.3])
    x[:, 2:] += np.where(np.abs(x[:, 2:]) < 0.1, 0.3, 0.0)  # of a side no turn
    law = form.lagrangian(p)
    ahead, behind = (form.step(p, x, s * h / 1e3, u[:, :1], 0).states for s in (1, -1))
    rates = (ahead - behind)[:, 2:] / (2e-3 * h[:, None])
    np.testing.assert_allclose(rates, law.acceleration(x[:, :2], x[:, 2:], u[:, 0, 0]), atol=1e-6)
    found, expected = form.step(p, x, h, u), differences(form, p, x, h, u)
    np.testing.assert_allclose(found.by_state, expected[0], atol=1e-8)
    np.testing.assert_allclose(found.by_coefficients, expected[1], atol=1e-8)


def test_steps_one_after_another():
    """As each alone, from the modes in which the one before ended."""
    (form, p), (x, _, _) = law_of(2, False, True), lanes_of(2, 9)
    rng = np.random.default_rng(3)
    h, u = rng.uniform(0, 0.2, (9, 5)), np.repeat(rng.normal(size=(9, 5, 1, 1, 2)), 6, axis=3)
    found, modes = form.follow(p, x, h, u), None
    for m in range(5):
        step = form.step(p, x, h[:, m], u[:, m], modes=modes)
        np.testing.assert_array_equal(step.states, found.states[:, m])
        np.testing.assert_array_equal(step.by_coefficients, found.by_coefficients[:, m])
        x, modes = step.states, step.modes


@pytest.mark.parametrize("seed", range(8))
def test_hopeless_lanes_end(seed):
    """Random tables: no number is refused, no lane is followed without end, none harms another."""
    rng = np.random.default_rng(seed)
    d, num = int(rng.integers(1, 4)), 40
    form, p = law_of(d, bool(rng.integers(2)), bool(rng.integers(2)), seed, shapes=seed > 3)
    form, p = each_its_own(form, p, num)
    x, h, u = lanes_of(d, num, seed)
    expected = form.step(p, x, h, u)
    harmed = rng.permutation(num)[:28]
    bad = [np.nan, np.inf, -np.inf, 1e300, 1e155, 0.0, -1e30]
    p, x, h, u = p.copy(), x.copy(), h.copy(), u.copy()
    for k, lane in enumerate(harmed.tolist()):
        value, where = bad[k % len(bad)], (p, x, h, u)[k // len(bad)]
        where[lane] = value if where.ndim < 2 else where[lane]
        if where.ndim > 1:
            where[lane, ..., rng.integers(where.shape[-1])] = value
    p[harmed[0], : form.basis.shape[1]] = 0.0
    h[harmed[1]] = 0.0
    found, others = form.step(p, x, h, u), np.setdiff1d(np.arange(num), harmed)
    np.testing.assert_array_equal(found.states[others], expected.states[others])
    np.testing.assert_array_equal(found.by_coefficients[others], expected.by_coefficients[others])
    lost = ~np.isfinite(found.states).all(axis=1)
    np.testing.assert_array_equal(found.status != 0, lost)
    assert lost.any()


def test_a_law_without_mass_and_states_without_lanes():
    massless = Form(
        Terms.of([((0,), (0,), (1,), 0.0)], 1), np.ones(1), np.zeros((1, 0)), Friction.of([], 1)
    )
    step = massless.step(np.zeros(0), np.ones((2, 2)), np.ones(2), np.zeros((2, 1, 6, 0)))
    assert np.isnan(step.states).all()
    assert step.status.all()
    none = massless.step(np.zeros(0), np.ones((0, 2)), np.ones(0), np.zeros((0, 1, 6, 0)))
    assert none.by_coefficients.shape == (0, 2, 0)


def test_laws_are_pickled_and_followed_by_threads():
    laws = [law_of(d, True, True) for d in (2, 3)]
    tasks = [(*law, *lanes_of(d, 200)) for law, d in zip(laws, (2, 3), strict=True)]
    expected = [form.step(*rest) for form, *rest in tasks]

    def again(task):
        form, *rest = task
        return pickle.loads(pickle.dumps(form)).step(*rest)

    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        for _ in range(5):
            for found, step in zip(pool.map(again, tasks), expected, strict=True):
                for one, other in zip(found, step, strict=True):
                    np.testing.assert_array_equal(one, other)
