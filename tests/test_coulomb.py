"""Motion with Coulomb's friction against stiff integrations of friction that is nearly as sharp,
and against exact solutions."""

import numpy as np
import pytest
import scipy.integrate
import scipy.optimize

from gfnn_jax.families.friction import DRY, LINEAR, LOADED, Friction
from gfnn_jax.families.lagrangian import Terms
from gfnn_jax.flows.dormand_prince import NODES
from gfnn_jax.flows.motion import Form

# Two unit masses between three springs.
TERMS = [
    ((2, 0), (0, 0), (0, 0), 0.0),
    ((0, 2), (0, 0), (0, 0), 0.0),
    ((0, 0), (2, 0), (0, 0), 0.0),
    ((0, 0), (0, 2), (0, 0), 0.0),
    ((0, 0), (1, 1), (0, 0), 0.0),
]
SPRINGS = np.array([0.5, 0.5, -1.0, -1.0, 1.0])


def blocks(friction, losses, gain=0.0, terms=TERMS, springs=SPRINGS):
    """The form of a law, its first coordinate pushed by an input, and its coefficients."""
    dim, count = len(terms[0][0]), len(terms)
    friction = Friction.of(friction, dim)
    form = Form(Terms.of(terms, dim), np.zeros(count), np.eye(count), friction, 1)
    return form, np.concatenate([springs, losses, [gain], np.zeros(dim - 1)])


def followed(form, p, x, h, u):
    """States (n, 2d) of one lane after steps h with inputs u (n,), and its modes."""
    x, modes, found, passed = np.array([x]), None, [], []
    for now in u:
        inputs = np.full((1, 1, 6, 1), now)
        step = form.step(p, x, np.array([h]), inputs, modes=modes)
        x, modes = step.states, step.modes
        found.append(x[0])
        passed.append(modes[0])
    return np.array(found), np.array(passed)


@pytest.mark.slow
def test_bodies_that_stick_together_and_to_the_ground():
    """Friction of one mass on the ground and of both on each other, with linear friction beside."""
    h, count, losses = 0.1, 70, [0.3, 0.15, 0.2]
    directions = [((1, 0), DRY), ((-1, 1), DRY), ((0, 1), LINEAR)]
    start = [0.5, 0.2, 0.1, 0.9]
    form, p = blocks([(*row, 0.0) for row in directions], losses)
    found, modes = followed(form, p, start, h, np.zeros(count))
    wide, p = blocks([(*row, 3e-5) for row in directions], losses)
    law = wide.lagrangian(p)
    expected = scipy.integrate.solve_ivp(
        lambda _, x: np.concatenate([x[2:], law.acceleration(x[:2], x[2:])]),
        (0, h * count),
        start,
        "Radau",
        h * np.arange(1, count + 1),
        rtol=1e-6,
        atol=1e-8,
    ).y.T
    np.testing.assert_allclose(found[:, :2], expected[:, :2], atol=3e-4)  # it creeps
    ways = {tuple(map(int, m[:2] != 0)) for m in modes}
    assert ways == {(1, 1), (0, 1), (1, 0), (0, 0)}  # sliding, either one stuck, both
    assert np.abs(found[-1, 2:]).max() < 1e-15


def test_directions_without_friction_do_not_hold_bodies_that_others_hold():
    """Two masses at rest up to rounding, and frictions between them that are not there: events
    that follow each other without end left lanes without a solution."""
    rng, directions = np.random.default_rng(0), ((1, 0), (0, 1), (-1, 1), (1, 1))
    terms = [*TERMS, ((1, 1), (0, 0), (0, 0), 0.0)]
    form, p = blocks(
        [(c, DRY, 0.0) for c in directions],
        [0.3, 0.3, 0.0, 0.0],
        1.0,
        terms,
        np.append(SPRINGS, 0.3),
    )
    positions, speeds = rng.uniform(-0.04, 0.04, (99, 2)), 1e-18 * rng.normal(size=(99, 2))
    x = np.concatenate([positions, speeds], axis=1)
    u = np.repeat(0.03 * rng.normal(size=(99, 1, 1, 1)), 6, axis=2)
    step = form.step(p, x, np.full(99, 0.1), u)
    np.testing.assert_allclose(step.states, x, atol=1e-15)
    np.testing.assert_array_equal(step.modes[:, :2], 0)
    assert np.isfinite(step.by_coefficients).all()


def test_bodies_are_held_where_frictions_together_can_hold_them():
    """Against linear programming: λ of three directions, |λ| ≤ ρ, that balance the springs. Of the
    third, the difference of the two others, ρ is small; from speeds of roundoff it turned without
    end."""
    rng, c = np.random.default_rng(1), np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 1.0]])
    losses, terms = np.array([0.3, 0.2, 0.02]), [*TERMS, ((1, 1), (0, 0), (0, 0), 0.0)]
    rows = [(tuple(map(int, row)), DRY, 0.0) for row in c]
    form, p = blocks(rows, losses, 0.0, terms, np.append(SPRINGS, 0.3))
    q = rng.uniform(-0.3, 0.3, (300, 2))
    bounds = np.stack([-losses, losses], axis=1)
    held = np.array(
        [
            scipy.optimize.linprog(np.zeros(3), A_eq=c.T, b_eq=force, bounds=bounds).success
            for force in q @ [[-2.0, 1.0], [1.0, -2.0]]
        ]
    )
    assert 0.2 < held.mean() < 0.8
    for speed in (0.0, 1e-18, 1e-17):
        x = np.concatenate([q, speed * rng.normal(size=q.shape)], axis=1)
        states = form.step(p, x, np.full(300, 0.1), np.zeros((300, 1, 6, 1))).states
        np.testing.assert_array_equal(np.abs(states - x).max(axis=1) < 1e-12, held)
        assert np.isfinite(states).all()


def test_an_input_moves_a_body_once_it_is_strong_enough():
    """A mass that sticks on a slope: ẍ₁ = u − ρ sign(ẋ₁), its spring cut."""
    mass = [((2,), (0,), (0,), 0.0)]
    form, p = blocks([((1,), DRY, 0.0)], [0.5], 1.0, mass, [0.5])
    u = np.array([0.4, -0.5, 0.9, 0.9, 0.0, -0.2, 0.0, -0.7])
    found, modes = followed(form, p, [0.0, 0.0], 1.0, u)
    # Held until u = 0.9; 0.5 slows it down for 0.6 of a unit of time, 0.7 for 3/7 of one.
    v = [0.0, 0.0, 0.4, 0.8, 0.3, 0.0, 0.0, -0.2]
    q = [0.0, 0.0, 0.2, 0.8, 1.35, 1.35 + 0.09 / 1.4, 1.35 + 0.09 / 1.4, 1.25 + 0.09 / 1.4]
    np.testing.assert_allclose(found, np.stack([q, v], axis=1), atol=1e-9)
    assert modes[:, 0].tolist() == [0, 0, 1, 1, 1, 0, 0, -1]


def test_a_load_decides_what_friction_holds():
    """A push of 0.5 against 0.4 N, N = 2 − t: the body lets go at t = 0.75, in the middle of a
    step; and dry friction beside holds it until 0.6 + 0.4 N is as small as a push of 1.1."""
    one = Terms.of([((2,), (0,), (0,), 0.0)], 1)
    h, count = 0.1, 15
    ends = h * np.arange(1, count + 1)
    load = 2 - h * (np.arange(count)[:, None] + np.asarray(NODES))
    for push, rho, rows in ((0.5, [0.4], []), (1.1, [0.4, 0.6], [((1,), DRY, 0.0)])):
        form = Form(
            one, np.zeros(1), np.eye(1), Friction.of([((1,), LOADED + 1, 0.0), *rows], 1), 2
        )
        inputs = np.stack([np.full_like(load, push), load], axis=-1)[None, :, None]
        p = np.array([0.5, *rho, 1.0, 0.0])
        found = form.follow(p, np.zeros((1, 2)), np.full((1, count), h), inputs)
        since = np.maximum(ends - 0.75, 0.0)
        np.testing.assert_allclose(found.states[0, :, 1], 0.2 * since**2, atol=1e-13)
        np.testing.assert_allclose(found.states[0, :, 0], 0.2 * since**3 / 3, atol=1e-13)


def test_more_directions_than_coordinates():
    """At rest within what three frictions of two coordinates hold together."""
    rows = [((1, 0), DRY, 0.0), ((0, 1), DRY, 0.0), ((-1, 1), DRY, 0.0)]
    found, modes = followed(*blocks(rows, [0.1, 0.1, 0.1]), [0.05, 0.03, 0, 0], 0.5, np.zeros(9))
    np.testing.assert_allclose(found, np.tile([0.05, 0.03, 0, 0], (9, 1)), atol=1e-15)
    assert not modes.any()


def test_steps_do_not_matter():
    """A turn is found to the order of the steps, wherever in one it falls."""
    law = blocks([((1, 0), DRY, 0.0), ((0, 1), DRY, 0.0)], [0.05, 0.03])
    start = [0.6, 0.2, 0.0, 0.3]
    (coarse, _), (fine, _) = (
        followed(*law, start, 7.0 / count, np.zeros(count)) for count in (70, 210)
    )
    np.testing.assert_allclose(coarse[-1], fine[-1], atol=1e-7)


@pytest.mark.parametrize("more", [[], [((-1, 1), DRY, 0.0)], [((0, 1), LOADED, 0.0)]])
def test_forces_that_change_within_a_step_are_followed(more):
    """Bodies that are let go, turn and stick again within one step, with friction of the relative
    speed, or twice of one: by polynomials through noise at the nodes of a step, and by the same in
    four parts of it."""
    rows = [((1, 0), DRY, 0.0), ((0, 1), DRY, 0.0), *more]
    form, p = blocks(rows, [1.0, 0.7, 0.4][: len(rows)], 1.0)
    rng, shape = np.random.default_rng(0), (2_000, 10)
    x, h = 0.5 * rng.normal(size=(shape[0], 4)), np.full(shape, 0.03)
    nodes = 1.5 * rng.normal(size=(*shape, 1)) + 0.3 * rng.normal(size=(*shape, 6))
    whole = form.follow(p, x, h, nodes[:, :, None, :, None], order=0)
    assert not whole.status.any()
    polynomials = np.linalg.solve(np.vander(NODES), nodes[..., None])[..., 0]
    inside = (np.arange(4)[:, None] + NODES) / 4
    parts = np.einsum("lsk,pnk->lspn", polynomials, np.vander(inside.ravel(), 6).reshape(4, 6, 6))
    fine = form.follow(p, x, h, parts[..., None], order=0)
    assert not fine.status.any()
    off = np.abs(whole.states - fine.states)[:, -1]
    assert np.quantile(off, 0.9) < 5e-3  # speeds are about 0.5
    assert np.max(off) < 0.05


def test_derivatives_across_turns_and_stops():
    """Against finite differences: in the state, and in coefficients of all kinds, with an input
    that changes within the step."""
    rows = [((1, 0), DRY, 0.0), ((-1, 1), DRY, 0.0), ((0, 1), LINEAR, 0.0)]
    form, p = blocks(rows, [0.3, 0.15, 0.2], 1.0)
    x, h = 0.6 * np.random.default_rng(0).normal(size=(400, 4)), np.full(400, 0.25)
    times = (np.arange(2)[:, None] + NODES) / 2
    u = np.broadcast_to(0.3 * np.sin(2 * times)[..., None], (400, 2, 6, 1))
    step = form.step(p, x, h, u)
    modes = step.modes[:, :2]
    speeds = np.stack([x[:, 2], x[:, 3] - x[:, 2]], axis=1)
    assert np.mean(np.any(modes != np.sign(speeds), axis=1)) > 0.3
    assert np.any(modes == 0)
    e = 1e-6

    def slope(vary, count):
        both = [
            [form.step(*vary(s * e * row), h, u).states for s in (1, -1)] for row in np.eye(count)
        ]
        return np.stack([(up - down) / (2 * e) for up, down in both], axis=-1)

    by_state = slope(lambda change: (p, x + change), 4)
    by_coefficients = slope(lambda change: (p + change, x), len(p))
    np.testing.assert_allclose(step.by_state, by_state, atol=3e-5)
    np.testing.assert_allclose(step.by_coefficients, by_coefficients, atol=3e-5)
